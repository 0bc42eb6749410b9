-- Between which limits should the days lie if nothing but chance moved them? Two estimates of chance: from the moving range
-- of successive day means (individuals chart: mean ± 3 MR / 1.128), and from the scatter within the days (mean-and-s chart).
-- If the second is much the smaller, days differ by more than repeats do: reference, calibration or temperature.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- n_days: days
-- n: values
-- center_mm: mean of the day means
-- moving_range_um: mean moving range of the day means, in µm
-- sigma_between_um: standard deviation of a day mean by the moving range (d2 = 1.128), in µm
-- lower_limit_mm: lower limit of the individuals chart
-- upper_limit_mm: upper limit of the individuals chart
-- moving_range_limit_um: upper limit of the moving range (D4 = 3.267), in µm
-- sigma_within_um: standard deviation within a day, pooled, in µm
-- sigma_ratio: scatter of the day means over what the scatter within the days explains
-- ewma_lower_limit_mm: lower limit of the EWMA chart (lambda 0.2, 3 sigma, settled)
-- ewma_upper_limit_mm: upper limit of the EWMA chart
-- sigma_between_uncompensated_um: as sigma_between_um, without temperature correction, in µm
WITH moved AS (
    SELECT
        *,
        1000 * abs(mean_mm - lag(mean_mm) OVER course) AS moving_range_um,
        1000 * abs(mean_uncompensated_mm - lag(mean_uncompensated_mm) OVER course) AS moving_range_uncompensated_um
    FROM stability_days
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on)
),

sums AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        count(*) AS n_days,
        sum(n)::BIGINT AS n,
        avg(mean_mm) AS center_mm,
        avg(moving_range_um) AS moving_range_um,
        avg(moving_range_um) / 1.128 AS sigma_between_um,
        avg(moving_range_uncompensated_um) / 1.128 AS sigma_between_uncompensated_um,
        sqrt(sum((n - 1) * standard_deviation_um ** 2) / nullif(sum(n - 1), 0)) AS sigma_within_um,
        avg(1.0 / n) AS inverse_n
    FROM moved
    GROUP BY wheelset_id, quantity, side
)

SELECT
    wheelset_id,
    quantity,
    side,
    n_days,
    n,
    center_mm,
    moving_range_um,
    sigma_between_um,
    center_mm - 3 * sigma_between_um / 1000 AS lower_limit_mm,
    center_mm + 3 * sigma_between_um / 1000 AS upper_limit_mm,
    3.267 * moving_range_um AS moving_range_limit_um,
    sigma_within_um,
    sigma_between_um / nullif(sigma_within_um * sqrt(inverse_n), 0) AS sigma_ratio,
    center_mm - 3 * sigma_between_um / 1000 * sqrt(0.2 / 1.8) AS ewma_lower_limit_mm,
    center_mm + 3 * sigma_between_um / 1000 * sqrt(0.2 / 1.8) AS ewma_upper_limit_mm,
    sigma_between_uncompensated_um
FROM sums
WHERE n_days > 2
ORDER BY wheelset_id, quantity_order(quantity), side
