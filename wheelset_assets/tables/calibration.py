"""Tables of stage 1: the sensors' calibration."""

from __future__ import annotations

from wheelset_assets.declare import Column, Table
from wheelset_assets.tables.columns import CALIBRATION_ID, RIG_ID, SENSOR_ID

_CAMERA = "fx, fy, cx, cy in px"
_DISTORTION = "Brown's k1, k2, p1, p2, k3"

CALIBRATIONS = Table(
    name="calibrations",
    version=1,
    meaning="Stereo calibration of each sensor: intrinsics, distortion, pose between the cameras, with full covariance",
    layout="calibration",
    key=("calibration_id", "sensor_id"),
    columns=(
        CALIBRATION_ID,
        RIG_ID,
        SENSOR_ID,
        Column("captured_at", "timestamp", "When the board images were taken", unit="utc"),
        Column("valid_from", "timestamp", "Start of validity stated in the bundle", unit="utc", nullable=True),
        Column("valid_until", "timestamp", "End of validity stated in the bundle", unit="utc", nullable=True),
        Column("rig_temperature_c", "float64", "Rig temperature while the boards were seen", unit="c"),
        Column("state", "string", "usable, or refused with a reason", values=("usable", "refused")),
        Column("reason", "string", "Why the calibration was refused", nullable=True),
        Column("image_width_px", "int32", "Image width", unit="px", minimum=1),
        Column("image_height_px", "int32", "Image height", unit="px", minimum=1),
        Column("n_poses", "int32", "Board poses in the bundle", minimum=0),
        Column("n_poses_used", "int32", "Board poses that entered the fit", minimum=0),
        Column(
            "left_rms_px", "float64", "RMS distance of corners from their projection, left", unit="px", nullable=True
        ),
        Column(
            "right_rms_px", "float64", "RMS distance of corners from their projection, right", unit="px", nullable=True
        ),
        Column("stereo_rms_px", "float64", "The same over both cameras", unit="px", nullable=True),
        Column("holdout_rms_px", "float64", "RMS over poses left out of the fit in turn", unit="px", nullable=True),
        Column(
            "epipolar_rms_px", "float64", "RMS distance of corners from their epipolar lines", unit="px", nullable=True
        ),
        Column("baseline_mm", "float64", "Distance between the cameras' centres", unit="mm", minimum=0, nullable=True),
        Column(
            "distortion_model",
            "string",
            "Lens model: the richest that does not predict left-out poses worse",
            nullable=True,
        ),
        Column(
            "rival_model", "string", "Lens model that it was tried against, best by Akaike's criterion", nullable=True
        ),
        Column("rival_holdout_rms_px", "float64", "Hold-out RMS of the rival", unit="px", nullable=True),
        Column("left_camera", "float64s", f"Left camera: {_CAMERA}", nullable=True),
        Column("left_distortion", "float64s", f"Left camera: {_DISTORTION}", nullable=True),
        Column("right_camera", "float64s", f"Right camera: {_CAMERA}", nullable=True),
        Column("right_distortion", "float64s", f"Right camera: {_DISTORTION}", nullable=True),
        Column("right_from_left", "float64s", "Transform x_right = R x_left + T, 4 x 4 by rows, mm", nullable=True),
        Column("parameter_names", "strings", "Order of the covariance's rows", nullable=True),
        Column("covariance", "float64s", "Covariance of the parameters by rows, from the fit", nullable=True),
        Column(
            "depth_range_mm",
            "float64s",
            "Nearest and farthest board corner from the left camera",
            nullable=True,
            unit="mm",
        ),
        Column(
            "coverage_ratio",
            "float64",
            "Share of an 8 x 8 grid of the left image in which corners were seen",
            unit="1",
            minimum=0,
            maximum=1,
            nullable=True,
        ),
        Column(
            "right_coverage_ratio",
            "float64",
            "The same of the right image",
            unit="1",
            minimum=0,
            maximum=1,
            nullable=True,
        ),
        Column(
            "max_tilt_deg", "float64", "Largest angle between a board and the image plane", unit="deg", nullable=True
        ),
        Column(
            "square_edge_mean_mm",
            "float64",
            "Mean edge of the squares, triangulated corner by corner",
            unit="mm",
            nullable=True,
        ),
        Column(
            "square_edge_standard_deviation_mm",
            "float64",
            "Standard deviation of those edges",
            unit="mm",
            nullable=True,
        ),
    ),
)

CALIBRATION_POSES = Table(
    name="calibration_poses",
    version=1,
    meaning="What became of each board pose",
    layout="calibration",
    key=("calibration_id", "sensor_id", "pose"),
    columns=(
        CALIBRATION_ID,
        SENSOR_ID,
        Column("pose", "string", "File name of the pose, without extension"),
        Column("used", "bool", "Whether the pose entered the fit"),
        Column("reason", "string", "Why it did not", nullable=True),
        Column("left_rms_px", "float64", "RMS residual of this pose, left", unit="px", nullable=True),
        Column("right_rms_px", "float64", "RMS residual of this pose, right", unit="px", nullable=True),
        Column(
            "holdout_rms_px", "float64", "RMS of this pose under a fit that did not use it", unit="px", nullable=True
        ),
        Column("tilt_deg", "float64", "Angle between board and image plane", unit="deg", nullable=True),
        Column(
            "distance_mm", "float64", "Distance of the board's centre from the left camera", unit="mm", nullable=True
        ),
    ),
)

CALIBRATION_CORNERS = Table(
    name="calibration_corners",
    version=1,
    meaning="Corners that entered each calibration, with their residuals",
    layout="calibration",
    key=("calibration_id", "sensor_id", "pose", "camera", "corner"),
    columns=(
        CALIBRATION_ID,
        SENSOR_ID,
        Column("pose", "string", "File name of the pose, without extension"),
        Column("camera", "string", "Camera of the sensor", values=("left", "right")),
        Column("corner", "int32", "Number of the inner corner, columns running fastest", minimum=0),
        Column("u_px", "float64", "Column of the corner as found in the image", unit="px"),
        Column("v_px", "float64", "Row of the corner as found in the image", unit="px"),
        Column("residual_u_px", "float64", "Projection by the calibration less u", unit="px"),
        Column("residual_v_px", "float64", "Projection by the calibration less v", unit="px"),
    ),
)
