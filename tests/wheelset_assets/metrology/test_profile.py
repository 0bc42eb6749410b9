"""Profile quantities on exact nominal profiles, whose values follow from the standards' own numbers."""

from __future__ import annotations

import numpy as np
import pytest
from nominal_profiles import by_arc_length, lma, s1002
from scipy.optimize import brentq
from two_sided import assert_pulls

from wheelset_assets.metrology import profile
from wheelset_assets.metrology.profile import ProfileDefinition, profile_values

DEFINITION = ProfileDefinition(datum_mm=70.0, flank_height_mm=10.0, tip_drop_mm=2.0, tread_half_width_mm=10.0)
RADIUS = 460.0
# From the standards: Sh, Sd, qR.
PUBLISHED = {"S1002": (s1002, 28.000, 32.500, 10.794), "LMA": (lma, 28.000, 32.900, 9.740)}


def dense(height, spacing=0.125, low=-69.0, high=55.0):
    """Points s (from the inner face) and r of a profile on a wheel of 460 mm."""
    points = by_arc_length(height, low, high, spacing)
    return points[:, 0] + 70.0, points[:, 1] + RADIUS


@pytest.mark.parametrize("name", list(PUBLISHED))
def test_the_written_out_profiles_are_the_published_ones(name):
    """The oracle itself, by root finding: Sh, Sd, qR, and z = 0 at the datum circle."""
    height, sh, sd, qr = PUBLISHED[name]
    tip = {"S1002": -55.0, "LMA": -54.0}[name]
    assert height(tip) == pytest.approx(sh, abs=1e-6)
    assert height(0.0) == pytest.approx(0.0, abs=1e-4)
    at_10, below_tip = (brentq(lambda s, z=z: height(s) - z, -50.0, -36.0) for z in (10.0, sh - 2.0))
    assert 70 + at_10 == pytest.approx(sd, abs=5e-4)
    assert at_10 - below_tip == pytest.approx(qr, abs=5e-4)
    s = np.linspace(-69.99, 59.99, 200_001)
    assert np.abs(np.diff(height(s))).max() < 0.03  # no jump at a joint: the steepest slope there is 40


@pytest.mark.parametrize("spacing", [0.05, 0.125, 0.25])
@pytest.mark.parametrize("name", list(PUBLISHED))
def test_exact_profiles_give_their_published_values_to_a_micrometre(name, spacing):
    height, sh, sd, qr = PUBLISHED[name]
    s, r = dense(height, spacing)
    found = profile_values(s, r, np.ones_like(s), DEFINITION)
    assert found.tread_radius_mm == pytest.approx(RADIUS, abs=1e-3)
    assert found.flange_height_mm == pytest.approx(sh, abs=1e-3)
    assert found.flange_thickness_mm == pytest.approx(sd, abs=1e-3)
    assert found.qr_mm == pytest.approx(qr, abs=1e-3)


def test_the_order_of_the_points_is_indifferent():
    s, r = dense(s1002)
    shuffled = np.random.default_rng(0).permutation(s.size)
    straight = profile_values(s, r, np.ones_like(s), DEFINITION)
    mixed = profile_values(s[shuffled], r[shuffled], np.ones_like(s), DEFINITION)
    for name in ("tread_radius_mm", "flange_height_mm", "flange_thickness_mm", "qr_mm"):
        assert getattr(mixed, name) == pytest.approx(getattr(straight, name), abs=1e-7)


def test_the_lengths_of_the_definition_are_parameters():
    """Flange thickness of LMA at 12 mm is 31.97, which tables call 32; the AAR taping line lies 77.79 mm out."""
    s, r = dense(lma)
    found = profile_values(s, r, np.ones_like(s), ProfileDefinition(70.0, 12.0, 2.0, 10.0))
    assert found.flange_thickness_mm == pytest.approx(31.97, abs=5e-3)
    outer = profile_values(s, r, np.ones_like(s), ProfileDefinition(77.79, 10.0, 2.0, 10.0))
    assert outer.tread_radius_mm == pytest.approx(RADIUS + lma(7.79), abs=1e-3)


