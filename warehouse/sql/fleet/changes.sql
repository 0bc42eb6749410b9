-- What changed since each wheelset's visit before the last, and is it more than U explains? The two values share the rig's
-- own errors at best in part; their U are taken as independent, which makes "significant" the safer word.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- visited_on: last visit
-- previous_on: visit before it
-- value: value at the last visit
-- previous_value: value at the visit before
-- change: last less previous, in unit
-- expanded_uncertainty_change: expanded uncertainty of the change
-- unit: unit of the values
-- change_ratio: size of the change over its expanded uncertainty; above 1 it is significant
-- turned_between: whether the wheelset was turned between the two visits
WITH pairs AS (
    SELECT
        *,
        lag(visited_on) OVER course AS previous_on,
        lag(value) OVER course AS previous_value,
        lag(expanded_uncertainty) OVER course AS previous_uncertainty,
        lag(n_turnings) OVER course AS previous_turnings
    FROM fleet_visits
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side ORDER BY visited_on)
)
SELECT
    wheelset_id,
    quantity,
    side,
    visited_on,
    previous_on,
    value,
    previous_value,
    value - previous_value AS change,
    sqrt(expanded_uncertainty ** 2 + previous_uncertainty ** 2) AS expanded_uncertainty_change,
    unit,
    abs(change) / nullif(expanded_uncertainty_change, 0) AS change_ratio,
    n_turnings > previous_turnings AS turned_between
FROM pairs
WHERE last_visit AND previous_on IS NOT NULL
ORDER BY change_ratio DESC, wheelset_id, quantity, side
