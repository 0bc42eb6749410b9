"""Page 1: every stored table and column, with unit, meaning and limits. No code but declarations lives here."""

from __future__ import annotations

from wheelset_assets.declare import Check, Column, Table
from wheelset_assets.quality import flag_names

SCAN_ID = Column("scan_id", "string", "Scan bundle that the row comes from")
SENSOR_ID = Column("sensor_id", "category", "Stereo sensor of the rig")
STATION = Column("station", "string", "Station of the rig: one wheel's rim or one journal")
LINE = Column("line", "int8", "Laser line: 0 is the one of smaller u in the left image", minimum=0, maximum=1)
FRAME = Column("frame", "int32", "Frame of the scan, counted from 0", minimum=0)
ROW = Column("row", "int16", "Row of the left image", minimum=0)
FLAGS = Column("quality_flags", "strings", f"Conditions under which the value stands, among: {', '.join(flag_names())}")
QUANTITY = Column("quantity", "string", "Measured quantity, as defined in `wheelset describe quantities`")
SIDE = Column(
    "side", "string", "left, right, or both for a distance across the wheelset", values=("left", "right", "both")
)
CALIBRATION_ID = Column("calibration_id", "string", "Calibration bundle")
RIG_ID = Column("rig_id", "string", "Measuring rig")

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

_POINT_COLUMNS = (
    SENSOR_ID,
    LINE,
    FRAME,
    ROW,
    Column("x_mm", "float32", "Along the left image's u axis, sensor frame", unit="mm"),
    Column("y_mm", "float32", "Along the left image's v axis, sensor frame", unit="mm"),
    Column("z_mm", "float32", "Away from the left camera, sensor frame", unit="mm"),
    Column(
        "u_depth_um",
        "float32",
        "Standard uncertainty along the line of sight, noise of the stripe centres",
        unit="um",
        minimum=0,
    ),
)

TRIANGULATED_CLOUDS = Table(
    name="triangulated_clouds",
    version=1,
    meaning="Points from matched stripe centres, in each sensor's own frame, organised by frame and image row",
    layout="scan",
    key=("sensor_id", "line", "frame", "row"),
    columns=_POINT_COLUMNS,
)

STRIPE_STATISTICS = Table(
    name="stripe_statistics",
    version=3,
    meaning="How well each sensor's stripes were seen and matched in a scan",
    layout="day",
    key=("scan_id", "sensor_id", "line"),
    columns=(
        SCAN_ID,
        Column("sensor_id", "string", "Stereo sensor of the rig"),
        LINE,
        Column("n_frames", "int32", "Frames with any stripe", minimum=0),
        Column("n_centres_left", "int64", "Stripe centres inside the left image", minimum=0),
        Column("n_centres_right", "int64", "Stripe centres inside the right image", minimum=0),
        Column("n_points", "int64", "Triangulated points", minimum=0),
        Column(
            "centre_noise_px",
            "float64",
            "Standard deviation of a stripe centre, estimated from the scan",
            unit="px",
            nullable=True,
        ),
        Column(
            "noise_correlation_rows",
            "float64",
            "Integral correlation length of that noise along the rows",
            unit="1",
            nullable=True,
        ),
        Column("plane_normal", "float64s", "Laser plane seen in this scan: unit normal, sensor frame", nullable=True),
        Column("plane_distance_mm", "float64", "Laser plane: normal . x", unit="mm", nullable=True),
        Column(
            "plane_centre_mm", "float64s", "Laser plane: middle of its points, sensor frame", unit="mm", nullable=True
        ),
        Column(
            "plane_extent_mm",
            "float64s",
            "Laser plane: spread of its points along its two directions",
            unit="mm",
            nullable=True,
        ),
        Column(
            "plane_direction",
            "float64s",
            "Laser plane: direction along which its points spread most, sensor frame",
            nullable=True,
        ),
        Column("plane_rms_um", "float64", "Laser plane: scatter of its points about it", unit="um", nullable=True),
        Column("n_off_plane", "int64", "Points left out as mismatches, for they lay off the laser plane", minimum=0),
        Column(
            "n_frames_out_of_step",
            "int32",
            "Frames left out because all their points lay off the laser plane alike: the cameras saw different instants",
            minimum=0,
        ),
        Column(
            "frame_scatter_um",
            "float64",
            "Robust scatter over the frames of their mean distance from the laser plane",
            unit="um",
            minimum=0,
            nullable=True,
        ),
        Column(
            "frame_pull",
            "float64",
            "The same over its noise: 1 if nothing is amiss",
            unit="1",
            minimum=0,
            nullable=True,
        ),
        Column(
            "epipolar_residual_px",
            "float64",
            "Vertical disparity between the cameras, right less left, by what the stripes' slopes put off the laser plane",
            unit="px",
            nullable=True,
        ),
        Column(
            "u_epipolar_residual_px",
            "float64",
            "Its standard uncertainty; large where the stripe has no slopes that differ",
            unit="px",
            minimum=0,
            nullable=True,
        ),
    ),
)

