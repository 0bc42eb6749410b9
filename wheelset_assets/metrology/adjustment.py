"""Joint least-squares adjustment of two cameras, the pose between them and all board poses, with full covariance.

Whole arrays over poses and corners, exact derivatives, board poses eliminated (Schur complement). Corners are (n, 2)
in px with NaN where a camera did not see one, so that partly hidden boards enter as far as they are seen. Which lens
model is taken and which poses are used is decided in `calibration`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.rigid import rotation_from_vector, skew, vector_from_rotation
from wheelset_assets.metrology.triangulation import Camera, StereoSensor

Array = NDArray[Any]

LENS_MODELS: dict[str, tuple[bool, tuple[int, ...]]] = {
    f"{'square pixels, ' if square else ''}{' '.join(('k1', 'k2', 'p1', 'p2', 'k3')[i] for i in terms)}": (
        square,
        terms,
    )
    for square in (True, False)
    for terms in ((0,), (0, 1), (0, 2, 3), (0, 1, 2, 3), (0, 1, 4), (0, 1, 2, 3, 4))
}
"""Candidates: whether fx = fy, and which of Brown's terms are free."""
DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3")
MAX_ITERATIONS = 60


@dataclass(frozen=True)
class BoardPose:
    """One pose of the board: corners (n, 2) in px, NaN where hidden; None with the reason where no board was found."""

    name: str
    left_px: Array | None
    right_px: Array | None
    reason: str | None = None


@dataclass(frozen=True)
class Adjustment:
    """Result of the joint adjustment of one lens model over some poses."""

    model: str
    sensor: StereoSensor
    parameter_names: tuple[str, ...]
    covariance: Array
    boards: Array
    """Board poses in the left camera, (poses, 6): rotation vector, then translation in mm."""
    residuals_px: Array
    """(poses, 2 cameras, corners, 2), NaN where a corner was not seen."""
    information_criterion: float
    """Akaike's, with the correction for small samples."""


@dataclass(frozen=True)
class Start:
    """Values from which an adjustment starts; boards as in Adjustment."""

    left: Camera
    right: Camera
    rotation: Array
    translation_mm: Array
    boards: Array


class _Layout:
    """Where each shared parameter stands: left camera, right camera, pose between them."""

    def __init__(self, model: str) -> None:
        self.square, self.terms = LENS_MODELS[model]
        self.n_focal = 1 if self.square else 2
        self.n_camera = self.n_focal + 2 + len(self.terms)
        self.n_shared = 2 * self.n_camera + 6

    def names(self) -> tuple[str, ...]:
        focal = ("f",) if self.square else ("fx", "fy")
        camera = (*focal, "cx", "cy", *(DISTORTION_NAMES[i] for i in self.terms))
        pose = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
        return tuple(f"left_{name}" for name in camera) + tuple(f"right_{name}" for name in camera) + pose

    def simplified(self, camera: Camera) -> Camera:
        """The camera with what this model does not hold set to zero, or to one focal length."""
        m, distortion = camera.matrix.copy(), np.zeros(5)
        if self.square:
            m[0, 0] = m[1, 1] = 0.5 * (m[0, 0] + m[1, 1])
        m[0, 1] = 0.0
        distortion[list(self.terms)] = camera.distortion[list(self.terms)]
        return Camera(m, distortion)

    def moved(self, camera: Camera, step: Array) -> Camera:
        m, distortion = camera.matrix.copy(), camera.distortion.copy()
        m[0, 0] += step[0]
        m[1, 1] += step[self.n_focal - 1]
        m[0, 2] += step[self.n_focal]
        m[1, 2] += step[self.n_focal + 1]
        distortion[list(self.terms)] += step[self.n_focal + 2 :]
        return Camera(m, distortion)


@dataclass(frozen=True)
class _State:
    left: Camera
    right: Camera
    rotation: Array
    translation: Array
    board_rotations: Array
    board_translations: Array

    def moved(self, layout: _Layout, shared: Array, boards: Array) -> _State:
        c = layout.n_camera
        return _State(
            layout.moved(self.left, shared[:c]),
            layout.moved(self.right, shared[c : 2 * c]),
            rotation_from_vector(shared[2 * c : 2 * c + 3]) @ self.rotation,
            self.translation + shared[2 * c + 3 :],
            rotations_from_vectors(boards[:, :3]) @ self.board_rotations,
            self.board_translations + boards[:, 3:],
        )


@dataclass(frozen=True)
class _Normal:
    """Residuals (poses, 2, corners, 2; zero where unseen), their sum of squares, and the blocks of the normal matrix."""

    residuals: Array
    cost: float
    shared: Array
    mixed: Array
    boards: Array
    shared_moment: Array
    board_moments: Array


