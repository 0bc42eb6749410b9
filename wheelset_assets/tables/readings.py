"""What stage 7 reads off the fused surface: turns, sections, profiles, maps."""

from __future__ import annotations

from wheelset_assets.declare import Column, Table
from wheelset_assets.tables.columns import FLAGS, FRAME, LINE, QUANTITY, ROW, SCAN_ID, SIDE, STATION

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
