"""Recordings of a small simulated campaign: one scan measured, others stopped early for different reasons."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

from pipelines.replay import viewer_environment, write_recording
from warehouse.night import Night
from wheelset_assets.config import Config
from wheelset_assets.quality import ConfigError
from wheelset_assets.simulation import SimulationPlan, simulate
from wheelset_assets.stages import SCAN_STAGES

FAULTS = ("empty-stripes", "wrong-hash", "unknown-calibration", "no-reference")
MEASURED = "WS-000-20250405-00"
FRAMES = 24


@dataclass(frozen=True)
class Site:
    """A warehouse, its inbox, and the scan that each fault struck."""

    warehouse: Path
    inbox: Path
    struck: dict[str, str]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """One wheelset, five scans, four of them spoiled."""
    base = tmp_path_factory.mktemp("replay")
    plan = SimulationPlan(
        out=base / "inbox", repeats=1 + len(FAULTS), frames=FRAMES, rows=256, board_poses=7, faults=FAULTS
    )
    campaign = simulate(plan)
    with Night(base / "warehouse", campaign.inbox, Config(), workers=0) as night:
        night.prepare()
        night.run_calibrations()
        for day in night.state.days():
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
    return Site(base / "warehouse", campaign.inbox, {fault: scan_id for scan_id, fault in campaign.faults.items()})


@dataclass(frozen=True)
class Recorded:
    """A recording read back."""

    path: Path

    @cached_property
    def columns(self) -> dict[str, dict[str, list]]:
        """By entity path: values of each column, row by row, over all its chunks."""
        from rerun.chunk import RrdReader

        found: dict[str, dict[str, list]] = {}
        for chunk in RrdReader(self.path).stream():
            entity = found.setdefault(chunk.entity_path, {})
            for name, values in chunk.to_record_batch().to_pydict().items():
                entity.setdefault(name, []).extend(values)
        return found

    @property
    def recording_id(self) -> str:
        from rerun.chunk import RrdReader

        return RrdReader(self.path).recordings()[0].recording_id

    def entities(self, under: str) -> set[str]:
        """Entity paths under one."""
        return {path for path in self.columns if path.startswith(under.rstrip("/") + "/") or path == under}

    def document(self, name: str) -> str:
        return self.columns[f"/documents/{name}"]["TextDocument:text"][0][0]

    def points(self, path: str) -> np.ndarray:
        """Points of an entity, all frames together (n, 3)."""
        rows = [np.array(row) for row in self.columns[path]["Points3D:positions"] if row]
        return np.concatenate(rows)


def record(site: Site, scan_id: str, out: Path, inbox: bool = True, max_points: int = 60_000) -> Recorded:
    """A recording, verified by rerun's own command."""
    path = write_recording(site.warehouse, scan_id, out / f"{scan_id}.rrd", site.inbox if inbox else None, max_points)
    command = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(path)]
    verified = subprocess.run(command, capture_output=True, env=viewer_environment(), timeout=120)
    assert b"verified without error" in verified.stdout + verified.stderr
    return Recorded(path)


