"""Headers of scan bundles, format 1: what is refused, and how the refusal reads; what is kept although unknown."""

from __future__ import annotations

import copy
import json
from datetime import date

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from wheelset_assets import bundle

POSE = [[1.0, 0, 0, 5.0], [0, -1.0, 0, 6.0], [0, 0, -1.0, 700.0], [0, 0, 0, 1]]
SHA = "0123456789abcdef" * 4
RIG = {
    "format": "wheelset-rig/1",
    "rig_id": "bench-1",
    "stations": [{"station": "left_wheel", "kind": "wheel", "side": "left"}],
    "sensors": [
        {"sensor_id": "a", "station": "left_wheel", "image_size": [512, 1024], "laser_lines": 1, "T_rig_sensor": POSE},
        {
            "sensor_id": "b",
            "station": "left_wheel",
            "image_size": [512, 1024],
            "laser_lines": 2,
            "T_rig_sensor": copy.deepcopy(POSE),
        },
    ],
    "expansion_per_k": 11.5e-6,
}
CALIBRATION = {
    "format": "wheelset-calibration/1",
    "calibration_id": "cal-1",
    "rig_id": "bench-1",
    "captured_at": "2025-03-30T06:00:00+08:00",
    "temperature_c": {"rig": 21.0},
    "board": {"type": "chessboard", "inner_corners": [6, 11], "square_mm": 8.0},
    "files": {"boards/a/left/000.png": SHA},
}
SCAN = {
    "format": "wheelset-scan/1",
    "scan_id": "s-1",
    "rig_id": "bench-1",
    "calibration_id": "cal-1",
    "captured_at": "2025-04-05T00:30:00+08:00",
    "purpose": "reference",
    "wheelset": {"wheelset_id": "MASTER", "type": "CRH3"},
    "temperature_c": {"wheelset": 20.5, "rig": 21.0},
    "files": {"frames.parquet": SHA},
    "certificate": [
        {"quantity": "wheel_diameter", "side": "left", "value_mm": 920.0, "expanded_uncertainty_mm": 0.003}
    ],
}
MODELS = {
    "rig": (bundle.Rig, RIG),
    "calibration": (bundle.CalibrationHeader, CALIBRATION),
    "scan": (bundle.ScanHeader, SCAN),
}


def changed(document, path, value):
    """A copy with one value replaced, or removed if it is `...`."""
    new = copy.deepcopy(document)
    *way, last = path
    target = new
    for step in way:
        target = target[step]
    if value is ...:
        del target[last]
    else:
        target[last] = value
    return new


def refusal(which, path, value) -> str:
    """How the refusal of a changed document reads."""
    model, document = MODELS[which]
    with pytest.raises(ValidationError) as error:
        model.model_validate_json(json.dumps(changed(document, path, value)))
    return bundle.explain(error.value, f"{which}.json")


# --- what is accepted


@pytest.mark.parametrize("which", list(MODELS))
def test_good_documents_are_accepted_and_unknown_keys_are_kept(which):
    model, document = MODELS[which]
    found = model.model_validate_json(json.dumps(document | {"vendor": {"x": [1, 2]}}))
    assert found.model_extra == {"vendor": {"x": [1, 2]}}
    with pytest.raises(ValidationError):
        found.format = "other"


def test_defaults_are_the_formats():
    scan = bundle.ScanHeader.model_validate(SCAN)
    assert scan.wheelset.expansion_per_k == 11.5e-6
    assert scan.reference_scan_id is None
    assert bundle.ScanHeader.model_validate(changed(SCAN, ["certificate"], ...)).certificate == []


def test_the_day_of_a_scan_is_the_one_in_its_own_offset():
    scan = bundle.ScanHeader.model_validate_json(json.dumps(SCAN))
    assert scan.acquired_on == date(2025, 4, 5)  # in UTC it is still the fourth
    assert scan.captured_at.utcoffset().total_seconds() == 8 * 3600


def test_numbers_as_names_of_cars_and_axles_become_text():
    scan = bundle.ScanHeader.model_validate(SCAN | {"trainset": 5032, "car": "05", "axle": 3})
    assert (scan.trainset, scan.car, scan.axle) == ("5032", "05", "3")


def test_sensors_of_a_station_keep_their_order_of_preference():
    rig = bundle.Rig.model_validate(RIG)
    assert [s.sensor_id for s in rig.station_sensors("left_wheel")] == ["a", "b"]
    assert rig.station_sensors("elsewhere") == []


@given(st.integers(0, 2**32 - 1))
def test_every_rigid_pose_is_accepted_as_json_writes_it(seed):
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=random).as_matrix(), random.uniform(-2000, 2000, 3)
    rig = bundle.Rig.model_validate_json(json.dumps(changed(RIG, ["sensors", 0, "T_rig_sensor"], pose.tolist())))
    assert rig.sensors[0].T_rig_sensor == pose.tolist()


# --- what is refused


@pytest.mark.parametrize(
    "name",
    [
        "",
        "..",
        "../x",
        "a/b",
        "a\\b",
        ".hidden",
        "-rf",
        "a b",
        "a\n",
        "a\x00",
        "ä",
        "x" * 65,
        "C:x",
        "a;b",
        "~root",
        "$x",
        None,
        7,
    ],
)
@pytest.mark.parametrize(
    ("which", "path"),
    [
        ("rig", ["rig_id"]),
        ("rig", ["sensors", 0, "sensor_id"]),
        ("rig", ["stations", 0, "station"]),
        ("calibration", ["calibration_id"]),
        ("scan", ["scan_id"]),
        ("scan", ["rig_id"]),
        ("scan", ["calibration_id"]),
        ("scan", ["wheelset", "wheelset_id"]),
    ],
)
def test_hostile_identifiers_are_refused_by_file_and_key(which, path, name):
    said = refusal(which, path, name)
    assert said.startswith(f"{which}.json: key {'.'.join(str(p) for p in path)}: ")


