"""Tables of the catalog that are derived from the ledger and the reviews: their declarations."""

from __future__ import annotations

import pyarrow as pa

from warehouse.limits import LIMITS
from wheelset_assets.declare import Column, Table

SCAN_STATUS = Table(
    "scan_status",
    1,
    "What became of every scan of the inbox",
    key=("scan_id",),
    layout="fleet",
    columns=(
        Column("scan_id", "string", "Scan bundle, or the folder's name if its JSON cannot be read"),
        Column("rig_id", "string", "Measuring rig", nullable=True),
        Column("wheelset_id", "string", "Wheelset", nullable=True),
        Column("purpose", "string", "production or reference", nullable=True),
        Column("captured_at", "timestamp", "When the scan was taken", unit="utc", nullable=True),
        Column("acquired_on", "date", "Day of the scan in its own time zone", nullable=True),
        Column(
            "state", "string", "measured, refused (the bundle cannot be used), failed (a stage could not), or pending"
        ),
        Column("stage", "string", "Stage that refused or failed", nullable=True),
        Column("reason", "string", "Why", nullable=True),
        Column("details", "string", "More of why", nullable=True),
        Column("recording", "string", "Path of the rerun recording, if any", nullable=True),
        Column("n_points", "int64", "Triangulated points", nullable=True),
    ),
)
REFERENCE_VALUES = Table(
    "reference_values",
    1,
    "Reviews by independent instruments, and certificates of master wheelsets",
    key=(),
    layout="fleet",
    columns=(
        Column("wheelset_id", "string", "Wheelset"),
        Column("quantity", "string", "Quantity"),
        Column("side", "string", "Side"),
        Column("value_mm", "float64", "Value at 20 °C", unit="mm"),
        Column("expanded_uncertainty_mm", "float64", "Expanded uncertainty, k = 2", unit="mm"),
        Column(
            "measured_at",
            "timestamp",
            "When it was measured; for a certificate, of the reference scan that carries it",
            unit="utc",
        ),
        Column("instrument", "string", "Instrument", nullable=True),
        Column("source", "string", "cmm or certificate"),
        Column("origin", "string", "File or scan that says so"),
    ),
)
LINEAGE = Table(
    "lineage",
    1,
    "One row for each output and each of its inputs, down to the files of the bundles",
    key=(),
    layout="fleet",
    columns=(
        Column("scan_id", "string", "Scan, calibration or fleet", nullable=True),
        Column("unit", "string", "scan_id, or scan_id@calibration_id for a reference triangulated again"),
        Column("stage", "string", "Stage; `bundle` is the verification of the raw files"),
        Column("output_name", "string", "Table that was written"),
        Column("output_version", "string", "Version of the output: hash of its content"),
        Column("input_name", "string", "Input: table, configuration file or raw file", nullable=True),
        Column("input_version", "string", "Version of the input: hash, sha256 for raw files", nullable=True),
        Column("code_version", "string", "Version of the stage and its tables"),
        Column("config_fingerprint", "string", "Fingerprint of the stage's configuration"),
        Column("fingerprint", "string", "Identity of the computation"),
        Column("git_commit", "string", "Commit of the program", nullable=True),
        Column("packages", "string", "Versions of the packages", nullable=True),
        Column("path", "string", "File of the output, relative to the warehouse", nullable=True),
        Column("run_id", "string", "Run that produced it", nullable=True),
        Column("produced_at", "timestamp", "When it was produced", unit="utc", nullable=True),
        Column("seconds", "float64", "How long it took", nullable=True),
        Column("superseded_at", "timestamp", "When it was superseded; null while current", unit="utc", nullable=True),
        Column("superseded_by", "string", "Version that superseded it", nullable=True),
    ),
)
STAGE_RUNS = Table(
    "stage_runs",
    1,
    "What each stage took for each scan, on record: time, points, bytes, and what became of it",
    key=(),
    layout="fleet",
    columns=(
        Column("run_id", "string", "Run", nullable=True),
        Column("day", "string", "Acquisition day; calibrations, fleet, or undated"),
        Column("scan_id", "string", "Scan, calibration or fleet"),
        Column("unit", "string", "scan_id, or scan_id@calibration_id for a reference triangulated again"),
        Column("stage", "string", "Stage"),
        Column("state", "string", "ok, refused or failed"),
        Column("reason", "string", "Why it was refused or failed", nullable=True),
        Column("produced_at", "timestamp", "When it ended", unit="utc", nullable=True),
        Column("seconds", "float64", "Wall-clock time", unit="s"),
        Column("compute_seconds", "float64", "Of it, in the stage's own function", unit="s", nullable=True),
        Column("n_points", "int64", "Points that it made"),
        Column("n_rows", "int64", "Rows that it wrote"),
        Column("n_bytes", "int64", "Size of what it wrote", unit="byte"),
        Column("superseded_at", "timestamp", "When its result was superseded", unit="utc", nullable=True),
    ),
)
DERIVED = (SCAN_STATUS, REFERENCE_VALUES, LINEAGE, STAGE_RUNS, LIMITS)
SINCE = pa.timestamp("us", tz="UTC")
