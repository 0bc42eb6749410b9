"""Laser planes from the stripes' own points: fit, check of each point against its plane, and of a plane against another.

A sensor's laser stands still against its cameras. A point off its plane was matched wrongly or is a reflection; a plane
that moved tells that the sensor is not what it was when the other plane was seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology import rigid

Array = NDArray[Any]

SAMPLE = 50_000
ROUNDS = 8
BALL = 5.0
"""Square of the half width over the variance of one component of a vector that fills a ball."""
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


def off_plane(
    plane: LaserPlane, points_mm: Array, u_across_mm: Array, sigmas: float, floor_mm: float
) -> NDArray[np.bool_]:
    """Which points (n, 3) lie farther from the plane than their noise explains; NaN points do not.

    u_across_mm: standard uncertainty across the plane (`off_plane_uncertainty`). The plane's own scatter counts too, as
    laser sheets are a little bent.
    """
    limit = np.maximum(sigmas * np.hypot(u_across_mm, plane.rms_mm), floor_mm)
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
    """What a rig's maker promises, as half widths: of a nominal pose, and of how a laser plane lies to the axle, in its
    distance from it beside what it lights and in its angle with it."""

    pose_mm: float
    pose_rad: float
    plane_mm: float
    plane_rad: float


@dataclass(frozen=True)
class Sensing:
    """How a laser plane lies to the axle, best estimate and standard uncertainty: distance from it, and angle with it;
    and how far from the axle its points lie."""

    radius_mm: float
    offset_mm: float
    yaw_rad: float
    u_offset_mm: float
    u_yaw_rad: float

    @property
    def u_strains(self) -> tuple[float, float, float]:
        """Standard uncertainties of the meridian's strain: along the axle, away from it, and shear.

        A plane at the angle psi with the axle shortens its meridian by psi^2 / 2 along the axle; one that passes the axle
        at b shortens it by b^2 / 2 R^2 away from it; both together shear it by b psi / R. No motion takes that away.
        """
        return self.u_cosine, self.u_shrink, self.u_shear

    @property
    def u_cosine(self) -> float:
        """Standard uncertainty of the cosine of the angle: of lengths along the axle."""
        return half_square_uncertainty(self.yaw_rad, self.u_yaw_rad)

    @property
    def u_shrink(self) -> float:
        """Standard uncertainty of the factor by which the offset shortens lengths along the radius."""
        return half_square_uncertainty(self.offset_mm / self.radius_mm, self.u_offset_mm / self.radius_mm)

    @property
    def u_shear(self) -> float:
        """Standard uncertainty of the meridian's tilt by both together: offset times angle over radius."""
        both = (self.offset_mm * self.u_yaw_rad, self.u_offset_mm * self.yaw_rad, self.u_offset_mm * self.u_yaw_rad)
        return float(np.linalg.norm(both)) / self.radius_mm


def half_square_uncertainty(value: float, u: float) -> float:
    """Standard uncertainty of value^2 / 2, the bias of the square included: the cosine of a small angle."""
    return float(np.hypot(value * u, np.sqrt(0.75) * u**2))


def turned_to_axle(rig_from_sensor: Array, plane: LaserPlane, make: Make) -> tuple[Array, Sensing, bool]:
    """Pose (4, 4) turned so that its laser plane lies to the axle as the rig's make says, and how it lies then.

    No point tells how its plane lies to the axle. A nominal pose leaves the distance open by a centimetre, the make by
    millimetres; and b of it, in a plane at an angle psi with the axle, tilts the meridian by b psi / R, while psi alone
    shortens it by psi^2 / 2. Least squares between pose and make: a turn about the axle's direction, in the sensor's
    place, and one about the radial direction through what is lit. Where the points hardly spread along their rays,
    what the plane's fit may lack counts too. True: the plane lies farther off than pose and make together allow, or
    where no turn takes it (then none is made).
    """
    pose = np.array(rig_from_sensor, float)
    reach = float(np.hypot(*pose[1:3, 3]))
    u_pose = float(np.hypot(make.pose_rad * reach, make.pose_mm)) / np.sqrt(BALL)
    lit = rigid.apply(pose, plane.centre_mm)
    normal = pose[:3, :3] @ plane.normal
    to_axle = np.array([lit[0], 0.0, 0.0]) - pose[:3, 3]
    # normal . (to_axle, turned by -angle) = distance, in the plane across the axle: |n| |t| cos(between - angle) = rest
    steep = float(np.hypot(*normal[1:]))
    rest = plane.distance_mm - normal[0] * to_axle[0]
    if steep * reach == 0 or abs(rest) > steep * reach:
        return (
            pose,
            Sensing(max(float(np.hypot(*lit[1:])), FORM_MM), u_pose, make.pose_rad, u_pose, make.pose_rad),
            True,
        )
    between = np.arctan2(to_axle[2], to_axle[1]) - np.arctan2(normal[2], normal[1])
    angles = between + np.array([-1.0, 1.0]) * np.arccos(rest / (steep * reach))
    angles = (angles + np.pi) % (2 * np.pi) - np.pi
    angle = float(angles[np.argmin(np.abs(angles))])
    offset = abs(float(rest - normal[1:] @ to_axle[1:])) / steep
    u_fit = FORM_MM / np.maximum(plane.extent_mm, FORM_MM)
    beside, u_offset = _between(offset, u_pose, np.hypot(make.plane_mm / np.sqrt(3), u_fit[1] * np.hypot(*lit[1:])))
    pose[:3, :3] = rigid.rotation_from_vector([(1 - beside / max(offset, 1e-12)) * angle, 0.0, 0.0]) @ pose[:3, :3]

    lit = rigid.apply(pose, plane.centre_mm)
    radial = np.array([0.0, *lit[1:]]) / np.hypot(*lit[1:])
    around = np.cross([1.0, 0.0, 0.0], radial)
    normal = pose[:3, :3] @ plane.normal
    yaw = float(np.arctan(normal[0] / (normal @ around)))
    kept, u_yaw = _between(yaw, make.pose_rad / np.sqrt(BALL), float(np.hypot(make.plane_rad / np.sqrt(3), u_fit[0])))
    turn = rigid.rotation_from_vector((kept - yaw) * radial)
    seen = Sensing(float(np.hypot(*lit[1:])), beside, abs(kept), u_offset, u_yaw)
    far = (
        offset > make.pose_rad * reach + make.pose_mm + make.plane_mm + 3 * u_fit[1] * np.hypot(*lit[1:])
        or abs(yaw) > make.pose_rad + make.plane_rad + 3 * u_fit[0]
    )
    return rigid.transform(turn, lit - turn @ lit) @ pose, seen, bool(far)


def _between(seen: float, u_pose: float, u_make: float) -> tuple[float, float]:
    """A quantity that is zero by the make and `seen` by the pose: its best estimate, and standard uncertainty."""
    share = u_make**2 / (u_pose**2 + u_make**2)
    return share * seen, u_pose * float(np.sqrt(share))
