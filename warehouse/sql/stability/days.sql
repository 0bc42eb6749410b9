-- What did each day say? Scans of one day share reference, calibration and temperature, so that the day is the natural
-- group of a control chart: its mean is an individual value, its standard deviation the scatter within.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- acquired_on: day
-- n: values
-- mean_mm: mean value at 20 °C
-- standard_deviation_um: sample standard deviation within the day (n - 1), in µm
-- mean_uncompensated_mm: mean value without temperature correction
-- mean_wheelset_temperature_c: mean wheelset temperature, °C
SELECT
    wheelset_id,
    quantity,
    side,
    acquired_on,
    count(*) AS n,
    avg(value_mm) AS mean_mm,
    1000 * stddev_samp(value_mm) AS standard_deviation_um,
    avg(value_uncompensated_mm) AS mean_uncompensated_mm,
    avg(wheelset_temperature_c) AS mean_wheelset_temperature_c
FROM stability_values
GROUP BY wheelset_id, quantity, side, acquired_on
ORDER BY wheelset_id, quantity_order(quantity), side, acquired_on
