"""Frames whose cameras saw different instants, among frames of noise alone; both sides."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology.laser_plane import fit_laser_plane
from wheelset_assets.metrology.synchrony import frame_offsets

FRAMES, ROWS, SIGMA_MM = 400, 300, 0.02


def scan(rng, correlated=1):
    """Points on a slightly bent sheet seen at 20 degrees, with noise along the line of sight, and that noise's sigma."""
    y = np.linspace(-40, 40, ROWS)[None, :] + np.zeros((FRAMES, 1))
    z = 250 + 0.05 * np.sin(np.linspace(0, 2 * np.pi, FRAMES))[:, None] + 0.002 * y**2
    x = np.tan(np.radians(20)) * (z - 250) + 0.003 * np.cos(y / 9)  # the bend
    points = np.stack([x, y, z], axis=-1)
    noise = rng.standard_normal((FRAMES, ROWS + correlated - 1))
    kernel = np.ones(correlated) / np.sqrt(correlated)
    noise = np.stack([np.convolve(row, kernel, "valid") for row in noise])
    sight = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return points + SIGMA_MM * noise[..., None] * sight


def across(plane, points):
    """The part of that noise that lies across the plane."""
    return SIGMA_MM * np.abs(points @ plane.normal) / np.linalg.norm(points, axis=-1)


@pytest.mark.parametrize("correlated", [1, 5])
def test_offsets_of_good_frames_are_noise_of_the_claimed_size(correlated):
    points = scan(np.random.default_rng(1), correlated)
    plane = fit_laser_plane(points.reshape(-1, 3))
    found = frame_offsets(plane, points, np.ones((FRAMES, ROWS), bool), across(plane, points), correlated)
    pulls = found.offset_mm / found.u_mm
    assert 0.9 < pulls.std() < 1.1
    scatter_mm, pull = found.scatter()
    assert 0.9 < pull < 1.1
    assert 0.9 < scatter_mm / found.u_mm.mean() < 1.1
    assert not found.off(6.0, 0.0).any()


def test_a_frame_of_another_instant_is_found_and_no_other():
    rng = np.random.default_rng(2)
    points = scan(rng)
    plane = fit_laser_plane(points.reshape(-1, 3))
    late = np.zeros(FRAMES, bool)
    late[[3, 100, 101, 399]] = True
    points[late] += np.array([0.0, 0.0, 0.030])  # a run-out of that size between the two instants
    found = frame_offsets(plane, points, np.ones((FRAMES, ROWS), bool), across(plane, points), 1.0)
    assert np.array_equal(found.off(6.0, 2e-3), late)
    expected = 0.030 * abs(plane.normal[2])
    assert np.abs(np.abs(found.offset_mm[late]) - expected).max() < 5 * found.u_mm.max()


def test_most_frames_off_by_a_little_show_in_the_scatter_and_single_ones_do_not():
    rng = np.random.default_rng(5)
    points = scan(rng)
    plane = fit_laser_plane(points.reshape(-1, 3))
    good, u_mm = np.ones((FRAMES, ROWS), bool), across(plane, points)
    little = np.median(u_mm) / np.sqrt(ROWS) / abs(plane.normal[2])
    late = points.copy()
    late[[10, 200]] += np.array([0.0, 0.0, 30 * little])
    assert 0.9 < frame_offsets(plane, late, good, u_mm, 1.0).scatter()[1] < 1.1
    points += 1.5 * little * rng.standard_normal((FRAMES, 1, 1)) * np.array([0.0, 0.0, 1.0])
    found = frame_offsets(plane, points, good, u_mm, 1.0)
    assert not found.off(6.0, 0.0).any()
    assert 1.6 < found.scatter()[1] < 2.0  # 1 and 1.5, added in squares


def test_gaps_and_frames_with_a_few_points_say_nothing():
    points = scan(np.random.default_rng(3))
    good = np.random.default_rng(4).random((FRAMES, ROWS)) < 0.5
    good[7], good[8, 5:] = False, False
    plane = fit_laser_plane(points[good])
    found = frame_offsets(plane, points, good, across(plane, points), 1.0)
    assert np.isnan(found.offset_mm[[7, 8]]).all()
    assert not found.off(6.0, 0.0).any()
    assert frame_offsets(plane, points[:5], good[:5], across(plane, points[:5]), 1.0) is None