@pytest.fixture(scope="session")
def measured(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(site, MEASURED, tmp_path_factory.mktemp("measured"))


def test_recording_of_a_measured_scan_shows_every_subject(measured: Recorded) -> None:
    sensor = "left_wheel_inner"
    wanted = {
        "/rig/axle", f"/rig/sensors/{sensor}", f"/rig/sensors/{sensor}/left", f"/rig/sensors/{sensor}/right", "/rig/stations/left_wheel",
        "/rig/faces/left_wheel", f"/rig/stripe/{sensor}", f"/rig/wheelset/triangulated/{sensor}", "/rig/wheelset/removed/outlier",
        f"/rig/wheelset/fused/{sensor}", f"/stripes/{sensor}/left/line0", f"/stripes/{sensor}/right/line0", f"/removed/{sensor}/line0",
        f"/keypoints/left_wheel/sensors/{sensor}", f"/meridian/left_wheel/measured/{sensor}/line0", "/meridian/left_wheel/nominal",
        "/turns/tread_radius/left_wheel/used", "/turns/tread_radius/left_wheel/harmonics", "/turns/journal_radius/right_journal/used",
        f"/calibration/{sensor}/left/residuals", f"/calibration/{sensor}/right/corners", "/documents/calibration",
        "/documents/report", "/documents/summary", "/documents/stripes", "/documents/removed",
    }  # fmt: skip
    assert wanted <= set(measured.columns)


def test_recording_says_which_scan_run_and_state_it_is_of(site: Site, measured: Recorded) -> None:
    properties = measured.columns["/__properties/scan"]
    assert [properties[name][0][0] for name in ("scan_id", "state", "stage")] == [MEASURED, "measured", "measurements"]
    run_id = properties["run_id"][0][0]
    assert run_id
    assert MEASURED in measured.recording_id
    assert run_id in measured.recording_id


def test_report_begins_with_the_state_and_lists_values_with_uncertainty(measured: Recorded) -> None:
    lines = measured.document("report").splitlines()
    assert lines[0] == "**measured**"
    row = next(line for line in lines if line.startswith("| wheel_diameter | left |"))
    value, expanded = (float(cell) for cell in row.split("|")[3:5])
    assert 900 < value < 930
    assert 0 < expanded < 1
    assert any("wheelset" in line and "°C" in line for line in lines)
    assert "| left_wheel_inner | usable |" in measured.document("report")


def test_stripes_and_turning_wheelset_share_the_timelines(measured: Recorded) -> None:
    for path in (
        "/rig/wheelset",
        "/rig/stripe/left_journal",
        "/stripes/left_journal/left/line0",
        "/turns/journal_radius/left_journal/harmonics",
    ):
        columns = measured.columns[path]
        frames = [f for f in columns["frame"] if f is not None]
        assert set(frames) <= set(range(FRAMES))
        assert len(set(frames)) > 0.8 * FRAMES
        angles = [a for a in columns["angle_mdeg"] if a is not None]
        assert np.ptp(angles) > 300_000


def test_cloud_on_the_wheelset_turned_by_the_frame_is_what_the_sensor_saw(measured: Recorded) -> None:
    turn = measured.columns["/rig/wheelset"]
    half = {f: q[0] for f, q in zip(turn["frame"], turn["Transform3D:quaternion"], strict=True) if f is not None}
    on_wheelset = measured.points("/rig/wheelset/triangulated/left_wheel_outer")
    stripe = measured.columns["/rig/stripe/left_wheel_outer"]
    seen = [
        (f, p)
        for f, row in zip(stripe["frame"], stripe["Points3D:positions"], strict=True)
        if f is not None
        for p in row
    ]
    assert len(seen) == len(on_wheelset)
    frames, points = np.array([f for f, _ in seen]), np.array([p for _, p in seen])
    angle = np.array([2 * np.arctan2(half[f][0], half[f][3]) for f in frames])
    x, y, z = on_wheelset.T
    turned = np.column_stack([x, np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z])
    assert np.abs(turned - points).max() < 2e-3
    assert np.ptp(np.arctan2(points[:, 2], points[:, 1])) < 0.6  # a sensor looks one way...
    assert np.histogram(np.arctan2(z, y), 12, (-np.pi, np.pi))[0].min() > 0  # ... and the turn fills the wheel


def test_removed_points_are_as_many_as_stored_and_lie_on_the_map(site: Site, measured: Recorded) -> None:
    from pipelines.recording.source import open_source

    stored = open_source(site.warehouse, MEASURED, None).table("removed_points")
    assert stored is not None
    drawn = sum(len(measured.points(path)) for path in measured.entities("/rig/wheelset/removed"))
    assert drawn == stored.num_rows > 0
    of_sensor = sum(name == "left_journal" for name in stored["sensor_id"].to_pylist())
    image = np.frombuffer(
        bytes(measured.columns["/removed/left_journal/line0"]["SegmentationImage:buffer"][0][0]), np.uint8
    )
    assert (image >= 2).sum() == of_sensor


def test_clouds_are_thinned_evenly_to_the_limit(site: Site, measured: Recorded, tmp_path: Path) -> None:
    thin = record(site, MEASURED, tmp_path, max_points=600)
    for kind in ("triangulated", "fused"):
        counts = [len(thin.points(path)) for path in sorted(thin.entities(f"/rig/wheelset/{kind}"))]
        assert sum(counts) == 600
        full = [len(measured.points(path)) for path in sorted(measured.entities(f"/rig/wheelset/{kind}"))]
        assert np.allclose(np.array(counts) / 600, np.array(full) / sum(full), atol=0.01)
    assert thin.path.stat().st_size < 0.7 * measured.path.stat().st_size


def test_scan_without_stripes_has_rig_reason_and_empty_images(site: Site, tmp_path: Path) -> None:
    made = record(site, site.struck["empty-stripes"], tmp_path)
    first = made.document("report").splitlines()[0]
    assert first.startswith("**failed** at triangulated_clouds: no point could be triangulated")
    assert made.columns["/__properties/scan"]["state"][0][0] == "failed"
    assert made.document("summary").splitlines()[0] == first
    assert {"/rig/axle", "/rig/sensors/left_journal", "/stripes/left_journal/left/edge"} <= set(made.columns)
    assert not made.entities("/rig/wheelset/triangulated")
    assert f"0 of {FRAMES}" in made.document("stripes")


def test_refused_bundle_has_a_recording_of_its_reason(site: Site, tmp_path: Path) -> None:
    made = record(site, site.struck["wrong-hash"], tmp_path)
    first = made.document("report").splitlines()[0]
    assert first.startswith("**refused** at verification of the bundle: ")
    assert "sha256" in first
    assert "was refused" in made.document("stripes")
    assert {path.split("/")[1] for path in made.columns} <= {"rig", "calibration", "documents", "__properties"}


def test_scan_without_calibration_shows_sensors_without_lenses(site: Site, tmp_path: Path) -> None:
    made = record(site, site.struck["unknown-calibration"], tmp_path)
    assert "is not in the inbox" in made.document("report").splitlines()[0]
    assert "/rig/sensors/left_journal/not_calibrated" in made.columns
    assert "/rig/sensors/left_journal/left" not in made.columns
    assert made.entities("/stripes/left_journal/left/line0")


def test_scan_without_reference_shows_all_but_turns_and_values(site: Site, tmp_path: Path) -> None:
    made = record(site, site.struck["no-reference"], tmp_path)
    report = made.document("report")
    assert report.splitlines()[0] == "**failed** at measurements: no reference"
    assert "no usable reference scan before this one" in report
    assert "## Measurements" not in report
    assert made.entities("/rig/wheelset/fused")
    assert made.entities("/meridian/left_wheel")
    assert not made.entities("/turns")


def test_without_an_inbox_only_the_raw_stripes_are_missing(site: Site, measured: Recorded, tmp_path: Path) -> None:
    made = record(site, MEASURED, tmp_path, inbox=False)
    assert made.document("stripes").startswith("Raw stripes are not available: no inbox")
    assert set(measured.columns) - set(made.columns) == measured.entities("/stripes")
    path = "/rig/wheelset/triangulated/left_journal"
    assert np.abs(made.points(path) - measured.points(path)).max() < 1e-3  # angles from the stored turns


def test_raw_file_that_changed_since_is_not_shown(site: Site, tmp_path: Path) -> None:
    inbox = tmp_path / "inbox"
    shutil.copytree(site.inbox / "scans" / MEASURED, inbox / "scans" / MEASURED)
    stripes = inbox / "scans" / MEASURED / "stripes"
    (stripes / "left_journal.parquet").write_bytes((stripes / "right_journal.parquet").read_bytes())
    (stripes / "left_wheel_inner.parquet").unlink()
    made = Recorded(write_recording(site.warehouse, MEASURED, tmp_path / "changed.rrd", inbox))
    said = made.document("stripes")
    for name in ("left_journal", "left_wheel_inner"):
        assert f"stripes/{name}.parquet is missing or is not the file that was processed" in said
        assert not made.entities(f"/stripes/{name}")
    assert made.entities("/stripes/right_journal/left/line0")


def test_table_that_was_removed_is_named_and_the_rest_is_shown(site: Site, tmp_path: Path) -> None:
    root = tmp_path / "warehouse"
    shutil.copytree(site.warehouse, root)
    shutil.rmtree(next((root / "triangulated_clouds").rglob(f"scan_id={MEASURED}")))
    made = Recorded(write_recording(root, MEASURED, tmp_path / "kept.rrd", site.inbox))
    assert "The table triangulated_clouds is no longer stored" in made.document("report")
    assert made.entities("/rig/wheelset/fused")
    assert not made.entities("/rig/wheelset/removed")


def test_out_may_be_a_folder_or_in_one_that_does_not_exist(site: Site, tmp_path: Path) -> None:
    assert write_recording(site.warehouse, MEASURED, tmp_path, max_points=10) == tmp_path / f"{MEASURED}.rrd"
    assert write_recording(site.warehouse, MEASURED, tmp_path / "a" / "b.rrd", max_points=10).is_file()


def test_error_while_drawing_leaves_the_old_recording_and_no_other(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipelines.recording import turns

    path = write_recording(site.warehouse, MEASURED, tmp_path / "one.rrd", max_points=10)
    before = path.read_bytes()
    monkeypatch.setattr(turns, "draw", lambda canvas: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_recording(site.warehouse, MEASURED, path, max_points=10)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["one.rrd"]


def test_unknown_scan_names_the_nearest(site: Site, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no scan WS-000-20250405-0 .*nearest: WS-000-20250405-0\d, "):
        write_recording(site.warehouse, "WS-000-20250405-0", tmp_path / "x.rrd")
    with pytest.raises(ConfigError, match="not a warehouse"):
        write_recording(tmp_path, MEASURED, tmp_path / "x.rrd")
    with pytest.raises(ConfigError, match="max_points 0"):
        write_recording(site.warehouse, MEASURED, tmp_path / "x.rrd", max_points=0)
    assert not list(tmp_path.iterdir())


def test_import_is_light() -> None:
    code = "import sys, pipelines.replay; print([m for m in ('rerun', 'numpy', 'pyarrow', 'scipy', 'cv2') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"
