"""The catalog that outsiders open: typed, commented, the same from everywhere, while a run writes and after a move."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_inbox import FakeStages, counts, inbox_of, rows, run_night, write_scan

from warehouse import catalog, execute, reviews
from warehouse.collect import Retention, collect
from warehouse.lineage import Ledger
from warehouse.report import build
from wheelset_assets.config import Config
from wheelset_assets.declare import Stage
from wheelset_assets.quality import ConfigError
from wheelset_assets.tables import ALL_TABLES

DAY = "2025-04-05"
CONTRACT = {
    "measurements": "scan_id wheelset_id rig_id purpose captured_at acquired_on quantity side value unit expanded_uncertainty "
    "coverage_factor value_uncompensated quality_flags reason calibration_id reference_scan_id",
    "measurements_history": "scan_id value superseded_at superseded_by",
    "scan_status": "scan_id rig_id purpose captured_at acquired_on state stage reason recording",
    "calibrations": "calibration_id rig_id sensor_id n_poses n_poses_used left_rms_px right_rms_px stereo_rms_px baseline_mm",
    "registrations": "scan_id station source_sensor_id target_sensor_id qw qx qy qz tx_mm ty_mm tz_mm inlier_rmse_mm "
    "n_constrained quality_flags",
    "repeatability": "wheelset_id quantity side period period_start n mean standard_deviation range",
    "budgets": "scan_id quantity side source standard_uncertainty sensitivity contribution share",
    "reference_values": "wheelset_id quantity side value_mm expanded_uncertainty_mm measured_at instrument",
    "lineage": "scan_id stage output_version input_name input_version code_version config_fingerprint git_commit produced_at",
    "triangulated_clouds": "scan_id x_mm y_mm z_mm",
    "filtered_clouds": "scan_id x_mm y_mm z_mm",
    "features": "scan_id",
    "alignments": "scan_id station",
}


@pytest.fixture
def warehouse(tmp_path: Path) -> Path:
    return tmp_path / "warehouse"


def made(inbox: Path, warehouse: Path, config: Config | None = None) -> Path:
    run_night(inbox, warehouse, config)
    return catalog.build(warehouse, Ledger(warehouse), sorted((inbox / "cmm").glob("*.csv")))


@pytest.mark.parametrize("empty", [True, False])
def test_every_view_and_column_of_the_contract_with_comments(
    inbox: Path, warehouse: Path, stages: FakeStages, empty: bool
) -> None:
    if empty:
        shutil.rmtree(inbox / "scans")
    made(inbox, warehouse)
    with duckdb.connect(str(warehouse / "warehouse.duckdb"), read_only=True) as connection:
        found = connection.execute(
            "SELECT table_name, column_name, comment FROM duckdb_columns() WHERE NOT internal"
        ).fetchall()
        views = dict(connection.execute("SELECT view_name, comment FROM duckdb_views() WHERE NOT internal").fetchall())
        columns: dict[str, dict[str, str | None]] = {}
        for view, column, comment in found:
            columns.setdefault(view, {})[column] = comment
        for view, names in CONTRACT.items():
            assert set(names.split()) <= set(columns[view]), view
        for view, comment in views.items():
            assert comment, view
            assert [c for c, text in columns[view].items() if not text] == [], view
            connection.execute(f"SELECT * FROM {view} LIMIT 3").fetchall()
        for table in ALL_TABLES:
            for c in table.columns:
                assert columns[table.name][c.name] == c.comment
                assert not c.unit or c.comment.endswith(f"[{c.unit}]")


def test_types_do_not_depend_on_whether_there_are_rows(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    made(inbox, tmp_path / "full")
    shutil.rmtree(inbox / "scans")
    made(inbox, tmp_path / "empty")
    query = "SELECT table_name, column_name, data_type FROM duckdb_columns() WHERE NOT internal ORDER BY ALL"
    full, empty = rows(tmp_path / "full", query), rows(tmp_path / "empty", query)
    assert set(full) == set(empty)
    assert ("measurements", "captured_at", "TIMESTAMP WITH TIME ZONE") in full
    assert ("measurements", "quality_flags", "VARCHAR[]") in full


def test_from_any_working_directory_and_awkward_names(tmp_path: Path, stages: FakeStages) -> None:
    root = tmp_path / "it's [a] *place* day=1 ö"
    inbox, warehouse = inbox_of(root / "inbox"), root / "ware house"
    made(inbox, warehouse)
    query = "SELECT count(*), min(day) FROM filtered_clouds"
    script = f"import duckdb, sys; print(duckdb.connect(sys.argv[1], read_only=True).sql('{query}').fetchall())"
    done = subprocess.run(
        [sys.executable, "-c", script, str(warehouse / "warehouse.duckdb")],
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == f"[(3, '{DAY}')]"


def test_readable_while_another_process_reads_and_a_run_replaces_it(
    inbox: Path, warehouse: Path, stages: FakeStages
) -> None:
    made(inbox, warehouse)
    reader = duckdb.connect(str(warehouse / "warehouse.duckdb"), read_only=True)
    before = reader.sql("SELECT count(*) FROM measurements").fetchall()
    write_scan(inbox, "more", f"{DAY}T20:00:00+08:00")
    made(inbox, warehouse)
    assert reader.sql("SELECT count(*) FROM measurements").fetchall() == before == [(3,)]
    reader.close()
    assert rows(warehouse, "SELECT count(*) FROM measurements") == [(4,)]


def test_a_moved_warehouse_is_rebuilt_by_the_first_who_asks(
    inbox: Path, warehouse: Path, tmp_path: Path, stages: FakeStages
) -> None:
    (inbox / "cmm" / "review.csv").write_text(
        "wheelset_id,quantity,side,value_mm,expanded_uncertainty_mm,measured_at\nWS-1,wheel_diameter,left,860.1,0.003,2025-04-05T12:00:00Z\n"
    )
    made(inbox, warehouse)
    shutil.move(warehouse, tmp_path / "moved")
    shutil.rmtree(inbox)
    connection = catalog.connect(tmp_path / "moved")
    assert connection.sql("SELECT count(*) FROM measurements").fetchall() == [(3,)]
    assert connection.sql("SELECT count(*) FROM reference_values WHERE source = 'cmm'").fetchall() == [(1,)]
    connection.close()
    with pytest.raises(ConfigError, match=r"no warehouse\.duckdb there; run `wheelset run"):
        catalog.connect(warehouse)


def test_a_kill_while_building_leaves_the_old_catalog(
    inbox: Path, warehouse: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    made(inbox, warehouse)
    write_scan(inbox, "more", f"{DAY}T20:00:00+08:00")
    run_night(inbox, warehouse)
    with monkeypatch.context() as patch:
        patch.setattr(catalog, "_create_fused_clouds", lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            catalog.build(warehouse, Ledger(warehouse))
    with duckdb.connect(str(warehouse / "warehouse.duckdb"), read_only=True) as connection:
        assert connection.sql("SELECT count(*) FROM measurements").fetchall() == [(3,)]


def test_superseded_values_with_when_and_by_what(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    made(inbox, warehouse)
    first = dict(rows(warehouse, "SELECT scan_id, value FROM measurements"))
    for rows_ in (9, 11):
        made(inbox, warehouse, Config.model_validate({"filtering": {"window_rows": rows_}}))
    history = rows(
        warehouse,
        "SELECT scan_id, value, superseded_at, superseded_by FROM measurements_history ORDER BY superseded_at",
    )
    assert len(history) == 6
    assert {scan: value for scan, value, *_ in history[:3]} == first
    current = dict(
        rows(
            warehouse,
            "SELECT unit, string_agg(DISTINCT output_version, '+') FROM lineage WHERE stage = 'measurements' GROUP BY 1",
        )
    )
    assert all(by for *_, by in history)
    assert current
    made(inbox, warehouse)  # back to the first values
    assert dict(rows(warehouse, "SELECT scan_id, value FROM measurements")) == first
    assert rows(warehouse, "SELECT count(*) FROM measurements_history") == [(9,)]


# --- reviews and certificates ------------------------------------------------------------------------------------

HEAD = "wheelset_id,quantity,side,value_mm,expanded_uncertainty_mm,measured_at"
ROW = "WS-1,wheel_diameter,left,860.1,0.003,2025-04-05T12:00:00+08:00"


def test_reviews_and_certificates_side_by_side(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    (inbox / "cmm" / "a.csv").write_bytes(f"\ufeff{HEAD},instrument,more\r\n{ROW},CMM 1,x\r\n".encode())
    made(inbox, warehouse)
    found = rows(
        warehouse,
        "SELECT source, origin, instrument, value_mm, measured_at = '2025-04-05 04:00:00Z' FROM reference_values ORDER BY 1",
    )
    assert found == [("certificate", f"ref-{DAY}", None, 860.0, False), ("cmm", "cmm/a.csv", "CMM 1", 860.1, True)]
    assert reviews.review_troubles(warehouse) == []


def test_the_certificate_of_a_refused_reference_is_none(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    (inbox / "scans" / f"ref-{DAY}" / "more").write_text("x")
    made(inbox, warehouse)
    assert rows(warehouse, "SELECT count(*) FROM reference_values") == [(0,)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "column wheelset_id is missing"),
        ("wheelset_id;quantity\n", "column wheelset_id is missing"),
        (f"{HEAD}\n{ROW.replace('860.1', 'about')}", "line 2: column value_mm: expected a number; found 'about'"),
        (f"{HEAD}\n{ROW.replace('860.1', 'nan')}", "line 2: column value_mm: expected a finite number"),
        (
            f"{HEAD}\n{ROW}\n{ROW.replace('0.003', '-1')}",
            "line 3: column expanded_uncertainty_mm: expected a finite number, not negative",
        ),
        (f"{HEAD}\n{ROW.replace('+08:00', '')}", "line 2: column measured_at: expected a time with an offset"),
        (f"{HEAD}\n{ROW.replace('2025-04-05T12:00:00+08:00', '0001-01-01T00:00:00+08:00')}", "column measured_at"),
        (f"{HEAD}\n{ROW.replace('left', 'Left')}", "line 2: column side: expected left, right or both; found 'Left'"),
        (f"{HEAD}\n{ROW.replace('WS-1', '')}", "line 2: column wheelset_id: expected a name"),
        (f"{HEAD}\nWS-1", "line 2: column quantity: expected a name; found None"),
        (f"{HEAD}\n\xff", "cannot be read"),
    ],
)
def test_a_review_that_cannot_be_read_is_a_warning(inbox: Path, warehouse: Path, text: str, words: str) -> None:
    (inbox / "cmm" / "bad.csv").write_bytes(text.encode("latin-1"))
    (inbox / "cmm" / "good.csv").write_text(f"{HEAD}\n{ROW}\n")
    warehouse.mkdir()
    catalog.build(warehouse, Ledger(warehouse), sorted((inbox / "cmm").glob("*.csv")))
    (warning,) = reviews.review_troubles(warehouse)
    assert warning.startswith("review left out: cmm/bad.csv: ")
    assert words in warning
    assert rows(warehouse, "SELECT origin FROM reference_values") == [("cmm/good.csv",)]


# --- fused clouds ------------------------------------------------------------------------------------------------


def test_fused_clouds_against_numpy(
    inbox: Path, warehouse: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points of three sensors or lines, two of them with a pose against the first."""
    lines = (("a", 0), ("a", 1), ("b", 0))
    names = ("qw", "qx", "qy", "qz", "tx_mm", "ty_mm", "tz_mm")
    random = np.random.default_rng(5)
    quaternions = random.normal(size=(2, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    shifts = random.normal(size=(2, 3)) * 100

    def publish(stage: Stage, task: execute.Task, produced: dict[str, pa.Table]) -> object:
        for table in stage.outputs:
            if table.name == "filtered_clouds":
                base = produced[table.name].to_pylist()[0]
                places = [(*line, frame) for line in lines for frame in range(4)]
                produced[table.name] = table.from_rows(
                    [
                        base
                        | {
                            "sensor_id": s,
                            "line": l,
                            "frame": f,
                            "x_mm": len(s) + f,
                            "y_mm": 2.0 * l,
                            "z_mm": 300.0 + f,
                        }
                        for s, l, f in places
                    ]
                )
            if table.name == "registrations":
                base = produced[table.name].to_pylist()[0] | {
                    "target_sensor_id": "a",
                    "target_line": 0,
                    "station": "st",
                }
                produced[table.name] = table.from_rows(
                    [
                        base | {"source_sensor_id": s, "source_line": l} | dict(zip(names, (*q, *t), strict=True))
                        for (s, l), q, t in zip(lines[1:], quaternions.tolist(), shifts.tolist(), strict=True)
                    ]
                )
        return kept(stage, task, produced)

    kept = execute._publish
    monkeypatch.setattr(execute, "_publish", publish)
    made(inbox, warehouse)
    columns = "sensor_id, line, frame, x_mm, y_mm, z_mm"
    order = f"WHERE scan_id = 'ref-{DAY}' ORDER BY sensor_id, line, frame"
    raw = rows(warehouse, f"SELECT {columns} FROM filtered_clouds {order}")
    fused = rows(warehouse, f"SELECT {columns} FROM fused_clouds {order}")
    assert len(raw) == len(fused) == 12
    for before, after in zip(raw, fused, strict=True):
        assert before[:3] == after[:3]
        point = np.array(before[3:])
        if before[:2] != ("a", 0):
            i = 0 if before[0] == "a" else 1
            w, v = quaternions[i, 0], quaternions[i, 1:]
            point = point + 2 * w * np.cross(v, point) + 2 * np.cross(v, np.cross(v, point)) + shifts[i]
        assert np.allclose(point, after[3:], atol=1e-9)


def test_a_single_sensor_is_in_its_own_frame_once(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    made(inbox, warehouse)
    columns = "source_sensor_id, source_line, target_sensor_id, target_line"
    assert rows(warehouse, f"SELECT DISTINCT {columns} FROM registrations") != []
    doubled = rows(
        warehouse, "SELECT scan_id, sensor_id, line, frame, row FROM fused_clouds GROUP BY ALL HAVING count(*) > 1"
    )
    assert doubled == []


def test_the_catalog_names_no_file_that_is_not_there(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    made(inbox, warehouse)
    found = set()
    for (sql,) in rows(warehouse, "SELECT sql FROM duckdb_views() WHERE NOT internal"):
        found |= {name for part in sql.split("'") for name in part.splitlines() if name.endswith(".parquet")}
    assert len(found) > 20
    assert all(name.startswith("/") and Path(name).is_file() for name in found)
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 3)
    stored = json.loads((warehouse / "_catalog" / "reviews.json").read_text())
    assert (stored["reviews"], stored["troubles"]) == ([], [])
    assert pq.read_table(warehouse / "_catalog" / "scan_status.parquet").schema.field("acquired_on").type == pa.date32()
    assert not [p for p in os.listdir(warehouse) if p.startswith(".tmp")]


def test_measurements_as_they_were(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    """Each generation is found again at the moment between it and the next; a result that came again counts from its first."""
    warehouse, moments, values = tmp_path / "w", [], []
    query = "SELECT scan_id, value FROM {} ORDER BY ALL"
    before = datetime.now(UTC)
    for window in (5, 7, 9):
        run_night(inbox, warehouse, Config.model_validate({"filtering": {"window_rows": window}}))
        moments.append(datetime.now(UTC))
        values.append(rows(warehouse, query.format("measurements")))
    assert len({str(v) for v in values}) == 3
    found = [rows(warehouse, query.format(f"measurements_as_of(TIMESTAMPTZ '{m.isoformat()}')")) for m in moments]
    assert found == values
    assert rows(warehouse, query.format(f"measurements_as_of(TIMESTAMPTZ '{before.isoformat()}')")) == []
    for moment, then in zip(moments, values, strict=True):
        with catalog.as_of(warehouse, moment) as connection:
            assert connection.execute(query.format("measurements")).fetchall() == then
            (n,) = connection.execute("SELECT count(*) FROM service_values").fetchone() or (None,)
            assert n == sum(scan.startswith("scan-") for scan, _ in then)  # views of reports stand on what was then
            report = build(connection, "stability", {"as_of": moment.isoformat()})
            assert any("current at the moment" in note for note in report.notes)
    record = Ledger(warehouse).day(DAY).current[f"scan-{DAY}-0", "measurements"]
    day = Ledger(warehouse).day(DAY)
    day.put(replace(record, produced_at=datetime.now(UTC), code_version="9"))
    assert day.current[f"scan-{DAY}-0", "measurements"].since == record.produced_at


def test_values_that_were_collected_are_not_left_out_in_silence(
    inbox: Path, tmp_path: Path, stages: FakeStages
) -> None:
    made(inbox, tmp_path, Config.model_validate({"filtering": {"window_rows": 5}}))
    moment = datetime.now(UTC)
    made(inbox, tmp_path, Config.model_validate({"filtering": {"window_rows": 9}}))
    with catalog.as_of(tmp_path, moment) as connection:
        assert connection.execute("SELECT count(*) FROM measurements").fetchone() != (0,)
    later = datetime.now(UTC)
    collect(tmp_path, Retention(keep_days=0, keep_versions=0), delete=True)
    with pytest.raises(ConfigError, match="have been collected"):
        catalog.as_of(tmp_path, moment)
    catalog.as_of(tmp_path, later).close()


def test_what_each_stage_took(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    stages.failing["features", f"scan-{DAY}-0"] = "no keypoints"
    run_night(inbox, tmp_path / "w")
    found = rows(
        tmp_path / "w", "SELECT stage, state, count(*), sum(seconds) FROM stage_runs GROUP BY ALL ORDER BY ALL"
    )
    assert ("features", "failed", 1, 0.0) in found
    assert ("features", "ok", 2, 0.5) in found
    assert ("measurements", "ok", 2, 0.5) in found
