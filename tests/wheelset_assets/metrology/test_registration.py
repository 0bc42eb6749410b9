"""Registration against scipy, PCL's published pose, and truth: what two profiles tell of each other, and what not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nominal_profiles import by_arc_length, s1002
from scipy.signal import lfilter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from two_sided import assert_pulls, assert_unbiased

from wheelset_assets.metrology import registration as reg
from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.revolution import RowNoise, meridian_motion
from wheelset_assets.quality import AlgorithmFailed

SETTINGS = reg.IcpSettings(
    prior_translation_mm=2.8, prior_rotation_rad=np.radians(1.4), max_iterations=60, convergence_mm=1e-5,
    max_pair_mm=6.0, min_pairs=30, form_floor_mm=1e-3, constrained_ratio=0.1,
)  # fmt: skip

# --- pose of paired points


@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.floats(0.0, 1.0))
def test_rigid_from_pairs_is_scipys(seed, n, noise):
    random = np.random.default_rng(seed)
    source = random.normal(size=(n, 3)) * [10, 5, 2]
    turn = Rotation.random(rng=random)
    target = turn.apply(source) + random.normal(size=3) + noise * random.normal(size=(n, 3))
    found = reg.rigid_from_pairs(source, target)
    theirs, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    assert found[:3, :3] == pytest.approx(theirs.as_matrix(), abs=1e-6)  # nearly degenerate triples lose digits
    assert found[:3, 3] == pytest.approx(target.mean(axis=0) - theirs.apply(source.mean(axis=0)), abs=1e-5)


@pytest.mark.parametrize("flat", [(1, 1, 0), (1, 0, 0), (1, 1, 1e-9)])
def test_no_reflection_from_plane_or_degenerate_points(flat):
    """Points in a plane fit their mirror image as well; the answer is still a rotation that fits."""
    random = np.random.default_rng(0)
    for _ in range(20):
        source = random.normal(size=(12, 3)) * flat
        turn = Rotation.random(rng=random)
        found = reg.rigid_from_pairs(source, turn.apply(source))
        assert np.linalg.det(found[:3, :3]) == pytest.approx(1, abs=1e-9)
        assert rigid.apply(found, source) == pytest.approx(turn.apply(source), abs=1e-7)


def test_a_mirror_image_is_met_by_the_best_rotation():
    """Eq. 24 as printed, U V', would return the reflection itself."""
    source = np.random.default_rng(1).normal(size=(30, 3))
    found = reg.rigid_from_pairs(source, source * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1, abs=1e-12)
    theirs, _ = Rotation.align_vectors((source - source.mean(0)) * [1, 1, -1], source - source.mean(0))
    assert found[:3, :3] == pytest.approx(theirs.as_matrix(), abs=1e-9)


def test_the_papers_matrix_is_40_degrees_about_y_in_row_form():
    """Points moved as row vectors by the matrix that the paper prints; it is orthonormal to its two digits only."""
    printed = np.array([[0.76, 0, 0.65, 0], [0, 1, 0, 0], [-0.647, 0, 0.76, 0], [69, 0, -34, 1]])
    source = np.random.default_rng(2).normal(size=(200, 3)) * 30
    target = np.column_stack([source, np.ones(200)]) @ printed
    found = reg.rigid_from_pairs(source, target[:, :3])
    vector = np.degrees(rigid.vector_from_rotation(found[:3, :3]))
    assert vector == pytest.approx([0, -40.4, 0], abs=0.1)
    assert found[:3, 3] == pytest.approx([69, 0, -34], abs=0.1)