FILTERED_CLOUDS = Table(
    name="filtered_clouds",
    version=1,
    meaning="Points that passed the filters, smoothed and thinned, in each sensor's own frame",
    layout="scan",
    key=("sensor_id", "line", "frame", "row"),
    columns=_POINT_COLUMNS,
)

REMOVAL_REASONS = ("range", "outlier", "isolated")
REMOVED_POINTS = Table(
    name="removed_points",
    version=1,
    meaning="Points that a filter removed, with the reason; join triangulated_clouds for their place",
    layout="scan",
    key=("sensor_id", "line", "frame", "row"),
    columns=(
        SENSOR_ID,
        LINE,
        FRAME,
        ROW,
        Column("reason", "category", "Filter that removed the point", values=REMOVAL_REASONS),
    ),
)

FEATURES = Table(
    name="features",
    version=1,
    meaning="ISS keypoints with FPFH descriptors, on each sensor's turn folded into a narrow patch",
    layout="scan",
    key=("sensor_id", "keypoint"),
    columns=(
        Column("sensor_id", "string", "Stereo sensor of the rig"),
        Column("keypoint", "int32", "Number of the keypoint within its sensor", minimum=0),
        Column("x_mm", "float64", "Rig frame, nominal pose", unit="mm"),
        Column("y_mm", "float64", "Rig frame, nominal pose", unit="mm"),
        Column("z_mm", "float64", "Rig frame, nominal pose", unit="mm"),
        Column(
            "saliency_mm2", "float64", "Smallest eigenvalue of the weighted scatter (eq. 19)", unit="mm^2", minimum=0
        ),
        Column("n_neighbours", "int32", "Points within the saliency radius", minimum=0),
        Column("fpfh", "float32x33", "Fast point feature histogram, 3 x 11 bins, each third summing to 100"),
    ),
)

