-- Which measured values had no review to be compared with, and so say nothing about accuracy here?
--
-- Columns
-- wheelset_id: wheelset
-- why: what is missing
-- n_scans: scans concerned
-- n: values concerned
-- quantities: the quantities concerned, with their sides
-- first_on: first day
-- last_on: last day
WITH lonely AS (
    SELECT
        production.*,
        CASE
            WHEN production.unit <> 'mm' THEN 'a review states lengths in mm'
            WHEN EXISTS (
                FROM reference_values AS review
                WHERE review.source = 'cmm' AND review.wheelset_id = production.wheelset_id
            ) THEN 'no review of this quantity and side'
            ELSE 'no review of this wheelset'
        END AS why
    FROM production_values AS production
    ANTI JOIN accuracy_pairs AS pairs USING (scan_id, quantity, side)
    WHERE production.value IS NOT NULL
)
SELECT
    wheelset_id,
    why,
    count(DISTINCT scan_id) AS n_scans,
    count(*) AS n,
    string_agg(DISTINCT quantity || ' ' || side, ', ' ORDER BY quantity || ' ' || side) AS quantities,
    min(acquired_on) AS first_on,
    max(acquired_on) AS last_on
FROM lonely
GROUP BY wheelset_id, why
ORDER BY wheelset_id, why
