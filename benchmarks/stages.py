"""Times the eight stages over one scan in one process: get, run, audit, publish, through the run's own code.

Runs as a process of its own (`python -m benchmarks.stages JOB.json`), so that its memory is its own and every library
has the one thread that a worker of a run has. Prints one JSON document.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.data import Data
from benchmarks.memory import peak_mb, reset_peak

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment of a run's workers; whoever starts this process sets it."""
BASE = "base"
"""Folder of the warehouse, within the work folder, that is left with the calibration and the reference scan."""


@dataclass
class Timing:
    """One stage over all repeats. `execute_seconds` leaves out the day's merged files and the ledger."""

    seconds: list[float] = field(default_factory=list)
    cpu_seconds: list[float] = field(default_factory=list)
    execute_seconds: list[float] = field(default_factory=list)
    peak_mb: float | None = None


class Stopwatch:
    """Timings by name, in the order of their first use."""

    def __init__(self) -> None:
        self.timings: dict[str, Timing] = {}

    def __call__(self, name: str, work: Callable[[], Any]) -> Any:
        """Do the work and record what it took; StageSummaries must tell of no failure."""
        timing = self.timings.setdefault(name, Timing())
        exact = reset_peak()
        started, cpu = time.perf_counter(), time.process_time()
        summary = work()
        timing.seconds.append(time.perf_counter() - started)
        timing.cpu_seconds.append(time.process_time() - cpu)
        if exact and (peak := peak_mb()) is not None:
            timing.peak_mb = max(timing.peak_mb or 0.0, peak)
        if summary is not None:
            if summary.failed or summary.refused or not summary.computed:
                raise SystemExit(f"benchmark: {name} gave nothing: {dict(summary.reasons)}")
            timing.execute_seconds.append(summary.seconds)
        return summary


def _preload() -> None:
    """What a run's workers load before their first task."""
    import cv2
    import duckdb  # noqa: F401
    import scipy.spatial  # noqa: F401

    cv2.setNumThreads(1)


def measure(data: Data, work: Path, repeats: int) -> dict[str, Any]:
    """Timings of every stage, points, bytes and results of the last repeat; the last warehouse stays in `work`."""
    from warehouse.night import Night
    from wheelset_assets.config import Config
    from wheelset_assets.stages import SCAN_STAGES

    _preload()
    watch = Stopwatch()
    base = work / BASE
    for _ in range(repeats):
        shutil.rmtree(base, ignore_errors=True)
        with Night(base, data.calibration_inbox, Config(), workers=0) as night:
            night.prepare()
            watch("calibrations", night.run_calibrations)
    _reference(base, data)
    points = 0
    for k in range(repeats):
        root = work / f"scan-{k}"
        shutil.copytree(base, root)
        with Night(root, data.inbox, Config(), workers=0) as night:
            watch("verify", night.prepare)
            (day,) = night.state.days()
            for stage in SCAN_STAGES:
                watch(stage.name, partial(night.run_stage, stage, day))
            watch("repeatability", night.run_fleet)
            points = night.record.points
            if k == repeats - 1:
                found = _results(night, data, day)
    return {
        "timings": {name: vars(timing) for name, timing in watch.timings.items()},
        "points": points,
        "end_to_end_seconds": _sums(watch, [stage.name for stage in SCAN_STAGES]),
        **found,
    }


def _sums(watch: Stopwatch, names: list[str]) -> list[float]:
    """Seconds over the named stages, repeat by repeat."""
    return [sum(parts) for parts in zip(*(watch.timings[name].seconds for name in names), strict=True)]


def _reference(root: Path, data: Data) -> None:
    """The reference scan, untimed: it zeroes the wheelset scan, and loads what is loaded at first use."""
    from warehouse.night import Night
    from wheelset_assets.config import Config
    from wheelset_assets.stages import SCAN_STAGES

    with Night(root, data.reference_inbox, Config(), workers=0) as night:
        night.prepare()
        (day,) = night.state.days()
        for stage in SCAN_STAGES:
            summary = night.run_stage(stage, day)
            if summary.failed or summary.refused:
                raise SystemExit(f"benchmark: {stage.name} of the reference: {dict(summary.reasons)}")


