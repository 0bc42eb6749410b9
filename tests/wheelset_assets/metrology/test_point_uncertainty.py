"""The calibration's part of a point's uncertainty: over 200 independent calibrations, two-sided, with noise on top."""

from __future__ import annotations

import cv2
import numpy as np
from test_calibration import BOARD, KNOBS, SIZE, project, true_rig

from wheelset_assets.metrology import calibration as cal
from wheelset_assets.metrology import triangulation as tri
from wheelset_assets.metrology.point_uncertainty import calibration_covariance, working_grid

POINTS = np.array([[0, 0, 265.0], [15, -30, 255], [-12, 25, 280], [20, 35, 270]])


def test_full_uncertainty_of_points_over_two_hundred_calibrations():
    """Each calibration is of another rig with its own corners; a point's own noise comes on top. Pulls 0.9 to 1.1."""
    sigma, pulls = 0.05, []
    for seed in range(200):
        random = np.random.default_rng([77, seed])
        lens = (random.uniform(-0.12, -0.04), *random.uniform(-0.1, 0.1, 1), *random.uniform(-4e-4, 4e-4, 2), 0)
        rig = true_rig(random, lens=lens, n_poses=7)
        poses = rig.poses(sigma, random)
        # The choice of the model is tested elsewhere; here the starting values stand for a calibration made before.
        start = cal._starting_values(poses, BOARD, (SIZE, SIZE))
        found = cal.adjust(poses, BOARD, "k1 k2 p1 p2 k3", start)
        s = found.sensor
        rays = []
        for m, d, pose in zip(
            rig.matrices, rig.lenses, ((np.eye(3), np.zeros(3)), (rig.rotation, rig.translation)), strict=True
        ):
            rays.append(project(POINTS, m, d, *pose) + sigma * random.standard_normal((len(POINTS), 2)))
        ideal = [tri.undistort(c, *px.T) for c, px in zip((s.left, s.right), rays, strict=True)]
        got = tri.intersect_rays(s, *ideal[0], *ideal[1])
        shared = calibration_covariance(s, found.parameter_names, found.covariance, POINTS)
        pulls.append((got - POINTS) / np.sqrt(np.diagonal(shared + _noise(s, rays, sigma), axis1=1, axis2=2)))
    rms = np.sqrt((np.array(pulls) ** 2).mean(axis=(0, 1)))
    assert np.all((rms > 0.9) & (rms < 1.1)), rms


def _noise(sensor, pixels, sigma):
    """Covariance (n, 3, 3) of points by numerical derivatives of the two rays' midpoint by all four pixels."""
    values = [*pixels[0].T, *pixels[1].T]

    def points(moved):
        left, right = tri.undistort(sensor.left, *moved[:2]), tri.undistort(sensor.right, *moved[2:])
        return tri.intersect_rays(sensor, *left, *right)

    total = 0.0
    for k in range(4):
        ends = [points([v + (s * 1e-3 if i == k else 0) for i, v in enumerate(values)]) for s in (1, -1)]
        slope = (ends[0] - ends[1]) / 2e-3
        total = total + sigma**2 * slope[:, :, None] * slope[:, None, :]
    return total


def test_the_grid_covers_the_image_and_the_depths():
    random = np.random.default_rng(1)
    rig = true_rig(random)
    s = cal.calibrate_stereo(rig.poses(0.05, random), BOARD, SIZE, **KNOBS).adjustment.sensor
    grid = working_grid(s, SIZE, (240.0, 290.0), (3, 5, 2))
    assert grid.shape == (30, 3)
    px = cv2.projectPoints(grid, np.zeros(3), np.zeros(3), s.left.matrix, s.left.distortion)[0].reshape(-1, 2)
    assert np.allclose(px.min(axis=0), 0, atol=1e-6)
    assert np.allclose(px.max(axis=0), np.array(SIZE) - 1, atol=1e-6)
    assert set(np.round(grid[:, 2], 6)) == {240.0, 290.0}
