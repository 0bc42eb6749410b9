"""Vertical disparity from the slopes of stripes in one laser plane: known offsets, two-sided, and where nothing is told."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology.epipolar import epipolar_residual
from wheelset_assets.metrology.triangulation import MatchedStripe
from wheelset_assets.simulation.noise import correlated

ROWS, FRAMES, FOCAL_PX = 400, 40, 1000.0
BASELINE_MM = 120.0


def depth_mm(y, shape):
    """A profile along the rows: a straight one, or one with a step's flanks and a fillet."""
    if shape == "straight":
        return 260.0 + 40.0 * y
    return 260.0 + 12.0 * np.tanh((y - 0.02) / 0.01) + 300.0 * np.clip(y + 0.1, None, 0.0) ** 2 / 0.2


def seen(offset_px, shape="wheel", noise_px=0.05, rows=ROWS, seed=0):
    """Matched stripes of a plane x = 10 mm + 0.05 z, the right image lying offset_px lower than the cameras' pose says."""
    random = np.random.default_rng(seed)
    y = np.tile(np.linspace(-0.2, 0.2, rows), (FRAMES, 1))
    run_out = 0.2 * np.sin(np.arange(FRAMES) / 6)[:, None]

    def columns(at):
        z = depth_mm(at, shape) + run_out
        return 0.05 + 10.0 / z, 0.05 + (10.0 - BASELINE_MM) / z

    x_left = columns(y)[0] + noise_px / FOCAL_PX * correlated(random, y.shape, 1.5)
    x_right = columns(y - offset_px / FOCAL_PX)[1] + noise_px / FOCAL_PX * correlated(random, y.shape, 1.5)
    return MatchedStripe(x_left, x_right, y), np.ones(y.shape, bool)


@pytest.mark.parametrize("offset_px", [0.0, 0.35, -0.8])
def test_an_offset_between_the_images_is_recovered(offset_px):
    found = epipolar_residual(*seen(offset_px, noise_px=0.0))
    assert found.offset * FOCAL_PX == pytest.approx(offset_px, abs=0.02 * abs(offset_px) + 1e-6)
    assert found.n_rows > 300


def test_the_claimed_uncertainty_is_neither_too_small_nor_too_large():
    pulls = []
    for seed in range(60):
        found = epipolar_residual(*seen(0.2, seed=seed))
        pulls.append((found.offset * FOCAL_PX - 0.2) / (found.u_offset * FOCAL_PX))
    # Sixty pulls: the root mean square of a right claim lies within 0.75 to 1.25.
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.3


def test_gaps_and_gross_errors_do_not_matter():
    matched, good = seen(0.3)
    random = np.random.default_rng(5)
    good[:, 100:110] = False
    struck = random.random(good.shape) < 0.002
    matched.x_right[struck] += 5.0 / FOCAL_PX
    found = epipolar_residual(matched, good)
    assert found.offset * FOCAL_PX == pytest.approx(0.3, abs=6 * found.u_offset * FOCAL_PX)
    assert found.u_offset * FOCAL_PX < 0.05


def test_a_stripe_without_slopes_says_that_it_knows_nothing():
    told = epipolar_residual(*seen(0.5, shape="straight"))
    assert told is None or told.u_offset * FOCAL_PX > 1.0


def test_too_few_rows_give_none():
    matched, good = seen(0.0, rows=30)
    assert epipolar_residual(matched, good) is None
    matched, good = seen(0.0)
    assert epipolar_residual(matched, np.zeros_like(good)) is None
