"""Weighted windows on the organised grid, paper eq. 15-17: pairs of neighbours about a point, and what noise they leave.

No window medians (window_median) and no choice among filters (filtering.smooth).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import blocks

Array = NDArray[Any]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Smoothed:
    """Smoothed depth (frames, rows), and the factor (frames, rows) by which the noise's standard deviation changed."""

    depth_mm: Array
    noise_factor: Array


def full_kernel(weights: Array) -> Array:
    kernel = np.concatenate([weights[::-1], [1.0], weights])
    return kernel / kernel.sum()


def noise_factor(kernel: Array, correlation: float) -> float:
    lags = np.abs(np.subtract.outer(np.arange(len(kernel)), np.arange(len(kernel))))
    return float(np.sqrt(kernel @ (correlation**lags) @ kernel))


def paired_mean(values: Array, weights: Array, factors: Array, axis: int, edge: float) -> tuple[Array, Array]:
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
    total, seen, support = values.copy(), np.isfinite(values), np.zeros(values.shape, np.int8)
    for k, middle, pair, joined in _pairs(values, len(weights), axis, edge):
        pair *= weights[k - 1]
        total[middle] += pair
        support[middle] += joined
    total /= totals.take(support)
    factor = factors.take(support)
    np.copyto(factor, np.nan, where=~seen)
    return total, factor


def _pairs(values: Array, half: int, axis: int, edge: float) -> Iterator[tuple[int, tuple[slice, slice], Array, Mask]]:
    """For k = 1, 2, ...: the places that have neighbours k before and after, the sums of both, and where they count.

    They count where all nearer ones do and their mean lies within `edge` of the point; elsewhere their sum is zero.
    """
    n = values.shape[axis]
    connected = np.isfinite(values)
    for k in range(1, half + 1):
        if 2 * k >= n:
            return
        middle, before, after = _along(axis, k, n - k), _along(axis, 0, n - 2 * k), _along(axis, 2 * k, n)
        pair = values[after] + values[before]
        away = 0.5 * pair
        away -= values[middle]
        np.abs(away, out=away)
        with np.errstate(invalid="ignore"):
            joined = away <= edge  # false where one is missing
        joined &= connected[middle]
        np.copyto(pair, 0.0, where=~joined)
        yield k, middle, pair, joined
        connected = np.zeros(values.shape, bool)
        connected[middle] = joined


def local_quadratic(values: Array, weights: Array, correlation: float, edge: float) -> Smoothed:
    """Value at each point of the parabola through it and its mirrored pairs of neighbours along the rows, weighted.

    Savitzky and Golay 1964, with weights (half,) for the pairs. A parabola keeps its height, so a curved surface is not
    drawn inwards as by a mean; as both sides of the point enter alike, cubic terms drop out too. With fewer than two
    pairs before a gap or an edge there is nothing to fit: the point stays as it is.
    """
    half = len(weights)
    kernels = np.stack([_quadratic_kernel(weights, k) for k in range(half + 1)])
    factors = np.array([noise_factor(np.concatenate([c[:0:-1], c]), correlation) for c in kernels])
    value, factor = np.empty(values.shape), np.empty(values.shape)
    for part in blocks(values.shape):
        here = values[part]
        support = np.zeros(here.shape, np.int8)
        sums = []
        for _, middle, pair, joined in _pairs(here, half, 1, edge):
            support[middle] += joined
            sums.append((middle, pair))
        total = here * kernels[:, 0].take(support)
        for k, (middle, pair) in enumerate(sums, start=1):
            pair *= kernels[:, k].take(support[middle])
            total[middle] += pair
        value[part] = total
        some = factors.take(support)
        np.copyto(some, np.nan, where=np.isnan(here))
        factor[part] = some
    return Smoothed(value, factor)