REGISTRATIONS = Table(
    name="registrations",
    version=1,
    meaning="Pose of each sensor against the first of its station, with what the data say of it",
    layout="day",
    key=("scan_id", "station", "source_sensor_id", "source_line"),
    columns=(
        SCAN_ID,
        STATION,
        Column("source_sensor_id", "string", "Sensor that is registered"),
        Column(
            "source_line",
            "int8",
            "Laser line of the source; lines of one sensor are registered to each other too",
            minimum=0,
            maximum=1,
        ),
        Column("target_sensor_id", "string", "Sensor that it is registered to: the station's first"),
        Column("target_line", "int8", "Laser line of the target", minimum=0, maximum=1),
        Column("qw", "float64", "Rotation target from source, quaternion, real part", unit="1"),
        Column("qx", "float64", "Rotation target from source, quaternion", unit="1"),
        Column("qy", "float64", "Rotation target from source, quaternion", unit="1"),
        Column("qz", "float64", "Rotation target from source, quaternion", unit="1"),
        Column("tx_mm", "float64", "Translation target from source", unit="mm"),
        Column("ty_mm", "float64", "Translation target from source", unit="mm"),
        Column("tz_mm", "float64", "Translation target from source", unit="mm"),
        Column(
            "direction_deg",
            "float64",
            "Direction of the station's meridian about the axle, from +Y towards +Z",
            unit="deg",
        ),
        Column(
            "method",
            "string",
            "icp, nominal (no overlap) or single (one sensor at the station)",
            values=("icp", "nominal", "single"),
        ),
        Column(
            "inlier_rmse_mm",
            "float64",
            "RMS distance of matched points along the normal",
            unit="mm",
            nullable=True,
            minimum=0,
        ),
        Column(
            "fitness",
            "float64",
            "Share of the source's meridian with a partner",
            unit="1",
            nullable=True,
            minimum=0,
            maximum=1,
        ),
        Column("n_iterations", "int32", "Iterations of the fine registration", minimum=0),
        Column("n_matches", "int32", "Mutual keypoint matches that agree with the coarse pose", minimum=0),
        Column("n_constrained", "int32", "Directions that the data constrain", minimum=0, maximum=6),
        Column("u_lateral_um", "float64", "Standard uncertainty along the axle", unit="um", nullable=True, minimum=0),
        Column(
            "u_radial_um", "float64", "Standard uncertainty away from the axle", unit="um", nullable=True, minimum=0
        ),
        Column(
            "u_meridian_deg",
            "float64",
            "Standard uncertainty of the rotation in the meridian plane",
            unit="deg",
            nullable=True,
            minimum=0,
        ),
        Column(
            "correction_lateral_mm",
            "float64",
            "Correction of the nominal pose along the axle",
            unit="mm",
            nullable=True,
        ),
        Column(
            "correction_radial_mm",
            "float64",
            "Correction of the nominal pose away from the axle",
            unit="mm",
            nullable=True,
        ),
        Column(
            "correction_meridian_deg",
            "float64",
            "Correction of the nominal rotation in the meridian plane",
            unit="deg",
            nullable=True,
        ),
        Column(
            "coarse_lateral_mm",
            "float64",
            "The same from matched keypoints alone, along the axle",
            unit="mm",
            nullable=True,
        ),
        Column(
            "coarse_radial_mm",
            "float64",
            "The same from matched keypoints alone, away from the axle",
            unit="mm",
            nullable=True,
        ),
        Column(
            "coarse_meridian_deg",
            "float64",
            "The same from matched keypoints alone, rotation",
            unit="deg",
            nullable=True,
        ),
        Column(
            "frequency_lateral_um",
            "float64",
            "Independent check: shift along the axle that phase correlation still finds at the registered pose",
            unit="um",
            nullable=True,
        ),
        Column("frequency_radial_um", "float64", "The same away from the axle", unit="um", nullable=True),
        Column(
            "frequency_meridian_deg",
            "float64",
            "The same, rotation from the magnitude of the spectrum",
            unit="deg",
            nullable=True,
        ),
        Column(
            "overlap_rms_um",
            "float64",
            "RMS distance between the sensors' mean meridians over the overlap, after registration",
            unit="um",
            nullable=True,
            minimum=0,
        ),
        Column(
            "information",
            "float64s",
            "Information matrix 6 x 6 by rows about the rig's origin shifted to the overlap, rotation (rad) first, then mm",
            nullable=True,
        ),
        FLAGS,
    ),
)

