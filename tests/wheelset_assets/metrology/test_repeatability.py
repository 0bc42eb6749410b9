"""Spread of repeated values against the standard library's exact arithmetic."""

from __future__ import annotations

import statistics
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wheelset_assets.metrology.repeatability import spreads


def spread(values):
    """Spread of one group."""
    return spreads(np.array(values, float), np.array([0]))


@given(st.lists(st.floats(-1e4, 1e4), min_size=2, max_size=30))
def test_spread_is_the_standard_librarys(values):
    found = spread(values)
    exact = [Fraction(v) for v in values]
    assert found.n == len(values)
    assert found.mean == pytest.approx(float(statistics.mean(exact)), abs=1e-8)
    assert found.standard_deviation == pytest.approx(float(statistics.stdev(values)), abs=1e-8)
    assert (found.minimum, found.maximum) == (min(values), max(values))
    assert found.range == max(values) - min(values)


def test_one_value_has_no_standard_deviation():
    found = spread([920.0])
    assert np.isnan(found.standard_deviation)
    assert (found.mean, found.range) == (920.0, 0.0)


def test_tight_groups_of_large_values_keep_their_digits():
    """Nanometres on a metre: a sum of squares about zero would lose all of them."""
    steps = np.array([0.0, 1e-6, 2e-6, 3e-6])
    assert spread(1353.0 + steps).standard_deviation == pytest.approx(np.std(steps, ddof=1), rel=1e-6)


def test_the_papers_table_1():
    """Errors of the left journal in its Table 1: mean +1.667, standard deviation 1.211 um (notes on the paper, 10)."""
    found = spread([1.0, 3.0, 2.0, 3.0, 1.0, 0.0])
    assert found.mean == pytest.approx(1.667, abs=5e-4)
    assert found.standard_deviation == pytest.approx(1.211, abs=5e-4)


@given(st.lists(st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=6), min_size=1, max_size=8))
def test_groups_do_not_touch_each_other(groups):
    lengths = [len(g) for g in groups]
    together = spreads(np.concatenate([np.array(g) for g in groups]), np.cumsum([0, *lengths[:-1]]))
    for k, group in enumerate(groups):
        alone = spread(group)
        for name in ("n", "mean", "standard_deviation", "minimum", "maximum"):
            assert getattr(together, name)[k] == pytest.approx(getattr(alone, name)[0], abs=1e-9, nan_ok=True)
