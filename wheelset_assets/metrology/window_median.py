"""Window medians on the organised grid, paper eq. 14: neighbours that no gap parts from the point, and their noise.

No weighted windows (windows) and no choice among filters (filtering.smooth).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import blocks, nan_median, scatter_overwriting
from wheelset_assets.metrology.windows import Smoothed, noise_factor

Array = NDArray[Any]
Mask = NDArray[np.bool_]

FADING = 0.4
STEEPEST, SLOPE_STEPS = 8, 1024
"""On a slope of as many noises a row a neighbour counts no more; steps of the table below, a noise a row."""


def median_smoothed(values: Array, half_rows: int, half_frames: int, correlation: float) -> Smoothed:
    """Median over the window, of the neighbours that are joined to the point, and whose mirror images are, by a path
    along its column and then along their row. The noise factor follows from how many there are.

    On a slope steeper than the noise the median of a row's window is the point itself, and lowers nothing: a neighbour
    counts as far as the slope leaves it within the noise.
    """
    noise = max(_row_noise(values), 1e-12)
    along = [1.0] + [noise_factor(np.full(n, 1.0 / n), correlation) for n in range(1, 2 * half_rows + 2)]
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
    rise = window[half + 1] - window[half - 1]
    for k in range(2, half + 1):
        ahead = window[half + k] - window[half - k]
        ahead *= k
        rise += ahead
    factor = claim.whole_factor(rise)
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
    count = np.ones(median.shape)
    for k, fade in enumerate(claim.fading(rise, np.maximum(runs, 1.0)[support])[1:], start=1):
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

    def fading(self, rise: Array, run: Array | float = 1.0) -> list[Array]:
        """How much a neighbour 0, 1 ... half_rows away counts on a slope rise / run (mm a row); `rise` is overwritten."""
        lags = np.arange(1, self.half_rows + 1)
        # What noise alone shows as a slope is none; FADING is fitted to what medians of lines in noise really leave.
        rise /= run * self.noise
        np.square(rise, out=rise)
        rise -= 2.0 / max(2.0 * float((lags**2).sum()), 1.0)
        np.maximum(rise, 0.0, out=rise)
        rise *= -FADING
        first = np.exp(rise, out=rise)
        made, square, odd = [np.ones((1,) * rise.ndim), first], first * first, first
        for _ in lags[1:]:
            odd = odd * square  # first to the power of 2 lag - 1
            made.append(made[-1] * odd)
        return made

    def whole_factor(self, rise: Array) -> Array:
        """Noise factor of windows along the row without a gap, from 2 sum(k^2) times their slope; `rise` is overwritten.

        There it is a function of the slope alone, which is tabulated: as `fading` and `factor`, in a third of the time.
        """
        start, slope = self._table
        rise *= SLOPE_STEPS / (self.noise * 2.0 * float((np.arange(self.half_rows + 1) ** 2).sum()))
        np.abs(rise, out=rise)
        np.minimum(rise, STEEPEST * SLOPE_STEPS, out=rise)  # a whole number of 32 bits holds no more than 2e9
        with np.errstate(invalid="ignore"):  # gaps, which the caller sees to
            whole = rise.astype(np.int32)
        rise *= slope.take(whole, mode="clip")
        rise += start.take(whole, mode="clip")
        return rise

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Noise factor between SLOPE_STEPS whole numbers a noise and row as start + slope x."""
        steep = np.arange(STEEPEST * SLOPE_STEPS + 1) / SLOPE_STEPS
        count = 2.0 * sum(self.fading(steep * self.noise)[1:], np.zeros(len(steep))) + 1.0
        made = self.factor(count, count)
        slope = np.append(np.diff(made), 0.0)
        return made - slope * np.arange(len(made)), slope

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


def row_window_median(values: Array, window: int) -> Array:
    stack = np.stack([_shift(values, 0, k) for k in range(-(window // 2), window // 2 + 1)])
    return nan_median(stack, axis=0)
