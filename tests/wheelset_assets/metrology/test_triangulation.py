"""Triangulation against OpenCV, scipy and closed forms: distortion, rectification, matching, depth, noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from two_sided import assert_pulls, mean_square_interval

from wheelset_assets.metrology import triangulation as tri
from wheelset_assets.metrology.stripe_noise import StripeNoise, stripe_noise
from wheelset_assets.quality import AlgorithmFailed

LENS = np.array([-0.11, 0.08, 3e-4, -4e-4, -0.04])
LEFT = tri.Camera(np.array([[1510.0, 0, 262.0], [0, 1512.0, 381.0], [0, 0, 1]]), LENS)
RIGHT = tri.Camera(np.array([[1495.0, 0, 251.0], [0, 1493.0, 390.0], [0, 0, 1]]), LENS * [0.9, -1.1, -1, 1, 0.5])
ROWS, DEPTH = 768, 250.0


def sensor_of(right_centre, euler_deg, right=RIGHT) -> tri.StereoSensor:
    """Sensor whose right camera stands at right_centre (mm), turned by Euler angles (deg) against the left one."""
    rotation = Rotation.from_euler("xyz", euler_deg, degrees=True).as_matrix().T
    return tri.StereoSensor(LEFT, right, rotation, -rotation @ np.asarray(right_centre, float))


SENSORS = {
    "baseline along u, parallel": sensor_of([80, 0, 0], [0, 0, 0]),
    "toed in": sensor_of([80, 1.5, 4], [0.4, -17, 0.8]),
    "right camera on the other side": sensor_of([-75, -2, 3], [-0.5, 16, -0.3]),
    "baseline rolled by 12 degrees": sensor_of([70, 15, 2], [3.5, -15, 1.0]),
    "right camera upside down": sensor_of([80, 0.5, 2], [0.3, -16, 179.0]),
}


@pytest.fixture(params=list(SENSORS), ids=lambda name: name.replace(" ", "-"))
def sensor(request):
    return SENSORS[request.param]


def cloud(seed=0, n=500):
    """Points (n, 3) mm in the volume that both cameras see."""
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(-20, 20, n), random.uniform(-50, 50, n), random.uniform(220, 290, n)])


def ideal(sensor, points):
    """Image coordinates at focal length 1, left (n, 2) and right (n, 2), by the definition of the pose."""
    right = points @ sensor.rotation.T + sensor.translation_mm
    return points[:, :2] / points[:, 2:], right[:, :2] / right[:, 2:]


def pixels(camera, rotation, translation, points):
    """Pixels (n, 2) by OpenCV."""
    vector = cv2.Rodrigues(np.asarray(rotation))[0]
    return cv2.projectPoints(points, vector, np.asarray(translation), camera.matrix, camera.distortion)[0].reshape(
        -1, 2
    )


def exact_matches(sensor, points):
    """What match_stripes would return for perfect partners, from the rectifying rotations alone."""
    r = tri.rectify(sensor)
    (left, right) = ideal(sensor, points)
    one = np.ones((len(points), 1))
    a, b = np.hstack([left, one]) @ r.rectified_from_left.T, np.hstack([right, one]) @ r.rectified_from_right.T
    return r, a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:]


# --- distortion


def test_distort_is_opencvs():
    points = cloud()
    u, v = tri.distort(LEFT, *(points[:, :2] / points[:, 2:]).T)
    assert np.allclose(np.column_stack([u, v]), pixels(LEFT, np.eye(3), np.zeros(3), points), atol=1e-9, rtol=0)


@given(st.lists(st.floats(-0.15, 0.15), min_size=5, max_size=5), st.integers(0, 2**32 - 1))
def test_undistort_undoes_distort(coefficients, seed):
    """To 1e-12 at focal length 1, for any lens within the strength of real ones (coefficients scaled: p small)."""
    camera = replace(LEFT, distortion=np.array(coefficients) * [1, 1, 0.01, 0.01, 1])
    x, y = np.random.default_rng(seed).uniform(-0.4, 0.4, (2, 50))
    back = tri.undistort(camera, *tri.distort(camera, x, y))
    assert np.abs(np.stack(back) - [x, y]).max() < 1e-12


def test_undistort_keeps_nan_and_shape():
    u = np.array([[100.0, np.nan], [300.0, 200.0]])
    v = np.array([[50.0, 60.0], [np.nan, 80.0]])
    x, y = tri.undistort(LEFT, u, v)
    assert x.shape == u.shape
    assert np.array_equal(np.isnan(x), [[False, True], [True, False]])
    assert np.array_equal(np.isnan(y), np.isnan(x))
    assert np.isnan(tri.undistort(LEFT, u * np.nan, v)[0]).all()


def test_undistort_refuses_a_lens_that_folds_the_image():
    # k1 = -3: the radius r (1 - 3 r^2) is largest at r = 1/3, where it is 0.22; there is nothing at 0.4.
    folding = replace(LEFT, distortion=np.array([-3.0, 0, 0, 0, 0]))
    with pytest.raises(AlgorithmFailed, match="distortion"), np.errstate(all="ignore"):
        tri.undistort(folding, np.array([LEFT.matrix[0, 2] + 0.4 * 1510.0]), np.array([381.0]))


def test_row_polynomials_are_the_exact_rectification(sensor):
    r = tri.rectify(sensor)
    table = tri.RowPolynomials(LEFT, r.rectified_from_left, ROWS, 30.0, 490.0)
    u = np.random.default_rng(3).uniform(30, 490, (4, ROWS))
    u[1, 5] = np.nan
    x, y = table(u)
    exact = tri.rotate_image(
        r.rectified_from_left, *tri.undistort(LEFT, u, np.broadcast_to(np.arange(ROWS, dtype=float), u.shape))
    )
    # Promised: 1e-11 between the nodes; 3e-11 leaves room for points that were not looked at.
    assert np.nanmax(np.abs(x - exact[0])) < 3e-11
    assert np.nanmax(np.abs(y - exact[1])) < 3e-11
    assert np.isnan(x[1, 5])
    assert np.isfinite(x[1, 6])


# --- rectification


def test_rectified_rows_are_epipolar_lines_and_the_baseline_is_x(sensor):
    r, left, right = exact_matches(sensor, cloud())
    assert np.abs(left[:, 1] - right[:, 1]).max() < 1e-14 * 10
    centre = r.rectified_from_left @ sensor.right_centre_mm
    assert np.allclose(centre, [np.linalg.norm(sensor.translation_mm), 0, 0], atol=1e-12)
    assert r.baseline_mm == pytest.approx(np.linalg.norm(sensor.translation_mm), abs=1e-12)
    for rotation in (r.rectified_from_left, r.rectified_from_right):
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-14)


def test_rectification_turns_the_left_camera_as_little_as_the_baseline_allows(sensor):
    """No direction square to the baseline is nearer to the left camera's axis than the rectified z axis."""
    r = tri.rectify(sensor)
    x_axis, _, z_axis = r.rectified_from_left
    turns = [Rotation.from_rotvec(a * x_axis).apply(z_axis)[2] for a in np.linspace(0, 2 * np.pi, 721)]
    assert z_axis[2] > 0
    assert z_axis[2] >= max(turns) - 1e-14