def test_noise_of_the_points_averages_out_and_does_not_bias():
    """Noise of 5 um on each of two thousand points, 100 trials: spread below the points' own, mean at the truth."""
    s, r = dense(s1002, 0.1)
    random = np.random.default_rng(1)
    values = []
    for _ in range(100):
        noisy = profile_values(s, r + 0.005 * random.standard_normal(r.size), np.ones_like(s), DEFINITION)
        values.append([noisy.tread_radius_mm, noisy.flange_height_mm, noisy.flange_thickness_mm, noisy.qr_mm])
    truth = [RADIUS, 28.0, 32.5, 10.794]
    spread = np.std(values, axis=0, ddof=1)
    assert np.all(
        spread < [0.001, 0.002, 0.0015, 0.005]
    )  # the flank under the tip leans by 60 degrees: qR suffers most
    # A quartic over 200 points fixes its middle to 15/8 / sqrt(200) of a point: 0.13; found from both sides.
    assert_pulls((np.array(values)[:, 0] - RADIUS) / (0.005 * 1.875 / np.sqrt(200)))
    assert np.all(np.abs(np.mean(values, axis=0) - truth) < 1e-3 + 3.3 * spread / 10)


def test_weights_count():
    """Points of a second sensor that lie 50 um too high have a hundredth of the weight: a hundredth of their error."""
    s, r = dense(s1002)
    both_s, both_r = np.concatenate([s, s]), np.concatenate([r, r + 0.05])
    weight = np.concatenate([np.full(s.size, 100.0), np.ones(s.size)])
    found = profile_values(both_s, both_r, weight, DEFINITION)
    assert found.tread_radius_mm - RADIUS == pytest.approx(0.05 / 101, abs=1e-4)


@pytest.mark.parametrize(
    ("hidden", "missing"),
    [
        ((60.0, 80.0), {"tread_radius_mm", "flange_height_mm", "flange_thickness_mm", "qr_mm"}),
        ((5.0, 20.0), {"flange_height_mm", "flange_thickness_mm", "qr_mm"}),
        ((28.0, 36.0), {"flange_thickness_mm", "qr_mm"}),
        ((19.0, 25.0), {"qr_mm"}),
    ],
)
def test_what_was_not_seen_has_no_value(hidden, missing):
    """NaN where the profile does not support a value: datum circle, flange's top, flank, and its upper point."""
    s, r = dense(s1002)
    seen = (s < hidden[0]) | (s > hidden[1])
    found = profile_values(s[seen], r[seen], np.ones(seen.sum()), DEFINITION)
    values = {name: getattr(found, name) for name in ("tread_radius_mm", "flange_height_mm", "flange_thickness_mm")}
    values["qr_mm"] = found.qr_mm
    assert {name for name, value in values.items() if np.isnan(value)} == missing


def test_a_hollow_tread_is_followed():
    """Wear of 1.5 mm over 60 mm of tread, deepest beside the datum circle: the local fit errs by micrometres only."""

    def worn(s):
        x = (s - 4.0) / 30.0
        return s1002(s) - 1.5 * np.maximum(1 - x * x, 0) ** 3

    s, r = dense(worn)
    found = profile_values(s, r, np.ones_like(s), DEFINITION)
    assert found.tread_radius_mm == pytest.approx(RADIUS + worn(0.0), abs=3e-3)
    assert found.flange_height_mm == pytest.approx(28.0 - worn(0.0), abs=4e-3)


# --- local fits


def test_a_local_fit_reproduces_its_polynomial():
    x = np.linspace(-5, 5, 101)
    y = 2 - 0.3 * x + 0.05 * x**2
    fit = profile.local_fit(x, y, np.ones_like(x), 1.0, 2.0, 2)
    assert fit.value == pytest.approx(2 - 0.3 + 0.05, abs=1e-12)
    assert fit(np.array([0.0, 2.0])) == pytest.approx([2.0, 2 - 0.6 + 0.2], abs=1e-12)
    assert (fit.n, fit.half_width) == (41, 2.0)


def test_a_local_fit_is_refused_without_points_on_both_sides_and_widens_only_as_far_as_told():
    x = np.linspace(0, 5, 51)
    assert profile.local_fit(x, x, np.ones_like(x), -0.01, 1.0, 1) is None
    sparse = np.arange(-10.0, 11.0, 2.0) + 0.5
    assert profile.local_fit(sparse, sparse, np.ones_like(sparse), 0.0, 1.0, 1) is None
    widened = profile.local_fit(sparse, sparse, np.ones_like(sparse), 0.0, 1.0, 1, widen=6.0)
    assert widened is not None
    assert widened.half_width <= 6.0 * 1.25
    assert widened.value == pytest.approx(0.0, abs=1e-12)
