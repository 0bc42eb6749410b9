"""Filters on the organised frame x row grid: range gate, outliers, isolated points, smoothing, thinning.

Paper 2.2.1 and eq. 14-17. All are NaN-aware: a point that is missing is never invented, and nothing is averaged across
a gap. What is removed keeps a reason; the caller stores it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import nan_median, robust_scatter

Array = NDArray[Any]
Mask = NDArray[np.bool_]


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
        residual = depth_mm - _row_window(depth_mm, window_rows)
    scale = _block_scatter(residual, block=64)
    if n_frames >= 8:
        # Where single-point errors are clipped, the running mean follows the offset of this frame.
        centre = nan_median(residual, axis=1)[:, None]
        clipped = np.clip(residual - centre, -3 * scale, 3 * scale) + centre
        residual = residual - running_mean(clipped, window_rows)
        scale = _block_scatter(residual, block=64)
    with np.errstate(invalid="ignore"):
        return np.abs(residual) > sigmas * np.maximum(scale, 1e-6)


def _block_scatter(residual: Array, block: int) -> Array:
    """Robust scatter of each block of rows, (1, rows); blocks without points take the scatter of all."""
    overall = robust_scatter(residual[:: max(1, len(residual) // 64)])
    starts = range(0, residual.shape[1], block)
    scatter = np.array([robust_scatter(residual[:, s : s + block]) for s in starts])
    scatter = np.where(np.isfinite(scatter) & (scatter > 0), scatter, overall)
    return np.repeat(scatter, block)[None, : residual.shape[1]]


def running_mean(values: Array, window: int) -> Array:
    """Mean over a window along the rows, over the points that are there; NaN where the window is empty. O(n)."""
    seen = np.isfinite(values)
    half = window // 2
    sums = _windowed(np.where(seen, values, 0.0), half)
    counts = _windowed(seen.astype(float), half)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(counts > 0.5, sums / counts, np.nan)


def _windowed(values: Array, half: int) -> Array:
    padded = np.pad(np.cumsum(values, axis=1), ((0, 0), (half + 1, half)), mode="edge")
    padded[:, : half + 1] = 0.0
    return padded[:, 2 * half + 1 :] - padded[:, : -2 * half - 1]


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


@dataclass(frozen=True)
class Smoothed:
    """Smoothed depth (frames, rows), and the factor (frames, rows) by which the noise's standard deviation changed."""

    depth_mm: Array
    noise_factor: Array


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
    """Smoothed depth over a window of the organised grid; `kind` is none, median, mean, gaussian or bilateral.

    median: eq. 14. mean: eq. 15. gaussian: eq. 16-17 with the spacing of rows as unit and the sum of weights as c.
    bilateral (Tomasi and Manduchi 1998): the Gaussian, each pair faded by how far its mean lies from the point, range_mm
    being the standard deviation: along the rows alone, so that an edge keeps its place. A
    neighbour enters only together with its mirror image about the point, and only if every nearer pair is there too:
    so a slope is never biased at the end of a gap, and nothing is averaged across one. For the mean and the Gaussian a
    pair whose mean lies farther than edge_mm from the point ends the window as a gap does: an edge is not smeared, while
    a slope of any steepness has pairs that agree. noise_correlation is the
    correlation of the centres' noise between neighbouring rows (first-order autoregressive), for the noise factor.
    """
    if kind == "none" or (window_rows <= 1 and window_frames <= 1):
        return Smoothed(depth_mm, np.where(np.isfinite(depth_mm), 1.0, np.nan))
    if kind == "median":
        return _median_smoothed(depth_mm, window_rows // 2, window_frames // 2, noise_correlation)
    if kind == "bilateral":
        return _bilateral(depth_mm, window_rows // 2, sigma_rows, range_mm, noise_correlation)
    half = window_rows // 2
    offsets = np.arange(1, half + 1)
    weights = np.ones(half) if kind == "mean" else np.exp(-(offsets**2) / (2 * sigma_rows**2))
    value, support = _paired_sum(depth_mm, weights, 1, edge_mm)
    factors = np.array([_noise_factor(_full_kernel(weights[:k]), noise_correlation) for k in range(half + 1)])
    factor = factors[support]
    if window_frames > 1:
        frame_weights = np.ones(window_frames // 2)
        value, frame_support = _paired_sum(value, frame_weights, 0, edge_mm)
        factor = factor / np.sqrt(2 * frame_support + 1)
    return Smoothed(value, np.where(np.isfinite(value), factor, np.nan))


def _full_kernel(weights: Array) -> Array:
    kernel = np.concatenate([weights[::-1], [1.0], weights])
    return kernel / kernel.sum()


def _noise_factor(kernel: Array, correlation: float) -> float:
    lags = np.abs(np.subtract.outer(np.arange(len(kernel)), np.arange(len(kernel))))
    return float(np.sqrt(kernel @ (correlation**lags) @ kernel))


def _paired_sum(values: Array, weights: Array, axis: int, edge: float) -> tuple[Array, NDArray[np.intp]]:
    """Weighted mean of each point and its mirrored pairs of neighbours; also how many pairs entered before an edge."""
    v = np.moveaxis(values, axis, -1)
    total, weight = v.copy(), np.ones(v.shape)
    connected = np.isfinite(v)
    support = np.zeros(v.shape, np.intp)
    for k, w in enumerate(weights, start=1):
        pair = np.full(v.shape, np.nan)
        pair[..., k:-k] = v[..., 2 * k :] + v[..., : -2 * k]
        with np.errstate(invalid="ignore"):
            connected = connected & (np.abs(0.5 * pair - v) <= edge)  # false where one is missing
        total += np.where(connected, w * pair, 0.0)
        weight += np.where(connected, 2 * w, 0.0)
        support += connected
    return np.moveaxis(total / weight, -1, axis), np.moveaxis(support, -1, axis)


def _bilateral(values: Array, half: int, sigma_rows: float, range_mm: float, correlation: float) -> Smoothed:
    """Pairs about each point, weighted by distance and by the agreement of their mean with the point.

    A slope has pairs that agree, whatever its steepness; an edge or a curve has not. The noise factor takes the weights
    as given: they depend a little on the noise itself.
    """
    total, weight, connected = values.copy(), np.ones(values.shape), np.isfinite(values)
    kept = [np.ones(values.shape)]
    for k in range(1, half + 1):
        pair = np.full(values.shape, np.nan)
        pair[:, k:-k] = 0.5 * (values[:, 2 * k :] + values[:, : -2 * k])
        connected = connected & np.isfinite(pair)
        away = np.where(connected, pair - values, 0.0)
        w = np.where(connected, np.exp(-0.5 * (k / sigma_rows) ** 2 - 0.5 * (away / range_mm) ** 2), 0.0)
        total += 2 * w * np.where(connected, pair, 0.0)
        weight += 2 * w
        kept.append(w)
    offsets = np.arange(-half, half + 1)
    variance = np.zeros(values.shape)
    for a in offsets:
        for b in offsets:
            variance += kept[abs(a)] * kept[abs(b)] * correlation ** abs(a - b)
    smoothed = total / weight
    return Smoothed(smoothed, np.where(np.isfinite(smoothed), np.sqrt(variance) / weight, np.nan))


def _median_smoothed(values: Array, half_rows: int, half_frames: int, correlation: float) -> Smoothed:
    """Median over the window, of the neighbours that are joined to the point, and whose mirror images are, by a path
    along its column and then along their row. The noise factor follows from how many there are.

    On a slope steeper than the noise the median of a row's window is the point itself, and lowers nothing: a neighbour
    counts as far as the slope leaves it within the noise.
    """
    joined: dict[tuple[int, int], Mask] = {(0, 0): np.isfinite(values)}
    for df in sorted(range(-half_frames, half_frames + 1), key=abs):
        if df:
            joined[df, 0] = joined[df - np.sign(df), 0] & np.isfinite(_shift(values, -df, 0))
        for dr in sorted((k for k in range(-half_rows, half_rows + 1) if k), key=abs):
            joined[df, dr] = joined[df, dr - np.sign(dr)] & np.isfinite(_shift(values, -df, -dr))
    pairs = {offset: here & joined[-offset[0], -offset[1]] for offset, here in joined.items()}
    stack = np.stack([np.where(pair, _shift(values, -df, -dr), np.nan) for (df, dr), pair in pairs.items()])
    rise = _row_slope(values, half_rows) / max(_row_noise(values), 1e-12)
    lags = np.arange(1, half_rows + 1)
    # A slope that noise alone would show, up to two standard deviations, is none.
    rise = np.sqrt(np.maximum(rise**2 - 4.0 / max(2.0 * float((lags**2).sum()), 1.0), 0.0))
    count, in_row = np.zeros(values.shape), np.zeros(values.shape)
    for (df, dr), pair in pairs.items():
        counts = pair * np.exp(-0.5 * (dr * rise / 2) ** 2)
        count += counts
        in_row += counts if df == 0 else 0.0
    along = np.array([1.0] + [_noise_factor(np.full(n, 1.0 / n), correlation) for n in range(1, 2 * half_rows + 2)])
    # Variance of the median of n independent normal values: 1 for n = 1, pi / 2n for many, 2 % off between.
    with np.errstate(invalid="ignore", divide="ignore"):
        independent = count / in_row / np.interp(in_row, np.arange(len(along)), along) ** 2
        factor = np.sqrt(np.pi / 2 / (independent + np.pi / 2 - 1))
    return Smoothed(nan_median(stack, axis=0), np.where(joined[0, 0], np.minimum(factor, 1.0), np.nan))


def _row_noise(values: Array) -> float:
    """Robust standard deviation of a point against the mean of its neighbours in the row; 0 where there are none."""
    found = robust_scatter(values[:, 1:-1] - 0.5 * (values[:, 2:] + values[:, :-2])) / np.sqrt(1.5)
    return float(found) if np.isfinite(found) else 0.0


def _row_slope(values: Array, half: int) -> Array:
    """Least-squares slope along the row, per row, from the neighbours that are there with their mirror images; else 0."""
    rise, run, connected = np.zeros(values.shape), np.zeros(values.shape), np.isfinite(values)
    for k in range(1, half + 1):
        ahead = np.full(values.shape, np.nan)
        ahead[:, k:-k] = values[:, 2 * k :] - values[:, : -2 * k]
        connected = connected & np.isfinite(ahead)
        rise += np.where(connected, k * ahead, 0.0)
        run += np.where(connected, 2.0 * k * k, 0.0)
    return rise / np.maximum(run, 1.0)


def _shift(values: Array, frames: int, rows: int) -> Array:
    out = np.full(values.shape, np.nan)
    n, m = values.shape
    if abs(frames) < n and abs(rows) < m:
        out[max(frames, 0) : n + min(frames, 0), max(rows, 0) : m + min(rows, 0)] = values[
            max(-frames, 0) : n + min(-frames, 0), max(-rows, 0) : m + min(-rows, 0)
        ]
    return out


def _row_window(values: Array, window: int) -> Array:
    stack = np.stack([_shift(values, 0, k) for k in range(-(window // 2), window // 2 + 1)])
    return nan_median(stack, axis=0)


def thin(seen: Mask, step: int) -> Mask:
    """True for the points that stay: rows divisible by step. Rows stay addressable in the image."""
    keep = np.zeros(seen.shape, bool)
    keep[:, ::step] = seen[:, ::step]
    return keep