def test_two_cameras_in_one_place_are_refused():
    with pytest.raises(AlgorithmFailed, match="one place"):
        tri.rectify(sensor_of([0, 0, 0], [0, 5, 0]))


# --- three triangulations


def test_disparity_least_squares_and_general_position_give_the_true_point(sensor):
    """Eq. 11-13, eq. 8-10 and eq. 5 on exact matches: each within 1 nm of the truth, and so of each other."""
    points = cloud()
    r, left, right = exact_matches(sensor, points)
    matched = tri.MatchedStripe(left[None, :, 0], right[None, :, 0], left[None, :, 1])
    nanometre = 1e-6
    assert np.abs(tri.triangulate_disparity(r, matched)[0] - points).max() < nanometre
    assert np.abs(tri.triangulate_least_squares(sensor, r, matched)[0] - points).max() < nanometre
    (xl, yl), (xr, yr) = (p.T for p in ideal(sensor, points))
    from_x, from_y = tri.triangulate_general(xl, yl, xr, yr, sensor.rotation, sensor.translation_mm)
    assert np.abs(from_x - points[:, 2]).max() < nanometre
    # The expression along y divides by the part of the disparity that lies along y: by nothing if there is none.
    baseline_y = abs(sensor.translation_mm[1])
    if baseline_y > 1:
        parallax = np.abs(
            yr * (np.column_stack([xl, yl, np.ones_like(xl)]) @ sensor.rotation.T)[:, 2]
            - (np.column_stack([xl, yl, np.ones_like(xl)]) @ sensor.rotation.T)[:, 1]
        )
        well = parallax > 1e-3
        assert well.sum() > 20
        assert np.abs(from_y - points[:, 2])[well].max() < nanometre


