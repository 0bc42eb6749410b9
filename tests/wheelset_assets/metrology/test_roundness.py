"""Harmonics of a turn against series whose every order is known, and flats against chords."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology.roundness import (
    body_angle_deg,
    find_flats,
    level_db,
    mean_direction_deg,
    peak_to_peak,
    spectrum,
)

TURN = np.arange(0.0, 360.0, 0.25)


def wave(angle_deg, terms):
    theta = np.radians(angle_deg)
    return sum((a * np.cos(n * theta + p) for n, a, p in terms), np.zeros_like(theta))


def test_a_noiseless_series_gives_its_orders_back():
    angle = np.arange(400) * 0.9
    terms = [(1, 0.02, 0.3), (3, 0.008, 2.0), (20, 0.002, 1.0)]
    found = spectrum(angle, 460.0 + wave(angle, terms), np.ones(400, bool), 30)
    assert found.order == 30
    assert found.mean == pytest.approx(460.0, abs=1e-12)
    for n, a, p in terms:
        assert found.cosine[n - 1] == pytest.approx(a * np.cos(p), abs=1e-12)
        assert found.sine[n - 1] == pytest.approx(-a * np.sin(p), abs=1e-12)
    others = [n - 1 for n in range(1, 31) if n not in (1, 3, 20)]
    assert found.amplitude[others].max() < 1e-12
    assert peak_to_peak(found, 1, 6).value == pytest.approx(np.ptp(wave(TURN, terms[:2])), abs=1e-5)
    assert peak_to_peak(found, 2).value == pytest.approx(np.ptp(wave(TURN, terms[1:])), abs=1e-5)


@pytest.mark.parametrize("gap_deg", [0, 60, 75, 90, 99])
def test_the_mean_over_a_gap_knows_what_the_orders_that_it_lost_do_to_it_two_sided(gap_deg):
    """Wheels of orders 1 to 4; a gap of 90 degrees leaves two orders, and what the others put into the mean is no noise."""
    angle, noise, pulls = np.arange(120) * 3.0, 0.002, []
    for seed in range(150):
        random = np.random.default_rng(seed)
        values = noise * random.standard_normal(120)
        for order, size in enumerate((0.020, 0.012, 0.006, 0.003), 1):
            values += size * random.uniform(0.3, 1.5) * np.cos(order * np.radians(angle) + random.uniform(0, 2 * np.pi))
        found = spectrum(angle, values, angle >= gap_deg, 30, noise)
        assert found is not None
        pulls.append(found.mean / found.u_mean)
    assert 0.75 < np.sqrt(np.mean(np.square(pulls))) < 1.35
    assert np.mean(np.abs(pulls) < 2) > 0.86


def test_the_mean_of_directions_goes_round():
    assert mean_direction_deg([359.0, 1.0]) == pytest.approx(0.0, abs=1e-9)
    assert abs(mean_direction_deg([179.9, -179.9])) == pytest.approx(180.0)
    assert mean_direction_deg([80.0, np.nan, 100.0]) == pytest.approx(90.0)
    assert np.isnan(mean_direction_deg([]))


def test_the_order_falls_with_frames_and_gaps():
    angle = np.arange(120) * 3.0
    values = wave(angle, [(1, 1.0, 0.0)])
    assert spectrum(angle, values, np.ones(120, bool), 30).order == 19  # three frames a coefficient
    used = (angle < 100) | (angle >= 140)
    assert spectrum(angle, values, used, 30).order == 6  # 270 / 43
    assert spectrum(angle, values, angle < 12, 30) is None


@pytest.mark.parametrize(
    ("orders", "first", "last"),
    [((20, 12, 6, 3), 1, 6), ((3, 2, 1, 0), 1, 6), ((20, 12, 6, 3), 2, 30), ((0, 2, 1, 0), 2, 6)],
)
def test_ranges_lie_within_their_uncertainty_two_sided(orders, first, last):
    """Six hundred turns each: U covers 90 to 99.9 % of the errors, whether the orders stand out of the noise or not."""
    random = np.random.default_rng(3)
    angle, covered, pulls = np.arange(120) * 3.0, 0, []
    for _ in range(600):
        terms = [(n, a, p) for n, (a, p) in enumerate(zip(orders, random.uniform(0, 6.3, 4), strict=True), 1)]
        truth = np.ptp(wave(TURN, [t for t in terms if first <= t[0] <= last]))
        found = spectrum(angle, wave(angle, terms) + 3.0 * random.standard_normal(120), np.ones(120, bool), 30)
        ranged = peak_to_peak(found, first, last)
        pulls.append((ranged.value - truth) / ranged.u)
        covered += abs(pulls[-1]) <= 2
    assert 0.90 <= covered / 600 <= 0.999
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.25


def test_a_shift_of_the_axis_is_a_change_of_order_one():
    angle = np.arange(200) * 1.8
    found = spectrum(angle, wave(angle, [(1, 0.02, 0.5), (2, 0.01, 0.0)]), np.ones(200, bool), 6)
    moved = peak_to_peak(found, 1, 6, shift=-np.array([0.02 * np.cos(0.5), -0.02 * np.sin(0.5)]))
    assert moved.value == pytest.approx(0.02, abs=1e-5)


def test_body_angles_of_two_sensors_name_one_point():
    """A mark at body angle 30 is seen from direction 90 after a turn of 60, and from 200 after a turn of 170."""
    assert body_angle_deg(np.array([60.0]), 90.0) == pytest.approx(30.0)
    assert body_angle_deg(np.array([170.0]), 200.0) == pytest.approx(30.0)


def test_level_is_relative_to_one_micrometre_effective():
    assert level_db(np.array([np.sqrt(2.0), 10 * np.sqrt(2.0)])) == pytest.approx([0.0, 20.0])
    assert level_db(np.array([0.0]))[0] == -np.inf


@pytest.mark.parametrize(("frames", "middle_deg"), [(1000, 100.0), (400, 0.3), (150, 359.9)])
def test_a_flat_is_found_with_place_length_and_depth(frames, middle_deg):
    random = np.random.default_rng(5)
    angle, diameter, length = np.arange(frames) * 360.0 / frames, 920.0, 60.0
    away = np.mod(angle - middle_deg + 180, 360) - 180
    x = np.radians(away) * diameter / 2
    chord = np.where(np.abs(x) < length / 2, x**2 / diameter - length**2 / (4 * diameter), 0.0)
    deviation = chord + 0.002 * random.standard_normal(frames)
    (flat,) = find_flats(angle, deviation, np.abs(deviation) > 0.01, 0.002, diameter)
    assert flat.depth_mm == pytest.approx(length**2 / (4 * diameter), abs=3 * flat.u_depth_mm + 1e-4)
    assert flat.length_mm == pytest.approx(length, abs=3 * flat.u_length_mm + 0.05)
    assert np.mod(flat.body_deg - middle_deg + 180, 360) - 180 == pytest.approx(0.0, abs=0.05)
    assert flat.u_depth_mm < 0.01


def test_dirt_is_no_flat():
    angle = np.arange(300) * 1.2
    deviation = np.where((angle > 50) & (angle < 60), 0.1, 0.0)
    assert find_flats(angle, deviation, deviation > 0.05, 0.001, 920.0) == []
