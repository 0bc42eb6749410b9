-- How well does each board pose fit, and how well was it predicted?
--
-- Columns
-- calibration_id: calibration bundle
-- sensor_id: stereo sensor
-- pose: file name of the pose
-- left_rms_px: RMS residual, left
-- right_rms_px: RMS residual, right
-- holdout_rms_px: RMS under a fit that did not use the pose
-- tilt_deg: angle between board and image plane
-- distance_mm: distance of the board's centre from the left camera
SELECT
    p.calibration_id,
    p.sensor_id,
    p.pose,
    p.left_rms_px,
    p.right_rms_px,
    p.holdout_rms_px,
    p.tilt_deg,
    p.distance_mm
FROM calibration_poses AS p
JOIN calibrations AS c USING (calibration_id, sensor_id)
WHERE p.used AND c.rig_id = coalesce(getvariable('rig_id'), c.rig_id)
ORDER BY p.calibration_id, p.sensor_id, p.pose