def test_triangulation_is_opencvs(sensor):
    """cv2.triangulatePoints, through OpenCV's projection and undistortion of the same points."""
    points = cloud(n=100)
    p_left = np.eye(3, 4)
    p_right = np.hstack([sensor.rotation, sensor.translation_mm[:, None]])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    undistorted = []
    for camera, pose in ((sensor.left, p_left), (sensor.right, p_right)):
        px = pixels(camera, pose[:, :3], pose[:, 3], points)
        undistorted.append(
            cv2.undistortPoints(px[:, None], camera.matrix, camera.distortion, criteria=criteria).reshape(-1, 2)
        )
    theirs = cv2.triangulatePoints(p_left, p_right, undistorted[0].T, undistorted[1].T)
    theirs = (theirs[:3] / theirs[3]).T
    r = tri.rectify(sensor)
    rectified = [
        tri.rotate_image(m, *xy.T)
        for m, xy in zip((r.rectified_from_left, r.rectified_from_right), undistorted, strict=True)
    ]
    matched = tri.MatchedStripe(rectified[0][0][None], rectified[1][0][None], rectified[0][1][None])
    # OpenCV's homogeneous solution is in double precision, its undistortion iterates to 1e-15: 10 nm is their sum.
    assert np.abs(tri.triangulate_disparity(r, matched)[0] - theirs).max() < 1e-5
    assert np.abs(tri.triangulate_least_squares(sensor, r, matched)[0] - theirs).max() < 1e-5


def test_parallel_rays_and_missing_partners_give_no_point():
    r = tri.rectify(SENSORS["toed in"])
    matched = tri.MatchedStripe(np.array([[0.1, 0.1, np.nan]]), np.array([[0.1, np.nan, 0.05]]), np.zeros((1, 3)))
    assert np.isnan(tri.triangulate_disparity(r, matched)).all()
    assert np.isnan(tri.triangulate_least_squares(SENSORS["toed in"], r, matched)).all()


# --- matching of stripes


def stripe(sensor, lift_mm=0.0, step_mm=0.0, amplitude_mm=8.0):
    """A curved stripe seen by both cameras: u at every row of each image, the true points of the left rows, max |u''|.

    The curve lies in a tilted laser plane; step_mm raises the half of positive y, like the edge of a chamfer.
    """
    parts = []
    for low, high, lift in ((-75.0, 0.0, lift_mm), (0.0, 75.0, lift_mm + step_mm)):
        y = np.linspace(low, high, 8001)
        z = DEPTH + lift + amplitude_mm * np.sin(y / 9.0)
        points = np.column_stack([0.03 * y + 0.12 * (z - DEPTH), y, z])
        parts.append(
            [
                points,
                *(
                    pixels(c, rot, t, points)
                    for c, rot, t in (
                        (sensor.left, np.eye(3), np.zeros(3)),
                        (sensor.right, sensor.rotation, sensor.translation_mm),
                    )
                ),
            ]
        )
    rows = np.arange(ROWS, dtype=float)
    columns = [np.full(ROWS, np.nan), np.full(ROWS, np.nan)]
    truth, bend = np.full((ROWS, 3), np.nan), 0.0
    for points, *images in parts:
        for k, image in enumerate(images):
            u, v = image[:: np.sign(image[-1, 1] - image[0, 1]).astype(int)].T
            spline = CubicSpline(v, u)
            seen = (rows >= v[0]) & (rows <= v[-1])
            columns[k][seen] = spline(rows[seen])
            bend = max(bend, np.abs(spline(rows[seen], 2)).max() if k else 0.0)
            if k == 0:
                truth[seen] = CubicSpline(v, points)(rows[seen])
    return columns[0], columns[1], truth, bend


