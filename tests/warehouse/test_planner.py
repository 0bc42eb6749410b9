"""What `status`, `--dry-run`, the schedule and the sensor say is what a run then does; asking changes nothing."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from fake_inbox import FakeStages, inbox_of, run_night, seal, write_calibration, write_rig, write_scan

from warehouse.planner import plan
from wheelset_assets.config import Config

DAY = "2025-04-05"


@pytest.fixture
def warehouse(tmp_path: Path) -> Path:
    return tmp_path / "warehouse"


def test_asking_makes_nothing(inbox: Path, warehouse: Path) -> None:
    found = plan(warehouse, inbox, Config())
    assert not warehouse.exists()
    assert not found.idle
    assert (found.n_scans, found.calibrations, found.estimated_seconds) == (3, ["cal-1"], None)
    assert [(d.day, d.new, d.stale) for d in found.days] == [
        (DAY, [f"ref-{DAY}", f"scan-{DAY}-0", f"scan-{DAY}-1"], {})
    ]
    document = json.loads(json.dumps(found.as_json()))
    assert document["scans_in_inbox"] == 3
    assert document["days"][0]["new"] == [f"ref-{DAY}", f"scan-{DAY}-0", f"scan-{DAY}-1"]


def test_only_some(inbox: Path, warehouse: Path) -> None:
    found = plan(warehouse, inbox, Config(), frozenset({f"scan-{DAY}-0"}))
    assert [d.new for d in found.days] == [[f"scan-{DAY}-0"]]


@pytest.mark.parametrize(
    "data", [b"{", b"[]", b'{"captured_at": 5}', b'{"captured_at": "yesterday"}', b"[" * 100_000, b"\xff"]
)
def test_bundles_without_a_readable_day(inbox: Path, warehouse: Path, stages: FakeStages, data: bytes) -> None:
    (inbox / "scans" / f"scan-{DAY}-1" / "scan.json").write_bytes(data)
    assert [(d.day, len(d.new)) for d in plan(warehouse, inbox, Config()).days] == [(DAY, 2), ("undated", 1)]
    run_night(inbox, warehouse)
    assert plan(warehouse, inbox, Config()).idle


def test_a_json_that_is_a_pipe_does_not_hold_the_plan_up(inbox: Path, warehouse: Path) -> None:
    folder = inbox / "scans" / "pipe"
    folder.mkdir()
    os.mkfifo(folder / "scan.json")
    assert [d.day for d in plan(warehouse, inbox, Config()).days] == [DAY, "undated"]


def test_a_json_of_many_images_is_read_whole(inbox: Path, warehouse: Path) -> None:
    folder = inbox / "scans" / f"scan-{DAY}-1"
    content = json.loads((folder / "scan.json").read_text())
    text = json.dumps(
        {"files": {f"images/{i}": "0" * 64 for i in range(20_000)}} | {k: v for k, v in content.items() if k != "files"}
    )
    assert len(text) > 2**20
    (folder / "scan.json").write_text(text)
    assert [d.day for d in plan(warehouse, inbox, Config()).days] == [DAY]


def test_why(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    config = Config.model_validate({"filtering": {"window_rows": 9}})
    (day,) = plan(warehouse, inbox, config).days
    assert dict(day.why) == {"filtered_clouds: configuration changed": 3}
    write_rig(inbox, expansion_per_k=12e-6)
    (day,) = plan(warehouse, inbox, Config()).days
    assert list(day.stale) == ["triangulated_clouds"]
    assert dict(day.why) == {"triangulated_clouds: rig changed": 3}


def test_a_knob_of_the_calibration_shows(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    config = Config.model_validate({"calibration": {"min_poses": 6}})
    found = plan(warehouse, inbox, config)
    assert found.calibrations == ["cal-1"]
    (day,) = found.days
    assert dict(day.why) == {"calibration cal-1 is new or stale": 3}


def test_a_scan_that_could_not_start_and_can_now(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    write_scan(inbox, "early", f"{DAY}T07:00:00+08:00")
    run_night(inbox, warehouse)
    assert plan(warehouse, inbox, Config()).idle
    write_scan(inbox, "first-ref", f"{DAY}T06:00:00+08:00", "reference")
    run_night(inbox, warehouse, only=frozenset({"first-ref"}))
    (day,) = plan(warehouse, inbox, Config()).days
    assert day.stale == {"measurements": [f"ref-{DAY}", "early"]}
    assert "measurements: could not start before: no reference" in day.why


def test_a_calibration_that_nobody_names_yet(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    write_calibration(inbox, "cal-9")
    found = plan(warehouse, inbox, Config())
    assert (found.idle, found.calibrations, found.days) == (False, ["cal-9"], [])
    run_night(inbox, warehouse)
    assert plan(warehouse, inbox, Config()).idle


def test_time_is_estimated_from_what_was_spent(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    assert plan(warehouse, inbox, Config()).estimated_seconds == 0
    write_scan(inbox, "more", f"{DAY}T20:00:00+08:00")
    assert plan(warehouse, inbox, Config()).estimated_seconds == 6 * 0.25
    config = Config.model_validate({"alignment": {"min_face_mm": 4.0}})
    assert plan(warehouse, inbox, config).estimated_seconds == (6 + 3 * 2) * 0.25


def test_a_plan_is_what_the_run_does(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=(DAY, "2025-04-06")), tmp_path / "warehouse"
    run_night(inbox, warehouse)
    stages.take()
    write_scan(inbox, "more", "2025-04-06T20:00:00+08:00")
    seal(inbox / "scans" / f"scan-{DAY}-0", comment="mended")
    planned = {scan for day in plan(warehouse, inbox, Config()).days for scan in day.new}
    run_night(inbox, warehouse)
    assert {unit for _, unit in stages.take()} - {"fleet"} == planned == {"more", f"scan-{DAY}-0"}
