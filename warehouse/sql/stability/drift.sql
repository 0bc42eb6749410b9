-- Do the values drift? A straight line through each wheelset's values over time, with the standard error of its slope
-- and the p-value against no drift; beside it the same without temperature compensation. A month is 365.25 / 12 days.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- n: values
-- span_months: months between the first value and the last
-- drift_um_per_month: slope over time, in µm a month
-- drift_standard_error_um_per_month: its standard error, in µm a month
-- drift_low_um_per_month: lower end of its 95 % interval, in µm a month
-- drift_high_um_per_month: upper end of its 95 % interval, in µm a month
-- drift_p: p-value of the slope against none
-- n_uncompensated: values without temperature correction
-- drift_uncompensated_um_per_month: slope over time without temperature correction, in µm a month
-- drift_uncompensated_standard_error_um_per_month: its standard error, in µm a month
-- drift_uncompensated_p: its p-value
WITH courses AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        1000 * (value_mm - avg(value_mm) OVER course) AS deviation_um,
        1000 * (value_uncompensated_mm - avg(value_uncompensated_mm) OVER course) AS uncompensated_um,
        epoch_us(captured_at - min(captured_at) OVER course) / (86400e6 * 365.25 / 12) AS months
    FROM stability_values
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side)
),

sums AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        count(*) AS n,
        max(months) AS span_months,
        regr_sxx(deviation_um, months) AS sxx,
        regr_sxy(deviation_um, months) AS sxy,
        regr_syy(deviation_um, months) AS syy,
        count(uncompensated_um) AS n_uncompensated,
        regr_sxx(uncompensated_um, months) AS sxx_uncompensated,
        regr_sxy(uncompensated_um, months) AS sxy_uncompensated,
        regr_syy(uncompensated_um, months) AS syy_uncompensated
    FROM courses
    GROUP BY wheelset_id, quantity, side
),

slopes AS (
    SELECT
        *,
        sxy / nullif(sxx, 0) AS slope,
        sqrt(greatest(syy - sxy ** 2 / nullif(sxx, 0), 0) / nullif(n - 2, 0) / nullif(sxx, 0)) AS slope_error,
        sxy_uncompensated / nullif(sxx_uncompensated, 0) AS slope_uncompensated,
        sqrt(
            greatest(syy_uncompensated - sxy_uncompensated ** 2 / nullif(sxx_uncompensated, 0), 0)
            / nullif(n_uncompensated - 2, 0) / nullif(sxx_uncompensated, 0)
        ) AS slope_uncompensated_error
    FROM sums
)

SELECT
    wheelset_id,
    quantity,
    side,
    n,
    span_months,
    slope AS drift_um_per_month,
    slope_error AS drift_standard_error_um_per_month,
    slope - student_t_95(n - 2) * slope_error AS drift_low_um_per_month,
    slope + student_t_95(n - 2) * slope_error AS drift_high_um_per_month,
    student_t_p(slope / nullif(slope_error, 0), n - 2) AS drift_p,
    n_uncompensated,
    slope_uncompensated AS drift_uncompensated_um_per_month,
    slope_uncompensated_error AS drift_uncompensated_standard_error_um_per_month,
    student_t_p(slope_uncompensated / nullif(slope_uncompensated_error, 0), n_uncompensated - 2)
        AS drift_uncompensated_p
FROM slopes
WHERE n > 1
ORDER BY wheelset_id, quantity_order(quantity), side
