-- How good is each sensor's calibration, and what does it cover?
--
-- Columns
-- rig_id: measuring rig
-- calibration_id: calibration bundle
-- sensor_id: stereo sensor
-- captured_at: when the boards were seen
-- state: usable or refused
-- n_poses: board poses in the bundle
-- n_poses_used: poses that entered the fit
-- left_rms_px: RMS residual of the left camera
-- right_rms_px: RMS residual of the right camera
-- stereo_rms_px: RMS residual over both
-- holdout_rms_px: RMS over poses under fits that did not use them
-- epipolar_rms_px: RMS distance of corners from their epipolar lines
-- baseline_mm: distance between the cameras
-- u_baseline_um: its standard uncertainty, in µm
-- square_edge_error_um: mean triangulated edge of the squares less its median over the calibration's sensors, in µm
-- coverage_ratio: share of the left image that corners cover
-- right_coverage_ratio: share of the right image that corners cover
-- max_tilt_deg: largest tilt of a board
-- nearest_mm: smallest depth of a corner
-- farthest_mm: largest depth of a corner
-- distortion_model: lens model
-- rival_model: lens model that it was tried against
-- rival_holdout_rms_px: the rival's hold-out RMS
-- rig_temperature_c: rig temperature at the calibration
-- age_days: from the calibration to the newest scan of the rig, in days
-- valid_from: start of validity stated in the bundle
-- valid_until: end of validity stated in the bundle
WITH newest AS (SELECT rig_id, max(captured_at) AS last_at FROM scan_status GROUP BY rig_id),
variances AS (
    SELECT
        calibration_id,
        sensor_id,
        len(parameter_names) AS n,
        covariance,
        right_from_left
    FROM calibrations
    WHERE state = 'usable'
)
SELECT
    c.rig_id,
    c.calibration_id,
    c.sensor_id,
    c.captured_at,
    c.state,
    c.n_poses,
    c.n_poses_used,
    c.left_rms_px,
    c.right_rms_px,
    c.stereo_rms_px,
    c.holdout_rms_px,
    c.epipolar_rms_px,
    c.baseline_mm,
    -- direction of T times the last three rows and columns of the covariance
    1000 * sqrt(list_sum([
        list_sum([
            v.right_from_left[4 * i] * v.right_from_left[4 * j]
            * v.covariance[(v.n - 4 + i) * v.n + v.n - 3 + j]
            for j in [1, 2, 3]
        ])
        for i in [1, 2, 3]
    ])) / c.baseline_mm AS u_baseline_um,
    1000 * (c.square_edge_mean_mm - median(c.square_edge_mean_mm) OVER (PARTITION BY c.calibration_id))
        AS square_edge_error_um,
    c.coverage_ratio,
    c.right_coverage_ratio,
    c.max_tilt_deg,
    c.depth_range_mm[1] AS nearest_mm,
    c.depth_range_mm[2] AS farthest_mm,
    c.distortion_model,
    c.rival_model,
    c.rival_holdout_rms_px,
    c.rig_temperature_c,
    date_diff('second', c.captured_at, n.last_at) / 86400.0 AS age_days,
    c.valid_from,
    c.valid_until
FROM calibrations AS c
LEFT JOIN newest AS n USING (rig_id)
LEFT JOIN variances AS v USING (calibration_id, sensor_id)
WHERE c.rig_id = coalesce(getvariable('rig_id'), c.rig_id)
ORDER BY c.rig_id, c.captured_at, c.calibration_id, c.sensor_id
