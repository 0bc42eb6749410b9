-- Between which limits do 95 % of the differences between machine and review lie (Bland and Altman), and do they grow
-- with the size? A slope is given only where the sizes differ by 1 mm or more.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- n: pairs of a value and a review
-- lower_limit_um: mean error less 1.96 standard deviations, in µm
-- lower_limit_low_um: lower end of that limit's 95 % interval, in µm
-- lower_limit_high_um: upper end of that limit's 95 % interval, in µm
-- upper_limit_um: mean error plus 1.96 standard deviations, in µm
-- upper_limit_low_um: lower end of that limit's 95 % interval, in µm
-- upper_limit_high_um: upper end of that limit's 95 % interval, in µm
-- smallest_mm: smallest size, as the mean of machine and review
-- largest_mm: largest size
-- slope_um_per_mm: change of the error with size, in µm per mm
-- slope_p: p-value of that slope against none
WITH sizes AS (
    SELECT
        quantity,
        side,
        error_um,
        mean_mm,
        mean_mm - avg(mean_mm) OVER same AS centred_mm
    FROM accuracy_pairs
    WINDOW same AS (PARTITION BY quantity, side)
),

spread AS (
    SELECT
        quantity,
        side,
        count(*) AS n,
        avg(error_um) AS bias_um,
        1.96 * stddev_samp(error_um) AS half_um,
        student_t_95(count(*) - 1) * stddev_samp(error_um) * sqrt(3 / count(*)) AS limit_half_um,
        min(mean_mm) AS smallest_mm,
        max(mean_mm) AS largest_mm,
        CASE WHEN max(mean_mm) - min(mean_mm) >= 1 THEN regr_slope(error_um, centred_mm) END AS slope_um_per_mm,
        regr_sxx(error_um, centred_mm) AS sxx,
        regr_syy(error_um, centred_mm) AS syy
    FROM sizes
    GROUP BY quantity, side
)

SELECT
    quantity,
    side,
    n,
    bias_um - half_um AS lower_limit_um,
    bias_um - half_um - limit_half_um AS lower_limit_low_um,
    bias_um - half_um + limit_half_um AS lower_limit_high_um,
    bias_um + half_um AS upper_limit_um,
    bias_um + half_um - limit_half_um AS upper_limit_low_um,
    bias_um + half_um + limit_half_um AS upper_limit_high_um,
    smallest_mm,
    largest_mm,
    slope_um_per_mm,
    student_t_p(
        slope_um_per_mm / nullif(sqrt(greatest(syy - slope_um_per_mm ** 2 * sxx, 0) / nullif(n - 2, 0) / sxx), 0),
        n - 2
    ) AS slope_p
FROM spread
ORDER BY quantity_order(quantity), quantity, side
