-- How well is each parameter known?
--
-- Columns
-- calibration_id: calibration bundle
-- sensor_id: stereo sensor
-- parameter: parameter; its unit stands in its name, px for f, fx, fy, cx and cy, 1 for the lens
-- standard_uncertainty: from the full covariance of the fit
WITH listed AS (
    SELECT
        calibration_id,
        sensor_id,
        parameter_names,
        covariance,
        unnest(range(1, len(parameter_names) + 1)) AS i
    FROM calibrations
    WHERE state = 'usable' AND rig_id = coalesce(getvariable('rig_id'), rig_id)
)
SELECT
    calibration_id,
    sensor_id,
    parameter_names[i] AS parameter,
    sqrt(covariance[(i - 1) * len(parameter_names) + i]) AS standard_uncertainty
FROM listed
ORDER BY calibration_id, sensor_id, i
