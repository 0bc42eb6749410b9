"""Budgets and the scale of a sensor: GUM's rules, and Monte Carlo over the calibration's covariance."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wheelset_assets.metrology.point_uncertainty import scale_uncertainty
from wheelset_assets.metrology.triangulation import Camera, StereoSensor
from wheelset_assets.metrology.uncertainty import COVERAGE_FACTOR, Source, combined

NAMES = (
    "left_f", "left_cx", "left_cy", "left_k1", "right_fx", "right_fy", "right_cx", "right_cy", "right_k1", "right_p1",
    "rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm",
)  # fmt: skip
TRUTH = np.array([1800, 320, 400, -0.09, 1790, 1792, 318, 402, -0.08, 2e-4, 0.01, 0.29, -0.005, -78, 0.5, 18.0])


def sensor_of(values) -> StereoSensor:
    v = dict(zip(NAMES, values, strict=True))
    left = Camera(
        np.array([[v["left_f"], 0, v["left_cx"]], [0, v["left_f"], v["left_cy"]], [0, 0, 1]]),
        np.array([v["left_k1"], 0, 0, 0, 0]),
    )
    right = Camera(
        np.array([[v["right_fx"], 0, v["right_cx"]], [0, v["right_fy"], v["right_cy"]], [0, 0, 1]]),
        np.array([v["right_k1"], 0, v["right_p1"], 0, 0]),
    )
    rotation = Rotation.from_rotvec([v["rx_rad"], v["ry_rad"], v["rz_rad"]]).as_matrix()
    return StereoSensor(left, right, rotation, np.array([v["tx_mm"], v["ty_mm"], v["tz_mm"]]))


def covariance(seed=0):
    """A full covariance with strong correlations, as calibrations have: random factors of realistic size."""
    scale = np.array([2.0, 1.5, 1.5, 2e-3, 2, 2, 1.5, 1.5, 2e-3, 1e-4, 8e-4, 1e-3, 1e-4, 0.02, 0.01, 0.05])
    mixed = np.random.default_rng(seed).standard_normal((16, 24)) / np.sqrt(24)
    return scale[:, None] * (mixed @ mixed.T + 0.1 * np.eye(16)) * scale


def displacements(pixels, sensor):
    """Lengths (2,) between the first point and each other one, triangulated by OpenCV."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    rays = [
        cv2.undistortPoints(p, c.matrix, c.distortion, criteria=criteria).reshape(-1, 2).T
        for p, c in zip(pixels, (sensor.left, sensor.right), strict=True)
    ]
    p = cv2.triangulatePoints(np.eye(3, 4), np.column_stack([sensor.rotation, sensor.translation_mm]), *rays)
    p = (p[:3] / p[3]).T
    return np.linalg.norm(p[1:] - p[0], axis=1)


@pytest.mark.parametrize("depth_mm", [200.0, 300.0])
def test_scale_uncertainty_is_the_spread_under_the_covariance_two_sided(depth_mm):
    """1500 draws of all parameters: relative errors of a millimetre in depth and of one across."""
    truth, c = sensor_of(TRUTH), covariance()
    ends = np.array([[0, 0, depth_mm], [0, 0, depth_mm + 1], [0, 1, depth_mm]])
    poses = ((np.zeros(3), np.zeros(3)), (cv2.Rodrigues(truth.rotation)[0], truth.translation_mm))
    pixels = [
        cv2.projectPoints(ends, *pose, camera.matrix, camera.distortion)[0]
        for pose, camera in zip(poses, (truth.left, truth.right), strict=True)
    ]
    random = np.random.default_rng(1)
    drawn = random.multivariate_normal(TRUTH, c, size=1500, method="cholesky")
    errors = np.array([displacements(pixels, sensor_of(values)) for values in drawn]) - 1
    claimed = scale_uncertainty(truth, NAMES, c, depth_mm)
    # A sampled standard deviation is known to 1 / sqrt(2 n); depth is quadratic in the angles: 2 % more.
    assert errors.std(axis=0) == pytest.approx(claimed, rel=3.3 / np.sqrt(3000) + 0.02)


def test_no_covariance_has_no_uncertainty_and_variance_scales():
    truth, c = sensor_of(TRUTH), covariance(2)
    assert scale_uncertainty(truth, NAMES, 0 * c, 250.0) == pytest.approx((0, 0), abs=1e-12)
    once, twice = (scale_uncertainty(truth, NAMES, k * c, 250.0) for k in (1, 4))
    assert np.array(twice) == pytest.approx(2 * np.array(once), rel=0.02)


def test_a_longer_baseline_is_a_smaller_depth():
    """One parameter at a time: 1 % of the baseline is 1 % of depth and of what lies across."""
    c = np.zeros((16, 16))
    c[13, 13] = (0.01 * 78) ** 2
    flat = TRUTH.copy()
    flat[[14, 15]] = 0
    depth, across = scale_uncertainty(sensor_of(flat), NAMES, c, 250.0)
    assert depth == pytest.approx(0.01, rel=0.02)
    assert across == pytest.approx(0.01, rel=0.02)


def test_sources_combine_by_the_gum():
    sources = [Source("a", 0.003, "mm", 1.0), Source("b", 0.02, "K", -0.2), Source("c", 1e-6, "1/K", 0.0)]
    assert [s.contribution for s in sources] == pytest.approx([0.003, 0.004, 0.0])
    assert combined(sources) == pytest.approx(0.005)
    assert combined([]) == 0.0
    assert COVERAGE_FACTOR == 2.0
