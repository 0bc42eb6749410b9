-- What went wrong on the last day with scans, and why? Scans that were refused or failed, a row each; then the values that
-- measured scans did not give, a row for each kind and reason, those that the rig has given on other scans first.
--
-- Columns
-- what: refused, failed, pending, or the value that is missing
-- n_scans: scans that it happened to
-- scan_id: scan bundle, the latest of them
-- wheelset_id: its wheelset, where the bundle could be read
-- rig_id: measuring rig
-- captured_at: when that scan was taken
-- stage: stage that stopped it
-- reason: why
-- given_before: whether the rig has given that value in any scan; null for a scan
-- recording: recording of the scan, for the rerun viewer
WITH last_day AS (SELECT as_of FROM fleet_day),

ever AS (
    SELECT
        rig_id,
        quantity,
        side,
        count(value) > 0 AS given_before
    FROM service_values
    GROUP BY rig_id, quantity, side
),

found AS (
    SELECT
        state AS what,
        1 AS n_scans,
        scan_id,
        wheelset_id,
        rig_id,
        captured_at,
        stage,
        reason,
        NULL::BOOLEAN AS given_before,
        recording
    FROM scan_status
    WHERE state <> 'measured'
        AND (acquired_on IS NULL OR acquired_on = (SELECT as_of FROM last_day))
        AND (getvariable('rig_id') IS NULL OR rig_id IS NULL OR rig_id = getvariable('rig_id')::VARCHAR)
        AND (getvariable('wheelset_id') IS NULL OR wheelset_id IS NULL OR wheelset_id = getvariable('wheelset_id')::VARCHAR)
    UNION ALL
    SELECT
        quantity || ' ' || side AS what,
        count(*) AS n_scans,
        max_by(scan_id, (captured_at, scan_id)) AS scan_id,
        max_by(wheelset_id, (captured_at, scan_id)) AS wheelset_id,
        rig_id,
        max(captured_at) AS captured_at,
        'measurements' AS stage,
        reason,
        any_value(given_before) AS given_before,
        NULL AS recording
    FROM service_values
    INNER JOIN ever USING (rig_id, quantity, side)
    WHERE value IS NULL
        AND acquired_on = (SELECT as_of FROM last_day)
    GROUP BY rig_id, quantity, side, reason
)

SELECT * FROM found
ORDER BY given_before IS NOT NULL, given_before DESC, captured_at NULLS FIRST, scan_id, what
