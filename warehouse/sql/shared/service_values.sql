-- What is known of each production value that fleet and wheelset pages need: where the wheelset runs, under which
-- calibration and reference it was measured, with which flags. The variables since, until, rig_id and wheelset_id narrow
-- it; one that is not set leaves all in.
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
-- quality_flags: conditions under which the value stands
-- reason: why there is no value
-- calibration_id: calibration of the sensors
-- reference_scan_id: reference scan that set the zero
-- trainset: trainset that the bundle names
-- car: car that the bundle names
-- bogie: bogie that the bundle names
-- axle: axle that the bundle names
-- mileage_km: mileage that the bundle names, in km
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
    quality_flags,
    reason,
    calibration_id,
    reference_scan_id,
    trainset,
    car,
    bogie,
    axle,
    mileage_km
FROM measurements
WHERE purpose = 'production'
    AND (getvariable('since') IS NULL OR acquired_on >= getvariable('since')::DATE)
    AND (getvariable('until') IS NULL OR acquired_on <= getvariable('until')::DATE)
    AND (getvariable('rig_id') IS NULL OR rig_id = getvariable('rig_id')::VARCHAR)
    AND (getvariable('wheelset_id') IS NULL OR wheelset_id = getvariable('wheelset_id')::VARCHAR)