@pytest.mark.parametrize("name", ["a", "A-1_b.c", "9", "x" * 64, "CRH380A-0001"])
def test_ordinary_identifiers_are_accepted(name):
    assert bundle.ScanHeader.model_validate(SCAN | {"scan_id": name}).scan_id == name


@pytest.mark.parametrize(
    ("which", "path"),
    [
        ("rig", ["expansion_per_k"]),
        ("rig", ["sensors", 1, "T_rig_sensor", 0, 3]),
        ("calibration", ["temperature_c", "rig"]),
        ("calibration", ["board", "square_mm"]),
        ("scan", ["temperature_c", "wheelset"]),
        ("scan", ["temperature_c", "rig"]),
        ("scan", ["certificate", 0, "value_mm"]),
        ("scan", ["certificate", 0, "expanded_uncertainty_mm"]),
    ],
)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), "warm", None, [1]])
def test_numbers_that_are_none_are_refused(which, path, value):
    """Python's JSON writes and reads NaN and Infinity."""
    said = refusal(which, path, value)
    assert f"{which}.json: key {'.'.join(str(p) for p in path)}: " in said
    assert "found" in said


@pytest.mark.parametrize("value", ["2025-04-05T08:00:00", "2025-04-05", "yesterday", "", None])
@pytest.mark.parametrize(("which", "key"), [("scan", "captured_at"), ("calibration", "captured_at")])
def test_times_without_an_offset_are_refused(which, key, value):
    assert f"{which}.json: key {key}: " in refusal(which, [key], value)


def test_times_of_validity_need_an_offset_too():
    assert "key valid_until: a time with an offset" in refusal("calibration", ["valid_until"], "2025-06-01T00:00:00")


def test_poses_that_are_not_rigid_are_refused():
    scaled = (1.001 * np.array(POSE)).tolist()
    scaled[3] = [0, 0, 0, 1]
    mirrored = copy.deepcopy(POSE)
    mirrored[0][0] = -1.0
    sheared = copy.deepcopy(POSE)
    sheared[0][1] = 0.01
    projective = [*copy.deepcopy(POSE[:3]), [0, 0, 1e-3, 1]]
    for pose in (scaled, mirrored, sheared, projective):
        said = refusal("rig", ["sensors", 1, "T_rig_sensor"], pose)
        assert said.startswith("rig.json: key sensors.1: T_rig_sensor: a rigid transform of four rows")
    for pose in (POSE[:3], [row[:3] for row in POSE], [], "identity"):
        assert "sensors.1.T_rig_sensor" in refusal("rig", ["sensors", 1, "T_rig_sensor"], pose)


@pytest.mark.parametrize(
    ("which", "path", "value", "said"),
    [
        ("rig", ["format"], "wheelset-rig/2", "key format"),
        ("rig", ["stations", 0, "kind"], "axle", "key stations.0.kind"),
        ("rig", ["stations"], [], "key stations"),
        ("rig", ["sensors", 0, "laser_lines"], 3, "key sensors.0.laser_lines"),
        ("rig", ["sensors", 0, "image_size"], [512], "key sensors.0.image_size"),
        ("rig", ["sensors", 0, "image_size"], [512, 0], "key sensors.0.image_size.1"),
        ("rig", ["sensors", 1, "sensor_id"], "a", "sensor_id: each only once"),
        ("rig", ["sensors", 1, "station"], "right_wheel", "station 'right_wheel' is not among the stations"),
        ("rig", ["expansion_per_k"], -1e-6, "key expansion_per_k"),
        ("calibration", ["board", "type"], "circles", "key board.type"),
        ("calibration", ["board", "square_mm"], 0, "key board.square_mm"),
        ("calibration", ["board", "inner_corners"], [6, 1], "key board.inner_corners.1"),
        ("calibration", ["files"], {"a.png": "abc"}, "key files.a.png"),
        ("scan", ["purpose"], "test", "key purpose"),
        ("scan", ["wheelset", "expansion_per_k"], 0, "key wheelset.expansion_per_k"),
        ("scan", ["certificate", 0, "side"], "middle", "key certificate.0.side"),
        ("scan", ["certificate", 0, "expanded_uncertainty_mm"], -1, "key certificate.0.expanded_uncertainty_mm"),
        ("scan", ["files"], {"frames.parquet": "Z" * 64}, "key files.frames.parquet"),
    ],
)
def test_other_contradictions_are_refused_by_key(which, path, value, said):
    assert said in refusal(which, path, value)


@pytest.mark.parametrize("which", list(MODELS))
def test_every_required_key_is_missed_by_name(which):
    model, document = MODELS[which]
    required = [name for name, field in model.model_fields.items() if field.is_required()]
    assert set(required) <= set(document)
    for key in required:
        assert refusal(which, [key], ...) == f"{which}.json: required key {key} is missing"


def test_explain_names_file_key_and_value_and_stays_short():
    said = refusal("scan", ["temperature_c", "rig"], "x" * 500)
    assert said.startswith("scan.json: key temperature_c.rig: ")
    assert "'xxx" in said
    assert len(said) < 250
    with pytest.raises(ValidationError) as error:
        bundle.ScanHeader.model_validate([])
    assert "the document" in bundle.explain(error.value, "scan.json")
