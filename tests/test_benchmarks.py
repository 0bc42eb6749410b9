"""The benchmark runs, and its figures are whole and sane. No time is judged here: machines differ."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # the checkout is where the benchmarks are run from
STAGES = (
    "calibrations",
    "triangulated_clouds",
    "filtered_clouds",
    "features",
    "registrations",
    "alignments",
    "measurements",
    "repeatability",
)
N_POINTS_AT_MOST = 6 * 60 * 256


def benchmark(data: Path, *options: str, **more: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "benchmarks.main_job", "--quick", "--data", str(data), *options]
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | more
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict:
    ran = benchmark(tmp_path_factory.mktemp("benchmark"), "--peer-limit", "20", "--json")
    assert ran.returncode == 0, ran.stderr[-3000:]
    return json.loads(ran.stdout)


def test_every_stage_is_timed_once_and_the_whole_is_their_sum(results):
    for stage in STAGES:
        timing = results["stages"][stage]
        assert len(timing["seconds"]) == 1
        assert 0 < timing["execute_seconds"][0] <= timing["seconds"][0]
    (whole,) = results["end_to_end"]["seconds"]
    assert whole == pytest.approx(sum(results["stages"][stage]["seconds"][0] for stage in STAGES[1:7]))
    assert results["end_to_end"]["points_per_second"]["median"] == pytest.approx(results["data"]["points"] / whole)


def test_points_are_most_of_what_six_sensors_can_see(results):
    assert 0.6 * N_POINTS_AT_MOST < results["data"]["points"] <= N_POINTS_AT_MOST
    assert results["command_line"]["scan"]["points"] == results["data"]["points"]


def test_memory_is_told_where_the_system_tells_it(results):
    peaks = [results["stages"]["features"]["peak_mb"], results["command_line"]["scan"]["peak_tree_mb"]]
    if sys.platform != "linux":
        pytest.skip("only Linux tells")
    assert all(50 < peak < 8000 for peak in peaks)
    assert results["command_line"]["scan"]["peak_process_mb"] <= results["command_line"]["scan"]["peak_tree_mb"] * 1.05


def test_bytes_a_point_add_up_over_all_tables_of_a_scan(results):
    stored = results["bytes_per_point"]
    assert {"triangulated_clouds", "filtered_clouds", "features", "measurements", "budgets"} <= set(stored["tables"])
    assert stored["total"] == pytest.approx(sum(stored["tables"].values()))
    assert 1 < stored["tables"]["triangulated_clouds"] < 17  # 17: uncompressed


def test_the_peer_goes_through_its_steps_or_says_why_not(results):
    peer = results["peer"]
    if not peer["available"]:
        assert peer["reason"]
        pytest.skip(peer["reason"])
    assert len(peer["steps"]) == 12
    assert peer["steps"]["triangulate"]["state"] == "done"
    for step in peer["steps"].values():
        assert step["seconds"] > 0 if step["state"] == "done" else step["reason"]
    assert peer["results"]["n_points"] == pytest.approx(results["data"]["points"], rel=0.02)


def test_errors_are_stated_for_both_stations_and_the_values_are_near_the_truth(results):
    poses = results["accuracy"]["registration"]
    assert {e["station"] for e in poses} == {"left_wheel", "right_wheel"}
    ours = [e for e in poses if e["method"].startswith("wheelset")]
    assert len(ours) == 2
    for error in ours:  # what a sensor's tolerance, 2 mm and 1 deg over its distance, allows
        assert abs(error["lateral_um"]) < 10_000
        assert error["total_deg"] < 3
    diameters = {e["side"]: e["error_um"] for e in results["accuracy"]["wheel_diameter"] if e["method"] == "wheelset"}
    assert set(diameters) == {"left", "right"}
    assert all(value is None or (math.isfinite(value) and abs(value) < 1000) for value in diameters.values())


def test_the_report_names_machine_command_and_every_part(results):
    from benchmarks.report import markdown

    text = markdown(results)
    assert results["command"] in text
    assert results["machine"]["python"] in text
    for heading in ("## Stages", "## The whole job", "## Bytes stored", "## Beside OpenCV", "## Errors"):
        assert heading in text
    assert all(stage in text for stage in STAGES)


def test_the_peer_is_left_out_without_the_libraries_that_open3d_loads(tmp_path):
    from benchmarks.peer_run import run_peer
    from benchmarks.processes import environment

    (tmp_path / "open3d.py").write_text(
        "raise OSError('libGL.so.1: cannot open shared object file')\n", encoding="utf-8"
    )
    path = os.pathsep.join((str(tmp_path), str(ROOT)))
    rig = tmp_path / "rig.json"
    rig.write_text('{"stations": [], "sensors": []}', encoding="utf-8")
    job = {"bundle": "b", "reference": "r", "rig": str(rig), "cameras": {}}
    found = run_peer(job, tmp_path / "peer", 20.0, environment() | {"PYTHONPATH": path})
    assert found == {"available": False, "reason": "OSError: libGL.so.1: cannot open shared object file"}


def test_a_step_of_the_peer_over_its_limit_is_stopped_and_the_others_go_on(tmp_path, monkeypatch):
    """A stand-in for the peer's module: its first step hangs, the second is done."""
    from benchmarks import peer_run
    from benchmarks.processes import environment

    (tmp_path / "stand_in.py").write_text(
        "import json, sys, time\n"
        "print(json.dumps({'parameters': {}}), flush=True)\n"
        "if 'slow' not in sys.argv:\n"
        "    print(json.dumps({'step': 'slow', 'state': 'started'}), flush=True)\n"
        "    time.sleep(60)\n"
        "print(json.dumps({'step': 'quick', 'state': 'done', 'seconds': 0.1}), flush=True)\n"
        "print(json.dumps({'results': {'n_points': 3}, 'sizes': {}}), flush=True)\n",
        encoding="utf-8",
    )
    monkeypatch.setattr(peer_run, "MODULE", "stand_in")
    path = os.pathsep.join((str(tmp_path), str(ROOT)))
    found = peer_run.run_peer({}, tmp_path / "peer", 1.0, environment() | {"PYTHONPATH": path})
    assert found["steps"]["slow"] == {"state": "stopped", "reason": "stopped after 1 s"}
    assert found["steps"]["quick"]["state"] == "done"
    assert found["results"] == {"n_points": 3}
