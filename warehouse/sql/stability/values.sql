-- What was measured, when and how warm, on the six dimensions of the paper's Fig. 2?
--
-- Columns
-- scan_id: scan bundle
-- wheelset_id: wheelset that was measured
-- rig_id: measuring rig
-- captured_at: when the scan was taken
-- acquired_on: day of the scan in its own time zone
-- month: first day of the month, in the scan's own time zone
-- quantity: measured quantity
-- side: left, right or both
-- value_mm: value at 20 °C
-- expanded_uncertainty_mm: expanded uncertainty U of the value
-- value_uncompensated_mm: the value without any temperature correction since the reference scan
-- wheelset_temperature_c: wheelset temperature, °C
-- rig_temperature_c: rig temperature, °C
SELECT
    scan_id,
    wheelset_id,
    rig_id,
    captured_at,
    acquired_on,
    date_trunc('month', acquired_on)::DATE AS month,
    quantity,
    side,
    value AS value_mm,
    expanded_uncertainty AS expanded_uncertainty_mm,
    value_uncompensated AS value_uncompensated_mm,
    wheelset_temperature_c,
    rig_temperature_c
FROM production_values
WHERE value IS NOT NULL
    AND unit = 'mm'
    AND quantity IN ('journal_diameter', 'wheel_diameter', 'shoulder_distance', 'inner_distance')
ORDER BY wheelset_id, quantity_order(quantity), side, captured_at, scan_id
