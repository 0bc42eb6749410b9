"""Ways to filter and to register that the ablation compares: configurations, and registrations beside the stage's own.

Each registration answers as stage 5 does, a motion of the rig frame and a row to store; claimed uncertainties are those
of the stage's own method, for the question is what a way does to the values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheelset_assets.config import Config, RegistrationConfig
from wheelset_assets.metrology.frequency import align_overlap
from wheelset_assets.metrology.registration import rigid_from_pairs
from wheelset_assets.metrology.revolution import meridian_motion
from wheelset_assets.quality import Flag
from wheelset_assets.stages.pose import (
    Keypoints,
    Register,
    StationScan,
    View,
    coarse_pose,
    pose_row,
    register_by_icp,
)

Array = NDArray[Any]
Planar = Callable[[StationScan, View, View, Keypoints, RegistrationConfig], Array]
"""A way in the meridian plane: motion (3, 3) of (lateral, radial, 1)."""

ITERATIONS = 60
FREQUENCY_ROUNDS = 4


def filters() -> dict[str, Config]:
    """Configurations by what they do in stage 3; the default is `quadratic`."""
    base = Config()
    changes: dict[str, dict[str, Any]] = {
        "none": {"smoothing": "none"},
        "median, 5 rows": {"smoothing": "median", "window_rows": 5},
        "mean, 5 rows": {"smoothing": "mean", "window_rows": 5},
        "gaussian": {"smoothing": "gaussian"},
        "gaussian, sigma 2, 9 rows": {"smoothing": "gaussian", "gaussian_sigma_rows": 2.0, "window_rows": 9},
        "quadratic": {},
        "quadratic, sigma 2, 9 rows": {"gaussian_sigma_rows": 2.0, "window_rows": 9},
        "bilateral": {"smoothing": "bilateral"},
        "quadratic, no outlier test": {"outlier_sigmas": 1e9},
    }
    return {
        name: base.model_copy(update={"filtering": base.filtering.model_copy(update=change)})
        for name, change in changes.items()
    }


def registrations() -> dict[str, Register]:
    """Ways to register by name; the stage's own is `point to curve, with prior`."""
    return {
        "nominal pose": _planar(_nominal),
        "keypoints alone": _planar(_keypoints),
        "point to point": _planar(_point_to_point),
        "point to line": _planar(_point_to_line),
        "frequency alone": _planar(_frequency),
        "point to curve, with prior": register_by_icp,
    }


def _planar(way: Planar) -> Register:
    """A way in the meridian plane as a registration; the row keeps what the stage's own method claims."""

    def register(
        station: StationScan, source: View, target: View, keypoints: Keypoints, config: RegistrationConfig
    ) -> tuple[Array | None, dict[str, Any]]:
        _, row = register_by_icp(station, source, target, keypoints, config)
        if row["method"] != "icp":
            return None, row
        plane = way(station, source, target, keypoints, config)
        angle = float(np.arctan2(plane[1, 0], plane[0, 0]))
        motion = meridian_motion(station.grids[source].direction_deg, (0.0, 0.0), angle, plane[0, 2], plane[1, 2])
        pose = pose_row(station, source, target, motion, Flag.NONE)
        decided = {name: pose[name] for name in ("qw", "qx", "qy", "qz", "tx_mm", "ty_mm", "tz_mm")}
        return motion, row | decided

    return register


def _nominal(*_: Any) -> Array:
    return np.eye(3)


def _keypoints(
    station: StationScan, source: View, target: View, keypoints: Keypoints, config: RegistrationConfig
) -> Array:
    """Coarse pose from matches (eq. 22-24); the nominal pose where there are too few."""
    pivot = station.curves[source].mean(axis=0)
    found = coarse_pose(keypoints.get(source[0]), keypoints.get(target[0]), (float(pivot[0]), float(pivot[1])), config)
    if found is None:
        return np.eye(3)
    return _about(pivot, found.rotation_rad, found.shift_mm)


def _about(pivot: Array, angle_rad: float, shift: Array) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.array([[c, -s], [s, c]])
    plane = np.eye(3)
    plane[:2, :2], plane[:2, 2] = turn, pivot - turn @ pivot + shift
    return plane


def _point_to_point(
    station: StationScan, source: View, target: View, keypoints: Keypoints, config: RegistrationConfig
) -> Array:
    """ICP by eq. 25-26 as printed: nearest points, then their least-squares motion, from the nominal pose."""
    moved, curve, plane = station.curves[source], station.curves[target], np.eye(3)
    tree, reach = cKDTree(curve), config.max_pair_mm
    for _ in range(ITERATIONS):
        distance, near = tree.query(moved)
        kept = _inner(distance, near, len(curve), reach)
        if kept.sum() < config.min_pairs:
            break
        step = rigid_from_pairs(_flat(moved[kept]), _flat(curve[near[kept]]))
        plane = _in_plane(step) @ plane
        moved = _moved(_in_plane(step), moved)
        reach = float(np.clip(4 * np.median(distance[kept]), 0.3, reach))
    return plane


def _point_to_line(
    station: StationScan, source: View, target: View, keypoints: Keypoints, config: RegistrationConfig
) -> Array:
    """ICP point to plane, which in the meridian is a line through each nearest point and its neighbours."""
    moved, curve, plane = station.curves[source], station.curves[target], np.eye(3)
    chord = np.gradient(curve, axis=0)
    normal = np.column_stack([-chord[:, 1], chord[:, 0]]) / np.linalg.norm(chord, axis=1)[:, None]
    tree, reach = cKDTree(curve), config.max_pair_mm
    for _ in range(ITERATIONS):
        distance, near = tree.query(moved)
        kept = _inner(distance, near, len(curve), reach)
        if kept.sum() < config.min_pairs:
            break
        n, gap = normal[near[kept]], moved[kept] - curve[near[kept]]
        centre = moved[kept].mean(axis=0)
        arm = moved[kept] - centre
        jacobian = np.column_stack([arm[:, 0] * n[:, 1] - arm[:, 1] * n[:, 0], n])
        across = (gap * n).sum(axis=1)
        step, *_ = np.linalg.lstsq(jacobian, -across, rcond=None)
        turn = _about(centre, float(step[0]), step[1:])
        plane, moved = turn @ plane, _moved(turn, moved)
        reach = float(np.clip(4 * np.median(np.abs(across)), 0.3, reach))
    return plane


def _frequency(
    station: StationScan, source: View, target: View, keypoints: Keypoints, config: RegistrationConfig
) -> Array:
    """Phase correlation and spectrum, the paper's 3.2, in a few rounds from the nominal pose."""
    plane = np.eye(3)
    for _ in range(FREQUENCY_ROUNDS):
        found = align_overlap(_moved(plane, station.curves[source]), station.curves[target])
        if found is None:
            break
        plane = _about(found.pivot_mm, float(np.radians(found.rotation_deg)), found.shift_mm) @ plane
    return plane


def _inner(distance: Array, near: Array, n: int, reach: float) -> NDArray[np.bool_]:
    """Pairs within reach whose partner is no end of the curve: beyond an end every point has the same partner."""
    return np.asarray((distance <= reach) & (near > 0) & (near < n - 1))


def _flat(points: Array) -> Array:
    return np.column_stack([points, np.zeros(len(points))])


def _in_plane(step: Array) -> Array:
    plane = np.eye(3)
    plane[:2, :2], plane[:2, 2] = step[:2, :2], step[:2, 3]
    return plane


def _moved(plane: Array, points: Array) -> Array:
    return points @ plane[:2, :2].T + plane[:2, 2]
