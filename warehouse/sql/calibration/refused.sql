-- Which sensors could not be calibrated, and why?
--
-- Columns
-- calibration_id: calibration bundle
-- sensor_id: stereo sensor
-- n_poses: board poses in the bundle
-- reason: why no scan may rest on it
SELECT
    calibration_id,
    sensor_id,
    n_poses,
    reason
FROM calibrations
WHERE state = 'refused' AND rig_id = coalesce(getvariable('rig_id'), rig_id)
ORDER BY calibration_id, sensor_id
