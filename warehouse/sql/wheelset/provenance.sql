-- Where do the numbers come from? Every scan of the wheelset, newest first, with what became of it, the reference that set
-- its zero, the calibration, the code that made its values, and the recording where there is one. `wheelset lineage SCAN`
-- goes on from here to the sha256 of every raw file.
--
-- Columns
-- scan_id: scan bundle
-- captured_at: when the scan was taken
-- rig_id: measuring rig
-- state: measured, refused, failed or pending
-- reason: why it was refused or failed
-- n_values: values that it gave
-- n_without_value: values that it did not give
-- reference_scan_id: reference scan that set the zero
-- calibration_id: calibration of the sensors
-- wheelset_temperature_c: wheelset temperature, °C
-- rig_temperature_c: rig temperature, °C
-- operator: operator
-- code_version: version of the stage that made the values
-- config_fingerprint: fingerprint of its configuration
-- git_commit: commit of the program
-- recording: recording for the rerun viewer
WITH made AS (
    SELECT
        scan_id,
        any_value(code_version) AS code_version,
        any_value(config_fingerprint) AS config_fingerprint,
        any_value(git_commit) AS git_commit
    FROM lineage
    WHERE output_name = 'measurements' AND superseded_at IS NULL
    GROUP BY scan_id
),

given AS (
    SELECT
        scan_id,
        count(value) AS n_values,
        count(*) - count(value) AS n_without_value,
        any_value(reference_scan_id) AS reference_scan_id,
        any_value(calibration_id) AS calibration_id,
        any_value(wheelset_temperature_c) AS wheelset_temperature_c,
        any_value(rig_temperature_c) AS rig_temperature_c,
        any_value(operator) AS operator
    FROM measurements
    GROUP BY scan_id
)

SELECT
    scan_id,
    captured_at,
    rig_id,
    state,
    reason,
    n_values,
    n_without_value,
    reference_scan_id,
    calibration_id,
    wheelset_temperature_c,
    rig_temperature_c,
    operator,
    code_version,
    config_fingerprint,
    git_commit,
    recording
FROM scan_status
LEFT JOIN given USING (scan_id)
LEFT JOIN made USING (scan_id)
WHERE purpose = 'production'
    AND (getvariable('wheelset_id') IS NULL OR wheelset_id = getvariable('wheelset_id')::VARCHAR)
    AND (getvariable('since') IS NULL OR acquired_on >= getvariable('since')::DATE)
    AND (getvariable('until') IS NULL OR acquired_on <= getvariable('until')::DATE)
ORDER BY captured_at DESC, scan_id