FUSED_PROFILES = Table(
    name="fused_profiles",
    version=1,
    meaning="Mean meridian of each station by sensor, laser line and image row, in the first sensor's nominal rig pose",
    layout="scan",
    key=("station", "sensor_id", "line", "row"),
    columns=(
        STATION,
        Column("sensor_id", "string", "Stereo sensor of the rig"),
        LINE,
        ROW,
        Column("lateral_mm", "float64", "Along the rig's X axis", unit="mm"),
        Column("radial_mm", "float64", "Distance from the rig's X axis", unit="mm"),
        Column(
            "u_um",
            "float64",
            "Standard uncertainty across the profile, from the scatter over the turn",
            unit="um",
            minimum=0,
        ),
        Column("n_frames", "int32", "Frames that entered the mean", minimum=1),
        Column(
            "residual_um",
            "float64",
            "Distance from the fused profile of the other sensors, where they overlap",
            unit="um",
            nullable=True,
        ),
    ),
)

ALIGNMENTS = Table(
    name="alignments",
    version=1,
    meaning="Datum of each station: inner-face plane or shoulder and journal, and the rotation that squares the cloud to the axle",
    layout="day",
    key=("scan_id", "station"),
    columns=(
        SCAN_ID,
        STATION,
        Column("kind", "string", "wheel or journal", values=("wheel", "journal")),
        Column("side", "string", "Side of the wheelset", values=("left", "right")),
        Column(
            "plane_a",
            "float64",
            "Normal of the datum face before squaring, along the axle (A of A X + B Y + C Z = D)",
            unit="1",
            nullable=True,
        ),
        Column(
            "plane_b", "float64", "The same, along the turn; zero where the data are silent", unit="1", nullable=True
        ),
        Column("plane_c", "float64", "The same, away from the axle", unit="1", nullable=True),
        Column(
            "plane_d_mm",
            "float64",
            "Distance of the datum face from the rig's origin along its normal",
            unit="mm",
            nullable=True,
        ),
        Column(
            "squaring_deg",
            "float64",
            "Rotation in the meridian plane that squares the station to the axle",
            unit="deg",
            nullable=True,
        ),
        Column("u_squaring_deg", "float64", "Its standard uncertainty", unit="deg", nullable=True, minimum=0),
        Column("squared_by", "string", "inner_face, journal, or none", values=("inner_face", "journal", "none")),
        Column(
            "face_lateral_mm",
            "float64",
            "Place of the datum face along the rig's X axis after squaring, mean over the turn",
            unit="mm",
            nullable=True,
        ),
        Column(
            "face_radial_min_mm",
            "float64",
            "Innermost radius at which the face was seen as flat",
            unit="mm",
            nullable=True,
        ),
        Column(
            "face_radial_max_mm",
            "float64",
            "Outermost radius at which the face was seen as flat",
            unit="mm",
            nullable=True,
        ),
        Column(
            "face_rms_um",
            "float64",
            "RMS distance of the mean meridian's face points from the plane",
            unit="um",
            nullable=True,
        ),
        Column("n_face_rows", "int32", "Rows of the mean meridian on the face", minimum=0),
        Column("pivot_lateral_mm", "float64", "Point about which the station was rotated, along the axle", unit="mm"),
        Column("pivot_radial_mm", "float64", "The same, away from the axle", unit="mm"),
        Column("reason", "string", "Why there is no datum", nullable=True),
        FLAGS,
    ),
)

READINGS = Table(
    name="readings",
    version=1,
    meaning="What the rig reads before it is compared with the master wheelset: the comparator's raw indications at the scan's temperature",
    layout="day",
    key=("scan_id", "quantity", "side"),
    columns=(
        SCAN_ID,
        QUANTITY,
        SIDE,
        Column(
            "reading",
            "float64",
            "Indication, in the unit of its quantity, rig corrected to its temperature",
            nullable=True,
        ),
        Column("u_noise", "float64", "Standard uncertainty from the scatter between frames", nullable=True, minimum=0),
        Column("n_frames", "int32", "Frames that entered", minimum=0),
        Column("angular_coverage_ratio", "float64", "Share of the turn that was seen", unit="1", minimum=0, maximum=1),
        Column(
            "excluded_ratio",
            "float64",
            "Share of frames excluded as dirt, flats or reflections",
            unit="1",
            minimum=0,
            maximum=1,
        ),
        Column("reason", "string", "Why there is no reading", nullable=True),
        FLAGS,
    ),
)

