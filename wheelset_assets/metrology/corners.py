"""Sub-pixel chessboard corners: each is fitted by the picture that two blurred edges make where they cross.

Detection of the board lives in `boards`; this starts from corners that are right to a pixel or two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

WINDOW_SHARE = 0.45
"""Half window as a share of the distance to the next corner, so that no other corner comes into it."""
WINDOW_PX = (3, 14)
MAX_MOVE_PX = 1.5
FULL_SCALE = 254.0
ITERATIONS = 7


@dataclass(frozen=True)
class RefinedCorners:
    """Corners (n, 2) in px, NaN where not given, and what their pictures say.

    blur_px: standard deviation of the edges' blur; sign: +1 where the square between the two grid directions is dark,
    -1 where it is bright; saturated_ratio: share of pixels of the window at full scale. Each (n,), NaN where no picture
    was fitted.
    """

    px: Array
    blur_px: Array
    sign: Array
    saturated_ratio: Array


def refine_corners(
    image: NDArray[np.uint8], corners: Array, inner_corners: tuple[int, int], window_share: float = WINDOW_SHARE
) -> RefinedCorners:
    """Corners (n, 2) in px, columns running fastest, refined on an 8-bit image; NaN stays NaN.

    First where the grey gradients meet (OpenCV), then by least squares on the grey levels themselves: the first alone
    errs by 0.03 px even without noise, and OpenCV's sector-based detector is biased by hundredths of a pixel, by tenths
    where squares are small. A corner whose fit leaves its start, or whose window leaves the image, keeps the first.
    """
    import cv2

    grid = np.asarray(corners, float).reshape(inner_corners[1], inner_corners[0], 2)
    half = np.clip(np.nan_to_num(window_share * _nearest(grid).ravel()), *WINDOW_PX).astype(int)
    angles = [np.arctan2(v[..., 1], v[..., 0]).ravel() for v in (_along(grid, 1), _along(grid, 0))]
    refined = grid.reshape(-1, 2).copy()
    blur, sign, saturated = np.full((3, len(refined)), np.nan)
    seen = np.isfinite(refined).all(axis=1) & np.isfinite(angles).all(axis=0)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    grey = image.astype(float)
    for size in np.unique(half[seen]):
        member = np.flatnonzero((half == size) & seen)
        window = (max(int(0.75 * size), 2),) * 2
        start = refined[member].reshape(-1, 1, 2).astype(np.float32)
        refined[member] = cv2.cornerSubPix(image, start, window, (-1, -1), stop).reshape(-1, 2)
        centre = np.rint(refined[member]).astype(int)
        inside = ((centre >= size) & (centre < np.array(image.shape[::-1]) - size)).all(axis=1)
        member, centre = member[inside], centre[inside]
        if len(member):
            start = np.column_stack([refined[member] - centre, *(a[member] for a in angles), np.ones(len(member))])
            fitted, amplitude, saturated[member] = _fit(grey, centre, int(size), start)
            px = centre + fitted[:, :2]
            near = np.linalg.norm(px - refined[member], axis=1) <= MAX_MOVE_PX
            refined[member[near]] = px[near]
            turn = np.sin(fitted[:, 3] - fitted[:, 2])
            blur[member], sign[member] = fitted[:, 4], np.sign(amplitude * turn)
    return RefinedCorners(refined, blur, sign, saturated)


def _along(grid: Array, axis: int) -> Array:
    """Vector (rows, columns, 2) from each corner towards the next along an axis, from whichever neighbours are seen."""
    step = np.diff(grid, axis=axis)
    edge = np.full_like(np.take(grid, [0], axis=axis), np.nan)
    both = np.stack([np.concatenate([edge, step], axis=axis), np.concatenate([step, edge], axis=axis)])
    known = np.isfinite(both)
    count = known.sum(axis=0)
    return np.where(count > 0, np.where(known, both, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def _nearest(grid: Array) -> Array:
    """Distance (rows, columns) of each corner from the nearest of its neighbours in the grid."""
    nearest = np.full(grid.shape[:2], np.inf)
    along, down = (np.linalg.norm(np.diff(grid, axis=axis), axis=2) for axis in (1, 0))
    for part, distance in ((np.s_[:, 1:], along), (np.s_[:, :-1], along), (np.s_[1:], down), (np.s_[:-1], down)):
        nearest[part] = np.fmin(nearest[part], distance)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _fit(image: Array, centre: NDArray[np.int64], half: int, parameters: Array) -> tuple[Array, Array, Array]:
    """Least-squares x, y, two edge angles and blur (n, 5) about integer centres (n, 2): Levenberg-Marquardt at once;
    amplitude (n,) of the crossing, and share (n,) of its pixels at full scale.

    Grey level = c0 + c1 x + c2 y + c3 erf(d1 / sqrt(2) blur) erf(d2 / sqrt(2) blur), d1 and d2 the distances from the
    two edges; the four coefficients are solved for at every step.
    """
    x, y = (offset.ravel().astype(float) for offset in np.meshgrid(*[np.arange(-half, half + 1)] * 2))
    disc = np.hypot(x, y) <= half + 0.5
    x, y = x[disc], y[disc]
    grey = image[centre[:, 1:] + y.astype(int), centre[:, :1] + x.astype(int)]
    damping, diagonal = np.full(len(centre), 1e-3), np.arange(9)
    slopes, basis, grey_scale, residual = _linearise(parameters, x, y, half, grey)
    cost = (residual**2).sum(axis=1)
    for _ in range(ITERATIONS):
        jacobian = np.concatenate([slopes * grey_scale[:, None, None], basis], axis=2)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        normal[:, diagonal, diagonal] *= 1 + damping[:, None]
        normal[:, diagonal, diagonal] += 1e-9
        step = np.linalg.solve(normal, np.swapaxes(jacobian, 1, 2) @ residual[..., None])[:, :5, 0]
        moved = parameters + step
        moved[:, 4] = np.clip(moved[:, 4], 0.3, max(4.0, 0.5 * half))
        trial = _linearise(moved, x, y, half, grey)
        trial_cost = (trial[3] ** 2).sum(axis=1)
        better = trial_cost < cost
        damping = np.where(better, damping / 5, damping * 8)
        state = (parameters, cost, slopes, basis, grey_scale, residual)
        for kept, new in zip(state, (moved, trial_cost, *trial), strict=True):
            kept[better] = new[better]
    return parameters, grey_scale, (grey >= FULL_SCALE).mean(axis=1)


def _linearise(parameters: Array, x: Array, y: Array, half: int, grey: Array) -> tuple[Array, Array, Array, Array]:
    """Derivatives of the crossing's shape (n, px, 5), linear basis (n, px, 4), amplitude (n,), residuals (n, px)."""
    from scipy.special import erf

    dx, dy = x - parameters[:, :1], y - parameters[:, 1:2]
    width = parameters[:, 4:5] * np.sqrt(2.0)
    across, along, normals = [], [], []
    for angle in (parameters[:, 2:3], parameters[:, 3:4]):
        c, s = np.cos(angle), np.sin(angle)
        across.append(c * dy - s * dx)
        along.append(c * dx + s * dy)
        normals.append((-s, c))
    edge = [erf(d / width) for d in across]
    slope = [2 / np.sqrt(np.pi) * np.exp(-((d / width) ** 2)) / width for d in across]
    first, second = slope[0] * edge[1], slope[1] * edge[0]
    shape = edge[0] * edge[1]
    slopes = np.stack(
        [
            -first * normals[0][0] - second * normals[1][0],
            -first * normals[0][1] - second * normals[1][1],
            -first * along[0],
            -second * along[1],
            -(first * across[0] + second * across[1]) / parameters[:, 4:5],
        ],
        axis=2,
    )
    flat = np.broadcast_to(np.stack([np.ones_like(x), x / half, y / half], axis=1), (*shape.shape, 3))
    basis = np.concatenate([flat, shape[..., None]], axis=2)
    transposed = np.swapaxes(basis, 1, 2)
    coefficients = np.linalg.solve(transposed @ basis + 1e-9 * np.eye(4), transposed @ grey[..., None])
    return slopes, basis, coefficients[:, 3, 0].copy(), grey - (basis @ coefficients)[..., 0]
