-- How far is each value from an independent review? Every production value in mm is set against the review of the same
-- wheelset, quantity and side that is nearest in time; of two equally near, the later. Certificates are no reviews: they
-- set the zero of the machine and would agree with themselves.
--
-- Columns
-- scan_id: scan bundle
-- wheelset_id: wheelset that was measured
-- captured_at: when the scan was taken
-- quantity: measured quantity
-- side: left, right or both
-- measured_mm: measured value at 20 °C
-- expanded_uncertainty_mm: expanded uncertainty U of the measured value
-- reference_mm: the review's value at 20 °C
-- reference_expanded_uncertainty_mm: expanded uncertainty U of the review's value
-- reference_measured_at: when the review was made
-- reference_instrument: instrument of the review
-- days_to_reference: days from the scan to the review, negative if the review came first
-- mean_mm: mean of measured and reference
-- error_um: measured minus reference, in µm
-- e_n: error divided by the root sum of squares of both expanded uncertainties; within ±1 the two agree
WITH candidates AS (
    SELECT
        production.*,
        review.value_mm AS reference_mm,
        review.expanded_uncertainty_mm AS reference_expanded_uncertainty_mm,
        review.measured_at AS reference_measured_at,
        review.instrument AS reference_instrument,
        (epoch_us(review.measured_at) - epoch_us(production.captured_at)) / 86400e6 AS days_to_reference
    FROM production_values AS production
    INNER JOIN reference_values AS review USING (wheelset_id, quantity, side)
    WHERE review.source = 'cmm'
        AND review.value_mm IS NOT NULL
        AND production.value IS NOT NULL
        AND production.unit = 'mm'
    QUALIFY row_number() OVER (
        PARTITION BY scan_id, quantity, side
        ORDER BY
            abs(epoch_us(review.measured_at) - epoch_us(production.captured_at)),
            review.measured_at DESC,
            review.expanded_uncertainty_mm,
            review.instrument,
            review.value_mm
    ) = 1
)
SELECT
    scan_id,
    wheelset_id,
    captured_at,
    quantity,
    side,
    value AS measured_mm,
    expanded_uncertainty AS expanded_uncertainty_mm,
    reference_mm,
    reference_expanded_uncertainty_mm,
    reference_measured_at,
    reference_instrument,
    days_to_reference,
    (value + reference_mm) / 2 AS mean_mm,
    1000 * (value - reference_mm) AS error_um,
    (value - reference_mm)
    / nullif(sqrt(expanded_uncertainty ** 2 + coalesce(reference_expanded_uncertainty_mm, 0) ** 2), 0) AS e_n
FROM candidates
ORDER BY quantity_order(quantity), quantity, side, captured_at, scan_id
