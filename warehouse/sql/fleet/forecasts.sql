-- When will each value reach each limit that applies to it? The trend since the last turning is carried forward; where
-- there is none (fewer than three visits), the last value stands. Uncertainty of the estimate: the value's own U / 2, taken
-- as common to all visits, and the line's. The earliest and latest day are Fieller's interval (95 %); where the trend is
-- not significant there is no latest day. Days more than ten years ahead are left out.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- level: level of the limit
-- bound: min or max
-- limit_value: the limit, in unit
-- unit: unit of the values
-- value_now: estimate for the report's day
-- value_in_a_week: estimate for seven days later
-- expanded_uncertainty_in_a_week: expanded uncertainty of that estimate (k = 2)
-- margin: distance to the limit on the report's day, negative beyond it
-- beyond_now_probability: probability that the true value is beyond the limit on the report's day
-- beyond_in_a_week_probability: probability that it will be seven days later
-- reaches_on: day on which the line reaches the limit
-- earliest_on: earliest day of the 95 % interval
-- latest_on: latest day of the interval; null if it may never come
-- outlook: the same in words
-- n_visits: visits since the last turning
WITH limits_now AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        level,
        unit,
        expanded_uncertainty,
        value,
        measured_on,
        unnest(['min', 'max']) AS bound,
        unnest([limit_min, limit_max]) AS limit_value,
        unnest([-1, 1]) AS outward
    FROM fleet_state
    WHERE level IN ('operating', 'planning')
),

lines AS (
    SELECT
        here.* EXCLUDE (expanded_uncertainty),
        coalesce(trend.n_visits, 0) AS n_trend,
        coalesce(trend.expanded_uncertainty, here.expanded_uncertainty) AS expanded_uncertainty,
        epoch(as_of) / 86400.0 + 0.5 AS today,
        coalesce(epoch_us(trend.mean_at) / 86400e6, today) AS mean_day,
        coalesce(trend.mean_value, here.value) AS mean_value,
        coalesce(trend.change_per_month / (365.25 / 12), 0) AS slope,
        coalesce(trend.residual_standard_deviation, 0) AS scatter,
        coalesce(trend.sxx_days2, 1) AS sxx,
        student_t_95(trend.n_visits - 2) AS student
    FROM limits_now AS here
    CROSS JOIN (SELECT as_of FROM fleet_day)
    LEFT JOIN fleet_trends AS trend USING (wheelset_id, quantity, side)
    WHERE here.limit_value IS NOT NULL
),

estimates AS (
    SELECT
        *,
        (expanded_uncertainty / 2) ** 2 AS variance_common,
        CASE WHEN n_trend > 0 THEN scatter ** 2 * (1 / n_trend + (today - mean_day) ** 2 / sxx) ELSE 0 END
            AS variance_now,
        CASE WHEN n_trend > 0 THEN scatter ** 2 * (1 / n_trend + (today + 7 - mean_day) ** 2 / sxx) ELSE 0 END
            AS variance_then,
        mean_value + slope * (today - mean_day) AS value_now,
        mean_value + slope * (today + 7 - mean_day) AS value_then,
        slope ** 2 - coalesce(student * scatter, 0) ** 2 / sxx AS a,
        slope * (limit_value - mean_value) AS b,
        (limit_value - mean_value) ** 2 - expanded_uncertainty ** 2
        - coalesce(student * scatter, 0) ** 2 / greatest(n_trend, 1) AS c
    FROM lines
),

chances AS (
    SELECT
        *,
        outward * (limit_value - value_now) AS margin,
        student_t_tail(
            outward * (limit_value - value_now) / sqrt(variance_common + variance_now),
            CASE WHEN variance_now > 0
                THEN least(1e6, floor((variance_common + variance_now) ** 2 / (variance_now ** 2 / (n_trend - 2)) + 1e-9))
                ELSE 1e6
            END::BIGINT
        ) AS beyond_now,
        student_t_tail(
            outward * (limit_value - value_then) / sqrt(variance_common + variance_then),
            CASE WHEN variance_then > 0
                THEN least(
                    1e6, floor((variance_common + variance_then) ** 2 / (variance_then ** 2 / (n_trend - 2)) + 1e-9)
                )
                ELSE 1e6
            END::BIGINT
        ) AS beyond_then,
        CASE WHEN n_trend > 0 AND outward * slope > 0 THEN mean_day + (limit_value - mean_value) / slope END AS reach,
        CASE
            WHEN n_trend = 0 THEN NULL
            WHEN b ** 2 < a * c THEN today
            WHEN a > 0 AND outward * slope > 0 THEN mean_day + (b - sqrt(b ** 2 - a * c)) / a
            WHEN a < 0 THEN mean_day + greatest((b - sqrt(b ** 2 - a * c)) / a, (b + sqrt(b ** 2 - a * c)) / a)
        END AS earliest,
        CASE
            WHEN n_trend > 0 AND a > 0 AND outward * slope > 0 THEN mean_day + (b + sqrt(b ** 2 - a * c)) / a
        END AS latest
    FROM estimates
),

days AS (
    SELECT
        *,
        CASE WHEN margin > 0 AND reach - today BETWEEN 0 AND 3652 THEN reach END AS reach_day,
        CASE WHEN margin > 0 AND earliest - today < 3652 THEN greatest(earliest, today) END AS earliest_day,
        CASE WHEN margin > 0 AND latest - today < 3652 THEN greatest(latest, today) END AS latest_day
    FROM chances
)

SELECT
    wheelset_id,
    quantity,
    side,
    level,
    bound,
    limit_value,
    unit,
    value_now,
    value_then AS value_in_a_week,
    2 * sqrt(variance_common + variance_then) AS expanded_uncertainty_in_a_week,
    margin,
    beyond_now AS beyond_now_probability,
    beyond_then AS beyond_in_a_week_probability,
    make_timestamp((reach_day * 86400e6)::BIGINT)::DATE AS reaches_on,
    make_timestamp((earliest_day * 86400e6)::BIGINT)::DATE AS earliest_on,
    make_timestamp((latest_day * 86400e6)::BIGINT)::DATE AS latest_on,
    CASE
        WHEN margin <= 0 THEN 'beyond it now'
        WHEN n_trend = 0 THEN 'no trend: fewer than three visits since the last turning'
        WHEN reach_day IS NULL AND earliest_day IS NULL THEN 'not within ten years'
        WHEN reach_day IS NULL THEN 'not by the trend; within its interval from ' || earliest_on
        WHEN latest_day IS NULL THEN 'about ' || reaches_on || ', from ' || earliest_on || ', perhaps never'
        ELSE 'about ' || reaches_on || ', between ' || earliest_on || ' and ' || latest_on
    END AS outlook,
    n_trend AS n_visits
FROM days
ORDER BY beyond_in_a_week_probability DESC, wheelset_id, quantity, side, level, bound
