"""What a benchmark's raw figures mean: rates with their spread, bytes a point, and errors against the truth.

From facts to facts, JSON in and out; no file but the truth is read and nothing is timed here.
"""

from __future__ import annotations

from statistics import median
from typing import Any

import numpy as np

from benchmarks import truth
from benchmarks.data import Data

STEPS_BY_STAGE = {
    "triangulated_clouds": ("triangulate",),
    "filtered_clouds": ("outliers", "downsample"),
    "features": ("normals", "keypoints", "descriptors"),
    "registrations": ("ransac", "icp"),
    "alignments": ("plane",),
    "measurements": ("radius",),
}
"""The peer's steps beside our stages; `icp_from_nominal` and `master` are its extras, timed but in no sum."""


def spread(values: list[float]) -> dict[str, float]:
    """Median, smallest and largest of the repeats."""
    return {"median": median(values), "min": min(values), "max": max(values)}


def rates(points: int, seconds: list[float]) -> dict[str, float]:
    """Points a second over the repeats."""
    return spread([points / s for s in seconds])


def bytes_per_point(ours: dict[str, Any], bundle_bytes: int) -> dict[str, Any]:
    """Bytes on disk by table and in all, and of the bundle as delivered, for each triangulated point of the scan."""
    points = ours["points"]
    tables = {name: size / points for name, size in sorted(ours["bytes"].items(), key=lambda item: -item[1])}
    return {"tables": tables, "total": sum(tables.values()), "bundle": bundle_bytes / points}


def peer_seconds(peer: dict[str, Any], stage: str | None = None) -> dict[str, Any]:
    """Seconds of the peer's steps beside a stage, or beside all; `complete` is False if one was stopped or failed."""
    names = STEPS_BY_STAGE[stage] if stage else [name for steps in STEPS_BY_STAGE.values() for name in steps]
    steps = [peer["steps"].get(name, {}) for name in names]
    stopped = sum(peer["limit_seconds"] for step in steps if step.get("state") == "stopped")
    return {
        "seconds": sum(step.get("seconds", 0.0) for step in steps) + stopped,
        "cpu_seconds": sum(step.get("cpu_seconds", 0.0) for step in steps),
        "complete": all(step.get("state") == "done" for step in steps),
    }


def registration_errors(data: Data, ours: dict[str, Any], peer: dict[str, Any]) -> list[dict[str, Any]]:
    """Errors of the relative poses of each wheel station's sensors, at the centroid of the source's points."""
    truth_rig = data.truth_rig
    poses, nominal = truth.true_poses(truth_rig, data.scan_id), truth.nominal_poses(truth_rig)
    found = []
    for row in ours["registrations"]:
        source, target = row["source_sensor_id"], row["target_sensor_id"]
        if source == target:
            continue
        side = row["station"].split("_")[0]
        methods = {"nominal pose": np.eye(4)}
        for method, label in (
            ("ransac", "peer: RANSAC"),
            ("icp", "peer: RANSAC, ICP"),
            ("icp_from_nominal", "peer: ICP alone"),
        ):
            motion = peer.get("results", {}).get(method, {}).get(side)
            if motion is not None:
                methods[label] = np.array(motion)
        back = np.linalg.inv(nominal[target])
        estimates = {label: back @ motion @ nominal[source] for label, motion in methods.items()}
        estimates[f"wheelset ({row['method']})"] = truth.pose(row["quaternion"], row["translation_mm"])
        at = np.array(ours["centroids_mm"][source])
        for label, pose in estimates.items():
            error = truth.registration_error(pose, source, target, at, poses)
            found.append({"station": row["station"], "method": label} | error)
    return found


def diameter_errors(data: Data, ours: dict[str, Any], peer: dict[str, Any]) -> list[dict[str, Any]]:
    """Errors of the wheel diameters in um by method; None where there is no value."""
    true = truth.true_diameters(data.truth, data.scan_id)
    found = []
    results = peer.get("results", {})
    for row in ours["diameters"]:
        side = row["side"]
        values = {"wheelset": row["value"], "wheelset, not compensated for temperature": row["value_uncompensated"]}
        for method, label in (("icp", "peer: RANSAC, ICP"), ("icp_from_nominal", "peer: ICP alone")):
            for table, how in (("diameters_mm", ""), ("zeroed_mm", ", zeroed by the master")):
                values[f"{label}{how}"] = results.get(table, {}).get(f"{method} {side}")
        for label, value in values.items():
            usable = value is not None and np.isfinite(value)
            claimed = row["expanded_uncertainty"] if label == "wheelset" else None
            found.append({
                "side": side, "method": label, "error_um": 1e3 * (value - true[side]) if usable else None,
                "expanded_uncertainty_um": 1e3 * claimed if claimed is not None else None,
            })  # fmt: skip
    return found