def test_matched_stripes_give_the_true_points_within_the_interpolation_error(sensor):
    """Linear interpolation between two rows errs by at most max|u''| / 8 px; depth by Z^2 / (B f) times that."""
    frames = [stripe(sensor, lift) for lift in (-6.0, 0.0, 5.0)]
    left, right, truth = (np.stack([f[k] for f in frames]) for k in range(3))
    r = tri.rectify(sensor)
    matched = tri.match_stripes(sensor, r, left, right, max_step_px=4.0)
    points = tri.triangulate_disparity(r, matched)
    seen = np.isfinite(points[..., 0])
    # Both cameras see the same 100 mm or so: nearly every left centre whose partner's row lies in the image is matched.
    assert seen.sum() > 0.85 * np.isfinite(left).sum()
    error = np.linalg.norm(points - truth, axis=-1)[seen]
    bend_px = max(f[3] for f in frames)
    nearest = 1490.0
    # The rays are up to 1.06 times longer than the depth, and cross the surface slantwise: 1.2 covers both.
    bound = 1.2 * bend_px / 8 * 275.0**2 / (r.baseline_mm * nearest)
    assert error.max() < bound
    assert error.max() > 0.05 * bound  # else the bound says nothing


def test_stripes_of_different_heights_match():
    sensor = SENSORS["toed in"]
    left, right, truth, _ = stripe(sensor)
    matched = tri.match_stripes(sensor, tri.rectify(sensor), left[None], right[None, :700], 4.0)
    points = tri.triangulate_disparity(tri.rectify(sensor), matched)[0]
    seen = np.isfinite(points[:, 0])
    assert seen.sum() > 600
    assert np.abs(points - truth)[seen].max() < 2e-3


def right_rows(sensor, truth):
    """Row of the right image, as a fraction, on which each true point lies."""
    return pixels(sensor.right, sensor.rotation, sensor.translation_mm, truth)[:, 1]


@pytest.mark.parametrize("name", ["toed in", "right camera upside down"])
def test_no_match_across_a_missing_row_and_all_others_stay(name):
    sensor = SENSORS[name]
    left, right, truth, _ = stripe(sensor)
    r = tri.rectify(sensor)
    whole = np.isfinite(tri.match_stripes(sensor, r, left[None], right[None], 4.0).x_right[0])
    missing = np.array([200, 201, 202, 400, 555])
    holed = right.copy()
    holed[missing] = np.nan
    matched = np.isfinite(tri.match_stripes(sensor, r, left[None], holed[None], 4.0).x_right[0])
    distance = np.abs(right_rows(sensor, truth)[:, None] - missing).min(axis=1)
    # 1e-3 of a row: the true row is known through splines only.
    assert not matched[whole & (distance < 1 - 1e-3)].any()
    assert matched[whole & (distance > 1 + 1e-3)].all()
    assert (whole & (distance < 1 - 1e-3)).sum() >= 6


def test_no_match_across_a_jump():
    sensor = SENSORS["toed in"]
    left, right, truth, _ = stripe(sensor, step_mm=6.0)
    r = tri.rectify(sensor)
    jump = np.flatnonzero(np.abs(np.diff(right)) > 4.0)
    assert jump.size == 1  # about 30 px
    matched = tri.match_stripes(sensor, r, left[None], right[None], 4.0)
    points = tri.triangulate_disparity(r, matched)[0]
    seen = np.isfinite(points[:, 0])
    row = right_rows(sensor, truth)
    assert not seen[(row > jump[0] + 1e-3) & (row < jump[0] + 1 - 1e-3)].any()
    assert np.abs(points - truth)[seen].max() < 2e-3  # no point hangs in the air between the two sides
    bridged = tri.match_stripes(sensor, r, left[None], right[None], 100.0)
    assert np.isfinite(bridged.x_right).sum() > seen.sum()  # it is max_step_px that kept them apart