def rotations_from_vectors(vectors: Array) -> Array:
    """Rotation matrices (n, 3, 3) from rotation vectors (n, 3) in radians, all at once."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()


def adjust(poses: list[BoardPose], board_mm: Array, model: str, start: Start) -> Adjustment:
    """Least-squares adjustment of all parameters of both cameras together (Levenberg-Marquardt, exact derivatives).

    board_mm (n, 3). The covariance is s^2 (J'J)^-1 over the shared parameters, the boards' poses marginalised; its
    rotation is that of the rotation vector.
    """
    layout = _Layout(model)
    observed = np.stack([np.stack([np.asarray(p.left_px), np.asarray(p.right_px)]) for p in poses]).astype(float)
    seen = np.isfinite(observed).all(axis=3)
    state = _State(
        layout.simplified(start.left),
        layout.simplified(start.right),
        start.rotation,
        np.asarray(start.translation_mm, float),
        rotations_from_vectors(start.boards[:, :3]),
        start.boards[:, 3:].copy(),
    )
    normal, damping = _linearise(layout, state, board_mm, observed, seen), 1e-6
    for _ in range(MAX_ITERATIONS):
        shared, boards = _step(normal, damping)
        trial_state = state.moved(layout, shared, boards)
        trial = _linearise(layout, trial_state, board_mm, observed, seen)
        if trial.cost < normal.cost:
            done = normal.cost - trial.cost < 1e-10 * normal.cost
            state, normal, damping = trial_state, trial, damping / 10
            if done:
                break
        elif damping > 1e6 or np.linalg.norm(shared[-6:]) < 1e-13:
            break
        else:
            damping = max(damping * 10, 1e-9)
    n, k = 2 * int(seen.sum()), layout.n_shared + 6 * len(poses)
    vectors = np.array([vector_from_rotation(r) for r in state.board_rotations])
    return Adjustment(
        model,
        StereoSensor(state.left, state.right, state.rotation, state.translation),
        layout.names(),
        _covariance(normal, layout, state.rotation, normal.cost / max(n - k, 1)),
        np.hstack([vectors, state.board_translations]),
        np.where(seen[..., None], normal.residuals, np.nan),
        float(n * np.log(max(normal.cost, 1e-30) / n) + 2 * k + 2 * k * (k + 1) / max(n - k - 1, 1)),
    )


def _step(normal: _Normal, damping: float) -> tuple[Array, Array]:
    """Damped Gauss-Newton step of the shared parameters (k,) and of the boards (poses, 6)."""
    boards = normal.boards.copy()
    index = np.arange(6)
    boards[:, index, index] *= 1 + damping
    weighted = np.linalg.solve(boards, np.swapaxes(normal.mixed, 1, 2))  # C^-1 B'
    reduced = normal.shared - (normal.mixed @ weighted).sum(axis=0)
    reduced += damping * np.diag(np.diag(normal.shared))
    moment = normal.shared_moment - np.einsum("pik,pi->k", weighted, normal.board_moments)
    scale = np.sqrt(np.maximum(np.diag(normal.shared), 1e-300))
    shared = -_solve(reduced / np.outer(scale, scale), moment / scale) / scale
    right = normal.board_moments + np.einsum("pki,k->pi", normal.mixed, shared)
    return shared, -np.linalg.solve(boards, right[..., None])[..., 0]


def _solve(matrix: Array, vector: Array) -> Array:
    try:
        return np.linalg.solve(matrix, vector)
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(matrix, vector, rcond=None)[0]


def _covariance(normal: _Normal, layout: _Layout, rotation: Array, variance: float) -> Array:
    weighted = np.linalg.solve(normal.boards, np.swapaxes(normal.mixed, 1, 2))
    reduced = normal.shared - (normal.mixed @ weighted).sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    inverse = np.linalg.pinv(reduced / np.outer(scale, scale), rcond=1e-13, hermitian=True) / np.outer(scale, scale)
    to_vector = np.eye(layout.n_shared)
    at = slice(2 * layout.n_camera, 2 * layout.n_camera + 3)
    to_vector[at, at] = _vector_from_turn(vector_from_rotation(rotation))
    covariance = variance * to_vector @ inverse @ to_vector.T
    return 0.5 * (covariance + covariance.T)


def _vector_from_turn(vector: Array) -> Array:
    """Derivative (3, 3) of a rotation vector by a small turn applied after it (inverse left Jacobian of SO(3))."""
    angle = float(np.linalg.norm(vector))
    k = skew(vector)
    if angle < 1e-6:
        return np.eye(3) - 0.5 * k + k @ k / 12
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.eye(3) - 0.5 * k + factor * k @ k


def _linearise(layout: _Layout, state: _State, board_mm: Array, observed: Array, seen: Array) -> _Normal:
    c, k = layout.n_camera, layout.n_shared
    turned = np.einsum("pij,nj->pni", state.board_rotations, board_mm)
    left = turned + state.board_translations[:, None]
    turned_left = left @ state.rotation.T
    right = turned_left + state.translation
    residuals = np.empty_like(observed)
    shared = np.zeros((*observed.shape, k))
    boards = np.empty((*observed.shape, 6))
    turn = _cross(turned)
    for side, (camera, points) in enumerate(((state.left, left), (state.right, right))):
        pixels, by_camera, by_point = project(camera, points)
        residuals[:, side] = pixels - observed[:, side]
        focal = by_camera[..., :2]
        if layout.square:
            focal = focal.sum(axis=-1, keepdims=True)
        terms = by_camera[..., [4 + i for i in layout.terms]]
        shared[:, side, ..., side * c : (side + 1) * c] = np.concatenate([focal, by_camera[..., 2:4], terms], axis=-1)
        if side == 1:
            shared[:, 1, ..., 2 * c : 2 * c + 3] = -by_point @ _cross(turned_left)
            shared[:, 1, ..., 2 * c + 3 :] = by_point
            by_point = by_point @ state.rotation
        boards[:, side, ..., :3] = -by_point @ turn
        boards[:, side, ..., 3:] = by_point
    mask = seen[..., None].astype(float)
    residuals = np.where(seen[..., None], residuals, 0.0)
    n = len(observed)
    a, b = (j * mask[..., None] for j in (shared, boards))
    a, b, r = a.reshape(n, -1, k), b.reshape(n, -1, 6), residuals.reshape(n, -1)
    transposed = np.swapaxes(b, 1, 2)
    flat = a.reshape(-1, k)
    return _Normal(
        residuals,
        float((residuals**2).sum()),
        flat.T @ flat,
        np.swapaxes(transposed @ a, 1, 2),
        transposed @ b,
        flat.T @ r.ravel(),
        (transposed @ r[..., None])[..., 0],
    )


def _cross(vectors: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    matrix = np.zeros((*vectors.shape, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -z, y, -x
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = z, -y, x
    return matrix


def project(camera: Camera, points: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of points (..., 3) in the camera's frame, with derivatives by fx, fy, cx, cy, k1, k2, p1, p2, k3
    (..., 2, 9) and by the point (..., 2, 3). Brown 1971."""
    k1, k2, p1, p2, k3 = camera.distortion
    fx, fy, cx, cy = camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2], camera.matrix[1, 2]
    depth = points[..., 2]
    x, y = points[..., 0] / depth, points[..., 1] / depth
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    xd = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx)
    yd = y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy
    pixels = np.stack([fx * xd + cx, fy * yd + cy], axis=-1)
    by_camera = np.zeros((*x.shape, 2, 9))
    by_camera[..., 0, 0], by_camera[..., 1, 1] = xd, yd
    by_camera[..., 0, 2] = by_camera[..., 1, 3] = 1.0
    for column, power in ((4, r2), (5, r2 * r2), (8, r2 * r2 * r2)):
        by_camera[..., 0, column], by_camera[..., 1, column] = fx * x * power, fy * y * power
    by_camera[..., 0, 6], by_camera[..., 1, 6] = fx * 2 * xy, fy * (r2 + 2 * yy)
    by_camera[..., 0, 7], by_camera[..., 1, 7] = fx * (r2 + 2 * xx), fy * 2 * xy
    dxx = fx * (radial + slope * xx + 2 * p1 * y + 6 * p2 * x)
    dyy = fy * (radial + slope * yy + 6 * p1 * y + 2 * p2 * x)
    mixed = slope * xy + 2 * p1 * x + 2 * p2 * y
    by_point = np.empty((*x.shape, 2, 3))
    by_point[..., 0, 0], by_point[..., 0, 1] = dxx / depth, fx * mixed / depth
    by_point[..., 1, 0], by_point[..., 1, 1] = fy * mixed / depth, dyy / depth
    by_point[..., 0, 2] = -(dxx * x + fx * mixed * y) / depth
    by_point[..., 1, 2] = -(fy * mixed * x + dyy * y) / depth
    return pixels, by_camera, by_point


