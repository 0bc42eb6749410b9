"""Organised grids against numpy's and scipy's slower functions, under random inputs with gaps."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.stats import median_abs_deviation

from wheelset_assets.metrology import grids

values = st.floats(-1e3, 1e3) | st.just(np.nan)
gappy = arrays(float, array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9), elements=values)


def quiet(function, *args, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # numpy warns of empty slices; ours must not
        return function(*args, **kwargs)


@given(gappy, st.sampled_from([0, 1]))
def test_nan_median_is_numpys(grid, axis):
    assert np.allclose(grids.nan_median(grid, axis), quiet(np.nanmedian, grid, axis=axis), equal_nan=True, atol=1e-12)


@given(gappy, st.sampled_from([0, 1]))
def test_nan_mean_is_numpys(grid, axis):
    mean, count = grids.nan_mean(grid, axis)
    assert np.allclose(mean, quiet(np.nanmean, grid, axis=axis), equal_nan=True, atol=1e-9)
    assert np.array_equal(count, np.isfinite(grid).sum(axis=axis))


@given(gappy, st.integers(0, 2**32 - 1))
def test_weights_of_missing_points_do_not_count(grid, seed):
    weights = np.random.default_rng(seed).uniform(0.1, 10, grid.shape)
    mean, _ = grids.nan_mean(grid, 1, weights=weights)
    masked = np.ma.masked_invalid(grid)
    expected = np.ma.average(masked, axis=1, weights=weights).filled(np.nan)
    assert np.allclose(mean, expected, equal_nan=True, atol=1e-9)


@given(gappy)
def test_robust_scatter_is_scipys(grid):
    if np.isfinite(grid).any():
        expected = median_abs_deviation(grid, axis=None, scale="normal", nan_policy="omit")
        assert grids.robust_scatter(grid) == pytest.approx(expected, rel=1e-4, abs=1e-9)  # 1.4826 has five digits
    else:
        assert np.isnan(grids.robust_scatter(grid))


@given(arrays(float, st.integers(1, 40), elements=st.floats(-1e3, 1e3)))
def test_median_reordering_is_numpys_to_the_bit(flat):
    assert grids.median_reordering(flat.copy()) == np.median(flat)


def test_robust_scatter_of_normal_values_is_their_standard_deviation():
    found = grids.robust_scatter(np.random.default_rng(0).normal(5.0, 0.3, 40_000))
    assert found == pytest.approx(0.3, rel=3.3 * 1.1664 / np.sqrt(40_000))  # asymptotic efficiency 37 %


@given(arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=8), elements=st.booleans()))
def test_points_return_to_their_places(seen):
    frame, row = np.nonzero(seen)
    depth = np.arange(frame.size, dtype=float)
    a, b = grids.to_grid(frame, row, seen.shape, depth, -depth)
    assert np.array_equal(np.isfinite(a), seen)
    assert np.array_equal(a[frame, row], depth)
    assert np.array_equal(b[frame, row], -depth)
