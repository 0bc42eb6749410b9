"""Page 3: the eight stages in order, each a declaration over a function between tables and arrays.

`capture` (1, 2), `cloud` (3), `pose` (4, 5), `align` (6) and `measure` (7, with `geometry`,
`comparison`, `watch` and `drift`) and `repeat` (8) hold the functions; `raw` what they get besides tables.
"""

from wheelset_assets import config, tables
from wheelset_assets.declare import Stage
from wheelset_assets.stages.align import run_alignments
from wheelset_assets.stages.capture import run_calibrations, run_triangulated_clouds
from wheelset_assets.stages.cloud import run_filtered_clouds
from wheelset_assets.stages.measure import run_measurements
from wheelset_assets.stages.pose import run_features, run_registrations
from wheelset_assets.stages.repeat import run_repeatability

CALIBRATION = Stage(
    version=2,
    meaning="Stereo calibration of each sensor from board images, with full covariance",
    scope="calibration",
    inputs=(),
    raw_inputs=("boards", "rig"),
    outputs=(tables.CALIBRATIONS, tables.CALIBRATION_POSES, tables.CALIBRATION_CORNERS),
    config_type=config.CalibrationConfig,
    run=run_calibrations,
)
TRIANGULATION = Stage(
    version=6,
    meaning="Stripe centres matched along epipolar lines and triangulated (eq. 1-13)",
    scope="scan",
    inputs=("calibrations",),
    raw_inputs=("stripes", "scan"),
    outputs=(tables.TRIANGULATED_CLOUDS, tables.STRIPE_STATISTICS),
    config_type=config.TriangulationConfig,
    run=run_triangulated_clouds,
)
FILTERING = Stage(
    version=7,
    meaning="Range gate, outliers, smoothing (eq. 14-17) and thinning on the organised grid",
    scope="scan",
    inputs=("triangulated_clouds", "stripe_statistics"),
    outputs=(tables.FILTERED_CLOUDS, tables.REMOVED_POINTS),
    config_type=config.FilteringConfig,
    run=run_filtered_clouds,
)
FEATURES = Stage(
    version=3,
    meaning="ISS keypoints (eq. 18-19) and FPFH descriptors (eq. 20-21)",
    scope="scan",
    inputs=("filtered_clouds", "stripe_statistics"),
    raw_inputs=("rig", "scan"),
    outputs=(tables.FEATURES,),
    config_type=config.FeatureConfig,
    run=run_features,
)
REGISTRATION = Stage(
    version=8,
    meaning="Coarse pose from matches (eq. 22-24), ICP (eq. 25-26) aware of degeneracy, check by frequency, fused meridians",
    scope="scan",
    inputs=("filtered_clouds", "stripe_statistics", "features"),
    raw_inputs=("rig", "scan"),
    outputs=(tables.REGISTRATIONS, tables.FUSED_PROFILES),
    config_type=config.RegistrationConfig,
    run=run_registrations,
)
ALIGNMENT = Stage(
    version=2,
    meaning="Inner-face plane (eq. 27), total least squares, and squaring to the axle",
    scope="scan",
    inputs=("fused_profiles", "registrations"),
    raw_inputs=("rig", "scan"),
    outputs=(tables.ALIGNMENTS,),
    config_type=config.AlignmentConfig,
    run=run_alignments,
)
MEASUREMENT = Stage(
    version=8,
    meaning="Quantities at 20 °C against the master wheelset, each with its uncertainty budget (eq. 28)",
    scope="scan",
    inputs=("filtered_clouds", "stripe_statistics", "registrations", "alignments", "calibrations"),
    raw_inputs=("rig", "scan", "frames", "reference", "nominal"),
    optional_inputs=(
        "reference_stripe_statistics",
        "reference_registrations",
        "reference_alignments",
        "reference_readings",
    ),
    outputs=(
        tables.MEASUREMENTS,
        tables.READINGS,
        tables.BUDGETS,
        tables.TURNS,
        tables.ROUNDNESS_ORDERS,
        tables.WHEEL_FLATS,
        tables.JOURNAL_SECTIONS,
        tables.WHEEL_PROFILES,
        tables.TREAD_MAPS,
    ),
    config_type=config.MeasurementConfig,
    run=run_measurements,
)
REPEATABILITY = Stage(
    version=2,
    meaning="Repeatability of production measurements by wheelset, quantity, side and period",
    scope="fleet",
    inputs=("measurements",),
    outputs=(tables.REPEATABILITY,),
    config_type=config.RepeatabilityConfig,
    run=run_repeatability,
)

STAGES = (CALIBRATION, TRIANGULATION, FILTERING, FEATURES, REGISTRATION, ALIGNMENT, MEASUREMENT, REPEATABILITY)
SCAN_STAGES = tuple(stage for stage in STAGES if stage.scope == "scan")
CONFIG_SECTIONS = dict(
    zip(
        (s.name for s in STAGES),
        (
            "calibration",
            "triangulation",
            "filtering",
            "features",
            "registration",
            "alignment",
            "measurement",
            "repeatability",
        ),
        strict=True,
    )
)
