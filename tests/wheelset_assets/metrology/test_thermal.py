"""The temperature model against the bundle format's own sentence and the paper's numbers."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology import thermal

STEEL_PER_K = 11.5e-6


@pytest.mark.parametrize(("length_mm", "growth_um"), [(130.0, 4.5), (920.0, 32.0), (1353.0, 47.0)])
def test_growth_of_a_wheelset_at_three_kelvin(length_mm, growth_um):
    """Journal, wheel and inner distance at 23 degrees, as the notes on the paper give them (to half a micrometre)."""
    grown = length_mm * (thermal.growth(STEEL_PER_K, 23.0) - 1) * 1e3
    assert grown == pytest.approx(growth_um, abs=0.5)


def test_nothing_grows_at_twenty_degrees():
    assert thermal.growth(STEEL_PER_K, 20.0) == 1.0


def test_a_pose_grows_about_the_origin_and_keeps_its_orientation():
    pose = np.array([[0, -1, 0, 100.0], [1, 0, 0, -50.0], [0, 0, 1, 700.0], [0, 0, 0, 1]])
    before = pose.copy()
    grown = thermal.grown_pose(pose, thermal.growth(STEEL_PER_K, 30.0))
    assert np.array_equal(grown[:3, :3], pose[:3, :3])
    assert grown[:3, 3] == pytest.approx(pose[:3, 3] * (1 + 11.5e-5), abs=1e-12)
    assert np.array_equal(grown[3], [0, 0, 0, 1])
    assert np.array_equal(pose, before)