def fit_boards(poses: list[BoardPose], board_mm: Array, sensor: StereoSensor, starts: Array) -> tuple[Array, Array]:
    """Each board's own pose alone, the sensor held fast: poses (n, 6) and residuals (n, 2, corners, 2), NaN unseen."""
    layout = _Layout("k1 k2 p1 p2 k3")
    observed = np.stack([np.stack([np.asarray(p.left_px), np.asarray(p.right_px)]) for p in poses]).astype(float)
    seen = np.isfinite(observed).all(axis=3)
    nothing = np.zeros(layout.n_shared)
    state = _State(
        sensor.left,
        sensor.right,
        sensor.rotation,
        sensor.translation_mm,
        rotations_from_vectors(starts[:, :3]),
        starts[:, 3:].copy(),
    )
    normal = _linearise(layout, state, board_mm, observed, seen)
    for _ in range(20):  # quadratic near the start, which is a fit with a little other camera
        step = -np.linalg.solve(normal.boards + 1e-12 * np.eye(6), normal.board_moments[..., None])[..., 0]
        state = state.moved(layout, nothing, step)
        before, normal = normal.cost, _linearise(layout, state, board_mm, observed, seen)
        if abs(before - normal.cost) <= 1e-12 * before:
            break
    vectors = np.array([vector_from_rotation(r) for r in state.board_rotations])
    return np.hstack([vectors, state.board_translations]), np.where(seen[..., None], normal.residuals, np.nan)
