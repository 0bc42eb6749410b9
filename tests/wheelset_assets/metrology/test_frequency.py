"""Alignment in the frequency domain: shifts and turns of profiles that are known, with noise, gaps and part of the overlap."""

from __future__ import annotations

import numpy as np
import pytest
from nominal_profiles import by_arc_length, s1002

from wheelset_assets.metrology import frequency as freq


@pytest.fixture(scope="module")
def profile():
    """The S1002 profile (n, 2) in steps of 0.15 mm."""
    return by_arc_length(s1002, -69.0, 60.0, 0.15)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_the_spectrum_is_the_transform_written_out(count):
    random = np.random.default_rng(3)
    points, weight, k = random.normal(0, 5, (40, 2)), random.random(40), 0.4 * np.arange(-count, count + 1)
    found = freq._spectrum(points, weight, k)
    written = np.einsum("n,in,jn->ij", weight, *(np.exp(-1j * np.outer(k, column)) for column in points.T))
    assert np.abs(found - written).max() < 1e-12


@pytest.mark.parametrize("rho", [10.0, 100.0, 1000.0])
@pytest.mark.parametrize("shift", [(-0.03, 0.05), (-0.3, 0.5), (7.0, -3.0), (0.0, 0.0), (25.0, 12.0)])
def test_shifts_of_a_clean_profile_are_exact(profile, shift, rho):
    found = freq.phase_correlation(profile + shift, profile, rho)
    assert found.shift_mm == pytest.approx(shift, abs=1e-6)
    assert found.pixels == pytest.approx(np.array(shift) * rho, abs=1e-3)
    assert found.peak == pytest.approx(1.0, abs=1e-6)


def test_shifts_of_noisy_profiles_scatter_as_their_noise_and_carry_no_bias(profile):
    """Other points on the line, 5 µm of noise: a tenth of a pixel at ρ = 100 is 1 µm."""
    errors = []
    for seed in range(30):
        random = np.random.default_rng(seed)
        shift = random.uniform(-1, 1, 2)
        other = by_arc_length(s1002, -69.0, 60.0, 0.15 + 0.02 * random.random())
        moved, fixed = (p + 0.005 * random.standard_normal(p.shape) for p in (other, profile))
        errors.append(freq.phase_correlation(moved + shift, fixed, 100.0).shift_mm - shift)
    rms = np.sqrt((np.array(errors) ** 2).mean())
    assert 5e-5 < rms < 5e-3


@pytest.mark.parametrize("angle", [0.0, 0.37, 44.0, 90.0, 135.5, 180.0, 225.0, 271.0, 359.9])
def test_turns_over_the_full_circle_are_found_whatever_the_shift(profile, angle):
    random = np.random.default_rng(int(angle))
    moved, fixed = (profile + 0.003 * random.standard_normal(profile.shape) for _ in range(2))
    found = freq.rotation_and_shift(freq.turn(moved, angle) + np.array([2.0, -1.5]), fixed)
    assert abs((found.rotation_deg - angle + 180) % 360 - 180) < 0.01
    assert found.shift_mm == pytest.approx([2.0, -1.5], abs=0.01)


def test_another_profile_has_a_lower_peak(profile):
    other = np.column_stack([profile[:, 0], 5 * np.sin(profile[:, 0] / 5)])
    assert freq.phase_correlation(other, profile, 100.0).peak < 0.7


def test_points_stand_for_their_length_of_line_and_for_no_gap():
    x = np.concatenate([np.arange(0, 10, 1.0), np.arange(30, 41, 0.5)])
    weight = freq.line_weights(np.column_stack([x, 0 * x]))
    assert weight.sum() == pytest.approx(9.0 + 10.5)
    assert weight[5] == 1.0
    assert weight[15] == 0.5


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.3), (0.0, -0.5, -0.2)])
def test_neighbouring_parts_of_a_profile_that_lie_apart_are_told_so(profile, off):
    """Two sensors that see s < 30 and s > -40 mm, one of them with a gap: lateral, radial and rotation that is missing."""
    errors = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        first, second = profile[profile[:, 0] < 30], profile[profile[:, 0] > -40]
        second = second[(second[:, 0] < -5) | (second[:, 0] > 1)] if seed % 2 else second
        first, second = (p + 0.004 * random.standard_normal(p.shape) for p in (first, second))
        pivot = np.array([0.0, 0.0])
        moved = freq.turn(second - pivot, off[2]) + pivot + np.array(off[:2])
        found = freq.align_overlap(moved, first)
        errors.append([found.shift_mm[1], found.rotation_deg])
    radial, turned = np.array(errors).T
    if not any(off):
        # At the right pose the answer is none, within noise: of 4 um over some hundred points.
        assert np.abs(radial[::2]).max() < 0.005
        assert np.abs(radial).max() < 0.04  # with a gap, whose ends are not the same in both
        assert np.abs(turned[::2]).max() < 0.03
    if abs(off[1]) > 0.1:  # the height is told in full but for what the steep parts at the cut's ends take from it
        assert np.all(radial / -off[1] > 0.6)
        assert np.all(radial / -off[1] < 1.3)
    if off[2] == 0.3:
        assert np.all(turned / -off[2] > 0.5)
        assert np.all(turned / -off[2] < 1.35)


def test_profiles_that_share_nothing_have_no_motion(profile):
    assert freq.align_overlap(profile[:100], profile[-100:]) is None
