-- The measurements that a report may use: production scans only, within the asked-for days, rig and wheelset. Reference
-- scans never enter. The variables since, until, rig_id and wheelset_id narrow it; one that is not set leaves all in.
--
-- Columns
-- scan_id: scan bundle
-- wheelset_id: wheelset that was measured
-- rig_id: measuring rig
-- captured_at: when the scan was taken
-- acquired_on: day of the scan in its own time zone
-- quantity: measured quantity
-- side: left, right or both
-- value: value at 20 °C, in unit; null where none could be given
-- unit: unit of value and uncertainty
-- expanded_uncertainty: expanded uncertainty of the value, in unit
-- value_uncompensated: the value without any temperature correction since the reference scan, in unit
-- reason: why there is no value
-- wheelset_temperature_c: wheelset temperature of the scan, °C
-- rig_temperature_c: rig temperature of the scan, °C
SELECT
    scan_id,
    wheelset_id,
    rig_id,
    captured_at,
    acquired_on,
    quantity,
    side,
    value,
    unit,
    expanded_uncertainty,
    value_uncompensated,
    reason,
    wheelset_temperature_c,
    rig_temperature_c
FROM measurements
WHERE purpose = 'production'
    AND (getvariable('since') IS NULL OR acquired_on >= getvariable('since')::DATE)
    AND (getvariable('until') IS NULL OR acquired_on <= getvariable('until')::DATE)
    AND (getvariable('rig_id') IS NULL OR rig_id = getvariable('rig_id')::VARCHAR)
    AND (getvariable('wheelset_id') IS NULL OR wheelset_id = getvariable('wheelset_id')::VARCHAR)
