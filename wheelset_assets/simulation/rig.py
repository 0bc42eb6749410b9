"""The rig: nominal and true sensor poses, cameras, laser planes, and the rig's JSON declaration.

Here: construction from a preset, the random misalignment of the true rig, growth with temperature, `wheelset-rig/1`.
Not here: what the sensors see (`stripes`, `boards`). Frames and growth follow the bundle format: the sensor frame is
the left camera's; the translation of a true pose is multiplied by 1 + expansion_per_k (T_rig - 20 degC).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..metrology.rigid import apply, inverse, rotation_from_vector, transform
from .optics import Camera
from .presets import PRESETS, RigPreset, SensorSpec
from .streams import in_ball, stream

Array = NDArray[np.float64]

# Nominal wheelset that the sensors are set up for.
INNER_DISTANCE_MM, SHOULDER_DISTANCE_MM, TREAD_RADIUS_MM = 1353.0, 2180.0, 460.0
POSE_LIMIT_MM, POSE_LIMIT_DEG = 1.9, 0.95  # the format allows 2 mm and 1 deg
FINE_SQUARE_PX = 22.0
PLANE_OFFSET_MM, PLANE_TILT_DEG = 1.5, 0.4  # how far a laser plane misses the axis, and its tilt against it


@dataclass(frozen=True)
class LaserPlane:
    """Points p (mm, sensor frame) with normal . p = offset; the light comes from `emitter_mm` (3,)."""

    normal: tuple[float, float, float]
    offset_mm: float
    emitter_mm: tuple[float, float, float]


@dataclass(frozen=True)
class Sensor:
    """One stereo sensor; poses hold at a rig temperature of 20 degC. `planes` are in the order of the line numbers."""

    sensor_id: str
    station: str
    kind: str
    side: str
    rig_from_sensor_nominal: Array
    rig_from_sensor: Array
    left: Camera
    right: Camera
    right_from_left: Array
    planes: tuple[LaserPlane, ...]
    working_distance_mm: float

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.left.image_size

    def moved(self, shift_in_rig_mm: Array) -> Sensor:
        """The sensor displaced by (3,) mm along the rig's axes."""
        pose = self.rig_from_sensor.copy()
        pose[:3, 3] += shift_in_rig_mm
        return replace(self, rig_from_sensor=pose)

    def rig_from_sensor_at(self, rig_temperature_c: float, expansion_per_k: float) -> Array:
        """True pose (4, 4) at a rig temperature: the frame grows about the rig's origin, orientation stays."""
        pose = self.rig_from_sensor.copy()
        pose[:3, 3] *= 1.0 + expansion_per_k * (rig_temperature_c - 20.0)
        return pose


@dataclass(frozen=True)
class Rig:
    """A true rig with its nominal declaration."""

    rig_id: str
    sensors: tuple[Sensor, ...]
    inner_corners: tuple[int, int]
    square_mm: float
    expansion_per_k: float = 11.5e-6

    def sensor(self, sensor_id: str) -> Sensor:
        """The sensor of that name."""
        return next(s for s in self.sensors if s.sensor_id == sensor_id)

    def declaration(self) -> dict[str, Any]:
        """Content of rigs/<rig_id>.json: nominal values only."""
        stations: dict[str, dict[str, str]] = {}
        for s in self.sensors:
            stations.setdefault(s.station, {"station": s.station, "kind": s.kind, "side": s.side})
        return {
            "format": "wheelset-rig/1",
            "rig_id": self.rig_id,
            "stations": list(stations.values()),
            "sensors": [
                {
                    "sensor_id": s.sensor_id,
                    "station": s.station,
                    "image_size": list(s.image_size),
                    "laser_lines": len(s.planes),
                    "T_rig_sensor": s.rig_from_sensor_nominal.tolist(),
                }
                for s in self.sensors
            ],
            "expansion_per_k": self.expansion_per_k,
        }


def build_rig(seed: int, preset: str | RigPreset, rig_id: str, rows: int = 0, expansion_per_k: float = 11.5e-6) -> Rig:
    """A rig drawn from the seed. `rows` > 0 scales all images so that the preset's tallest has that many rows."""
    spec = PRESETS[preset] if isinstance(preset, str) else preset
    factor = rows / max(s.image_size[1] for s in spec.sensors) if rows else 1.0
    sensors = [
        _sensor(seed, index, one, side, factor)
        for index, (side, one) in enumerate((side, one) for side in ("left", "right") for one in spec.sensors)
    ]
    finest = min(s.left.fx_px / s.working_distance_mm for s in sensors)  # px per mm
    columns, corner_rows, square_mm = spec.board if finest * spec.board[2] >= FINE_SQUARE_PX else spec.coarse_board
    return Rig(rig_id, tuple(sensors), (columns, corner_rows), square_mm, expansion_per_k)


