"""What a stripe scan tells of the two cameras' pose against each other: the vertical disparity of its stripes.

The match puts both rays of a point into one epipolar plane, so no single point has an epipolar residual. But a laser
plane makes the disparity an affine function of the left image (a plane induces a homography), and a right image that
lies offset along its columns adds the offset times the stripe's slope there: corners, flanks and fillets then stick out
of the plane one way, and slopes of the other sign the other way. The offset is the slope's coefficient.

Seen: a camera that turned about its rows or moved along its columns. Not seen here: a turn that moves the stripe along
its rows, or about the line of sight; these move or tilt the laser plane in the points (`laser_plane`). A stripe without
slopes says nothing: its uncertainty shows that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import nan_mean, robust_scatter
from wheelset_assets.metrology.triangulation import MatchedStripe

Array = NDArray[Any]

HALF_WINDOW_ROWS = 3
MIN_ROWS = 40
MAX_SLOPE = 3.0
LIMIT_SIGMAS = 4.0
ROUNDS = 5
MAX_FRAMES = 256


@dataclass(frozen=True)
class EpipolarResidual:
    """Vertical disparity between the two cameras, right less left in rectified images at focal length 1, and its standard
    uncertainty from the scatter of the n_rows row means about the laser plane, with their correlation along the rows."""

    offset: float
    u_offset: float
    n_rows: int


def epipolar_residual(matched: MatchedStripe, good: NDArray[np.bool_]) -> EpipolarResidual | None:
    """Mean vertical disparity over the stripes of a scan; good (frames, rows) names the points that count.

    Row means over at most MAX_FRAMES frames: their slopes are free of the noise that would bend a regression on slopes.
    None if fewer than MIN_ROWS rows are there, or if their slopes do not vary at all.
    """
    step = max(1, len(good) // MAX_FRAMES)
    (x_left, count), (x_right, _), (y, _) = (
        nan_mean(np.where(good[::step], values[::step], np.nan), axis=0)
        for values in (matched.x_left, matched.x_right, matched.y)
    )
    known = count >= max(1, 0.5 * count.max(initial=0))
    slope = _slopes(x_right, y, known)
    known &= np.isfinite(slope) & (np.abs(slope) < MAX_SLOPE)
    if known.sum() < MIN_ROWS:
        return None
    middle = float(y[known].mean())
    design = np.column_stack(
        [np.ones(known.sum()), y[known] - middle, x_left[known] - x_left[known].mean(), slope[known]]
    )
    disparity = (x_left - x_right)[known]
    kept = np.ones(len(disparity), bool)
    for _ in range(ROUNDS):
        if kept.sum() < MIN_ROWS or np.linalg.matrix_rank(design[kept]) < design.shape[1]:
            return None
        found, *_ = np.linalg.lstsq(design[kept], disparity[kept], rcond=None)
        residual = disparity - design @ found
        before, kept = kept, np.abs(residual) <= LIMIT_SIGMAS * max(robust_scatter(residual[kept]), 1e-12)
        if np.array_equal(before, kept):
            break
    residual = np.where(kept, residual, 0.0)
    variance = float((residual**2).sum()) / max(int(kept.sum()) - design.shape[1], 1)
    covariance = np.linalg.inv(design[kept].T @ design[kept]) * variance * _integral_length(residual, kept)
    return EpipolarResidual(float(found[3]), float(np.sqrt(covariance[3, 3])), int(kept.sum()))


def _slopes(x: Array, y: Array, known: NDArray[np.bool_]) -> Array:
    """Least-squares slope dx/dy over a window of rows, (rows,); NaN where a row of the window is missing."""
    half, n = HALF_WINDOW_ROWS, len(y)
    slope = np.full(n, np.nan)
    if n <= 2 * half:
        return slope
    rise, run, whole = np.zeros(n - 2 * half), np.zeros(n - 2 * half), known[half : n - half].copy()
    for k in range(1, half + 1):
        ahead, behind = slice(half + k, n - half + k), slice(half - k, n - half - k)
        across = y[ahead] - y[behind]
        rise += (x[ahead] - x[behind]) * across
        run += across**2
        whole &= known[ahead] & known[behind]
    with np.errstate(invalid="ignore", divide="ignore"):
        slope[half : n - half] = np.where(whole, rise / run, np.nan)
    return slope


def _integral_length(residual: Array, kept: NDArray[np.bool_]) -> float:
    """Integral correlation length of the residuals along the rows: 1 for white noise; zeros are gaps."""
    variance = float((residual**2).sum()) / max(int(kept.sum()), 1)
    length = 1.0
    for lag in range(1, len(residual) // 4):
        pairs = int((kept[lag:] & kept[:-lag]).sum())
        if pairs < MIN_ROWS or variance == 0.0:
            break
        correlation = float(residual[lag:] @ residual[:-lag]) / pairs / variance
        if correlation < 0.05:
            break
        length += 2 * correlation
    return length