def test_icp_over_rigid_from_pairs_gives_pcls_published_pose(shared_data):
    """bun0 onto bun4, nearest points within 0.05, 50 iterations: PCL's unit test gives the pose to 1e-3."""
    folder = shared_data / "pcl-bun0"
    source = np.loadtxt(folder / "bun0.pcd", skiprows=11)[:, :3]
    target = np.loadtxt(folder / "bun4.pcd", skiprows=10)[:, :3]
    published = json.loads((folder / "pcl_registration_expected.json").read_text())["icp_p2p"]
    tree, pose = cKDTree(target), np.eye(4)
    for _ in range(published["max_iterations"]):
        moved = rigid.apply(pose, source)
        distance, nearest = tree.query(moved)
        near = distance <= published["max_correspondence_distance"]
        pose = reg.rigid_from_pairs(moved[near], target[nearest[near]]) @ pose
    assert np.abs(pose - published["T"]).max() <= published["tolerance"]


# --- matches


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12))
def test_mutual_matches_are_each_others_nearest_among_the_allowed(seed, n, m):
    random = np.random.default_rng(seed)
    a, b, allowed = random.normal(size=(n, 5)), random.normal(size=(m, 5)), random.random((n, m)) < 0.6
    distance = np.where(allowed, np.linalg.norm(a[:, None] - b[None], axis=2), np.inf)
    expected = [
        (i, j)
        for i in range(n)
        for j in range(m)
        if np.isfinite(distance[i, j]) and distance[i].min() == distance[i, j] == distance[:, j].min()
    ]
    i, j = reg.mutual_matches(a, b, allowed)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == expected


COARSE = {"max_rotation_rad": np.radians(3), "max_shift_mm": 6.0, "inlier_mm": 1.0, "trials": 200, "seed": 1}


def planar(rotation, shift, points):
    c, s = np.cos(rotation), np.sin(rotation)
    return points @ np.array([[c, -s], [s, c]]).T + shift


def test_coarse_pose_survives_sixty_per_cent_of_wrong_matches():
    """Forty trials of 20 matches, 12 of them wrong within the search radius; keypoints known to 0.2 mm."""
    errors = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        source = random.uniform(-40, 40, (20, 2))
        rotation, shift = np.radians(random.uniform(-1.5, 1.5)), random.uniform(-3, 3, 2)
        target = planar(rotation, shift, source) + 0.2 * random.normal(size=(20, 2))
        wrong = random.permutation(20)[:12]
        target[wrong] += random.uniform(2.5, 8, (12, 1)) * random.choice([-1, 1], (12, 2))
        found = reg.coarse_meridian_pose(source, target, **COARSE)
        assert found is not None
        assert found.n_inliers >= 7
        errors.append([found.rotation_rad - rotation, *(found.shift_mm - shift)])
    # Eight matches of 0.2 mm over +-23 mm: 0.07 mm and 3 mrad; five standard deviations, for a few near-wrong inliers.
    assert np.abs(np.array(errors)[:, 0]).max() < 5 * 0.2 / (23 * np.sqrt(8))
    assert np.abs(np.array(errors)[:, 1:]).max() < 5 * 0.2 / np.sqrt(8)


def test_coarse_pose_beyond_the_tolerance_of_the_nominal_one_is_no_pose():
    random = np.random.default_rng(3)
    source = random.uniform(-40, 40, (15, 2))
    assert reg.coarse_meridian_pose(source, planar(0.0, np.array([9.0, 0]), source), **COARSE) is None
    assert reg.coarse_meridian_pose(source, planar(np.radians(8), np.zeros(2), source), **COARSE) is None
    inside = reg.coarse_meridian_pose(source, planar(np.radians(2), np.array([1.0, -2]), source), **COARSE)
    assert inside is not None
    assert inside.rotation_rad == pytest.approx(np.radians(2), abs=1e-9)
    assert inside.shift_mm == pytest.approx([1, -2], abs=1e-9)


def test_coarse_pose_needs_three_matches_that_agree():
    points = np.array([[0.0, 0], [20, 5]])
    assert reg.coarse_meridian_pose(points, points, **COARSE) is None
    assert reg.coarse_meridian_pose(points[:1], points[:1], **COARSE) is None


def test_coarse_pose_is_the_same_for_the_same_seed():
    random = np.random.default_rng(4)
    source, target = random.uniform(-40, 40, (2, 30, 2))
    first, again = (reg.coarse_meridian_pose(source, target, **{**COARSE, "inlier_mm": 20.0}) for _ in range(2))
    assert (first is None and again is None) or np.array_equal(first.shift_mm, again.shift_mm)


