-- Which values are missing though their scan was measured to the end, and why.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- reason: why there is no value
-- n: values not given for this reason
-- n_wheelsets: wheelsets concerned
-- first_on: first day
-- last_on: last day
-- example_scan_id: the last scan concerned
SELECT
    quantity,
    side,
    reason,
    count(*) AS n,
    count(DISTINCT wheelset_id) AS n_wheelsets,
    min(acquired_on) AS first_on,
    max(acquired_on) AS last_on,
    arg_max(scan_id, (captured_at, scan_id)) AS example_scan_id
FROM production_values
WHERE value IS NULL
GROUP BY quantity, side, reason
ORDER BY quantity_order(quantity), quantity, side, n DESC, reason
