"""Uncertainty by the GUM (JCGM 100): contributions of independent sources to one value. No distributions are drawn here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wheelset_assets.metrology.triangulation import Camera, StereoSensor

COVERAGE_FACTOR = 2.0
"""k: about 95.45 % for a normal distribution."""


@dataclass(frozen=True)
class Source:
    """One line of a budget: the source's standard uncertainty, its unit, and the value's sensitivity to it."""

    name: str
    standard_uncertainty: float
    unit: str
    sensitivity: float

    @property
    def contribution(self) -> float:
        """Standard uncertainty of the value from this source."""
        return abs(self.sensitivity) * self.standard_uncertainty


def combined(sources: list[Source]) -> float:
    """Combined standard uncertainty of independent sources (JCGM 100, eq. 10)."""
    return float(np.sqrt(sum(source.contribution**2 for source in sources)))


def scale_uncertainty(
    sensor: StereoSensor, parameter_names: tuple[str, ...], covariance: np.ndarray, depth_mm: float
) -> tuple[float, float]:
    """Relative standard uncertainty of displacements that the sensor measures at depth_mm: in depth, and across.

    From the covariance of the calibration: two points one millimetre apart are projected with the estimated
    parameters and triangulated with each parameter moved by its standard uncertainty (central differences).
    """
    x0 = np.array([_get(sensor, name) for name in parameter_names])
    step = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    points = np.array([0.0, 0.0, depth_mm]) + np.array([[0.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    pixels = _project(sensor, points)
    rays = {side: _rays(sensor, side, pixels) for side in ("left", "right")}
    slopes = []
    for k, name in enumerate(parameter_names):
        lengths = []
        for sign in (1.0, -1.0):
            x = x0.copy()
            x[k] += sign * step[k]
            moved = _set(sensor, parameter_names, x)
            own = name.partition("_")[0]
            seen = rays | {own: _rays(moved, own, pixels)} if own in rays else rays
            p = _intersect(moved, seen["left"], seen["right"])
            lengths.append(np.linalg.norm(p[1:] - p[0], axis=1))
        slopes.append((lengths[0] - lengths[1]) / (2 * step[k]))
    gradient = np.array(slopes)  # (parameters, 2): in depth, across
    depth, across = np.sqrt(np.maximum(np.einsum("ia,ij,ja->a", gradient, covariance, gradient), 0.0))
    return float(depth), float(across)


def _get(sensor: StereoSensor, name: str) -> float:
    from wheelset_assets.metrology.rigid import vector_from_rotation

    side, _, key = name.partition("_")
    if side in ("left", "right") and key:
        camera = sensor.left if side == "left" else sensor.right
        entries = {"f": (0, 0), "fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
        if key in entries:
            return float(camera.matrix[entries[key]])
        return float(camera.distortion[("k1", "k2", "p1", "p2", "k3").index(key)])
    index = "xyz".index(name[1])
    return float(sensor.translation_mm[index] if name[0] == "t" else vector_from_rotation(sensor.rotation)[index])


def _set(sensor: StereoSensor, names: tuple[str, ...], values: np.ndarray) -> StereoSensor:
    from wheelset_assets.metrology.rigid import rotation_from_vector, vector_from_rotation

    matrices = {"left": sensor.left.matrix.copy(), "right": sensor.right.matrix.copy()}
    distortions = {"left": sensor.left.distortion.copy(), "right": sensor.right.distortion.copy()}
    rotation, translation = vector_from_rotation(sensor.rotation), sensor.translation_mm.copy()
    for name, value in zip(names, values, strict=True):
        side, _, key = name.partition("_")
        if side not in matrices:
            (translation if name[0] == "t" else rotation)["xyz".index(name[1])] = value
        elif key == "f":
            matrices[side][0, 0] = matrices[side][1, 1] = value
        elif key in ("fx", "fy", "cx", "cy"):
            matrices[side][{"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}[key]] = value
        else:
            distortions[side][("k1", "k2", "p1", "p2", "k3").index(key)] = value
    return StereoSensor(
        Camera(matrices["left"], distortions["left"]),
        Camera(matrices["right"], distortions["right"]),
        rotation_from_vector(rotation),
        translation,
    )


def _project(sensor: StereoSensor, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    from wheelset_assets.metrology.triangulation import distort

    right = points @ sensor.rotation.T + sensor.translation_mm
    left_px = distort(sensor.left, points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
    return (*left_px, *distort(sensor.right, right[:, 0] / right[:, 2], right[:, 1] / right[:, 2]))


def _rays(sensor: StereoSensor, side: str, pixels: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Directions (n, 3) of the pixels of one camera, in its own frame."""
    from wheelset_assets.metrology.triangulation import undistort

    camera, u, v = (sensor.left, *pixels[:2]) if side == "left" else (sensor.right, *pixels[2:])
    return np.column_stack([*undistort(camera, u, v), np.ones(len(u))])


def _intersect(sensor: StereoSensor, left: np.ndarray, right_in_right: np.ndarray) -> np.ndarray:
    """Midpoints (n, 3) of the shortest lines between the two rays of each pixel pair."""
    right = right_in_right @ sensor.rotation
    centre = sensor.right_centre_mm
    ll, rr, lr = (left * left).sum(1), (right * right).sum(1), (left * right).sum(1)
    lc, rc = left @ centre, right @ centre
    determinant = ll * rr - lr * lr
    a = (rr * lc - lr * rc) / determinant
    b = (lr * lc - ll * rc) / determinant
    return 0.5 * (left * a[:, None] + centre + right * b[:, None])