def test_a_left_gap_stays_a_gap_and_empty_images_match_nothing():
    sensor = SENSORS["toed in"]
    left, right, _, _ = stripe(sensor)
    left[300:310] = np.nan
    r = tri.rectify(sensor)
    matched = tri.match_stripes(sensor, r, left[None], right[None], 4.0)
    assert np.isnan(matched.x_left[0, 300:310]).all()
    for a, b in ((left * np.nan, right), (left, right * np.nan)):
        assert np.isnan(tri.match_stripes(sensor, r, a[None], b[None], 4.0).x_right).all()


def test_reflections_outside_the_image_spoil_their_own_rows_only():
    """The format allows gross outliers, also outside the image; the lens model means nothing far out there."""
    sensor = SENSORS["toed in"]
    left, right, truth, _ = stripe(sensor)
    left, right, r = left[None].repeat(3, 0), right[None].repeat(3, 0), tri.rectify(sensor)
    clean = tri.triangulate_disparity(r, tri.match_stripes(sensor, r, left, right, 4.0))
    left[1, 350], right[2, 420], right[0, 500] = -9000.0, 60000.0, -700.0
    points = tri.triangulate_disparity(r, tri.match_stripes(sensor, r, left, right, 4.0))
    lost = np.isfinite(clean[..., 0]) & ~(np.abs(points - clean).max(axis=-1) < 1e-8)
    assert 1 <= lost.sum() <= 5  # the left one itself, and up to two matches beside each of the right ones
    assert np.nanmax(np.abs(points - truth)[~lost]) < 2e-3


# --- noise


@pytest.mark.parametrize(("white", "wide", "rows"), [(0.06, 0.0, 0.0), (0.06, 0.04, 3.0), (0.02, 0.05, 2.0)])
def test_stripe_noise_is_found_from_both_sides(white, wide, rows):
    """White noise plus noise of correlation exp(-d^2 / 2 rows^2): sigma and integral length, on a moving surface."""
    random = np.random.default_rng(17)
    frames, n = 98, 900
    u = 250 + 30 * np.sin(np.arange(n) / 70.0) + 2 * np.sin(np.arange(frames) / 98 * 2 * np.pi)[:, None]
    u = u + white * random.standard_normal((frames, n))
    if wide:
        kernel = np.exp(-((np.arange(-12, 13) / rows) ** 2))
        kernel /= np.sqrt((kernel**2).sum())
        u += wide * np.apply_along_axis(np.convolve, 1, random.standard_normal((frames, n + 24)), kernel, "valid")
    u[random.random(u.shape) < 0.002] += 30.0
    u[random.random(u.shape) < 0.01] = np.nan
    found = stripe_noise(u)
    sigma = np.hypot(white, wide)
    lags = np.arange(1, 40)
    correlation = wide**2 / sigma**2 * np.exp(-(lags**2) / (2 * rows**2)) if rows else np.zeros(39)
    length = 1 + 2 * correlation.sum()
    # 96 overlapping triples are worth about 96 / 1.94 independent ones (squared correlations 4/6 and 1/6 summed), each
    # of n / length values; the relative error of a standard deviation is 1 / sqrt(2 N).
    effective = 96 / 1.94 * n / (1 + 2 * (correlation**2).sum())
    assert found.sigma_px == pytest.approx(
        sigma, rel=3.3 / np.sqrt(2 * effective) + 0.005
    )  # 0.005: outliers near 5 sigma
    # Correlations under 0.03 are cut off: at most two lags' worth. Their noise is 1 / sqrt(effective) each.
    assert found.correlation_rows == pytest.approx(length, abs=0.12 + 2 * 3.3 * np.sqrt(8.0 / effective))


