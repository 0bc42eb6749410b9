-- Which values with a limit does a rig never give, and why? At least ten scans of it were to give the value, and none did: its
-- sensors do not see what the value needs. To measure again cannot help; these limits must be checked in another way.
--
-- Columns
-- rig_id: measuring rig
-- quantity: measured quantity
-- side: left, right or both
-- n_scans: scans that were to give the value
-- reason: why there is no value, most often
-- since_on: day of the first of the scans
SELECT
    rig_id,
    quantity,
    side,
    count(*) AS n_scans,
    mode(reason) AS reason,
    min(acquired_on) AS since_on
FROM measurements
WHERE purpose = 'production'
    AND quantity IN (SELECT quantity FROM limits)
    AND (getvariable('until') IS NULL OR acquired_on <= getvariable('until')::DATE)
    AND (getvariable('rig_id') IS NULL OR rig_id = getvariable('rig_id')::VARCHAR)
GROUP BY rig_id, quantity, side
HAVING count(value) = 0 AND count(*) >= 10
ORDER BY rig_id, quantity_order(quantity), quantity, side
