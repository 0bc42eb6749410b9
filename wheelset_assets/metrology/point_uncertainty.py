"""What the calibration's uncertainty does to points: its covariance propagated to a grid over the working volume.

All points of a scan share this part: it does not average away. The noise part is `triangulation.point_covariance`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.adjustment import DISTORTION_NAMES
from wheelset_assets.metrology.rigid import rotation_from_vector, vector_from_rotation
from wheelset_assets.metrology.triangulation import Camera, StereoSensor, distort, intersect_rays, undistort

Array = NDArray[Any]


def displacement_modes(
    sensor: StereoSensor, parameter_names: tuple[str, ...], covariance: Array, points_mm: Array
) -> Array:
    """Fields (modes, n, 3) in mm by which the calibration's error moves points (n, 3) of the sensor frame.

    Independent of each other, each at one standard uncertainty: their outer products add up to the displacements'
    covariance. First order: the points' pixels are held fast and triangulated with every parameter moved by its
    standard uncertainty to either side.
    """
    pixels = _pixels(sensor, points_mm)
    still = _rays(sensor, pixels)
    u = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    slopes = np.zeros((len(parameter_names), *points_mm.shape))
    for k, name in enumerate(parameter_names):
        if u[k] > 0:
            ends = [_points(moved(sensor, {name: sign * u[k]}), pixels, sensor, still) for sign in (1.0, -1.0)]
            slopes[k] = (ends[0] - ends[1]) / (2 * u[k])
    values, vectors = np.linalg.eigh(covariance)
    return np.einsum("pm,pnk->mnk", vectors * np.sqrt(np.maximum(values, 0.0)), slopes)


def calibration_covariance(
    sensor: StereoSensor, parameter_names: tuple[str, ...], covariance: Array, points_mm: Array
) -> Array:
    """Covariance (n, 3, 3) in mm^2 of points (n, 3) in the sensor frame, from that of the calibration's parameters."""
    modes = displacement_modes(sensor, parameter_names, covariance, points_mm)
    return np.einsum("mni,mnj->nij", modes, modes)


def scale_uncertainty(
    sensor: StereoSensor, parameter_names: tuple[str, ...], covariance: Array, depth_mm: float
) -> tuple[float, float]:
    """Relative standard uncertainty of displacements that the sensor measures at depth_mm: in depth, and across.

    From the covariance of the calibration, between points one millimetre apart.
    """
    points = np.array([0.0, 0.0, depth_mm]) + np.array([[0.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    modes = displacement_modes(sensor, parameter_names, covariance, points)
    depth, across = modes[:, 1, 2] - modes[:, 0, 2], modes[:, 2, 1] - modes[:, 0, 1]
    return float(np.linalg.norm(depth)), float(np.linalg.norm(across))


def working_grid(
    sensor: StereoSensor, image_size: tuple[int, int], depth_range_mm: tuple[float, float], shape: tuple[int, int, int]
) -> Array:
    """Points (n, 3) in mm over the left image (columns, rows) and the depths that boards covered, seen by both cameras
    or not."""
    columns, rows, depths = shape
    u = np.linspace(0, image_size[0] - 1, columns)
    v = np.linspace(0, image_size[1] - 1, rows)
    uu, vv = (g.ravel() for g in np.meshgrid(u, v))
    x, y = undistort(sensor.left, uu, vv)
    z = np.linspace(*depth_range_mm, depths)
    return np.concatenate([np.column_stack([x * d, y * d, np.full_like(x, d)]) for d in z])


def moved(sensor: StereoSensor, steps: dict[str, float]) -> StereoSensor:
    """The sensor with parameters, by the names of an adjustment, moved by steps (px, 1, rad, mm)."""
    cameras = {"left": sensor.left, "right": sensor.right}
    turn, translation = np.zeros(3), sensor.translation_mm.copy()
    entries = {"f": ((0, 0), (1, 1)), "fx": ((0, 0),), "fy": ((1, 1),), "cx": ((0, 2),), "cy": ((1, 2),)}
    for name, step in steps.items():
        side, _, key = name.partition("_")
        if side not in cameras:
            (translation if name[0] == "t" else turn)["xyz".index(name[1])] += step
            continue
        matrix, lens = cameras[side].matrix.copy(), cameras[side].distortion.copy()
        if key in entries:
            for place in entries[key]:
                matrix[place] += step
        else:
            lens[DISTORTION_NAMES.index(key)] += step
        cameras[side] = Camera(matrix, lens)
    rotation = rotation_from_vector(vector_from_rotation(sensor.rotation) + turn) if turn.any() else sensor.rotation
    return StereoSensor(cameras["left"], cameras["right"], rotation, translation)


def _pixels(sensor: StereoSensor, points: Array) -> list[Array]:
    right = points @ sensor.rotation.T + sensor.translation_mm
    return [
        value
        for camera, p in ((sensor.left, points), (sensor.right, right))
        for value in distort(camera, p[:, 0] / p[:, 2], p[:, 1] / p[:, 2])
    ]


def _rays(sensor: StereoSensor, pixels: list[Array]) -> list[tuple[Array, Array]]:
    return [undistort(sensor.left, *pixels[:2]), undistort(sensor.right, *pixels[2:])]


def _points(sensor: StereoSensor, pixels: list[Array], base: StereoSensor, rays: list[tuple[Array, Array]]) -> Array:
    """Points of the pixels; a camera that is the base's has its rays."""
    left = rays[0] if sensor.left is base.left else undistort(sensor.left, *pixels[:2])
    right = rays[1] if sensor.right is base.right else undistort(sensor.right, *pixels[2:])
    return intersect_rays(sensor, *left, *right)
