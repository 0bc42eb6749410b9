"""Each kind of fault does what it says, to one scan, and leaves the others alone."""

from __future__ import annotations

import hashlib
import json
from datetime import datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wheelset_assets.simulation import FAULTS, SimulationPlan, simulate

KINDS = tuple(FAULTS)
KNOBS = {"seed": 7, "repeats": len(KINDS), "frames": 24, "rows": 256, "board_poses": 3}


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """{kind: folder} of a campaign in which every production scan is spoilt, and the same campaign unspoilt."""
    out = tmp_path_factory.mktemp("faults") / "inbox"
    spoilt = simulate(SimulationPlan(out, faults=KINDS, **KNOBS))
    sound = simulate(SimulationPlan(out.parent / "sound", **KNOBS))
    recorded = json.loads(spoilt.faults_path.read_text())
    assert list(recorded) == list(spoilt.production_scan_ids)
    assert sorted(recorded.values()) == sorted(KINDS)
    return {kind: (out / "scans" / scan, sound.inbox / "scans" / scan) for scan, kind in recorded.items()}


def document(folder):
    return json.loads((folder / "scan.json").read_text())


def found(folder):
    files = [p for p in folder.rglob("*") if p.is_file() and p.name != "scan.json"]
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def stripes(folder, sensor, name="left_u"):
    return np.stack(pq.read_table(folder / "stripes" / f"{sensor}.parquet")[name].to_numpy()).astype(float)


INTACT = {"empty-stripes", "missing-sensor", "missing-station", "sector-gap", "grease", "inner-face-unseen"} | {
    "unknown-calibration",
    "no-reference",
    "moved-sensor",
    "corrupt",
    "missing-key",
}


@pytest.mark.parametrize("kind", sorted(INTACT))
def test_hashes_hold_where_the_fault_lies_elsewhere(scans, kind):
    folder, _ = scans[kind]
    assert document(folder)["files"] == found(folder)


def test_corrupt(scans):
    folder, sound = scans["corrupt"]
    path = folder / "stripes" / "left_journal.parquet"
    with pytest.raises(pa.ArrowInvalid):
        pq.read_table(path)
    assert (sound / "stripes" / "left_journal.parquet").read_bytes().startswith(path.read_bytes())


def test_wrong_hash(scans):
    folder, _ = scans["wrong-hash"]
    listed, actual = document(folder)["files"], found(folder)
    assert listed.keys() == actual.keys()
    assert sum(listed[k] != actual[k] for k in listed) == 1


def test_missing_image(scans):
    folder, _ = scans["missing-image"]
    listed, actual = document(folder)["files"], found(folder)
    assert len(listed.keys() - actual.keys()) == 1
    assert min(listed.keys() - actual.keys()).startswith("images/left_journal/")
    assert not (folder / "stripes" / "left_journal.parquet").exists()
    assert (folder / "stripes" / "right_journal.parquet").exists()


def test_bad_json_and_missing_key(scans):
    with pytest.raises(json.JSONDecodeError):
        document(scans["bad-json"][0])
    sound = document(scans["missing-key"][1])
    assert document(scans["missing-key"][0]) == {k: v for k, v in sound.items() if k != "temperature_c"}


def test_unlisted_file_and_path_escape(scans):
    folder, _ = scans["unlisted-file"]
    assert found(folder).keys() - document(folder)["files"].keys() == {"stripes/leftover.parquet"}
    folder, _ = scans["path-escape"]
    assert [k for k in document(folder)["files"] if k.startswith("../")] == ["../../elsewhere/left_journal.parquet"]


def test_empty_stripes(scans):
    folder, _ = scans["empty-stripes"]
    for path in (folder / "stripes").iterdir():
        assert np.isnan(stripes(folder, path.stem)).all()


def test_missing_sensor_and_station(scans):
    names = {p.stem for p in (scans["missing-sensor"][1] / "stripes").iterdir()}
    assert names - {p.stem for p in (scans["missing-sensor"][0] / "stripes").iterdir()} == {"left_wheel_outer"}
    assert names - {p.stem for p in (scans["missing-station"][0] / "stripes").iterdir()} == {"right_journal"}


def test_sector_gap(scans):
    folder, sound = scans["sector-gap"]
    frames = pq.read_table(folder / "stripes" / "right_journal.parquet")["frame"].to_numpy()
    assert len(frames) in (21, 22)  # 40 of 360 degrees, 24 frames
    assert np.array_equal(stripes(folder, "right_journal"), stripes(sound, "right_journal")[frames], equal_nan=True)
    assert pq.read_table(folder / "frames.parquet").num_rows == 24


def test_grease_lies_on_the_left_datum_circle_only(scans):
    folder, sound = scans["grease"]
    moved = np.nan_to_num(abs(stripes(folder, "left_wheel_inner") - stripes(sound, "left_wheel_inner")))
    frames = np.flatnonzero((moved > 0.02).sum(axis=1) > 20)
    assert 1 <= len(frames) <= 3  # 25 degrees at 15 degrees a frame
    rows = np.flatnonzero((moved[frames] > 0.02).any(axis=0))
    assert np.ptp(rows) < 256 * 45 / 130  # 36 mm of a field of 130
    assert np.array_equal(stripes(folder, "right_wheel_inner"), stripes(sound, "right_wheel_inner"), equal_nan=True)


def test_inner_face_unseen(scans):
    folder, sound = scans["inner-face-unseen"]
    before, after = (np.isfinite(stripes(f, "left_wheel_inner")).sum() for f in (sound, folder))
    assert 0.03 < (before - after) / before < 0.3
    assert np.array_equal(stripes(folder, "right_wheel_inner"), stripes(sound, "right_wheel_inner"), equal_nan=True)


def test_unknown_calibration_and_no_reference(scans):
    folder, _ = scans["unknown-calibration"]
    assert not (folder.parents[1] / "calibrations" / document(folder)["calibration_id"]).exists()
    folder, _ = scans["no-reference"]
    reference = document(folder.parent / "ref-20250405")
    assert datetime.fromisoformat(document(folder)["captured_at"]) < datetime.fromisoformat(reference["captured_at"])


def test_moved_sensor(scans):
    folder, sound = scans["moved-sensor"]
    for sensor in ("left_wheel_outer", "left_wheel_inner", "right_wheel_outer", "left_journal"):
        off = np.nanmedian(abs(stripes(folder, sensor) - stripes(sound, sensor)))
        assert (off > 0.01) == (sensor == "left_wheel_outer")


def test_unknown_kinds_are_refused(tmp_path):
    with pytest.raises(ValueError, match="unknown fault 'gremlin'"):
        simulate(SimulationPlan(tmp_path, faults=("gremlin",)))


def test_faults_strike_image_deliveries_too(tmp_path):
    kinds = ("corrupt", "wrong-hash", "unlisted-file", "path-escape", "missing-image", "empty-stripes")
    plan = SimulationPlan(tmp_path / "inbox", faults=kinds, images=True, repeats=6, frames=8, rows=128, board_poses=3)
    result = simulate(plan)
    folder = result.inbox / "scans" / result.production_scan_ids[2]
    assert len(found(folder).keys() - document(folder)["files"].keys()) == 1