def test_stripe_noise_needs_three_frames_and_some_centres():
    u = np.random.default_rng(0).normal(size=(6, 200))
    assert stripe_noise(u[:2]) is None
    assert stripe_noise(u * np.nan) is None
    assert stripe_noise(u[:, :10]) is None
    assert stripe_noise(np.ones((6, 200))) == StripeNoise(0.0, 1.0)


def test_depth_uncertainty_two_sided(sensor):
    """Monte Carlo along each line of sight, whose obliqueness counts: 12 % here, where 2 % would be noticed."""
    random = np.random.default_rng(5)
    side = random.choice([-1.0, 1.0], 60)
    points = np.column_stack(
        [random.uniform(-20, 20, 60), side * random.uniform(95, 110, 60), random.uniform(205, 215, 60)]
    )
    r, left, right = exact_matches(sensor, points)
    matched = tri.MatchedStripe(left[None, :, 0], right[None, :, 0], left[None, :, 1])
    u_left, u_right = 0.08 / 1510, 0.05 / 1495
    claimed = tri.depth_uncertainty(r, matched, u_left, u_right)[0]
    noise = random.standard_normal((2, 200, 60))
    noisy = tri.MatchedStripe(
        left[None, :, 0] + u_left * noise[0],
        right[None, :, 0] + u_right * noise[1],
        np.repeat(left[None, :, 1], 200, 0),
    )
    error = tri.triangulate_disparity(r, noisy) - points
    sight = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert_pulls((error * sight).sum(axis=-1) / claimed)


def test_depth_uncertainty_of_matched_stripes_counts_the_averaging_of_two_rows():
    """Through match_stripes: the right abscissa is a mean of two rows: (1-w)^2 + w^2 of one centre's variance."""
    sensor = SENSORS["toed in"]
    left, right, _, _ = stripe(sensor)
    r, sigma, trials = tri.rectify(sensor), 0.05, 60
    random = np.random.default_rng(6)
    exact = tri.match_stripes(sensor, r, left[None], right[None], 4.0)
    truth = tri.triangulate_disparity(r, exact)[0]
    noisy = [u + sigma * random.standard_normal((trials, ROWS)) for u in (left, right)]
    matched = tri.match_stripes(sensor, r, *noisy, 4.0)
    points = tri.triangulate_disparity(r, matched)
    claimed = tri.depth_uncertainty(r, exact, sigma / 1510, sigma / 1495)[0]
    sight = truth / np.linalg.norm(truth, axis=1, keepdims=True)
    along = ((points - truth) * sight).sum(axis=-1)
    good = np.isfinite(along).all(axis=0)
    share = (along[:, good] / claimed[good]) ** 2
    # The stripe's slope against the epipolar lines adds its square; it is under 0.3 here.
    low, high = mean_square_interval(trials * 200)  # neighbouring rows share right centres: a third counts
    assert low < share.mean() < high * 1.09


@pytest.mark.parametrize("name", ["toed in", "right camera on the other side", "right camera upside down"])
def test_noise_pulls_of_matched_stripes_are_one_in_each_axis(name):
    """Within one scan with the true calibration: (x - truth) / u from 0.95 to 1.05 in x, y and z."""
    sensor = SENSORS[name]
    left, right, _, _ = stripe(sensor)
    r, sigma, trials = tri.rectify(sensor), 0.05, 120
    random = np.random.default_rng(8)
    exact = tri.match_stripes(sensor, r, left[None], right[None], 4.0)
    truth = tri.triangulate_disparity(r, exact)[0]
    noisy = [u + sigma * random.standard_normal((trials, ROWS)) for u in (left, right)]
    error = tri.triangulate_disparity(r, tri.match_stripes(sensor, r, *noisy, 4.0)) - truth
    u = np.sqrt(np.diagonal(tri.point_covariance(r, exact, sigma / 1510, sigma / 1495)[0], axis1=1, axis2=2))
    good = np.isfinite(error).all(axis=(0, 2))
    pulls = np.sqrt(np.mean((error[:, good] / u[good]) ** 2, axis=(0, 1)))
    assert good.sum() > 300
    assert np.all((pulls > 0.95) & (pulls < 1.05)), pulls


