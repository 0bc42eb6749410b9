"""Laser planes from the stripes' own points: fit, check of each point against its plane, and of a plane against another.

A sensor's laser stands still against its cameras. A point off its plane was matched wrongly or is a reflection; a plane
that moved tells that the sensor is not what it was when the other plane was seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.rigid import rotation_from_vector

Array = NDArray[Any]

SAMPLE = 50_000
ROUNDS = 8
FORM_MM = 0.01
"""What distortions left by a calibration may bend a plane by, over its points."""


@dataclass(frozen=True)
class LaserPlane:
    """normal . x = distance_mm in the sensor frame. rms_mm: scatter of the points about it, outliers left out; extent_mm:
    standard deviations of the points along the plane's two directions about centre_mm, the first along `direction`."""

    normal: Array
    distance_mm: float
    centre_mm: Array
    rms_mm: float
    n_points: int
    extent_mm: tuple[float, float]
    direction: Array

    def offsets_mm(self, points_mm: Array) -> Array:
        """Signed distances (...) of points (..., 3) from the plane."""
        return points_mm @ self.normal - self.distance_mm


def fit_laser_plane(points_mm: Array, limit_sigmas: float = 4.0) -> LaserPlane | None:
    """Plane through points (n, 3) of one laser line by total least squares, outliers left out in rounds.

    None if fewer than 100 points are there, or if they do not span a plane (a straight stripe that never moves).
    """
    points = points_mm[np.isfinite(points_mm).all(axis=1)]
    if len(points) < 100:
        return None
    points = points[:: max(1, len(points) // SAMPLE)]
    kept = _near_median(points)
    previous = -1
    for _ in range(ROUNDS):
        centre = points[kept].mean(axis=0)
        _, spread, axes = np.linalg.svd(points[kept] - centre, full_matrices=False)
        offsets = (points - centre) @ axes[2]
        middle = float(np.median(offsets[kept]))
        scatter = 1.4826 * float(np.median(np.abs(offsets[kept] - middle)))
        kept = np.abs(offsets - middle) <= limit_sigmas * max(scatter, 1e-6)
        if kept.sum() < 100:
            return None
        if kept.sum() == previous:
            break
        previous = int(kept.sum())
    extent = spread / np.sqrt(len(points[kept]))
    if extent[1] < 5 * max(extent[2], 1e-6):
        return None
    normal = axes[2] * (1.0 if axes[2][0] >= 0 else -1.0)
    distance = float(normal @ centre)
    rms = float(np.sqrt(np.mean((points[kept] @ normal - distance) ** 2)))
    return LaserPlane(normal, distance, centre, rms, len(points_mm), (float(extent[0]), float(extent[1])), axes[0])


def _near_median(points: Array) -> NDArray[np.bool_]:
    """Points that are not far outside the others: gross mismatches would turn the first fit."""
    middle = np.median(points, axis=0)
    reach = np.percentile(np.abs(points - middle), 95, axis=0) + 1.0
    return (np.abs(points - middle) <= 2 * reach).all(axis=1)


def off_plane(plane: LaserPlane, points_mm: Array, u_mm: Array, sigmas: float, floor_mm: float) -> NDArray[np.bool_]:
    """Which points (n, 3) lie farther from the plane than their noise explains; NaN points do not.

    u_mm: standard uncertainty along the line of sight; what of it lies across the plane counts, and the plane's own
    scatter, as laser sheets are a little bent.
    """
    length = np.linalg.norm(points_mm, axis=-1)
    across = np.abs(points_mm @ plane.normal) / length
    limit = np.maximum(sigmas * np.hypot(u_mm * across, plane.rms_mm), floor_mm)
    with np.errstate(invalid="ignore"):
        return np.abs(plane.offsets_mm(points_mm)) > limit


def plane_shift(now: LaserPlane, then: LaserPlane) -> tuple[float, float]:
    """How a plane lies against an earlier one: largest distance in mm over the field of the earlier one's points, two
    standard deviations along each of its directions, and the angle between the normals in degrees."""
    sign = 1.0 if now.normal @ then.normal >= 0 else -1.0
    normal, distance = sign * now.normal, sign * now.distance_mm
    along = then.direction - (then.direction @ then.normal) * then.normal
    across = np.cross(then.normal, along)
    tilts = [
        2.0 * extent * abs(float(normal @ axis)) for extent, axis in zip(then.extent_mm, (along, across), strict=True)
    ]
    angle = float(np.degrees(np.arcsin(min(1.0, float(np.linalg.norm(np.cross(then.normal, normal)))))))
    return abs(float(normal @ then.centre_mm - distance)) + sum(tilts), angle


@dataclass(frozen=True)
class Make:
    """What a rig's maker promises, as half widths: of a nominal pose, and of how near to the axle a laser plane passes."""

    pose_mm: float
    pose_rad: float
    plane_mm: float


@dataclass(frozen=True)
class TurnedToAxle:
    """Pose (4, 4), and how far from the axle the plane passed before, beside what the make allows for that."""

    rig_from_sensor: Array
    offset_mm: float
    limit_mm: float


def turned_to_axle(rig_from_sensor: Array, plane: LaserPlane, make: Make) -> TurnedToAxle:
    """Pose turned about the axle's direction, in its place, so that the laser plane passes near the axle.

    No point tells how far from the axle its plane passes. A nominal pose leaves that open by a centimetre, the make by
    millimetres; and an error b of it, in a sensor that is turned out of the meridian by psi, tilts the meridian by
    b psi / R. The turn is the least-squares one between both, at the lateral place of the points; where these hardly
    spread along their rays, what the plane's fit may lack counts too. No turn takes the plane there: none is made, and
    the offset is NaN.
    """
    pose = np.array(rig_from_sensor, float)
    normal = pose[:3, :3] @ plane.normal
    lit = pose[:3, :3] @ plane.centre_mm + pose[:3, 3]
    to_axle = np.array([lit[0], 0.0, 0.0]) - pose[:3, 3]
    reach = float(np.hypot(*to_axle[1:]))
    by_fit = FORM_MM / max(plane.extent_mm[1], FORM_MM) * float(np.hypot(*lit[1:]))
    by_pose = float(np.hypot(make.pose_rad * reach, make.pose_mm))
    limit = make.pose_rad * reach + make.pose_mm + make.plane_mm + 3.0 * by_fit
    # normal . (to_axle, turned by -angle) = distance, in the plane across the axle: |n| |t| cos(between - angle) = rest
    across = float(np.hypot(*normal[1:])) * reach
    rest = plane.distance_mm - normal[0] * to_axle[0]
    if across == 0 or abs(rest) > across:
        return TurnedToAxle(pose, float("nan"), limit)
    between = np.arctan2(to_axle[2], to_axle[1]) - np.arctan2(normal[2], normal[1])
    angles = between + np.array([-1.0, 1.0]) * np.arccos(rest / across)
    angles = (angles + np.pi) % (2 * np.pi) - np.pi
    angle = float(angles[np.argmin(np.abs(angles))])
    share = by_pose**2 / (by_pose**2 + make.plane_mm**2 + by_fit**2)
    turned = pose.copy()
    turned[:3, :3] = rotation_from_vector([share * angle, 0.0, 0.0]) @ pose[:3, :3]
    offset = (rest - normal[1:] @ to_axle[1:]) / float(np.hypot(*normal[1:]))
    return TurnedToAxle(turned, abs(float(offset)), limit)
