-- How fast does each value change? A straight line through the visits since the last turning, for three visits or more.
-- The interval is Student's, from the scatter about the line; a month is 365.25 / 12 days.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- unit: unit of the value
-- n_visits: visits since the last turning
-- since_on: first of them
-- last_on: last of them
-- change_per_month: slope over time, in unit a month
-- change_low_per_month: lower end of its 95 % interval
-- change_high_per_month: upper end of its 95 % interval
-- change_p: p-value of the slope against no change
-- change_per_10000_km: slope over mileage, in unit per 10,000 km, where every visit names its mileage
-- mean_at: mean time of the visits
-- mean_value: mean of the values
-- residual_standard_deviation: scatter of the visits about the line, in unit
-- sxx_days2: sum of squares of the visits' times about their mean, in days²
-- expanded_uncertainty: expanded uncertainty of the last visit's value
WITH latest AS (
    SELECT visits.*
    FROM fleet_visits AS visits
    INNER JOIN (
        SELECT wheelset_id, quantity, side, max(n_turnings) AS n_turnings
        FROM fleet_visits
        GROUP BY wheelset_id, quantity, side
    ) USING (wheelset_id, quantity, side, n_turnings)
),

centred AS (
    SELECT
        *,
        epoch_us(captured_at) / 86400e6 AS day,
        avg(epoch_us(captured_at) / 86400e6) OVER course AS mean_day,
        avg(value) OVER course AS mean_value,
        mileage_km - avg(mileage_km) OVER course AS centred_km
    FROM latest
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side)
),

sums AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        any_value(unit) AS unit,
        count(*) AS n_visits,
        min(visited_on) AS since_on,
        max(visited_on) AS last_on,
        any_value(mean_day) AS mean_day,
        any_value(mean_value) AS mean_value,
        sum((day - mean_day) ** 2) AS sxx,
        sum((day - mean_day) * (value - mean_value)) AS sxy,
        sum((value - mean_value) ** 2) AS syy,
        CASE WHEN count(centred_km) = count(*) AND max(centred_km) > min(centred_km)
            THEN 1e4 * regr_slope(value - mean_value, centred_km)
        END AS change_per_10000_km,
        arg_max(expanded_uncertainty, visited_on) AS expanded_uncertainty
    FROM centred
    GROUP BY wheelset_id, quantity, side
),

lines AS (
    SELECT
        *,
        sxy / sxx AS slope,
        sqrt(greatest(syy - sxy ** 2 / sxx, 0) / (n_visits - 2)) AS scatter,
        365.25 / 12 AS month_days
    FROM sums
    WHERE n_visits >= 3 AND sxx > 0
)

SELECT
    wheelset_id,
    quantity,
    side,
    unit,
    n_visits,
    since_on,
    last_on,
    slope * month_days AS change_per_month,
    (slope - student_t_95(n_visits - 2) * scatter / sqrt(sxx)) * month_days AS change_low_per_month,
    (slope + student_t_95(n_visits - 2) * scatter / sqrt(sxx)) * month_days AS change_high_per_month,
    student_t_p(slope / nullif(scatter / sqrt(sxx), 0), n_visits - 2) AS change_p,
    CASE WHEN n_visits >= 3 THEN change_per_10000_km END AS change_per_10000_km,
    make_timestamptz((mean_day * 86400e6)::BIGINT) AS mean_at,
    mean_value,
    scatter AS residual_standard_deviation,
    sxx AS sxx_days2,
    expanded_uncertainty
FROM lines
ORDER BY wheelset_id, quantity_order(quantity), quantity, side
