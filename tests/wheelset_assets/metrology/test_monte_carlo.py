"""Propagation of distributions against closed forms, and against the law of propagation where that holds."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology.monte_carlo import DISTRIBUTIONS, _standard, propagate, shortest_interval
from wheelset_assets.metrology.uncertainty import Source


def test_normal_sources_give_what_the_gum_gives():
    sources = [
        Source("certificate of the master", 0.0015, "mm", 1.0),
        Source("wheelset temperature", 0.03, "K", -0.0106),
    ]
    found = propagate(920.0, sources, 2_000_000)
    assert found.standard_uncertainty == pytest.approx(np.hypot(0.0015, 0.03 * 0.0106), rel=3e-3)
    assert found.agrees
    assert found.tolerance == 0.5e-4


def test_a_single_disc_dominated_value_has_a_shorter_interval_than_two_u():
    """The difference of two discs is bounded: k = 2 claims too much, and the check says so."""
    found = propagate(0.0, [Source("axis of rotation", 0.001, "mm", 1.0)], 1_000_000)
    assert found.standard_uncertainty == pytest.approx(0.001, rel=5e-3)
    assert 0.9 < (found.interval[1] - found.interval[0]) / 0.004 < 0.985
    assert not found.agrees


def test_a_cosine_is_one_sided():
    """(z^2 - 1) / sqrt 2: its shortest interval begins at the bound, and ends where chi-square does."""
    found = propagate(0.0, [Source("sensor pose in unconstrained directions", 1.0, "1", 1.0)], 1_000_000)
    assert found.interval[0] == pytest.approx(-1 / np.sqrt(2), abs=1e-3)
    assert found.interval[1] == pytest.approx((4.0 - 1) / np.sqrt(2), abs=0.03)  # 95.45 % of z^2 lie below 4


@pytest.mark.parametrize("name", ["noise of the scan", *DISTRIBUTIONS])
def test_every_distribution_is_standard(name):
    drawn = _standard(name, 400_000, np.random.default_rng(3))
    assert abs(drawn.mean()) < 5 / np.sqrt(400_000)
    assert drawn.std() == pytest.approx(1.0, rel=0.01)


def test_shortest_interval_of_a_skewed_sample():
    drawn = np.concatenate([np.linspace(0, 1, 951), np.linspace(5, 100, 49)])
    assert shortest_interval(drawn, 0.951) == (0.0, 1.0)


def test_too_few_draws_are_refused():
    with pytest.raises(ValueError, match="10,000"):
        propagate(0.0, [Source("a", 1.0, "mm", 1.0)], 999)


def test_the_same_seed_gives_the_same_draws():
    source = [Source("a", 1.0, "mm", 1.0)]
    assert propagate(0.0, source, 20_000, 4) == propagate(0.0, source, 20_000, 4)
    assert propagate(0.0, source, 20_000, 4) != propagate(0.0, source, 20_000, 5)
