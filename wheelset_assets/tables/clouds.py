"""Tables of stages 2 to 4: triangulated and filtered clouds, what the stripes say of the scan, features."""

from __future__ import annotations

from wheelset_assets.declare import Column, Table
from wheelset_assets.tables.columns import FRAME, LINE, ROW, SCAN_ID, SENSOR_ID

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
            "Standard deviation over the frames, but for single ones that are far off, of their mean distance from the laser plane",
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
        Column("x_mm", "float64", "Rig frame, pose before registration", unit="mm"),
        Column("y_mm", "float64", "Rig frame, pose before registration", unit="mm"),
        Column("z_mm", "float64", "Rig frame, pose before registration", unit="mm"),
        Column(
            "saliency_mm2", "float64", "Smallest eigenvalue of the weighted scatter (eq. 19)", unit="mm^2", minimum=0
        ),
        Column("n_neighbours", "int32", "Points within the saliency radius", minimum=0),
        Column("fpfh", "float32x33", "Fast point feature histogram, 3 x 11 bins, each third summing to 100"),
    ),
)
