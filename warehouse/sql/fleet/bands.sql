-- Where do the trends of the plotted values lead? The line and its 95 % interval (scatter of the visits and the values' own
-- U) from the first visit since the last turning to sixty days after the report's day, at forty places.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: deciding quantity
-- side: left, right or both
-- place: place of the wheelset in the list of those to be turned
-- day_at: time
-- value: the line
-- value_low: lower end of the interval
-- value_high: upper end of the interval
WITH shown AS (
    SELECT DISTINCT wheelset_id, quantity, side, place FROM fleet_courses
),

grid AS (
    SELECT
        shown.place,
        trend.*,
        epoch(trend.since_on) / 86400.0 AS first_day,
        epoch(as_of) / 86400.0 + 60 AS last_day,
        first_day + (last_day - first_day) * unnest(range(40)) / 39 AS day,
        epoch_us(trend.mean_at) / 86400e6 AS mean_day
    FROM fleet_trends AS trend
    INNER JOIN shown USING (wheelset_id, quantity, side)
    CROSS JOIN (SELECT as_of FROM fleet_day)
),

lines AS (
    SELECT
        *,
        mean_value + change_per_month / (365.25 / 12) * (day - mean_day) AS line,
        sqrt(
            expanded_uncertainty ** 2
            + (student_t_95(n_visits - 2) * residual_standard_deviation) ** 2
            * (1 / n_visits + (day - mean_day) ** 2 / sxx_days2)
        ) AS half
    FROM grid
)

SELECT
    wheelset_id,
    quantity,
    side,
    place,
    make_timestamptz((day * 86400e6)::BIGINT) AS day_at,
    line AS value,
    line - half AS value_low,
    line + half AS value_high
FROM lines
ORDER BY place, day_at
