"""The main job as a user would put it together from the tutorials of OpenCV and Open3D.

Runs as `python -m benchmarks.peer JOB.json [STEP ...]`, does the steps of `peer_steps` that no earlier process over the
same job has done, except those named, and tells of each in a line of JSON. Left and right wheel stations, two sensors
each: `target` is the station's first sensor, `source` its second.
"""

from __future__ import annotations

import json
import pickle
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np


class Job:
    """What the user has: a bundle, the reference's bundle, the rig's file, and calibrated cameras."""

    def __init__(self, task: dict[str, Any]) -> None:
        self.bundle, self.reference = Path(task["bundle"]), Path(task["reference"])
        self.rig = json.loads(Path(task["rig"]).read_text(encoding="utf-8"))
        self.cameras = task["cameras"]
        self.pairs: dict[str, tuple[str, str]] = {}
        for station in self.rig["stations"]:
            names = [s["sensor_id"] for s in self.rig["sensors"] if s["station"] == station["station"]]
            if station["kind"] == "wheel" and len(names) >= 2:
                self.pairs[station["side"]] = (names[1], names[0])
        self.poses = {s["sensor_id"]: np.array(s["T_rig_sensor"]) for s in self.rig["sensors"]}
        self.wheel_sensors = [name for pair in self.pairs.values() for name in pair]


def main(arguments: list[str]) -> None:
    """Carry out the steps that no earlier process has done, except those named."""
    path, skipped = Path(arguments[0]), arguments[1:]
    job = Job(json.loads(path.read_text(encoding="utf-8")))
    try:
        import cv2
        import open3d as o3d

        from benchmarks.peer_steps import PARAMETERS, STEPS
    except (ImportError, OSError) as error:
        tell(unavailable=f"{type(error).__name__}: {error}")
        return
    tell(versions={"open3d": o3d.__version__, "opencv": cv2.__version__}, parameters=PARAMETERS)
    state: dict[str, Any] = {}
    for step in STEPS:
        name, kept = step.__name__, path.with_name(f"peer-{step.__name__}.pickle")
        if kept.exists():
            state |= pickle.loads(kept.read_bytes())
            continue
        if name in skipped:
            continue
        tell(step=name, state="started")
        started, cpu = time.perf_counter(), time.process_time()
        try:
            made = step(job, state)
        except KeyError as error:
            tell(step=name, state="not run", reason=f"needs {error}, which no step has left")
            continue
        except Exception as error:
            tell(step=name, state="failed", reason=f"{type(error).__name__}: {error}")
            continue
        taken = {"seconds": time.perf_counter() - started, "cpu_seconds": time.process_time() - cpu}
        state |= made
        kept.with_suffix(".tmp").write_bytes(pickle.dumps(made))
        kept.with_suffix(".tmp").replace(kept)
        tell(step=name, state="done", **taken)
    results = ("n_points", "ransac", "icp", "icp_from_nominal", "diameters_mm", "zeroed_mm")
    sizes = {
        name: {k: len(v) for k, v in state[name].items()}
        for name in ("clouds", "clean", "thin", "keypoints")
        if name in state
    }
    tell(results={k: state[k] for k in results if k in state}, sizes=sizes)


def tell(**facts: Any) -> None:
    print(json.dumps(facts, default=lambda value: value.tolist()), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
