-- Does the error grow with the size (linearity)? The error of every value against its review over the review, straight
-- line; only where the reviewed sizes differ by 1 mm or more. Values of one wheelset share a review, so that the p-values
-- are too small rather than too large.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- n: pairs of a value and a review
-- n_sizes: different reviews
-- bias_um: mean error, in µm
-- smallest_mm: smallest reviewed size
-- largest_mm: largest reviewed size
-- slope_um_per_mm: change of the error with size, in µm per mm
-- slope_standard_error_um_per_mm: its standard error
-- slope_p: p-value of the slope against none
WITH pairs AS (
    SELECT
        quantity,
        side,
        1000 * (value - value_mm) AS error_um,
        value_mm - avg(value_mm) OVER (PARTITION BY quantity, side) AS size_mm,
        value_mm
    FROM production_values
    INNER JOIN (
        SELECT wheelset_id, quantity, side, avg(value_mm) AS value_mm
        FROM reference_values
        WHERE source = 'cmm'
        GROUP BY wheelset_id, quantity, side
    ) USING (wheelset_id, quantity, side)
    WHERE value IS NOT NULL AND unit = 'mm'
),

sums AS (
    SELECT
        quantity,
        side,
        count(*) AS n,
        count(DISTINCT value_mm) AS n_sizes,
        avg(error_um) AS bias_um,
        min(value_mm) AS smallest_mm,
        max(value_mm) AS largest_mm,
        regr_sxx(error_um, size_mm) AS sxx,
        regr_sxy(error_um, size_mm) AS sxy,
        regr_syy(error_um, size_mm) AS syy
    FROM pairs
    GROUP BY quantity, side
    HAVING count(*) > 2 AND max(value_mm) - min(value_mm) >= 1
)

SELECT
    quantity,
    side,
    n,
    n_sizes,
    bias_um,
    smallest_mm,
    largest_mm,
    sxy / sxx AS slope_um_per_mm,
    sqrt(greatest(syy - sxy ** 2 / sxx, 0) / (n - 2) / sxx) AS slope_standard_error_um_per_mm,
    student_t_p(slope_um_per_mm / nullif(slope_standard_error_um_per_mm, 0), n - 2) AS slope_p
FROM sums
ORDER BY quantity_order(quantity), quantity, side
