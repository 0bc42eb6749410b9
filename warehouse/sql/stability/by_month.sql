-- How well did the values repeat within each month, with and without temperature compensation?
-- A range grows with the number of values: read it with n.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- month: first day of the month
-- n: values
-- mean_mm: mean value at 20 °C
-- from_review_um: mean value minus the review, in µm
-- standard_deviation_um: sample standard deviation (n - 1), in µm
-- range_um: largest minus smallest value, in µm
-- standard_deviation_uncompensated_um: standard deviation without temperature correction, in µm
-- range_uncompensated_um: largest minus smallest value without temperature correction, in µm
-- mean_wheelset_temperature_c: mean wheelset temperature, °C
-- mean_rig_temperature_c: mean rig temperature, °C
-- mean_captured_at: mean time of the values
SELECT
    wheelset_id,
    quantity,
    side,
    month,
    count(*) AS n,
    avg(value_mm) AS mean_mm,
    1000 * avg(value_mm - review_mm) AS from_review_um,
    1000 * stddev_samp(value_mm) AS standard_deviation_um,
    1000 * (max(value_mm) - min(value_mm)) AS range_um,
    1000 * stddev_samp(value_uncompensated_mm) AS standard_deviation_uncompensated_um,
    1000 * (max(value_uncompensated_mm) - min(value_uncompensated_mm)) AS range_uncompensated_um,
    avg(wheelset_temperature_c) AS mean_wheelset_temperature_c,
    avg(rig_temperature_c) AS mean_rig_temperature_c,
    make_timestamptz(avg(epoch_us(captured_at))::BIGINT) AS mean_captured_at
FROM stability_values
LEFT JOIN stability_reviews USING (wheelset_id, quantity, side)
GROUP BY wheelset_id, quantity, side, month
ORDER BY wheelset_id, quantity_order(quantity), side, month