# --- distances from a curve


@pytest.mark.parametrize("radius", [14.0, 40.0, 460.0])
@pytest.mark.parametrize("offset_mm", [0.0, 0.05, -0.05])
def test_distance_from_an_arc_has_no_sagitta(radius, offset_mm):
    """A local line would be short by 1.5^2 / (2 R) at its ends, 12 um in the mean at 14 mm; a quadratic by 0.3 um."""
    angle = np.arange(-0.9, 0.9, 0.12 / radius) if radius < 100 else np.arange(-0.09, 0.09, 0.12 / radius)
    curve = radius * np.column_stack([np.sin(angle), np.cos(angle)])
    between = angle[40:-40:7] + 0.04 / radius
    ring = np.column_stack([np.sin(between), np.cos(between)])
    found = reg.project_on_curve((radius + offset_mm) * ring, curve)
    assert found.valid.all()
    # The curve runs to the right over the top of the circle, so its left is outside.
    assert np.abs(found.distance_mm - offset_mm).max() < 3e-4
    assert found.normal == pytest.approx(ring, abs=5e-3)
    assert np.linalg.norm(found.normal, axis=1) == pytest.approx(1, abs=1e-12)


def test_a_noisy_curve_is_averaged_over_the_window():
    """About twelve of 25 points count: the foot is known three times better than a point, and not thirty times."""
    random = np.random.default_rng(5)
    x = np.arange(0, 60, 0.12)
    curve = np.column_stack([x, 0.01 * random.standard_normal(x.size)])
    points = np.column_stack([np.arange(3, 57, 3.1), np.zeros(18)])
    spread = reg.project_on_curve(points, curve).distance_mm.std()
    assert 0.001 < spread < 0.006


def test_beyond_the_end_and_in_a_gap_there_is_no_foot():
    x = np.concatenate([np.arange(0, 10, 0.1), np.arange(20, 30, 0.1)])
    curve = np.column_stack([x, 0 * x])
    places = [-1.0, -0.2, 0.5, 9.5, 10.4, 15.0, 19.6, 20.5, 29.5, 31.0]
    found = reg.project_on_curve(np.column_stack([places, np.full(10, 0.3)]), curve)
    assert found.valid.tolist() == [False, False, True, True, False, False, False, True, True, False]
    assert found.distance_mm[found.valid] == pytest.approx(0.3, abs=1e-9)
    assert found.nearest_mm[5] > 4.9


# --- registration of two meridians


def two_views(random, *, sigma=0.002, correlation=0.0, target=(-69.0, 5.0), source=(-38.0, 60.0), height=s1002):
    """Profiles (lateral, radial) of one wheel as two sensors see them, the second one out of place by a known motion.

    Noise along the normal, first-order autoregressive along the rows; different places of the rows. Returns the source,
    the target, the true motion and the direction of the meridian.
    """
    psi = random.uniform(60, 120)
    views = []
    for low, high in (target, source):
        view = by_arc_length(height, low + random.uniform(0, 0.1), high, 0.2)
        tangent = np.gradient(view, axis=0)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1, keepdims=True)
        noise = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], random.standard_normal(len(view) + 30))[30:]
        views.append(view + sigma * noise[:, None] * normal + [700.0, 460.0])
    motion = meridian_motion(psi, (720.0, 455.0), np.radians(random.uniform(-0.8, 0.8)), *random.uniform(-1.2, 1.2, 2))
    c, s = np.cos(np.radians(psi)), np.sin(np.radians(psi))
    there, seen = np.array([0, c, s]), views[1]
    moved = rigid.apply(rigid.inverse(motion), seen[:, :1] * [1, 0, 0] + seen[:, 1:] * there)
    return np.column_stack([moved[:, 0], moved[:, 1:] @ [c, s]]), views[0], motion, psi


