"""Synthetic tables for the tests of the reports: an in-memory DuckDB with the views that a warehouse has."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from warehouse.catalog_tables import LINEAGE
from warehouse.limits import read_limits
from warehouse.report import functions, query
from wheelset_assets.tables import ALL_TABLES, CALIBRATION_CORNERS, CALIBRATION_POSES, CALIBRATIONS, MEASUREMENTS

UTC = datetime.UTC
REVIEWS = pa.schema(
    [
        ("wheelset_id", pa.string()),
        ("quantity", pa.string()),
        ("side", pa.string()),
        ("value_mm", pa.float64()),
        ("expanded_uncertainty_mm", pa.float64()),
        ("measured_at", pa.timestamp("us", tz="UTC")),
        ("instrument", pa.string()),
        ("source", pa.string()),
    ]
)
STATUS = pa.schema(
    [
        ("scan_id", pa.string()),
        ("rig_id", pa.string()),
        ("wheelset_id", pa.string()),
        ("purpose", pa.string()),
        ("captured_at", pa.timestamp("us", tz="UTC")),
        ("acquired_on", pa.date32()),
        ("state", pa.string()),
        ("stage", pa.string()),
        ("reason", pa.string()),
        ("recording", pa.string()),
    ]
)
SIX = (
    ("journal_diameter", "left", 130.4530, 0.0008),
    ("journal_diameter", "right", 130.5250, 0.0008),
    ("wheel_diameter", "left", 920.6550, 0.003),
    ("wheel_diameter", "right", 921.1660, 0.003),
    ("shoulder_distance", "both", 2180.1200, 0.003),
    ("inner_distance", "both", 1354.2960, 0.003),
)


def at(month: int, day: int, hour: int = 10, minute: int = 0) -> datetime.datetime:
    """A moment of the year of the tests."""
    return datetime.datetime(2024, month, day, hour, minute, tzinfo=UTC)


def measurement(scan_id: str, quantity: str, side: str, value: float | None, **given: Any) -> dict[str, Any]:
    """A row of `measurements`; what is not given is filled in."""
    captured_at = given.pop("captured_at", at(4, 1))
    row: dict[str, Any] = dict.fromkeys(MEASUREMENTS.schema.names)
    row |= {
        "scan_id": scan_id,
        "wheelset_id": "W1",
        "rig_id": "bench",
        "purpose": "production",
        "captured_at": captured_at,
        "acquired_on": captured_at.date(),
        "quantity": quantity,
        "side": side,
        "value": value,
        "unit": "mm",
        "expanded_uncertainty": None if value is None else 0.002,
        "coverage_factor": 2.0,
        "value_uncompensated": value,
        "quality_flags": [],
        "reason": None if value is not None else "not seen",
        "wheelset_type": "CRH3",
        "calibration_id": "cal-1",
        "reference_scan_id": "ref-1",
        "wheelset_temperature_c": 20.0,
        "rig_temperature_c": 20.0,
    }
    assert set(given) <= set(row), given
    return row | given


def review(quantity: str, side: str, value_mm: float, measured_at: datetime.datetime, **given: Any) -> dict[str, Any]:
    """A row of `reference_values`."""
    return {
        "wheelset_id": "W1",
        "quantity": quantity,
        "side": side,
        "value_mm": value_mm,
        "expanded_uncertainty_mm": 0.001,
        "measured_at": measured_at,
        "instrument": "CMM",
        "source": "cmm",
    } | given


def warehouse(
    measurements: list[dict[str, Any]] | None = None,
    reviews: list[dict[str, Any]] | None = None,
    status: list[dict[str, Any]] | None = None,
    others: dict[str, list[dict[str, Any]]] | None = None,
) -> duckdb.DuckDBPyConnection:
    """A connection with the views that the reports read."""
    connection = duckdb.connect(":memory:")
    connection.register("measurements", pa.Table.from_pylist(measurements or [], schema=MEASUREMENTS.schema))
    connection.register("reference_values", pa.Table.from_pylist(reviews or [], schema=REVIEWS))
    connection.register("scan_status", pa.Table.from_pylist(status or [], schema=STATUS))
    connection.register("limits", read_limits(Path("no warehouse, so the shipped examples")))
    for table in (*ALL_TABLES, LINEAGE):
        if table.name not in ("measurements", *(others or ())):
            empty = table.empty()
            if table.layout == "scan":
                empty = empty.append_column("scan_id", pa.array([], pa.string()))
            connection.register(table.name, empty)
    history = pa.Table.from_pylist([], schema=MEASUREMENTS.schema).append_column(
        "output_version", pa.array([], pa.string())
    )
    connection.register("measurements_history", history)
    for name, rows in (others or {}).items():
        known = {table.name: table.schema for table in ALL_TABLES if table.layout != "scan"}
        connection.register(name, pa.Table.from_pylist(rows, schema=known.get(name)))
    connection.execute(functions())
    for name in ("verdicts", "diameter_differences"):
        connection.execute(f"CREATE VIEW {name} AS {query(f'limits/{name}.sql').text}")
    return connection


def campaign(wheelsets: tuple[str, ...] = ("W1", "W2"), repeats: int = 8, seed: int = 5) -> duckdb.DuckDBPyConnection:
    """Five months of repeats of a few wheelsets, as in the paper's Fig. 2, with a review of each in June."""
    rng = np.random.default_rng(seed)
    rows, reviews = [], []
    for wheelset in wheelsets:
        for month in (4, 5, 6, 7, 8):
            warm = 18 + 2 * (month - 4) + rng.uniform(-1, 1)
            for repeat in range(repeats):
                captured_at = at(month, 12, 8, 10 * repeat % 60) + datetime.timedelta(hours=repeat // 6)
                for quantity, side, nominal, _ in SIX:
                    noise = 0.0003 * rng.standard_normal()
                    rows.append(
                        measurement(
                            f"{wheelset}-{month:02d}-{repeat}", quantity, side, nominal + noise,
                            wheelset_id=wheelset, captured_at=captured_at,
                            expanded_uncertainty=0.0012 if "journal" in quantity else 0.0032,
                            value_uncompensated=nominal + noise - 0.0053 * (warm - 20),
                            wheelset_temperature_c=warm, rig_temperature_c=warm + 0.4,
                        )
                    )  # fmt: skip
        for quantity, side, nominal, expanded in SIX:
            value = nominal + expanded / 2 * rng.standard_normal()
            reviews.append(
                review(quantity, side, value, at(6, 12), wheelset_id=wheelset, expanded_uncertainty_mm=expanded)
            )
    return warehouse(
        rows,
        reviews,
        [failed("W9-01", at(5, 3), "no stripe on the inner face"), refused("W9-02", "bad hash")],
        calibrated(),
    )


def calibrated(seed: int = 6) -> dict[str, list[dict[str, Any]]]:
    """Tables of a calibration with one sensor that was calibrated and one, `W9-01`, that was refused."""
    rng = np.random.default_rng(seed)
    common = {
        "calibration_id": "cal", "rig_id": "bench", "captured_at": at(3, 30), "rig_temperature_c": 21.0,
        "image_width_px": 512, "image_height_px": 1024, "n_poses": 3, "n_poses_used": 3,
    }  # fmt: skip
    empty = {column.name: None for column in CALIBRATIONS.columns}
    names = ["left_f", "rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"]
    usable = {
        "sensor_id": "left_journal", "state": "usable", "left_rms_px": 0.02, "right_rms_px": 0.03,
        "stereo_rms_px": 0.025, "holdout_rms_px": 0.03, "epipolar_rms_px": 0.02, "baseline_mm": 100.0,
        "right_from_left": [1.0, 0, 0, -80, 0, 1, 0, 0, 0, 0, 1, 60, 0, 0, 0, 1], "parameter_names": names,
        "covariance": (1e-4 * np.eye(len(names))).ravel().tolist(), "depth_range_mm": [240.0, 290.0],
        "square_edge_mean_mm": 10.0, "coverage_ratio": 0.8, "right_coverage_ratio": 0.7, "max_tilt_deg": 30.0,
    }  # fmt: skip
    poses = [
        {column.name: None for column in CALIBRATION_POSES.columns}
        | {"calibration_id": "cal", "sensor_id": "left_journal", "pose": str(k), "used": True}
        | {"left_rms_px": 0.02, "right_rms_px": 0.03, "tilt_deg": 10.0 * k, "distance_mm": 250.0 + 10 * k}
        for k in range(3)
    ]
    corners = [
        dict(
            zip(
                (column.name for column in CALIBRATION_CORNERS.columns),
                ("cal", "left_journal", str(k), camera, n, 40.0 * (n % 10) + 60, 150.0 * (n // 10) + 100,
                 *(0.02 * rng.standard_normal(2))),
                strict=True,
            )
        )
        for k in range(3) for camera in ("left", "right") for n in range(50)
    ]  # fmt: skip
    refused_sensor = {"sensor_id": "W9-01", "state": "refused", "reason": "too few board poses"}
    return {
        "calibrations": [empty | common | usable, empty | common | refused_sensor],
        "calibration_poses": poses,
        "calibration_corners": corners,
    }


def failed(scan_id: str, captured_at: datetime.datetime, reason: str) -> dict[str, Any]:
    """A row of `scan_status` for a scan that a stage could not work on."""
    return {
        "scan_id": scan_id,
        "rig_id": "bench",
        "purpose": "production",
        "captured_at": captured_at,
        "acquired_on": captured_at.date(),
        "state": "failed",
        "stage": "alignments",
        "reason": reason,
    }


def refused(scan_id: str, reason: str) -> dict[str, Any]:
    """A row of `scan_status` for a bundle that cannot be read: without times."""
    return {"scan_id": scan_id, "state": "refused", "stage": "inbox", "reason": reason}