def _sensor(seed: int, index: int, spec: SensorSpec, side: str, factor: float) -> Sensor:
    rng = stream(seed, "rig", index)
    rig_from_left = _turn_z(side) @ _camera_pose(spec, +1)
    rig_from_right = _turn_z(side) @ _camera_pose(spec, -1)
    wiggle = transform(rotation_from_vector(in_ball(rng, np.deg2rad(POSE_LIMIT_DEG))), in_ball(rng, POSE_LIMIT_MM))
    true_pose = rig_from_left @ transform(wiggle[:3, :3], np.zeros(3))
    true_pose[:3, 3] += wiggle[:3, 3]
    stereo = inverse(rig_from_right) @ rig_from_left
    stereo = transform(rotation_from_vector(in_ball(rng, np.deg2rad(0.3))), in_ball(rng, 0.5)) @ stereo
    size = (round(spec.image_size[0] * factor), round(spec.image_size[1] * factor))
    cameras = [_camera(seed, 2 * index + c, spec).scaled(factor, size) for c in range(2)]
    planes = _planes(seed, index, spec, side, true_pose, stereo)
    # Line 0 is the one of smaller u in the left image.
    ordered = sorted(planes, key=lambda plane: _column(plane, cameras[0], spec.standoff_mm))
    distance = float(np.hypot(spec.standoff_mm, spec.half_baseline_mm))
    return Sensor(
        f"{side}_{spec.name}",
        f"{side}_{spec.kind}",
        spec.kind,
        side,
        rig_from_left,
        true_pose,
        cameras[0],
        cameras[1],
        stereo,
        tuple(ordered),
        distance,
    )


def _meridian_frame(spec: SensorSpec, azimuth_deg: float) -> tuple[Array, Array, Array]:
    """Target point, radial and circumferential unit vectors (3,) of the left side's meridian plane at an azimuth."""
    a = np.deg2rad(azimuth_deg)
    radial = np.array([0.0, -np.sin(a), np.cos(a)])  # right-hand rotation of Z about +X
    around = np.array([0.0, np.cos(a), np.sin(a)])
    base = (INNER_DISTANCE_MM if spec.kind == "wheel" else SHOULDER_DISTANCE_MM) / 2
    height = spec.target_mm[1] + (TREAD_RADIUS_MM if spec.kind == "wheel" else 0.0)
    return np.array([-(base + spec.target_mm[0]), 0.0, 0.0]) + height * radial, radial, around


def _camera_pose(spec: SensorSpec, camera: int) -> Array:
    """Nominal pose (4, 4) of the left side's left (+1) or right (-1) camera: v runs outward, z to the target."""
    target, radial, around = _meridian_frame(spec, spec.azimuth_deg)
    tilt = np.deg2rad(spec.tilt_deg)
    look = -np.sin(tilt) * np.array([1.0, 0.0, 0.0]) - np.cos(tilt) * radial
    centre = target - spec.standoff_mm * look + camera * spec.half_baseline_mm * around
    z = (target - centre) / np.linalg.norm(target - centre)
    y = -np.cos(tilt) * np.array([1.0, 0.0, 0.0]) + np.sin(tilt) * radial  # in the meridian plane, square to `look`
    return transform(np.column_stack([np.cross(y, z), y, z]), centre)


def _planes(
    seed: int, index: int, spec: SensorSpec, side: str, rig_from_left: Array, stereo: Array
) -> list[LaserPlane]:
    """Laser planes in the true sensor's frame: through the target, missing the axis by little, slightly tilted."""
    rng = stream(seed, "laser", index)
    right_centre = inverse(stereo)[:3, 3]
    emitter = right_centre / 2  # between the cameras
    planes = []
    for line_deg in spec.lines_deg:
        point, radial, around = _meridian_frame(spec, spec.azimuth_deg + line_deg)
        height = float(point @ radial)
        miss, tilt = rng.uniform(-PLANE_OFFSET_MM, PLANE_OFFSET_MM), rng.uniform(-PLANE_TILT_DEG, PLANE_TILT_DEG)
        normal = around + miss / height * radial + np.deg2rad(tilt) * np.array([1.0, 0.0, 0.0])
        normal, point = _turn_z(side)[:3, :3] @ normal / np.linalg.norm(normal), _turn_z(side)[:3, :3] @ point
        in_sensor = rig_from_left[:3, :3].T @ normal
        offset = float(in_sensor @ apply(inverse(rig_from_left), point))
        planes.append(LaserPlane(_triple(in_sensor), offset, _triple(emitter)))
    return planes


def _camera(seed: int, index: int, spec: SensorSpec) -> Camera:
    """A full-size camera: about the nominal focal length and centre, with a lens' usual distortion."""
    rng = stream(seed, "optics", index)
    width, height = spec.image_size
    focal = spec.focal_px * (1.0 + rng.uniform(-0.008, 0.008))
    k1, k2, k3 = rng.uniform(-0.12, -0.04), rng.uniform(-0.1, 0.1), rng.uniform(-0.05, 0.05)
    p1, p2 = rng.uniform(-4e-4, 4e-4, 2)
    return Camera(
        focal,
        focal * (1.0 + rng.uniform(-0.0005, 0.0005)),
        (width - 1) / 2 + rng.uniform(-6.0, 6.0),
        (height - 1) / 2 + rng.uniform(-6.0, 6.0),
        (float(k1), float(k2), float(p1), float(p2), float(k3)),
        spec.image_size,
    )


def _column(plane: LaserPlane, left: Camera, distance_mm: float) -> float:
    """Column where a plane crosses the left camera's middle row at the working distance."""
    n = np.asarray(plane.normal)
    return left.fx_px * (plane.offset_mm - n[2] * distance_mm) / n[0] / distance_mm + left.cx_px


def _turn_z(side: str) -> Array:
    return np.eye(4) if side == "left" else np.diag([-1.0, -1.0, 1.0, 1.0])


def _triple(v: Array) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
