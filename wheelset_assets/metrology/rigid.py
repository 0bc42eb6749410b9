"""Rigid transforms, written `b_from_a`: 4 x 4 homogeneous matrices in millimetres, and rotation vectors in radians.

The only module of the metrology core that the simulator may share. No estimation lives here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]


def rotation_from_vector(rotation_rad: ArrayLike) -> Array:
    """Rotation matrix (3, 3) from a rotation vector (3,) in radians (Rodrigues' formula)."""
    v = np.asarray(rotation_rad, float)
    angle = float(np.linalg.norm(v))
    k = skew(v)
    if angle < 1e-8:  # second order is exact to double precision here
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * (k @ k)


def vector_from_rotation(rotation: ArrayLike) -> Array:
    """Rotation vector (3,) in radians from a rotation matrix (3, 3); its length is at most pi."""
    w, x, y, z = quaternion_from_rotation(rotation)
    v = np.array([x, y, z])
    sine = float(np.linalg.norm(v))
    if sine < 1e-12:
        return 2.0 * v
    return v / sine * 2.0 * np.arctan2(sine, w)


def skew(v: ArrayLike) -> Array:
    """Matrix (3, 3) of the cross product: skew(v) @ w == cross(v, w)."""
    x, y, z = np.asarray(v, float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def transform(rotation: ArrayLike, translation_mm: ArrayLike) -> Array:
    """Homogeneous matrix (4, 4) from a rotation (3, 3) and a translation (3,) in mm."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = rotation
    b_from_a[:3, 3] = translation_mm
    return b_from_a


def inverse(b_from_a: ArrayLike) -> Array:
    """a_from_b (4, 4) of a rigid b_from_a (4, 4), by transposition of its rotation."""
    m = np.asarray(b_from_a, float)
    return transform(m[:3, :3].T, -m[:3, :3].T @ m[:3, 3])


def apply(b_from_a: ArrayLike, points_in_a_mm: ArrayLike) -> Array:
    """Points (..., 3) in frame b from points (..., 3) in frame a."""
    m = np.asarray(b_from_a, float)
    return np.asarray(points_in_a_mm, float) @ m[:3, :3].T + m[:3, 3]


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Unit quaternion (w, x, y, z), w >= 0, from a rotation matrix (3, 3); stable at every angle (Bar-Itzhack 2000)."""
    r = np.asarray(rotation, float)
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    _, vectors = np.linalg.eigh(k / 3.0)  # eigh reads the lower triangle
    x, y, z, w = vectors[:, -1]
    q = np.array([w, x, y, z])
    return -q if w < 0 else q


def rotation_from_quaternion(wxyz: ArrayLike) -> Array:
    """Rotation matrix (3, 3) from a quaternion (w, x, y, z) of any non-zero length."""
    w, x, y, z = np.asarray(wxyz, float) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
