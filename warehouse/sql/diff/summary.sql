-- How much changed, by quantity?
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- n: values in both versions or in one of them
-- n_changed: values or uncertainties that changed
-- n_gained: values that only version B gives
-- n_lost: values that only version A gives
-- mean_change: mean of new less old, in unit
-- max_change: largest size of a change, in unit
-- max_change_ratio: largest change over the larger U
-- n_beyond: changes of more than U
-- mean_uncertainty_ratio: mean of the new U over the old
-- unit: unit of the values
SELECT
    quantity,
    side,
    count(*) AS n,
    count(*) FILTER (WHERE what = 'changed') AS n_changed,
    count(*) FILTER (WHERE what = 'gained') AS n_gained,
    count(*) FILTER (WHERE what = 'lost') AS n_lost,
    avg(change) AS mean_change,
    max(abs(change)) AS max_change,
    max(change_ratio) AS max_change_ratio,
    count(*) FILTER (WHERE change_ratio > 1) AS n_beyond,
    avg(new_expanded_uncertainty / nullif(old_expanded_uncertainty, 0)) AS mean_uncertainty_ratio,
    any_value(unit) AS unit
FROM diff_values
GROUP BY quantity, side
ORDER BY n_beyond DESC, quantity_order(quantity), quantity, side