TURNS = Table(
    name="turns",
    version=1,
    meaning="Frame by frame: radius at the datum circle, place of the faces, journal radius",
    layout="scan",
    key=("station", "series", "frame"),
    columns=(
        STATION,
        Column(
            "series",
            "category",
            "Which series",
            values=("tread_radius", "face_lateral", "journal_radius", "shoulder_lateral"),
        ),
        FRAME,
        Column("angle_deg", "float64", "Angle of the turn", unit="deg"),
        Column("value_mm", "float64", "Value in this frame at the scan's temperature", unit="mm"),
        Column("used", "bool", "Whether the frame entered the harmonic fit"),
        Column("fitted_mm", "float64", "Fitted harmonics at this angle", unit="mm"),
    ),
)

ROUNDNESS_ORDERS = Table(
    name="roundness_orders",
    version=1,
    meaning="Harmonics of the radius on the datum circle over the turn, order by order: run-out, ovality, polygons",
    layout="day",
    key=("scan_id", "side", "harmonic"),
    columns=(
        SCAN_ID,
        SIDE,
        Column("harmonic", "int16", "Order of the harmonic, 1 for a shift of the centre", minimum=1),
        Column("wavelength_mm", "float64", "Circumference of the datum circle over the order", unit="mm", minimum=0),
        Column("amplitude_um", "float64", "Amplitude, noise included", unit="um", minimum=0),
        Column("u_amplitude_um", "float64", "Standard uncertainty of the amplitude", unit="um", minimum=0),
        Column("phase_deg", "float64", "Body angle of the first maximum", unit="deg"),
        Column("level_db", "float64", "20 log10 of the effective value over 1 um", unit="db", nullable=True),
        Column("significant", "bool", "Whether the order stands out of the noise"),
    ),
)

WHEEL_FLATS = Table(
    name="wheel_flats",
    version=1,
    meaning="Wheel flats: chords of the tread, deepest first",
    layout="day",
    key=("scan_id", "side", "number"),
    columns=(
        SCAN_ID,
        SIDE,
        Column("number", "int16", "1 for the deepest of its wheel", minimum=1),
        Column("position_deg", "float64", "Body angle of its middle, zero where the encoder is", unit="deg"),
        Column("length_mm", "float64", "Length along the tread", unit="mm", minimum=0),
        Column("u_length_mm", "float64", "Standard uncertainty of the length", unit="mm", minimum=0),
        Column("depth_mm", "float64", "Depth of the chord", unit="mm", minimum=0),
        Column("u_depth_mm", "float64", "Standard uncertainty of the depth", unit="mm", minimum=0),
        Column("n_frames", "int32", "Frames that saw it", minimum=1),
    ),
)

JOURNAL_SECTIONS = Table(
    name="journal_sections",
    version=1,
    meaning="Journals by section, as indicated at the scan's temperature in the reference's geometry",
    layout="day",
    key=("scan_id", "side", "place_mm"),
    columns=(
        SCAN_ID,
        SIDE,
        Column("place_mm", "float64", "Middle of the section, from the shoulder outward", unit="mm"),
        Column("diameter_mm", "float64", "Indicated mean diameter", unit="mm"),
        Column("u_diameter_mm", "float64", "Standard uncertainty of its noise", unit="mm", minimum=0),
        Column("ovality_mm", "float64", "Largest less smallest diameter", unit="mm", minimum=0),
        Column("u_ovality_mm", "float64", "Standard uncertainty of the ovality", unit="mm", minimum=0),
        Column("roundness_mm", "float64", "Largest less smallest radius about its own centre", unit="mm", minimum=0),
        Column("u_roundness_mm", "float64", "Standard uncertainty of the roundness", unit="mm", minimum=0),
    ),
)

