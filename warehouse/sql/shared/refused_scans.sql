-- Which scans gave nothing because they were refused (the bundle cannot be used) or failed (a stage could not do its
-- work), and why. Reference scans included: without one the scans after it have no zero. Not narrowed by wheelset, which
-- a refused bundle may not even tell.
--
-- Columns
-- scan_id: scan bundle
-- rig_id: measuring rig; null where the bundle cannot be read
-- purpose: production or reference; null where the bundle cannot be read
-- captured_at: when the scan was taken; null where the bundle cannot be read
-- state: refused or failed
-- stage: stage that stopped it
-- reason: why
SELECT
    scan_id,
    rig_id,
    purpose,
    captured_at,
    state,
    stage,
    reason
FROM scan_status
WHERE state IN ('refused', 'failed')
    AND (getvariable('since') IS NULL OR acquired_on IS NULL OR acquired_on >= getvariable('since')::DATE)
    AND (getvariable('until') IS NULL OR acquired_on IS NULL OR acquired_on <= getvariable('until')::DATE)
    AND (getvariable('rig_id') IS NULL OR rig_id IS NULL OR rig_id = getvariable('rig_id')::VARCHAR)
ORDER BY captured_at NULLS FIRST, scan_id
