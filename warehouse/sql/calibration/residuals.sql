-- Where in the images do the corners of each rig's newest calibration lie, and which way do they miss? Of each camera's
-- corners evenly at most 600; `calibration_corners` has them all.
--
-- Columns
-- calibration_id: calibration bundle
-- sensor_id: stereo sensor
-- camera: left or right
-- pose: file name of the pose
-- corner: number of the inner corner
-- u_px: column of the corner
-- v_px: row of the corner
-- residual_u_px: projection by the calibration less u
-- residual_v_px: projection by the calibration less v
-- image_width_px: width of the image
-- image_height_px: height of the image
WITH newest AS (
    SELECT
        calibration_id,
        sensor_id,
        image_width_px,
        image_height_px
    FROM calibrations
    WHERE state = 'usable' AND rig_id = coalesce(getvariable('rig_id'), rig_id)
    QUALIFY captured_at = max(captured_at) OVER (PARTITION BY rig_id)
),
numbered AS (
    SELECT
        *,
        row_number() OVER one - 1 AS number,
        count(*) OVER (PARTITION BY calibration_id, sensor_id, camera) AS n
    FROM calibration_corners
    WINDOW one AS (PARTITION BY calibration_id, sensor_id, camera ORDER BY pose, corner)
)
SELECT
    calibration_id,
    sensor_id,
    c.camera,
    c.pose,
    c.corner,
    c.u_px,
    c.v_px,
    c.residual_u_px,
    c.residual_v_px,
    n.image_width_px,
    n.image_height_px
FROM numbered AS c
JOIN newest AS n USING (calibration_id, sensor_id)
WHERE c.number % ceil(c.n / 600) = 0
ORDER BY calibration_id, sensor_id, c.camera, c.pose, c.corner