WHEEL_PROFILES = Table(
    name="wheel_profiles",
    version=1,
    meaning="Mean meridian of each wheel in the geometry of its values, beside the nominal profile, at the scan's temperature",
    layout="scan",
    key=("station", "sensor_id", "line", "row"),
    columns=(
        STATION,
        Column("sensor_id", "string", "Stereo sensor of the rig"),
        LINE,
        ROW,
        Column("from_inner_face_mm", "float64", "Lateral place, from the inner face towards the field side", unit="mm"),
        Column("radius_mm", "float64", "Distance from the axis of rotation", unit="mm", minimum=0),
        Column("height_mm", "float64", "Above the tread at the datum circle", unit="mm", nullable=True),
        Column("u_um", "float64", "Standard uncertainty from the scatter over the turn", unit="um", minimum=0),
        Column(
            "deviation_um",
            "float64",
            "Distance from the nominal profile along its normal, positive for more metal; aligned by inner face and flange's top",
            unit="um",
            nullable=True,
        ),
    ),
)

TREAD_MAPS = Table(
    name="tread_maps",
    version=1,
    meaning="Unrolled deviation of each wheel from its mean meridian, along the normal, in bins of angle and lateral place",
    layout="scan",
    key=("station", "angle_deg", "from_inner_face_mm"),
    columns=(
        STATION,
        Column("angle_deg", "float32", "Body angle, middle of the bin", unit="deg"),
        Column("from_inner_face_mm", "float32", "Lateral place, middle of the bin", unit="mm"),
        Column("deviation_um", "float32", "Mean deviation, positive outward", unit="um"),
        Column("n_points", "int32", "Points in the bin", minimum=1),
    ),
)

MEASUREMENTS = Table(
    name="measurements",
    version=2,
    meaning="Values at 20 °C with expanded uncertainty; null with a reason where the data do not support one",
    layout="day",
    key=("scan_id", "quantity", "side"),
    columns=(
        SCAN_ID,
        Column("wheelset_id", "string", "Wheelset that was measured"),
        RIG_ID,
        Column(
            "purpose", "string", "production, or reference for the master wheelset", values=("production", "reference")
        ),
        Column("captured_at", "timestamp", "When the scan was taken", unit="utc"),
        Column("acquired_on", "date", "Day of the scan in its own time zone"),
        QUANTITY,
        SIDE,
        Column("value", "float64", "Value at 20 °C, in `unit`", nullable=True),
        Column("unit", "string", "Unit of value and uncertainty", values=("mm", "deg", "1")),
        Column("expanded_uncertainty", "float64", "Expanded uncertainty U = k u, in `unit`", nullable=True, minimum=0),
        Column("coverage_factor", "float64", "Coverage factor k", unit="1"),
        Column(
            "value_uncompensated",
            "float64",
            "The same without any temperature correction since the reference scan",
            nullable=True,
        ),
        FLAGS,
        Column("reason", "string", "Why there is no value", nullable=True),
        CALIBRATION_ID,
        Column("reference_scan_id", "string", "Reference scan that set the zero", nullable=True),
        Column("wheelset_temperature_c", "float64", "Wheelset temperature of the scan", unit="c"),
        Column("rig_temperature_c", "float64", "Rig temperature of the scan", unit="c"),
        Column(
            "definition", "string", "Lengths, alignment and support that the quantity was evaluated with", nullable=True
        ),
        Column("wheelset_type", "string", "Type of wheelset that the bundle names"),
        Column("profile", "string", "Nominal profile that the bundle names", nullable=True),
        Column("trainset", "string", "Trainset that the bundle names", nullable=True),
        Column("car", "string", "Car that the bundle names", nullable=True),
        Column("bogie", "string", "Bogie that the bundle names", nullable=True),
        Column("axle", "string", "Axle that the bundle names", nullable=True),
        Column("operator", "string", "Operator that the bundle names", nullable=True),
        Column("mileage_km", "float64", "Mileage that the bundle names, in km", nullable=True),
    ),
    checks=(
        Check(
            "value_or_reason",
            "SELECT * FROM {table} WHERE (value IS NULL) = (reason IS NULL)",
            "a row has a value or a reason, never both or neither",
        ),
        Check(
            "value_with_uncertainty",
            "SELECT * FROM {table} WHERE value IS NOT NULL AND (expanded_uncertainty IS NULL OR expanded_uncertainty <= 0)",
            "no value without its uncertainty",
        ),
    ),
)

