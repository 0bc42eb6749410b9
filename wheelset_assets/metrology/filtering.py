"""Filters on the organised frame x row grid: range gate, outliers, isolated points, smoothing, thinning.

Paper 2.2.1 and eq. 14-17. All are NaN-aware: a point that is missing is never invented, and nothing is averaged across
a gap. What is removed keeps a reason; the caller stores it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import blocks, nan_median, robust_scatter, scatter_overwriting

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
    np.abs(residual, out=residual)
    with np.errstate(invalid="ignore"):
        return residual > limit


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
    factors = np.array([_noise_factor(_full_kernel(weights[:k]), noise_correlation) for k in range(half + 1)])
    value, factor = _paired_mean(depth_mm, weights, factors, 1, edge_mm)
    if window_frames > 1:
        frame_weights = np.ones(window_frames // 2)
        roots = np.sqrt(2 * np.arange(len(frame_weights) + 1) + 1)
        value, root = _paired_mean(value, frame_weights, roots, 0, edge_mm)
        factor /= root
    return Smoothed(value, factor)


def _full_kernel(weights: Array) -> Array:
    kernel = np.concatenate([weights[::-1], [1.0], weights])
    return kernel / kernel.sum()


def _noise_factor(kernel: Array, correlation: float) -> float:
    lags = np.abs(np.subtract.outer(np.arange(len(kernel)), np.arange(len(kernel))))
    return float(np.sqrt(kernel @ (correlation**lags) @ kernel))


def _paired_mean(values: Array, weights: Array, factors: Array, axis: int, edge: float) -> tuple[Array, Array]:
    """Weighted mean of each point and its mirrored pairs of neighbours along an axis, and the factor (k,) for the number
    of pairs that entered before a gap or an edge; both NaN where the point is missing."""
    mean, factor = np.empty(values.shape), np.empty(values.shape)
    totals = np.cumsum(np.concatenate([[1.0], 2 * weights]))
    for part in blocks(values.shape, 1 - axis):
        at = (part, slice(None)) if axis else (slice(None), part)
        mean[at], factor[at] = _paired_mean_of_block(values[at], weights, totals, factors, axis, edge)
    return mean, factor


def _paired_mean_of_block(
    values: Array, weights: Array, totals: Array, factors: Array, axis: int, edge: float
) -> tuple[Array, Array]:
    n = values.shape[axis]
    total, connected = values.copy(), np.isfinite(values)
    seen, support = connected, np.zeros(values.shape, np.int8)
    for k, w in enumerate(weights, start=1):
        if 2 * k >= n:
            break
        middle, before, after = _along(axis, k, n - k), _along(axis, 0, n - 2 * k), _along(axis, 2 * k, n)
        pair = values[after] + values[before]
        away = 0.5 * pair
        away -= values[middle]
        np.abs(away, out=away)
        with np.errstate(invalid="ignore"):
            joined = away <= edge  # false where one is missing
        joined &= connected[middle]
        pair *= w
        np.copyto(pair, 0.0, where=~joined)
        total[middle] += pair
        support[middle] += joined
        connected = np.zeros(values.shape, bool)
        connected[middle] = joined
    total /= totals.take(support)
    factor = factors.take(support)
    np.copyto(factor, np.nan, where=~seen)
    return total, factor


def _along(axis: int, start: int, stop: int) -> tuple[slice, slice]:
    """Index of a grid that takes a part of one axis and all of the other."""
    return (slice(start, stop), slice(None)) if axis == 0 else (slice(None), slice(start, stop))


def _bilateral(values: Array, half: int, sigma_rows: float, range_mm: float, correlation: float) -> Smoothed:
    """Pairs about each point, weighted by distance and by the agreement of their mean with the point.

    A slope has pairs that agree, whatever its steepness; an edge or a curve has not. The noise factor takes the weights
    as given: they depend a little on the noise itself.
    """
    # Covariance of the weighted values, by how far they lie from the point: both sides of both.
    order = np.arange(half + 1)
    joint = 2 * (correlation ** np.abs(np.subtract.outer(order, order)) + correlation ** np.add.outer(order, order))
    joint[0] = 2 * correlation**order
    joint[:, 0], joint[0, 0] = joint[0], 1.0
    mean, factor = np.empty(values.shape), np.empty(values.shape)
    for part in blocks(values.shape):
        mean[part], factor[part] = _bilateral_block(values[part], sigma_rows, range_mm, joint)
    return Smoothed(mean, factor)


def _bilateral_block(values: Array, sigma_rows: float, range_mm: float, joint: Array) -> tuple[Array, Array]:
    n, half = values.shape[1], len(joint) - 1
    total, weight = values.copy(), np.ones(values.shape)
    variance = np.ones(values.shape)
    connected = np.isfinite(values)
    kept: list[Array] = []
    for k in range(1, half + 1):
        w, pair = np.zeros(values.shape), np.zeros(values.shape)
        joined = np.zeros(values.shape, bool)
        if 2 * k < n:
            middle = slice(k, n - k)
            near = values[:, 2 * k :] + values[:, : n - 2 * k]
            near *= 0.5
            joined[:, middle] = connected[:, middle] & np.isfinite(near)
            away = near - values[:, middle]
            away /= range_mm
            np.square(away, out=away)
            away *= -0.5
            away -= 0.5 * (k / sigma_rows) ** 2
            np.exp(away, out=away)
            gone = ~joined[:, middle]
            np.copyto(away, 0.0, where=gone)
            np.copyto(near, 0.0, where=gone)
            w[:, middle], pair[:, middle] = away, near
        connected = joined
        pair *= w
        pair *= 2.0
        total += pair
        weight += 2 * w
        variance += (2 * joint[0, k]) * w
        for i, other in enumerate(kept, start=1):
            if joint[i, k]:
                variance += (2 * joint[i, k]) * (w * other)
        variance += joint[k, k] * (w * w)
        kept.append(w)
    total /= weight
    np.sqrt(variance, out=variance)
    variance /= weight
    np.copyto(variance, np.nan, where=np.isnan(total))
    return total, variance


def _median_smoothed(values: Array, half_rows: int, half_frames: int, correlation: float) -> Smoothed:
    """Median over the window, of the neighbours that are joined to the point, and whose mirror images are, by a path
    along its column and then along their row. The noise factor follows from how many there are.

    On a slope steeper than the noise the median of a row's window is the point itself, and lowers nothing: a neighbour
    counts as far as the slope leaves it within the noise.
    """
    noise = max(_row_noise(values), 1e-12)
    along = [1.0] + [_noise_factor(np.full(n, 1.0 / n), correlation) for n in range(1, 2 * half_rows + 2)]
    claim = _MedianClaim(half_rows, noise, np.array(along))
    if half_frames == 0 and 2 * half_rows + 1 in EXCHANGES:
        median, factor = np.empty(values.shape), np.empty(values.shape)
        for part in blocks(values.shape):
            median[part], factor[part] = _row_median(values[part], half_rows, claim)
        return Smoothed(median, factor)
    joined: dict[tuple[int, int], Mask] = {(0, 0): np.isfinite(values)}
    for df in sorted(range(-half_frames, half_frames + 1), key=abs):
        if df:
            joined[df, 0] = joined[df - np.sign(df), 0] & np.isfinite(_shift(values, -df, 0))
        for dr in sorted((k for k in range(-half_rows, half_rows + 1) if k), key=abs):
            joined[df, dr] = joined[df, dr - np.sign(dr)] & np.isfinite(_shift(values, -df, -dr))
    pairs = {offset: here & joined[-offset[0], -offset[1]] for offset, here in joined.items()}
    stack = np.stack([np.where(pair, _shift(values, -df, -dr), np.nan) for (df, dr), pair in pairs.items()])
    fading = claim.fading(_row_slope(values, half_rows))
    count, in_row = np.zeros(values.shape), np.zeros(values.shape)
    for (df, dr), pair in pairs.items():
        counts = pair * fading[abs(dr)]
        count += counts
        in_row += counts if df == 0 else 0.0
    factor = np.where(joined[0, 0], claim.factor(count, in_row), np.nan)
    return Smoothed(nan_median(stack, axis=0), factor)


def _needed(exchanges: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int, bool, bool], ...]:
    """Exchanges of places (i, j), and whether the smaller value, for i, and the larger, for j, are of any use later."""
    used, made = {max(max(pair) for pair in exchanges) // 2}, []
    for i, j in reversed(exchanges):
        made.append((i, j, i in used, j in used))
        used |= {i, j}
    return tuple(reversed(made))


EXCHANGES = {
    3: _needed(((0, 1), (1, 2), (0, 1))),
    5: _needed(((0, 1), (3, 4), (0, 3), (1, 4), (1, 2), (2, 3), (1, 2))),
    7: _needed(
        ((0, 5), (0, 3), (1, 6), (2, 4), (0, 1), (3, 5), (2, 6), (2, 3), (3, 6), (4, 5), (1, 4), (1, 3), (3, 4))
    ),
    9: _needed((
        (1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3),
        (5, 8), (4, 7), (3, 6), (1, 4), (2, 5), (4, 7), (4, 2), (6, 4), (4, 2),
    )),
}  # fmt: skip
"""Exchanges (smaller value, larger value) after which the middle one of so many values is their median (Devillard 1998)."""


def _row_median(values: Array, half: int, claim: _MedianClaim) -> tuple[Array, Array]:
    """Median over the largest window along the row, up to 2 half + 1, that has no gap; and its noise factor.

    Nearly all windows are whole: all are taken for that, and those that are not are done again one by one.
    """
    padded = np.full((len(values), values.shape[1] + 2 * half), np.nan)
    padded[:, half : half + values.shape[1]] = values
    window = [padded[:, i : i + values.shape[1]] for i in range(2 * half + 1)]
    median = _median_of(window)
    rise, runs = np.zeros(values.shape), np.cumsum(2.0 * np.arange(half + 1) ** 2)
    for k in range(1, half + 1):
        ahead = window[half + k] - window[half - k]
        ahead *= k
        rise += ahead
    rise /= max(runs[-1], 1.0)
    count = np.zeros(values.shape)
    for fade in claim.fading(rise)[1:]:
        count += fade
    count *= 2.0
    count += 1.0
    factor = claim.factor(count, count)
    broken = np.flatnonzero(np.isnan(median) & np.isfinite(values))
    if broken.size:
        at = broken + np.int64(2 * half) * (broken // values.shape[1])
        gathered = [padded.take(at + i) for i in range(2 * half + 1)]
        median.flat[broken], factor.flat[broken] = _broken_median(gathered, claim)
    np.copyto(factor, np.nan, where=np.isnan(median))
    return median, factor


def _broken_median(window: list[Array], claim: _MedianClaim) -> tuple[Array, Array]:
    """The same of points (n,) whose window may have gaps: values 2 half + 1 places, NaN in the gaps."""
    half = len(window) // 2
    median, rise, runs = window[half].copy(), np.zeros(window[0].shape), np.cumsum(2.0 * np.arange(half + 1) ** 2)
    support = np.zeros(median.shape, np.int64)
    for k in range(1, half + 1):
        found = _median_of(window[half - k : half + k + 1])
        joined = np.isfinite(found)  # one that is missing makes all of it missing
        median[joined] = found[joined]
        rise[joined] += k * (window[half + k] - window[half - k])[joined]
        support += joined
    rise /= np.maximum(runs, 1.0)[support]
    count = np.ones(median.shape)
    for k, fade in enumerate(claim.fading(rise)[1:], start=1):
        count += 2.0 * fade * (support >= k)
    return median, claim.factor(count, count)


def _median_of(values: list[Array]) -> Array:
    """Median, element by element, of an odd number of arrays; NaN where one of them is."""
    slots, own = list(values), [False] * len(values)
    for i, j, smaller, larger in EXCHANGES[len(values)]:
        low = np.minimum(slots[i], slots[j]) if smaller else None
        if larger:
            slots[j], own[j] = np.maximum(slots[i], slots[j], out=slots[j] if own[j] else None), True
        if low is not None:
            slots[i], own[i] = low, True
    return slots[len(values) // 2]


@dataclass(frozen=True)
class _MedianClaim:
    """Noise factor of a median from what its window holds and how steep it is."""

    half_rows: int
    noise: float
    along: Array
    """Noise factor of the mean of 0, 1 ... 2 half_rows + 1 neighbouring values of a row."""

    def fading(self, rise: Array) -> list[Array]:
        """How much a neighbour 0, 1 ... half_rows away counts on a slope (mm a row); `rise` is overwritten."""
        lags = np.arange(1, self.half_rows + 1)
        # A slope that noise alone would show, up to two standard deviations, is none.
        rise /= self.noise
        np.square(rise, out=rise)
        rise -= 4.0 / max(2.0 * float((lags**2).sum()), 1.0)
        np.maximum(rise, 0.0, out=rise)
        rise *= -0.125
        odd = np.exp(rise, out=rise)  # to the power of 2 lag - 1
        made, square = [np.ones((1,) * rise.ndim), odd], odd * odd
        for _ in lags[1:]:
            odd = odd * square
            made.append(made[-1] * odd)
        return made

    def factor(self, count: Array, in_row: Array) -> Array:
        """Noise factor for `count` neighbours that count, `in_row` of which lie in the point's own row; NaN for NaN."""
        # Variance of the median of n independent normal values: 1 for n = 1, pi / 2n for many, 2 % off between.
        with np.errstate(invalid="ignore", divide="ignore"):
            independent = self._along(in_row)
            np.square(independent, out=independent)
            np.divide(1.0 if count is in_row else count / in_row, independent, out=independent)
            independent += np.pi / 2 - 1
            np.divide(np.pi / 2, independent, out=independent)
            np.sqrt(independent, out=independent)
            return np.minimum(independent, 1.0, out=independent)

    def _along(self, n: Array) -> Array:
        """`along` between its whole numbers: as np.interp, in half the time."""
        slope = np.diff(self.along, append=self.along[-1:])
        start = self.along - slope * np.arange(len(slope))
        whole = n.astype(np.int64)
        made = slope.take(whole, mode="clip")
        made *= n
        made += start.take(whole, mode="clip")
        return made


def _row_noise(values: Array) -> float:
    """Robust standard deviation of a point against the mean of its neighbours in the row; 0 where there are none."""
    apart, n = np.empty(max(0, values.shape[1] - 2) * len(values)), 0
    for part in blocks(values.shape):
        here = values[part, 2:] + values[part, :-2]
        here *= -0.5
        here += values[part, 1:-1]
        seen = here[np.isfinite(here)]
        apart[n : n + len(seen)] = seen
        n += len(seen)
    found = scatter_overwriting(apart[:n]) / np.sqrt(1.5)
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