def meridian_offsets(motion, centre, psi):
    """Rotation in the meridian plane (rad), lateral and radial shift (mm) of the centre under a motion."""
    radial = np.array([0, np.cos(np.radians(psi)), np.sin(np.radians(psi))])
    step = rigid.apply(motion, centre) - centre
    return rigid.vector_from_rotation(motion[:3, :3]) @ np.cross([1.0, 0, 0], radial), step[0], step @ radial


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_meridian_motions_two_sided(correlation):
    """Sixty pairs of views: rotation, lateral and radial pulls, each by itself; three directions constrained each time."""
    pulls = []
    for seed in range(60):
        source, target, motion, psi = two_views(np.random.default_rng(seed), correlation=correlation)
        found = reg.register_meridians(source, target, psi, np.eye(4), SETTINGS)
        truth = meridian_offsets(motion, found.centre_mm, psi)
        estimate = (found.rotation_rad, found.lateral_mm, found.radial_mm)
        u = (found.u_rotation_rad, found.u_lateral_mm, found.u_radial_mm)
        pulls.append([(e - t) / w for e, t, w in zip(estimate, truth, u, strict=True)])
        assert found.converged
        assert found.n_constrained == 3
        assert np.array(estimate) == pytest.approx(meridian_offsets(found.motion, found.centre_mm, psi), abs=1e-9)
    for column in np.array(pulls).T:
        assert_pulls(column)
        assert_unbiased(column / np.sqrt((column**2).mean()))


def test_noise_that_is_long_beside_the_overlap_is_claimed_from_the_rows_own():
    """Noise of nineteen rows' integral length: the fit takes so much of it that the residuals do not tell it any more."""
    told, pulls, sigma = [], [], 0.002
    for seed in range(60):
        source, target, motion, psi = two_views(np.random.default_rng(seed), sigma=sigma, correlation=0.9)
        noise = []
        for view in (source, target):
            tangent = np.gradient(view, axis=0)
            tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
            noise.append(RowNoise(sigma * np.column_stack([-tangent[:, 1], tangent[:, 0]]), 19.0))
        without = reg.register_meridians(source, target, psi, np.eye(4), SETTINGS)
        found = reg.register_meridians(source, target, psi, np.eye(4), SETTINGS, (noise[0], noise[1]))
        assert np.array_equal(found.motion, without.motion)
        truth = meridian_offsets(motion, found.centre_mm, psi)
        error = np.array([found.rotation_rad, found.lateral_mm, found.radial_mm]) - truth
        pulls.append(error / (found.u_rotation_rad, found.u_lateral_mm, found.u_radial_mm))
        told.append(error / (without.u_rotation_rad, without.u_lateral_mm, without.u_radial_mm))
    for column in np.array(pulls).T:
        assert_pulls(column, overclaim=1.1)
    assert (np.sqrt(np.mean(np.square(told), axis=0)) > 1.2).all()


def test_the_three_silent_directions_stay_where_the_nominal_pose_holds_them():
    """A slide along the turn, a turn about the axle and one about the radial direction: of those nothing is claimed."""
    source, target, _, psi = two_views(np.random.default_rng(7))
    found = reg.register_meridians(source, target, psi, np.eye(4), SETTINGS)
    radial = np.array([0, np.cos(np.radians(psi)), np.sin(np.radians(psi))])
    around = np.cross([1.0, 0, 0], radial)
    turn = rigid.vector_from_rotation(found.motion[:3, :3])
    step = rigid.apply(found.motion, found.centre_mm) - found.centre_mm
    assert abs(turn[0]) < 1e-4
    assert abs(turn @ radial) < 1e-4
    assert abs(step @ around) < 1e-3
    prior = [SETTINGS.prior_rotation_rad] * 3 + [SETTINGS.prior_translation_mm] * 3
    u = np.sqrt(np.diag(found.covariance))
    for axis, limit in (([1, 0, 0, 0, 0, 0], prior[0]), ([0, 0, 0, 0, *around[1:]], prior[3])):
        assert np.sqrt(np.array(axis) @ found.covariance @ axis) > 0.5 * limit
    assert np.all(u <= np.array(prior) * (1 + 1e-9))


