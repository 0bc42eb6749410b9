-- Which board poses were left out, and why?
--
-- Columns
-- calibration_id: calibration bundle
-- sensor_id: stereo sensor
-- pose: file name of the pose
-- reason: why it did not enter the fit
SELECT
    p.calibration_id,
    p.sensor_id,
    p.pose,
    p.reason
FROM calibration_poses AS p
JOIN calibrations AS c USING (calibration_id, sensor_id)
WHERE NOT p.used AND c.rig_id = coalesce(getvariable('rig_id'), c.rig_id)
ORDER BY p.calibration_id, p.sensor_id, p.pose