BUDGETS = Table(
    name="budgets",
    version=1,
    meaning="Uncertainty budget of each value: one row a source",
    layout="day",
    key=("scan_id", "quantity", "side", "source"),
    columns=(
        SCAN_ID,
        QUANTITY,
        SIDE,
        Column("source", "string", "Source of uncertainty"),
        Column("standard_uncertainty", "float64", "Standard uncertainty of the source, in `source_unit`", minimum=0),
        Column("source_unit", "string", "Unit of the source"),
        Column("sensitivity", "float64", "Change of the value for one unit of the source"),
        Column(
            "contribution",
            "float64",
            "Standard uncertainty of the value from this source, in the value's unit",
            minimum=0,
        ),
        Column("share", "float64", "Share of the combined variance", unit="1", minimum=0, maximum=1),
    ),
    checks=(
        Check(
            "shares_sum_to_one",
            "SELECT scan_id, quantity, side FROM {table} GROUP BY ALL HAVING abs(sum(share) - 1) > 1e-6",
            "the shares of a value's variance sum to one",
        ),
    ),
)

REPEATABILITY = Table(
    name="repeatability",
    version=1,
    meaning="Repeatability of production measurements by wheelset, quantity, side and day, month, or all time",
    layout="fleet",
    key=("wheelset_id", "quantity", "side", "period", "period_start"),
    columns=(
        Column("wheelset_id", "string", "Wheelset"),
        QUANTITY,
        SIDE,
        Column("period", "string", "day, month, or all", values=("day", "month", "all")),
        Column("period_start", "date", "First day of the period; for all, of the first measurement"),
        Column("unit", "string", "Unit of the statistics"),
        Column("n", "int32", "Values", minimum=1),
        Column("mean", "float64", "Mean"),
        Column(
            "standard_deviation",
            "float64",
            "Sample standard deviation (n - 1); null for one value",
            nullable=True,
            minimum=0,
        ),
        Column("range", "float64", "Largest minus smallest", minimum=0),
        Column("minimum", "float64", "Smallest value"),
        Column("maximum", "float64", "Largest value"),
        Column(
            "standard_deviation_uncompensated",
            "float64",
            "The same without temperature correction",
            nullable=True,
            minimum=0,
        ),
        Column("range_uncompensated", "float64", "The same without temperature correction", nullable=True, minimum=0),
        Column("mean_expanded_uncertainty", "float64", "Mean of the claimed expanded uncertainties", minimum=0),
    ),
)

ALL_TABLES = (
    CALIBRATIONS,
    CALIBRATION_POSES,
    CALIBRATION_CORNERS,
    TRIANGULATED_CLOUDS,
    STRIPE_STATISTICS,
    FILTERED_CLOUDS,
    REMOVED_POINTS,
    FEATURES,
    REGISTRATIONS,
    FUSED_PROFILES,
    ALIGNMENTS,
    READINGS,
    TURNS,
    ROUNDNESS_ORDERS,
    WHEEL_FLATS,
    JOURNAL_SECTIONS,
    WHEEL_PROFILES,
    TREAD_MAPS,
    MEASUREMENTS,
    BUDGETS,
    REPEATABILITY,
)
TABLES = {table.name: table for table in ALL_TABLES}
