"""Outlier removal and thinning of unorganised clouds: planted outliers, slow loops as oracles."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology.surface import far_from_others, lonely, voxel_thinned


@pytest.fixture
def cloud():
    """Points of a wavy patch 40 mm wide, and twelve far above it."""
    random = np.random.default_rng(3)
    xy = random.uniform(-20, 20, (3000, 2))
    patch = np.column_stack([xy, np.sin(xy[:, 0] / 8)])
    far = np.column_stack([random.uniform(-20, 20, (12, 2)), random.uniform(15, 60, 12)])
    return np.concatenate([patch, far])


def test_lonely_points_are_those_of_the_slow_loop(cloud):
    found = lonely(cloud, 2.0, 5)
    slow = [(np.linalg.norm(cloud - p, axis=1) <= 2.0).sum() - 1 < 5 for p in cloud]
    assert np.array_equal(found, slow)
    assert found[3000:].all()
    assert found[:3000].mean() < 0.02


def test_points_far_from_others_are_the_planted_ones_and_few_more(cloud):
    found = far_from_others(cloud, 20, 2.0)
    assert found[3000:].all()
    assert found[:3000].mean() < 0.01
    assert not far_from_others(cloud[:1]).any()


def test_statistical_removal_is_that_of_the_definition(cloud):
    sample = cloud[::10]
    distance = np.sort(np.linalg.norm(sample[:, None] - sample[None], axis=2), axis=1)[:, 1:9].mean(axis=1)
    expected = distance > distance.mean() + 1.5 * distance.std(ddof=1)
    assert np.array_equal(far_from_others(sample, 8, 1.5), expected)


def test_voxels_hold_the_means_of_their_points(cloud):
    thin = voxel_thinned(cloud, 4.0)
    cell = np.floor((cloud - cloud.min(axis=0)) / 4.0).astype(int)
    means = [cloud[(cell == c).all(axis=1)].mean(axis=0) for c in np.unique(cell, axis=0)]
    assert np.allclose(thin, means)