def _quadratic_kernel(weights: Array, pairs: int) -> Array:
    """Coefficients (half + 1,) of the point and of each pair's members when `pairs` pairs are there."""
    kernel = np.zeros(len(weights) + 1)
    kernel[0] = 1.0
    if pairs < 2:
        return kernel
    place = np.arange(pairs + 1)
    w = np.concatenate([[1.0], weights[:pairs]])
    both = np.where(place > 0, 2.0, 1.0) * w
    zeroth, second, fourth = (float((both * place**power).sum()) for power in (0, 2, 4))
    kernel[: pairs + 1] = w * (fourth - second * place**2) / (zeroth * fourth - second**2)
    return kernel


def _along(axis: int, start: int, stop: int) -> tuple[slice, slice]:
    """Index of a grid that takes a part of one axis and all of the other."""
    return (slice(start, stop), slice(None)) if axis == 0 else (slice(None), slice(start, stop))


SAMPLED = 16
"""Of so many frames one tells how much of the noise the weights themselves bring in."""


def bilateral(values: Array, half: int, sigma_rows: float, range_mm: float, correlation: float) -> Smoothed:
    """Pairs about each point, weighted by distance and by the agreement of their mean with the point.

    A slope has pairs that agree, whatever its steepness; an edge or a curve has not. The noise factor is that of the
    weights as given, times one for the whole grid: how much more the derivatives of the smoothed value by all that enter
    it let through, as the weights depend on the noise as well. On average that is no less than the noise left (Gaussian
    Poincare inequality), and close to it up to a noise of range_mm; no point claims more than its own noise.
    """
    # Covariance of the weighted values, by how far they lie from the point: both sides of both.
    order = np.arange(half + 1)
    joint = 2 * (correlation ** np.abs(np.subtract.outer(order, order)) + correlation ** np.add.outer(order, order))
    joint[0] = 2 * correlation**order
    joint[:, 0], joint[0, 0] = joint[0], 1.0
    mean, factor = np.empty(values.shape), np.empty(values.shape)
    for part in blocks(values.shape):
        mean[part], factor[part] = _bilateral_block(values[part], sigma_rows, range_mm, joint)
    factor *= _leaning(values[::SAMPLED], mean[::SAMPLED], factor[::SAMPLED], sigma_rows, range_mm, joint)
    np.minimum(factor, 1.0, out=factor)  # a point that stood alone is what it was
    return Smoothed(mean, factor)


def _bilateral_block(values: Array, sigma_rows: float, range_mm: float, joint: Array) -> tuple[Array, Array]:
    total, weight = values.copy(), np.ones(values.shape)
    variance = np.ones(values.shape)
    kept: list[Array] = []
    for k, (pair, w) in enumerate(_faded_pairs(values, len(joint) - 1, sigma_rows, range_mm), start=1):
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


def _faded_pairs(values: Array, half: int, sigma_rows: float, range_mm: float) -> Iterator[tuple[Array, Array]]:
    """For k = 1, 2, ... half: the means (frames, rows) of the neighbours k before and after, and their weights.

    Both are zero where the pair or a nearer one is not whole.
    """
    n = values.shape[1]
    connected = np.isfinite(values)
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
        yield pair, w


def _leaning(values: Array, mean: Array, factor: Array, sigma_rows: float, range_mm: float, joint: Array) -> float:
    """By how much the noise let through exceeds that of the weights as given, over all points of some frames."""
    known = np.isfinite(mean)
    if not known.any():
        return 1.0
    whole = np.ones(values.shape)  # sum of all weights
    given = [np.ones(values.shape)]
    for pair, w in _faded_pairs(values, len(joint) - 1, sigma_rows, range_mm):
        whole += 2 * w
        bent = w * (pair - mean) * (pair - values) / range_mm**2
        given[0] += 2 * bent
        given.append(w - bent)
    stack = np.stack([g[known] for g in given])
    variance = np.einsum("in,ij,jn->n", stack, joint, stack, optimize=True) / whole[known] ** 2
    return float(np.sqrt(variance.sum() / np.square(factor[known]).sum()))
