"""Laser planes: fit against a known plane with outliers, points off it, and a plane that moved."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology.laser_plane import fit_laser_plane, off_plane, plane_shift

NORMAL = np.array([0.99, 0.04, -0.13]) / np.linalg.norm([0.99, 0.04, -0.13])


def points_on_plane(n=4000, noise_mm=0.02, outliers=0.0, normal=NORMAL, distance=12.0, seed=0):
    """Points (n, 3) mm whose noise lies along their lines of sight; some are mismatches by centimetres."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-60, 60, n), random.uniform(240, 300, n)
    points = np.column_stack([(distance - normal[1] * y - normal[2] * z) / normal[0], y, z])
    points *= 1 + noise_mm * random.standard_normal((n, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    wrong = random.random(n) < outliers
    points[wrong] *= 1 + random.uniform(0.02, 0.2, (wrong.sum(), 1)) * random.choice([-1, 1], (wrong.sum(), 1))
    return points, wrong


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_the_plane_is_found_among_mismatches(outliers):
    points, wrong = points_on_plane(outliers=outliers)
    plane = fit_laser_plane(points)
    across = abs(points[0] @ NORMAL) / np.linalg.norm(points[0])
    assert np.degrees(np.arccos(min(1.0, plane.normal @ NORMAL))) < 0.01
    assert plane.distance_mm == pytest.approx(12.0, abs=0.02)
    assert 0.3 * 0.02 * across < plane.rms_mm < 0.02
    flagged = off_plane(plane, points, np.full(len(points), 0.02), sigmas=6.0, floor_mm=0.02)
    assert flagged[wrong].mean() > 0.95 if wrong.any() else True
    assert not flagged[~wrong].any()


def test_what_is_no_plane_gives_none():
    points, _ = points_on_plane(50)
    assert fit_laser_plane(points) is None
    line = np.outer(np.linspace(-1, 1, 500), [0, 40, 5.0]) + np.array([10, 0, 260])
    assert fit_laser_plane(line + 0.01 * np.random.default_rng(1).standard_normal(line.shape)) is None
    assert fit_laser_plane(np.full((200, 3), np.nan)) is None


def test_a_plane_that_moved_is_told_by_how_much():
    then = fit_laser_plane(points_on_plane(noise_mm=0)[0])
    same = fit_laser_plane(points_on_plane(noise_mm=0, seed=2)[0])
    shift, angle = plane_shift(same, then)
    assert shift < 1e-6
    assert angle < 1e-6
    shift, angle = plane_shift(fit_laser_plane(points_on_plane(noise_mm=0, distance=12.3)[0]), then)
    assert shift == pytest.approx(0.3, abs=1e-6)
    turned = NORMAL + np.cross([0, np.radians(0.2), 0], NORMAL)
    shift, angle = plane_shift(
        fit_laser_plane(points_on_plane(noise_mm=0, normal=turned / np.linalg.norm(turned))[0]), then
    )
    assert angle == pytest.approx(0.2, rel=0.02)
    assert shift > 0.1
