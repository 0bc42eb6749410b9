-- What went wrong on the last day with scans, and why? Scans that were refused or failed, and values that a measured scan
-- did not give.
--
-- Columns
-- scan_id: scan bundle
-- wheelset_id: wheelset, where the bundle could be read
-- rig_id: measuring rig
-- captured_at: when the scan was taken
-- what: refused, failed, pending, or the value that is missing
-- stage: stage that stopped it
-- reason: why
-- recording: recording of the scan, for the rerun viewer
WITH last_day AS (SELECT as_of FROM fleet_day)

SELECT
    scan_id,
    wheelset_id,
    rig_id,
    captured_at,
    state AS what,
    stage,
    reason,
    recording
FROM scan_status
WHERE state <> 'measured'
    AND (acquired_on IS NULL OR acquired_on = (SELECT as_of FROM last_day))
    AND (getvariable('rig_id') IS NULL OR rig_id IS NULL OR rig_id = getvariable('rig_id')::VARCHAR)
    AND (getvariable('wheelset_id') IS NULL OR wheelset_id IS NULL OR wheelset_id = getvariable('wheelset_id')::VARCHAR)
UNION ALL
SELECT
    scan_id,
    wheelset_id,
    rig_id,
    captured_at,
    quantity || ' ' || side AS what,
    'measurements' AS stage,
    reason,
    NULL AS recording
FROM service_values
WHERE value IS NULL
    AND acquired_on = (SELECT as_of FROM last_day)
ORDER BY captured_at NULLS FIRST, scan_id, what
