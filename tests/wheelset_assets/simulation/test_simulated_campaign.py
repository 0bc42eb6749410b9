"""Written bundles: valid by the format page, reproducible to the byte, true to their truth files."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import subprocess
import sys
from dataclasses import replace
from datetime import date, datetime

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wheelset_assets.simulation import PRESETS, Defects, NoiseModel, SimulationPlan, simulate
from wheelset_assets.simulation.campaign import _wheelset
from wheelset_assets.simulation.plan import CERTIFICATE_U_MM
from wheelset_assets.simulation.rig import build_rig
from wheelset_assets.simulation.scan import perfect_stripes
from wheelset_assets.simulation.schedule import calibrations, schedule

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
SMALL = {"frames": 12, "rows": 256, "board_poses": 3}


def contents(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def load(path):
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    out = tmp_path_factory.mktemp("campaign") / "inbox"
    calls = []
    plan = SimulationPlan(out, wheelsets=2, days=2, repeats=1, seed=7, profile=("S1002", "LMA"), **SMALL)
    return plan, simulate(plan, lambda *call: calls.append(call)), calls


def test_progress_and_result(campaign):
    plan, result, calls = campaign
    assert [c[0] for c in calls] == list(range(1, 8))
    assert {c[1] for c in calls} == {7}
    assert calls[0][2] == "cal-2025-03-30"
    assert result.n_scans == 6
    assert result.reference_scan_ids == ("ref-20250405", "ref-20250406")
    assert result.production_scan_ids[0] == "WS-000-20250405-00"
    assert not (plan.out / ".staging").exists()


def test_every_listed_file_is_there_and_nothing_else(campaign):
    plan, _, _ = campaign
    documents = [*plan.out.glob("scans/*/scan.json"), *plan.out.glob("calibrations/*/calibration.json")]
    assert len(documents) == 7
    for document in documents:
        listed, folder = load(document)["files"], document.parent
        found = {k: v for k, v in contents(folder).items() if k != document.name}
        assert listed == {k: hashlib.sha256(v).hexdigest() for k, v in found.items()}


def test_names_match_the_format_and_their_folders(campaign):
    plan, result, _ = campaign
    rig = load(result.rig_path)
    assert (rig["format"], rig["rig_id"], result.rig_path.stem) == ("wheelset-rig/1", "bench-1", "bench-1")
    stations = {s["station"]: s for s in rig["stations"]}
    assert {(s["kind"], s["side"]) for s in stations.values()} == {
        (kind, side) for kind in ("wheel", "journal") for side in ("left", "right")
    }
    for sensor in rig["sensors"]:
        pose = np.array(sensor["T_rig_sensor"])
        assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        assert sensor["station"] in stations
        assert sensor["image_size"] == [128, 256]
    for scan_json in plan.out.glob("scans/*/scan.json"):
        scan = load(scan_json)
        assert scan["format"] == "wheelset-scan/1"
        assert scan["scan_id"] == scan_json.parent.name
        assert (plan.out / "calibrations" / scan["calibration_id"]).is_dir()
        assert datetime.fromisoformat(scan["captured_at"]).utcoffset().total_seconds() == 8 * 3600
        for name in (scan["scan_id"], scan["rig_id"], scan["wheelset"]["wheelset_id"]):
            assert NAME.fullmatch(name)
        assert ("certificate" in scan) == (scan["purpose"] == "reference")


def test_parquet_schemas(campaign):
    plan, _, _ = campaign
    for path in plan.out.glob("scans/*/frames.parquet"):
        table = pq.read_table(path)
        assert table.schema == pa.schema([("frame", pa.int32()), ("angle_deg", pa.float64())])
        assert table["frame"].to_pylist() == list(range(12))
        angle = table["angle_deg"].to_numpy()
        assert np.all(np.diff(angle) > 0)
        assert angle[-1] - angle[0] == pytest.approx(330.0, abs=0.1)
    stripes = list(plan.out.glob("scans/*/stripes/*.parquet"))
    assert len(stripes) == 6 * 6
    for path in stripes:
        table = pq.read_table(path)
        assert table.schema.names == ["frame", "line", "left_u", "right_u"]
        assert table.schema.types[:2] == [pa.int32(), pa.int8()]
        assert table.schema.types[2] == pa.list_(pa.float32(), 256)
        assert table.num_rows == 12
        u = np.stack(table["left_u"].to_numpy())
        assert 0.4 < np.isfinite(u).mean() < 1.0


def test_calibration_images(campaign):
    plan, result, _ = campaign
    folder = plan.out / "calibrations" / result.calibration_ids[0]
    calibration = load(folder / "calibration.json")
    assert calibration["format"] == "wheelset-calibration/1"
    assert calibration["board"] == {"type": "chessboard", "inner_corners": [4, 7], "square_mm": 12.0}
    images = sorted(k for k in calibration["files"])
    assert len(images) == 6 * 2 * 3
    assert {k.replace("/left/", "/right/") for k in images if "/left/" in k} == {k for k in images if "/right/" in k}
    image = cv2.imread(str(folder / images[0]), cv2.IMREAD_UNCHANGED)
    assert image.shape == (256, 128)
    assert image.dtype == np.uint8


def test_two_runs_write_the_same_bytes(campaign, tmp_path):
    plan, _, _ = campaign
    again = replace(plan, out=tmp_path / "inbox")
    simulate(again)
    first, second = contents(plan.out.parent), contents(tmp_path)
    assert first.keys() == second.keys()
    assert [k for k in first if first[k] != second[k]] == []


def test_a_scan_does_not_depend_on_how_many_are_asked_for(campaign, tmp_path):
    plan, _, _ = campaign
    fewer = simulate(replace(plan, out=tmp_path / "inbox", wheelsets=1, days=1))
    assert fewer.production_scan_ids == ("WS-000-20250405-00",)
    whole, part = contents(plan.out), contents(tmp_path / "inbox")
    assert [k for k in part if part[k] != whole[k] and k != "cmm/review.csv"] == []
    other = simulate(replace(plan, out=tmp_path / "other", seed=8, wheelsets=1, days=1))
    frames = "scans/WS-000-20250405-00/frames.parquet"
    assert contents(other.inbox)[frames] != part[frames]


def test_truth_table_and_reviews_agree(campaign):
    plan, result, _ = campaign
    truth = pq.read_table(result.truth_path).to_pylist()
    assert {row["scan_id"] for row in truth} == set(result.production_scan_ids)
    value = {(r["wheelset_id"], r["quantity"], r["side"]): r["truth_mm"] for r in truth}
    quantities = {q for _, q, _ in value}
    assert quantities >= {"wheel_diameter", "inner_distance", "journal_diameter", "shoulder_distance", "flange_height"}
    assert quantities >= {"flange_thickness", "qr", "radial_runout", "axial_runout", "journal_ovality", "journal_taper"}
    with result.review_path.open() as file:
        reviews = list(csv.DictReader(file))
    assert len(reviews) == 2 * 6
    pulls = []
    for row in reviews:
        true = value[row["wheelset_id"], row["quantity"], row["side"]]
        pulls.append((float(row["value_mm"]) - true) / (float(row["expanded_uncertainty_mm"]) / 2))
    assert 0.3 < np.std(pulls) < 2.0
    certificate = load(plan.out / "scans" / "ref-20250405" / "scan.json")["certificate"]
    assert {c["quantity"] for c in certificate} == set(CERTIFICATE_U_MM)
    assert certificate == load(plan.out / "scans" / "ref-20250406" / "scan.json")["certificate"]


def test_truth_rig_rebuilds_what_the_sensors_saw(campaign):
    """Stripes retraced from the recorded conditions differ from the delivered ones by the declared noise alone."""
    plan, result, _ = campaign
    rig = build_rig(plan.seed, plan.rig, plan.rig_id, plan.rows)
    scan = next(s for s in schedule(plan) if s.scan_id == "WS-000-20250405-00")
    recorded = next(s for s in load(result.truth_rig_path)["scans"] if s["scan_id"] == scan.scan_id)
    assert recorded["conditions"]["shift_mm"] == scan.conditions.shift_mm
    sensor = rig.sensors[1]
    body = scan.conditions.first_angle_deg + scan.conditions.body_zero_deg + np.arange(12) * 30.0
    perfect = perfect_stripes(_wheelset(plan, 0), rig, sensor, scan.conditions, body)[0]
    path = plan.out / "scans" / scan.scan_id / "stripes" / f"{sensor.sensor_id}.parquet"
    delivered = np.stack(pq.read_table(path)["left_u"].to_numpy()).astype(float)
    both = np.isfinite(delivered) & np.isfinite(perfect.left_u)
    off = (delivered - perfect.left_u)[both]
    off = off[abs(off) < 0.5]  # reflections aside
    declared = np.hypot(plan.noise.white_px, plan.noise.speckle_px)
    assert off.std() == pytest.approx(declared, rel=0.12)
    assert abs(off.mean()) < 0.02


def test_conditions_keep_their_limits():
    plan = SimulationPlan("x", wheelsets=3, days=5, repeats=8, seed=2, span_days=150)
    scans = schedule(plan)
    assert [s.captured_at.date() for s in scans if s.purpose == "reference"] == [
        date(2025, 4, 5),
        date(2025, 5, 5),
        date(2025, 6, 4),
        date(2025, 7, 4),
        date(2025, 8, 3),
    ]
    reference = {s.key[0]: s.conditions for s in scans if s.purpose == "reference"}
    spread = [c.rig_c for c in reference.values()]
    assert np.ptp(spread) > 5.0
    for scan in scans:
        c, r = scan.conditions, reference[scan.key[0]]
        assert 18.0 <= c.rig_c <= 28.0
        assert abs(c.rig_c - r.rig_c) <= 3.0
        assert abs(c.wheelset_c - r.rig_c) <= 3.0
        assert abs(c.shift_mm) <= 1.0
        assert np.hypot(*c.axis_mm) <= 0.5e-3
    errors = [s.conditions.reported_rig_c - s.conditions.rig_c for s in scans]
    assert 0.03 < np.std(errors) < 0.07
    times = [s.captured_at for s in scans]
    assert times == sorted(times)
    assert len({s.scan_id for s in scans}) == len(scans) == 5 * 25


def test_long_campaigns_are_calibrated_afresh():
    plan = SimulationPlan("x", days=12, repeats=1, span_days=365)
    cals = calibrations(plan)
    assert [c.captured_at.date() for c in cals] == [date(2025, 3, 30), date(2025, 8, 27), date(2026, 1, 24)]
    for scan in schedule(plan):
        age = scan.captured_at - cals[scan.calibration].captured_at
        assert 0 < age.days < 160


def test_rigs_may_share_an_inbox_and_wheelsets(tmp_path):
    common = {"seed": 1, "repeats": 1, "wheelset_seed": 5, **SMALL}
    one = simulate(SimulationPlan(tmp_path / "inbox", **common))
    two = simulate(SimulationPlan(tmp_path / "inbox", rig="compact", name="pit-2", **{**common, "seed": 2}))
    assert sorted(p.name for p in (tmp_path / "inbox" / "rigs").iterdir()) == ["bench-1.json", "pit-2.json"]
    assert len(list((tmp_path / "inbox" / "scans").iterdir())) == 4
    truths = [pq.read_table(c.truth_path).drop_columns("scan_id").to_pylist() for c in (one, two)]
    assert truths[0] == truths[1]
    table = pq.read_table(tmp_path / "inbox" / "scans" / two.production_scan_ids[0] / "stripes" / "left_wheel.parquet")
    assert table["line"].to_pylist() == [0, 1] * 12
    assert table["frame"].to_pylist() == sorted([*range(12), *range(12)])


def test_images_in_place_of_stripes(tmp_path):
    plan = SimulationPlan(tmp_path / "inbox", wheelsets=0, images=True, seed=3, noise=NoiseModel.none(), **SMALL)
    simulate(plan)
    folder = tmp_path / "inbox" / "scans" / "ref-20250405"
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*.png")}
    assert len(names) == 6 * 2 * 12
    assert "images/left_journal/right/000011.png" in names
    assert not (folder / "stripes").exists()
    stripes = simulate(replace(plan, out=tmp_path / "stripes", images=False))
    path = stripes.inbox / "scans" / "ref-20250405" / "stripes" / "left_journal.parquet"
    u = np.stack(pq.read_table(path)["left_u"].to_numpy())[7]
    image = cv2.imread(str(folder / "images" / "left_journal" / "left" / "000007.png"), cv2.IMREAD_UNCHANGED)
    brightest = image.argmax(axis=1)
    seen = np.isfinite(u) & (u < 126)
    assert np.median(abs(brightest[seen] - u[seen])) < 0.6


def test_defects_and_custom_profiles(tmp_path):
    plan = SimulationPlan(
        tmp_path / "inbox",
        profile="mine",
        custom_profiles={"mine": ([-70.0, -55.0, -37.0, 0.0, 60.0], [9.0, 28.0, 10.0, 0.0, -3.0])},
        defects=Defects(flat_length_mm=30.0, polygon_um=2.0, journal_taper_um=4.0),
    )
    wheelset = _wheelset(plan, 0)
    truths = wheelset.truths()
    assert truths["journal_taper", "left"] == pytest.approx(0.004 * 70.0 / 187.5)
    assert truths["flange_thickness", "left"] == pytest.approx(33.0, abs=1.5)
    assert wheelset.wheels[0].radial.orders[-1] == 20
    assert [len(w.patches) for w in wheelset.wheels] == [1, 0]


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"frames": 3}, "frames is at least 8"),
        ({"profile": "P8"}, "profile is one of"),
        ({"rig": "none"}, "rig is one of"),
        ({"name": "../up"}, "name is at most"),
        ({"faults": ("corrupt",) * 9}, "9 faults need"),
    ],
)
def test_plans_refuse_nonsense(knobs, message):
    with pytest.raises(ValueError, match=message):
        SimulationPlan("x", **knobs)


def test_importing_the_plan_loads_nothing_heavy():
    code = (
        "import sys; from wheelset_assets.simulation import PRESETS, SimulationPlan;"
        "heavy = {'cv2', 'scipy', 'pyarrow', 'wheelset_assets.simulation.campaign'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert set(PRESETS) == {"bench", "compact", "wide"}
