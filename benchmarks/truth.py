"""Errors against the simulator's truth: of relative poses in the directions that a stripe can tell, and of diameters.

Plain numpy on the truth files; nothing of the program's own geometry, so that an error of it cannot hide here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

Array = NDArray[np.float64]


def true_poses(truth_rig: dict[str, Any], scan_id: str) -> dict[str, Array]:
    """rig_from_sensor (4, 4) of every sensor as it stood during a scan: at the rig's true temperature."""
    scan = next(s for s in truth_rig["scans"] if s["scan_id"] == scan_id)
    growth = 1.0 + truth_rig["rig"]["expansion_per_k"] * (scan["conditions"]["rig_c"] - 20.0)
    poses = {}
    for sensor in truth_rig["rig"]["sensors"]:
        pose = np.array(sensor["rig_from_sensor"])
        pose[:3, 3] *= growth
        poses[sensor["sensor_id"]] = pose
    return poses


def nominal_poses(truth_rig: dict[str, Any]) -> dict[str, Array]:
    """rig_from_sensor (4, 4) as the rig's file states it."""
    return {s["sensor_id"]: np.array(s["rig_from_sensor_nominal"]) for s in truth_rig["rig"]["sensors"]}


def pose(quaternion: list[float], translation_mm: list[float]) -> Array:
    """Transform (4, 4) of a unit quaternion (w, x, y, z) and a translation."""
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, 3] = translation_mm
    return found


def registration_error(
    target_from_source: Array, source: str, target: str, at_mm: Array, poses: dict[str, Array]
) -> dict:
    """Error of a relative pose at a point (3,) of the source's frame, in the rig, the target sensor standing truly.

    Along the axle, away from it, and the rotation within the meridian plane: none of them changes with a turn about
    the axle, which a surface of revolution does not show. `total_deg` and `displacement_mm` count that turn too.
    """
    estimated = poses[target] @ target_from_source
    true = poses[source]
    found, wanted = (m[:3, :3] @ at_mm + m[:3, 3] for m in (estimated, true))
    # The direction that truly runs along the axle: how far does it lean away from the axle where it is put?
    leaning = estimated[:3, :3] @ true[:3, :3].T @ np.array([1.0, 0.0, 0.0])
    outward = np.array([0.0, *found[1:]]) / np.hypot(*found[1:])
    turned = estimated[:3, :3] @ true[:3, :3].T
    return {
        "lateral_um": 1e3 * float(found[0] - wanted[0]),
        "radial_um": 1e3 * float(np.hypot(*found[1:]) - np.hypot(*wanted[1:])),
        "meridian_deg": float(np.degrees(np.arctan2(leaning @ outward, leaning[0]))),
        "total_deg": float(np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))),
        "displacement_mm": float(np.linalg.norm(found - wanted)),
    }


def true_diameters(path: Path, scan_id: str) -> dict[str, float]:
    """True wheel diameters of a scan's wheelset in mm, by side."""
    rows = pq.read_table(path).to_pylist()
    return {r["side"]: r["truth_mm"] for r in rows if r["scan_id"] == scan_id and r["quantity"] == "wheel_diameter"}
