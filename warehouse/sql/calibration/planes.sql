-- Where did the laser planes lie in each scan, against the first scan under the same calibration?
--
-- Columns
-- scan_id: scan bundle
-- sensor_id: stereo sensor
-- line: laser line
-- calibration_id: calibration that the scan was triangulated with
-- n_points: points on the plane
-- n_off_plane: points left out as mismatches
-- n_frames_out_of_step: frames left out because the two cameras saw different instants
-- centre_noise_px: noise of a stripe centre
-- noise_correlation_rows: its correlation length along the rows
-- plane_rms_um: scatter of the points about their plane
-- shift_um: distance from the first scan's plane at the middle of the points, in µm
-- turn_deg: angle between the two planes
-- epipolar_residual_px: vertical disparity between the cameras, from the stripes' slopes
-- u_epipolar_residual_px: its standard uncertainty
-- epipolar_change_px: its change since the first scan
-- watch: flags of the drift watch that values of this scan carry, of whichever sensor
WITH named AS (
    SELECT
        scan_id,
        any_value(calibration_id) AS calibration_id,
        list_intersect(['cameras_moved', 'laser_plane_moved', 'cameras_out_of_step'], flatten(list(quality_flags))) AS watch
    FROM measurements
    GROUP BY scan_id
),
seen AS (
    SELECT
        t.*,
        s.captured_at,
        n.calibration_id,
        n.watch,
        first_value(t.plane_normal) OVER earlier AS first_normal,
        first_value(t.plane_distance_mm) OVER earlier AS first_distance_mm,
        first_value(t.epipolar_residual_px) OVER earlier AS first_residual_px
    FROM stripe_statistics AS t
    JOIN scan_status AS s USING (scan_id)
    JOIN named AS n USING (scan_id)
    WHERE t.plane_normal IS NOT NULL
        AND s.rig_id = coalesce(getvariable('rig_id'), s.rig_id)
    WINDOW earlier AS (PARTITION BY n.calibration_id, t.sensor_id, t.line ORDER BY s.captured_at, t.scan_id)
)
SELECT
    scan_id,
    sensor_id,
    line,
    calibration_id,
    n_points,
    n_off_plane,
    n_frames_out_of_step,
    centre_noise_px,
    noise_correlation_rows,
    plane_rms_um,
    1000 * (list_dot_product(first_normal, plane_centre_mm) - first_distance_mm) AS shift_um,
    degrees(2 * asin(least(1.0, list_distance(first_normal, plane_normal) / 2))) AS turn_deg,
    epipolar_residual_px,
    u_epipolar_residual_px,
    epipolar_residual_px - first_residual_px AS epipolar_change_px,
    array_to_string(list_sort(watch), ', ') AS watch
FROM seen
ORDER BY captured_at, scan_id, sensor_id, line
