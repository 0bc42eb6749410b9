"""Tables of stages 7 and 8: measurements, their budgets, repeatability."""

from __future__ import annotations

from wheelset_assets import screens
from wheelset_assets.declare import Check, Column, Table
from wheelset_assets.tables.columns import CALIBRATION_ID, FLAGS, QUANTITY, RIG_ID, SCAN_ID, SIDE

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
            screen=screens.value_or_reason,
        ),
        Check(
            "value_with_uncertainty",
            "SELECT * FROM {table} WHERE value IS NOT NULL AND (expanded_uncertainty IS NULL OR expanded_uncertainty <= 0)",
            "no value without its uncertainty",
            screen=screens.value_with_uncertainty,
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
            screen=screens.shares_sum_to_one,
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
