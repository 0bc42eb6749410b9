-- Where is the constant line: what do the independent reviews of each wheelset say, on average over all of them?
-- Their uncertainty is not divided by their number, since one instrument made them.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- n_reviews: reviews
-- review_mm: mean of the reviews, at 20 °C
-- expanded_uncertainty_mm: mean of the reviews' expanded uncertainties
-- range_um: largest minus smallest review, in µm
-- first_at: first review
-- last_at: last review
SELECT
    wheelset_id,
    quantity,
    side,
    count(*) AS n_reviews,
    avg(value_mm) AS review_mm,
    avg(expanded_uncertainty_mm) AS expanded_uncertainty_mm,
    1000 * (max(value_mm) - min(value_mm)) AS range_um,
    min(measured_at) AS first_at,
    max(measured_at) AS last_at
FROM reference_values
WHERE source = 'cmm'
    AND value_mm IS NOT NULL
    AND (wheelset_id, quantity, side) IN (SELECT (wheelset_id, quantity, side) FROM stability_values)
GROUP BY wheelset_id, quantity, side
ORDER BY wheelset_id, quantity_order(quantity), side