def _results(night: Any, data: Data, day: str) -> dict[str, Any]:
    """What the scan's stages left: bytes by table, poses, diameters, and the cameras for the peer."""
    from warehouse import store
    from warehouse.lineage import CALIBRATION_DAY

    records = {stage: r for (unit, stage), r in night.ledger.day(day).current.items() if unit == data.scan_id}
    outputs = {output.table: output for record in records.values() for output in record.outputs}
    tables = {name: store.read_table(night.root, o.path) for name, o in outputs.items() if o.path and o.rows < 100_000}
    calibration = night.ledger.day(CALIBRATION_DAY).get(data.calibration_id, "calibrations").output("calibrations")
    rows = store.read_table(night.root, calibration.path).to_pylist()
    mine = {name: [r for r in tables[name].to_pylist() if r["scan_id"] == data.scan_id] for name in _LIGHT_RESULTS}
    return {
        "bytes": {name: _bytes(night.root, output, tables.get(name)) for name, output in outputs.items()},
        "rows": {name: output.rows for name, output in outputs.items()},
        "centroids_mm": _centroids(store.read_table(night.root, outputs["filtered_clouds"].path)),
        "registrations": [_pose(row) for row in mine["registrations"]],
        "diameters": [
            {k: row[k] for k in ("side", "value", "value_uncompensated", "expanded_uncertainty", "reason")}
            for row in mine["measurements"]
            if row["quantity"] == "wheel_diameter"
        ],
        "cameras": {row["sensor_id"]: _cameras(row) for row in rows if row["state"] == "usable"},
    }


_LIGHT_RESULTS = ("registrations", "measurements")


def _bytes(root: Path, output: Any, table: Any) -> float:
    """Bytes on disk of one output; of a file that a day's scans share, the part that its rows are of all rows."""
    size = (root / output.path).stat().st_size
    return size * output.rows / table.num_rows if table is not None and table.num_rows else float(size)


def _centroids(cloud: Any) -> dict[str, list[float]]:
    """Mean point of each sensor's cloud, sensor frame: where errors of its pose are stated."""
    means = cloud.group_by("sensor_id").aggregate([(f"{axis}_mm", "mean") for axis in "xyz"])
    return {row["sensor_id"]: [row[f"{axis}_mm_mean"] for axis in "xyz"] for row in means.to_pylist()}


def _pose(row: dict[str, Any]) -> dict[str, Any]:
    kept = ("station", "source_sensor_id", "target_sensor_id", "method", "inlier_rmse_mm", "fitness", "n_constrained")
    return {k: row[k] for k in kept} | {
        "quaternion": [row[k] for k in ("qw", "qx", "qy", "qz")],
        "translation_mm": [row[f"t{axis}_mm"] for axis in "xyz"],
    }


def _cameras(row: dict[str, Any]) -> dict[str, Any]:
    pose = row["right_from_left"]
    facts: dict[str, Any] = {"size": [row["image_width_px"], row["image_height_px"]]}
    for side in ("left", "right"):
        fx, fy, cx, cy = row[f"{side}_camera"]
        facts[side] = {"matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "distortion": row[f"{side}_distortion"]}
    return facts | {"rotation": [pose[0:3], pose[4:7], pose[8:11]], "translation_mm": [pose[3], pose[7], pose[11]]}


def main(job: Path) -> None:
    """Carry out a job file: data, work folder, repeats."""
    task = json.loads(job.read_text(encoding="utf-8"))
    data = Data(Path(task["data"].pop("folder")), **task["data"])
    print(json.dumps(measure(data, Path(task["work"]), task["repeats"])))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