def test_point_covariance_two_sided_as_a_whole(sensor):
    """Mahalanobis distances of exact matches with noise on both abscissae: rank two, as rows are exact."""
    points = cloud(seed=3, n=60)
    r, left, right = exact_matches(sensor, points)
    matched = tri.MatchedStripe(left[None, :, 0], right[None, :, 0], left[None, :, 1])
    u_left, u_right = 0.08 / 1510, 0.05 / 1495
    covariance = tri.point_covariance(r, matched, u_left, u_right)[0]
    noise = np.random.default_rng(4).standard_normal((2, 100, 60))
    noisy = tri.MatchedStripe(matched.x_left + u_left * noise[0], matched.x_right + u_right * noise[1], matched.y)
    error = tri.triangulate_disparity(r, noisy) - points
    inverse = np.linalg.pinv(covariance, rcond=1e-10, hermitian=True)
    squares = np.einsum("tni,nij,tnj->tn", error, inverse, error)
    low, high = mean_square_interval(2 * squares.size)
    assert low < squares.mean() / 2 < high
    sight = points / np.linalg.norm(points, axis=1)[:, None]
    along = np.sqrt(np.einsum("ni,nij,nj->n", sight, covariance, sight))
    assert tri.depth_uncertainty(r, matched, u_left, u_right)[0] == pytest.approx(along, rel=0.12)
    for normal in np.random.default_rng(5).standard_normal((8, 3)):
        across = np.sqrt(np.einsum("i,nij,j->n", normal, covariance, normal))
        assert tri.off_plane_uncertainty(r, matched, u_left, u_right, normal)[0] == pytest.approx(across, rel=1e-9)


def test_a_laser_plane_as_a_fifth_row_lowers_the_noise_and_hides_no_bias():
    sensor = SENSORS["toed in"]
    random = np.random.default_rng(9)
    y, z = random.uniform(-50, 50, 400), random.uniform(225, 285, 400)
    normal = np.array([1.0, 0.05, -0.12])
    normal /= np.linalg.norm(normal)
    points = np.column_stack([(8.0 - normal[1] * y - normal[2] * z) / normal[0], y, z])
    r, left, right = exact_matches(sensor, points)
    u = (0.12 / 1510, 0.03 / 1495)
    noise = random.standard_normal((2, 200, 400))
    noisy = tri.MatchedStripe(
        left[:, 0] + u[0] * noise[0], right[:, 0] + u[1] * noise[1], np.tile(left[:, 1], (200, 1))
    )
    plain = tri.triangulate_disparity(r, noisy) - points
    best = tri.triangulate_optimal(r, noisy, *u, (normal, 8.0, 1e-4)) - points
    assert np.allclose(tri.triangulate_optimal(r, noisy, *u), plain + points, equal_nan=True)
    assert np.abs(best @ normal).max() < 2e-3
    assert best[..., 2].std() < 0.6 * plain[..., 2].std()  # the good camera and the plane say more than the pair
    # Against the closed form: the covariance conditioned on the plane.
    covariance = tri.point_covariance(r, tri.MatchedStripe(left[:, 0], right[:, 0], left[:, 1]), *u)
    gain = covariance @ normal / (np.einsum("i,nij,j->n", normal, covariance, normal) + 1e-8)[:, None]
    left_over = covariance - gain[:, :, None] * (covariance @ normal)[:, None, :]
    assert_pulls(best[..., 2] / np.sqrt(left_over[:, 2, 2]))
    assert abs(best[..., 2].mean()) < 4 * best[..., 2].std() / np.sqrt(best[..., 2].size) + 1e-3


def test_a_baseline_along_the_axis_is_refused():
    sensor = tri.StereoSensor(LEFT, RIGHT, np.eye(3), np.array([0.0, 0.0, -80.0]))
    with pytest.raises(AlgorithmFailed, match="epipole"):
        tri.rectify(sensor)
