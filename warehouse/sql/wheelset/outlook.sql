-- When will this wheelset reach its limits? See fleet/forecasts.sql for how.
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
-- beyond_in_a_week_probability: probability that the true value is beyond the limit seven days later
-- outlook: when the trend reaches the limit
SELECT
    wheelset_id,
    quantity,
    side,
    level,
    bound,
    limit_value,
    unit,
    value_now,
    value_in_a_week,
    expanded_uncertainty_in_a_week,
    beyond_in_a_week_probability,
    outlook
FROM fleet_forecasts
ORDER BY beyond_in_a_week_probability DESC, margin / expanded_uncertainty_in_a_week, quantity, side, level, bound
