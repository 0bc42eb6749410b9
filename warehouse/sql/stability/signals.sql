-- Which series are out of control, by which rules, and since when?
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- n_days: days
-- n_days_with_signal: days with any signal
-- n_nelson: days that break a rule of Nelson
-- rules: the rules that are broken
-- n_ewma: days on which the weighted mean is outside its limits
-- n_mean: days whose mean the scatter within days does not explain
-- first_on: first day with a signal
-- last_on: last day with a signal
SELECT
    wheelset_id,
    quantity,
    side,
    count(*) AS n_days,
    count(*) FILTER (WHERE n_signals > 0) AS n_days_with_signal,
    count(*) FILTER (WHERE rules <> '') AS n_nelson,
    array_to_string(list_sort(list_distinct(flatten(list(string_split(rules, ', ')) FILTER (WHERE rules <> '')))), ', ')
        AS rules,
    count(*) FILTER (WHERE contains(signals, 'EWMA')) AS n_ewma,
    count(*) FILTER (WHERE contains(signals, 'mean against')) AS n_mean,
    min(acquired_on) FILTER (WHERE n_signals > 0) AS first_on,
    max(acquired_on) FILTER (WHERE n_signals > 0) AS last_on
FROM stability_control
GROUP BY wheelset_id, quantity, side
ORDER BY n_nelson DESC, n_days_with_signal DESC, wheelset_id, quantity_order(quantity), side
