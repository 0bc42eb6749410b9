"""Organised grids (frames, rows): NaN-aware medians and means, and the way between point lists and grids.

Only what several stages of the core need to treat a stripe scan as an image; no filter and no measurement lives here.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
FEW = 5
"""Up to so many values, medians are taken slice by slice."""
BLOCK_POINTS = 32_768
"""Points of a block: 256 kB in double precision."""


def nan_median(values: Array, axis: int) -> Array:
    """Median along an axis, ignoring NaN; NaN where nothing is left, without a warning. Faster than numpy's own."""
    if values.shape[axis] <= FEW:
        return _median_of_few(np.moveaxis(values, axis, 0))
    ordered = np.array(np.moveaxis(values, axis, -1), order="C")  # sorting along strides takes twice as long
    ordered.sort(axis=-1)  # NaN goes last
    count = np.isfinite(values).sum(axis=axis)
    low = np.maximum((count - 1) // 2, 0)[..., None]
    high = np.minimum(np.maximum(count // 2, 0), ordered.shape[-1] - 1)[..., None]
    middle = 0.5 * (np.take_along_axis(ordered, low, -1) + np.take_along_axis(ordered, high, -1))[..., 0]
    return np.where(count > 0, middle, np.nan)


def median_reordering(values: Array) -> float:
    """Median of values (n,) without NaN, n > 0, which are reordered on the way. Equal to numpy's to the last bit.

    numpy looks for both middle values, and for NaN, in one partition by several places: several times slower than one
    by a single place, of which the lower middle value is the largest before it.
    """
    middle = len(values) // 2
    values.partition(middle)
    if len(values) % 2:
        return float(values[middle])
    return float(0.5 * (values[:middle].max() + values[middle]))


def blocks(shape: tuple[int, ...], axis: int = 0) -> Iterator[slice]:
    """Slices along an axis of a grid (frames, rows) so short that a handful of temporaries stays in a core's cache."""
    length = max(1, BLOCK_POINTS // max(1, shape[1 - axis]))
    return (slice(k, min(k + length, shape[axis])) for k in range(0, shape[axis], length))


def _median_of_few(values: Array) -> Array:
    """The same over the first axis, of a handful of whole slices: an odd-even sorting network."""
    seen = np.isfinite(values)
    slices = [np.where(here, one, np.inf) for here, one in zip(seen, values, strict=True)]
    n = len(slices)
    for turn in range(n):
        for j in range(turn % 2, n - 1, 2):
            slices[j], slices[j + 1] = np.minimum(slices[j], slices[j + 1]), np.maximum(slices[j], slices[j + 1])
    count = seen.sum(axis=0)
    middle = np.full(values.shape[1:], np.nan)
    for k in range(1, n + 1):
        middle = np.where(count == k, 0.5 * (slices[(k - 1) // 2] + slices[k // 2]), middle)
    return middle


def nan_mean(values: Array, axis: int, weights: Array | None = None) -> tuple[Array, NDArray[np.int64]]:
    """Mean along an axis, ignoring NaN, and the number of values in it; NaN where nothing is left."""
    seen = np.isfinite(values)
    filled = np.where(seen, values, 0.0)
    count = seen.sum(axis=axis)
    with np.errstate(invalid="ignore", divide="ignore"):
        if weights is None:
            return filled.sum(axis=axis) / np.where(count > 0, count, np.nan), count
        w = np.where(seen, weights, 0.0)
        total = w.sum(axis=axis)
        return (filled * w).sum(axis=axis) / np.where(total > 0, total, np.nan), count


def robust_scatter(values: Array) -> float:
    """1.4826 times the median absolute deviation from the median of all finite values; NaN if there are none."""
    return scatter_overwriting(values[np.isfinite(values)])


def scatter_overwriting(finite: Array) -> float:
    """The same of finite values (n,), which are lost."""
    if finite.size == 0:
        return float("nan")
    finite -= median_reordering(finite)
    np.abs(finite, out=finite)
    return 1.4826 * median_reordering(finite)


def to_grid(
    frame_index: NDArray[np.int64], row_index: NDArray[np.int64], shape: tuple[int, int], *columns: NDArray[np.floating]
) -> list[Array]:
    """Grids (frames, rows), NaN where there is no point, from columns of points at (frame_index, row_index)."""
    at = frame_index * shape[1]
    at += row_index
    grids = []
    for column in columns:
        grid = np.full(shape[0] * shape[1], np.nan)
        grid[at] = column.astype(float, copy=False)  # conversion on the way would take longer
        grids.append(grid.reshape(shape))
    return grids
