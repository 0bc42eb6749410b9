"""Filters on the organised frame x row grid: range gate, outliers, isolated points, smoothing, thinning.

Paper 2.2.1 and eq. 14-17. All are NaN-aware: a point that is missing is never invented, and nothing is averaged across
a gap. What is removed keeps a reason; the caller stores it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import blocks, nan_median, robust_scatter
from wheelset_assets.metrology.window_median import median_smoothed, row_window_median
from wheelset_assets.metrology.windows import (
    Smoothed,
    bilateral,
    full_kernel,
    local_quadratic,
    noise_factor,
    paired_mean,
)

Array = NDArray[Any]
Mask = NDArray[np.bool_]

SHAPE_ROWS = 9
"""Rows in a row that are off alike are no outliers: single points are wrong by chance, one in some hundred."""


def range_gate(depth_mm: Array, margin_mm: float) -> Mask:
    """True for points (frames, rows) whose depth lies outside the 1st to 99th percentile by more than margin_mm."""
    seen = depth_mm[np.isfinite(depth_mm)]
    if seen.size == 0:
        return np.zeros(depth_mm.shape, bool)
    low, high = np.percentile(seen, [1.0, 99.0])
    with np.errstate(invalid="ignore"):
        return (depth_mm < low - margin_mm) | (depth_mm > high + margin_mm)


def outliers(depth_mm: Array, sigmas: float, window_rows: int) -> Mask:
    """Hampel test on the grid: True for points too far from what their frame and their row lead to expect.

    The expected depth is the median over the frames at that row (the turning wheel repeats its profile) plus the local
    offset of this frame against that template (run-out, lateral shift, flats: long compared with the window). With
    fewer than eight frames the expected depth is the median of the window along the row alone. The scale is robust,
    and local to blocks of rows, because noise grows on steep faces.
    """
    n_frames = len(depth_mm)
    if n_frames >= 8:
        residual = depth_mm - nan_median(depth_mm, axis=0)
    else:
        residual = depth_mm - row_window_median(depth_mm, window_rows)
    scale = _block_scatter(residual, block=64)
    if n_frames >= 8:
        # Where single-point errors are clipped, the running mean follows the offset of this frame.
        limit = 3 * scale
        for part in blocks(residual.shape):
            here = residual[part]
            centre = nan_median(here, axis=1)[:, None]
            clipped = here - centre
            np.clip(clipped, -limit, limit, out=clipped)
            clipped += centre
            here -= running_mean(clipped, window_rows)
        scale = _block_scatter(residual, block=64)
    limit = sigmas * np.maximum(scale, 1e-6)
    with np.errstate(invalid="ignore"):
        hit = np.abs(residual) > limit
    return _without_shapes(hit, residual, limit)


def _without_shapes(hit: Mask, residual: Array, limit: Array) -> Mask:
    """Outliers less those that stand together: a flat or a patch of dirt is a shape, which is judged by its frames.

    A run of at least SHAPE_ROWS hits is one where each lies within the limit of the run's median about it.
    """
    frames = np.flatnonzero(hit.sum(axis=1) >= SHAPE_ROWS)
    if frames.size:
        run = hit[frames] & ~isolated(hit[frames], SHAPE_ROWS)
        here = np.where(run, residual[frames], np.nan)
        with np.errstate(invalid="ignore"):
            hit[frames] &= ~(np.abs(here - row_window_median(here, SHAPE_ROWS)) <= limit)
    return hit


def _block_scatter(residual: Array, block: int) -> Array:
    """Robust scatter of each block of rows, (1, rows); blocks without points take the scatter of all."""
    starts = range(0, residual.shape[1], block)
    scatter = np.array([robust_scatter(residual[:, s : s + block]) for s in starts])
    usable = np.isfinite(scatter) & (scatter > 0)
    if not usable.all():
        scatter[~usable] = robust_scatter(residual[:: max(1, len(residual) // 64)])
    return np.repeat(scatter, block)[None, : residual.shape[1]]


def running_mean(values: Array, window: int) -> Array:
    """Mean over a window along the rows, over the points that are there; NaN where the window is empty."""
    seen = np.isfinite(values)
    half = window // 2
    whole = bool(seen.all())
    sums = _windowed(values if whole else np.where(seen, values, 0.0), half)
    counts = _windowed(seen.astype(np.int16), half)
    with np.errstate(invalid="ignore", divide="ignore"):
        return sums / counts  # 0 / 0: nothing in the window


def _windowed(values: Array, half: int) -> Array:
    """Sums over 2 half + 1 neighbours along the rows, fewer at the ends: sums of 1, 2, 4 ... neighbours, put together."""
    n_frames, n_rows = values.shape
    run = np.zeros((n_frames, n_rows + 2 * half), values.dtype)
    run[:, half : half + n_rows] = values
    wanted, total, start, length = 2 * half + 1, None, 0, 1
    while True:
        if wanted & length:
            part = run[:, start : start + n_rows]
            if total is None:
                total = part.copy()
            else:
                total += part
            start += length
        if 2 * length > wanted:
            assert total is not None
            return total
        run = run[:, :-length] + run[:, length:]
        length *= 2


def isolated(seen: Mask, min_run: int) -> Mask:
    """True for points that lie in a run of fewer than min_run consecutive rows of their frame."""
    if min_run <= 1:
        return np.zeros(seen.shape, bool)
    n_frames, n_rows = seen.shape
    padded = np.zeros((n_frames, n_rows + 2), np.int8)
    padded[:, 1:-1] = seen
    change = np.diff(padded, axis=1)
    frame, start = np.nonzero(change == 1)
    _, stop = np.nonzero(change == -1)
    short = stop - start < min_run
    marks = np.zeros((n_frames, n_rows + 1), np.int32)
    np.add.at(marks, (frame[short], start[short]), 1)
    np.add.at(marks, (frame[short], stop[short]), -1)
    return np.cumsum(marks, axis=1)[:, :n_rows] > 0


def smooth(
    depth_mm: Array,
    kind: str,
    *,
    window_rows: int,
    window_frames: int,
    sigma_rows: float,
    noise_correlation: float = 0.0,
    range_mm: float = 0.03,
    edge_mm: float = np.inf,
) -> Smoothed:
    """Smoothed depth over a window of the organised grid; `kind`: none, median, mean, gaussian, quadratic or bilateral.

    median: eq. 14. mean: eq. 15. gaussian: eq. 16-17 with the spacing of rows as unit and the sum of weights as c.
    quadratic: a parabola fitted with the Gaussian's weights, which keeps the height of a curved surface. bilateral
    (Tomasi and Manduchi 1998): the Gaussian, each pair faded by how far its mean lies from the point, range_mm being the
    standard deviation. These two work along the rows alone.

    A neighbour enters only together with its mirror image about the point, and only if every nearer pair is there too:
    so a slope is never biased at the end of a gap, and nothing is averaged across one. For mean, Gaussian and parabola a
    pair whose mean lies farther than edge_mm from the point ends the window as a gap does: an edge is not smeared, while
    a slope of any steepness has pairs that agree. noise_correlation is the correlation of the centres' noise between
    neighbouring rows (first-order autoregressive), for the noise factor.
    """
    if kind == "none" or (window_rows <= 1 and window_frames <= 1):
        return Smoothed(depth_mm, np.where(np.isfinite(depth_mm), 1.0, np.nan))
    if kind == "median":
        return median_smoothed(depth_mm, window_rows // 2, window_frames // 2, noise_correlation)
    if kind == "bilateral":
        return bilateral(depth_mm, window_rows // 2, sigma_rows, range_mm, noise_correlation)
    half = window_rows // 2
    offsets = np.arange(1, half + 1)
    weights = np.ones(half) if kind == "mean" else np.exp(-(offsets**2) / (2 * sigma_rows**2))
    if kind == "quadratic":
        return local_quadratic(depth_mm, weights, noise_correlation, edge_mm)
    factors = np.array([noise_factor(full_kernel(weights[:k]), noise_correlation) for k in range(half + 1)])
    value, factor = paired_mean(depth_mm, weights, factors, 1, edge_mm)
    if window_frames > 1:
        frame_weights = np.ones(window_frames // 2)
        roots = np.sqrt(2 * np.arange(len(frame_weights) + 1) + 1)
        value, root = paired_mean(value, frame_weights, roots, 0, edge_mm)
        factor /= root
    return Smoothed(value, factor)


def thin(seen: Mask, step: int) -> Mask:
    """True for the points that stay: rows divisible by step. Rows stay addressable in the image."""
    keep = np.zeros(seen.shape, bool)
    keep[:, ::step] = seen[:, ::step]
    return keep
