"""The calibration report on a few rows whose figures are known beforehand."""

from __future__ import annotations

import datetime
from typing import Any

import duckdb
import pytest

from warehouse.render_figures import draw
from warehouse.report import Report, build
from wheelset_assets.tables import CALIBRATION_CORNERS, CALIBRATION_POSES, CALIBRATIONS, STRIPE_STATISTICS

AT = datetime.datetime(2025, 3, 30, tzinfo=datetime.UTC)
NAMES = ["left_f", "rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"]


def calibration(sensor_id: str, **given: Any) -> dict[str, Any]:
    row: dict[str, Any] = {column.name: None for column in CALIBRATIONS.columns}
    n = len(NAMES)
    variances = [0.25, 0, 0, 0, 0.03**2, 0.02**2, 0.05**2]
    covariance = [variances[i] if i == j else 0.0 for i in range(n) for j in range(n)]
    usable = {
        "state": "usable",
        "n_poses": 3,
        "n_poses_used": 2,
        "baseline_mm": 100.0,
        "right_from_left": [1, 0, 0, -80.0, 0, 1, 0, 0.0, 0, 0, 1, 60.0, 0, 0, 0, 1],
        "parameter_names": NAMES,
        "covariance": covariance,
        "depth_range_mm": [240.0, 290.0],
        "square_edge_mean_mm": 10.0,
    }
    common = {
        "calibration_id": "cal",
        "rig_id": "rig",
        "sensor_id": sensor_id,
        "captured_at": AT,
        "rig_temperature_c": 21.0,
        "image_width_px": 512,
        "image_height_px": 1024,
    }
    return row | common | usable | given


def pose(name: str, used: bool, reason: str | None = None) -> dict[str, Any]:
    row: dict[str, Any] = {column.name: None for column in CALIBRATION_POSES.columns}
    return row | {"calibration_id": "cal", "sensor_id": "a", "pose": name, "used": used, "reason": reason}


def corner(number: int) -> dict[str, Any]:
    """A corner of pose 0 in the left image of sensor a, that misses by a tenth of a pixel downwards."""
    place = {"calibration_id": "cal", "sensor_id": "a", "pose": "0", "camera": "left", "corner": number}
    return place | {"u_px": float(number), "v_px": 500.0, "residual_u_px": 0.0, "residual_v_px": 0.1}


def stripes(scan_id: str, normal: list[float], distance_mm: float, epipolar_px: float) -> dict[str, Any]:
    row: dict[str, Any] = {c.name: 0 if c.type.startswith("int") else None for c in STRIPE_STATISTICS.columns}
    plane = {"plane_normal": normal, "plane_distance_mm": distance_mm, "plane_centre_mm": [distance_mm, 5.0, 260.0]}
    epipolar = {"epipolar_residual_px": epipolar_px, "u_epipolar_residual_px": 0.01}
    return row | {"scan_id": scan_id, "sensor_id": "a"} | plane | epipolar


@pytest.fixture
def report() -> Report:
    refused = {c.name: None for c in CALIBRATIONS.columns if c.nullable}
    calibrations = [
        calibration("a"),
        calibration("b", **refused | {"state": "refused", "reason": "too few board poses", "n_poses_used": 0}),
    ]
    connection = duckdb.connect(":memory:")
    connection.execute("SET TimeZone = 'UTC'")
    tables = {
        "calibrations": CALIBRATIONS.from_rows(calibrations),
        "calibration_poses": CALIBRATION_POSES.from_rows(
            [pose("0", True), pose("1", True), pose("2", False, "blurred")]
        ),
        "calibration_corners": CALIBRATION_CORNERS.from_rows([corner(n) for n in range(700)]),
        "stripe_statistics": STRIPE_STATISTICS.from_rows(
            [stripes("s1", [1, 0, 0], 40.0, 0.02), stripes("s2", [1, 0, 0], 40.3, -0.38)]
        ),
    }
    for name, table in tables.items():
        connection.register(f"given_{name}", table)
        connection.execute(f"CREATE VIEW {name} AS SELECT * FROM given_{name}")
    connection.execute(
        "CREATE VIEW scan_status AS SELECT * FROM (VALUES ('s1', 'rig', TIMESTAMPTZ '2025-04-01 00:00Z'), "
        "('s2', 'rig', TIMESTAMPTZ '2025-04-09 00:00Z')) t(scan_id, rig_id, captured_at)"
    )
    connection.execute(
        "CREATE VIEW measurements AS SELECT scan_id, 'cal' AS calibration_id, unnest([['outliers'], if(scan_id = 's2', "
        "['laser_plane_moved', 'outliers', 'cameras_moved'], [])]) AS quality_flags FROM scan_status"
    )
    return build(connection, "calibration", {})


def rows(report: Report, block: str) -> list[dict[str, Any]]:
    return report.blocks[block].table.to_pylist()


def test_uncertainty_of_the_baseline_and_age_are_those_of_the_rows(report: Report) -> None:
    good = rows(report, "sensors")[0]
    assert good["u_baseline_um"] == pytest.approx(1000 * ((0.8 * 0.03) ** 2 + (0.6 * 0.05) ** 2) ** 0.5)
    assert good["age_days"] == pytest.approx(10.0)
    assert (good["nearest_mm"], good["farthest_mm"]) == (240.0, 290.0)
    listed = {r["parameter"]: r["standard_uncertainty"] for r in rows(report, "intrinsics")}
    assert listed["left_f"] == pytest.approx(0.5)
    assert listed["tz_mm"] == pytest.approx(0.05)


def test_refused_sensors_and_poses_stand_with_their_reason(report: Report) -> None:
    assert [(r["sensor_id"], r["reason"]) for r in rows(report, "refused")] == [("b", "too few board poses")]
    assert [(r["pose"], r["reason"]) for r in rows(report, "left_out")] == [("2", "blurred")]
    assert [r["pose"] for r in rows(report, "board_poses")] == ["0", "1"]


def test_corners_are_drawn_evenly_and_not_more_than_six_hundred_a_camera(report: Report) -> None:
    drawn = rows(report, "residuals")
    assert [r["corner"] for r in drawn] == list(range(0, 700, 2))
    assert {(r["residual_v_px"], r["image_width_px"]) for r in drawn} == {(0.1, 512)}
    figure = draw(report, report.spec.figures[0])
    assert [panel.title for panel in figure.groups[0].panels] == ["left, residuals × 300", "poses"]


def test_a_laser_plane_that_moved_shows_by_how_much(report: Report) -> None:
    first, second = rows(report, "planes")
    assert (first["scan_id"], first["shift_um"], first["turn_deg"]) == ("s1", pytest.approx(0.0), pytest.approx(0.0))
    assert second["shift_um"] == pytest.approx(300.0)
    assert second["turn_deg"] == pytest.approx(0.0)


def test_cameras_that_moved_show_by_how_much_and_with_the_flags_of_the_scan(report: Report) -> None:
    first, second = rows(report, "planes")
    assert (first["epipolar_change_px"], first["watch"]) == (pytest.approx(0.0), "")
    assert second["epipolar_change_px"] == pytest.approx(-0.4)
    assert second["watch"] == "cameras_moved, laser_plane_moved"