def test_a_straight_tread_alone_constrains_fewer_than_three():
    """A cone tells height and tilt; along itself it slides freely, and the lateral uncertainty covers that."""
    for seed in range(6):
        source, target, motion, psi = two_views(
            np.random.default_rng(seed), target=(-20.0, 40.0), source=(0.0, 60.0), height=lambda s: -0.05 * s
        )
        found = reg.register_meridians(source, target, psi, np.eye(4), SETTINGS)
        truth = meridian_offsets(motion, found.centre_mm, psi)
        assert found.n_constrained == 2
        assert found.u_lateral_mm > 0.25 * SETTINGS.prior_translation_mm
        assert abs(found.lateral_mm - truth[1]) < 3 * found.u_lateral_mm
        # What stays open along the cone shows in the radial place as a twentieth of it, and no more.
        across = (found.radial_mm - truth[2]) + 0.05 * (found.lateral_mm - truth[1])
        assert abs(across) < 0.01
        assert 0.02 * found.u_lateral_mm < found.u_radial_mm < 0.1 * found.u_lateral_mm


def test_the_uncertainty_follows_the_noise():
    """Information and covariance belong together, and four times the noise is four times the uncertainty."""
    results = []
    for sigma in (0.002, 0.008):
        source, target, _, psi = two_views(np.random.default_rng(8), sigma=sigma)
        found = reg.register_meridians(source, target, psi, np.eye(4), SETTINGS)
        assert found.information == pytest.approx(found.information.T, rel=1e-9)
        # In the plane of the meridian the prior is a millionth: the block of the inverse is that of the covariance.
        radial = np.array([0, np.cos(np.radians(psi)), np.sin(np.radians(psi))])
        plane = np.zeros((6, 3))
        plane[:3, 0], plane[3, 1], plane[3:, 2] = np.cross([1.0, 0, 0], radial), 1.0, radial
        block = np.linalg.inv(plane.T @ found.information @ plane)
        assert plane.T @ found.covariance @ plane == pytest.approx(block, rel=0.02)
        # A noisy curve adds its own share to the point's: between one and one and a half sigma.
        assert 1.0 < found.rmse_mm / sigma < 1.5
        results.append(found.u_radial_mm)
    assert results[1] / results[0] == pytest.approx(4.0, rel=0.35)


def test_outliers_and_parts_that_only_one_sensor_sees_do_not_pull():
    random = np.random.default_rng(9)
    source, target, motion, psi = two_views(random)
    source[random.permutation(len(source))[:20]] += random.uniform(0.3, 3, (20, 2))
    found = reg.register_meridians(source, target, psi, np.eye(4), SETTINGS)
    truth = meridian_offsets(motion, found.centre_mm, psi)
    assert found.lateral_mm == pytest.approx(truth[1], abs=5 * found.u_lateral_mm)
    assert found.radial_mm == pytest.approx(truth[2], abs=5 * found.u_radial_mm)
    assert 0.3 < found.fitness < 0.6  # the source reaches 55 mm beyond the target's end


def test_profiles_without_overlap_are_refused_with_the_number_of_pairs():
    source, target, _, psi = two_views(np.random.default_rng(10), target=(-69.0, -45.0), source=(0.0, 60.0))
    with pytest.raises(AlgorithmFailed, match="too few points") as failure:
        reg.register_meridians(source, target, psi, np.eye(4), SETTINGS)
    assert failure.value.facts["required"] == 30


@pytest.mark.parametrize("n", [0, 1, 20])
def test_profiles_of_a_few_points_are_refused(n):
    source, target, _, psi = two_views(np.random.default_rng(10))
    for pair in ((source[:n], target), (source, target[:n])):
        with pytest.raises(AlgorithmFailed, match="too few rows"):
            reg.register_meridians(*pair, psi, np.eye(4), SETTINGS)
