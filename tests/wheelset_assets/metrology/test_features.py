"""Keypoints and descriptors against slow loops, known shapes, and values that PCL's unit tests publish.

Definitions differ between libraries; each function names the one that it implements, and is held against its owner: the
paper's against loops written from its text, PCL's against the published values, Open3D's against Open3D.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wheelset_assets.metrology import features


@pytest.fixture(scope="module")
def bun0(shared_data):
    """PCL's little cloud, its normals, and what PCL's unit tests expect of it."""
    folder = shared_data / "pcl-bun0"
    table = np.loadtxt(folder / "bun0.pcd", skiprows=11)
    expected = json.loads((folder / "pcl_expected.json").read_text())
    return table[:, :3], table[:, 3:6], expected


def published(expected, name):
    """Values (n,) and their tolerances (n,)."""
    (entries,) = expected[name].values()
    values = [entries[str(k)] for k in range(len(entries))]
    return np.array([v[0] for v in values]), np.array([v[1] for v in values])


# --- neighbourhoods and normals


@given(st.integers(2, 40), st.floats(0.05, 1.5), st.integers(0, 2**32 - 1))
def test_pairs_are_all_that_lie_within_the_radius(n, radius, seed):
    random = np.random.default_rng(seed)
    points = random.uniform(0, 1, (n, 3))
    queries = np.flatnonzero(random.random(n) < 0.5)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    expected = [(i, j) for i in range(n) for j in range(n) if i != j and distance[i, j] <= radius]
    found = features.neighbour_pairs(points, radius)
    assert list(zip(found.i, found.j, strict=True)) == expected
    some = features.neighbour_pairs(points, radius, queries)
    assert list(zip(some.i, some.j, strict=True)) == [pair for pair in expected if pair[0] in queries]
    assert found.difference == pytest.approx(points[found.j] - points[found.i], abs=1e-15)
    assert found.distance == pytest.approx([distance[pair] for pair in expected], abs=1e-15)


def test_points_in_one_place_are_no_pair():
    assert features.neighbour_pairs(np.zeros((3, 3)), 1.0).i.size == 0


def test_normals_of_a_plane_face_the_viewpoint():
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True)
    x, y = np.meshgrid(np.arange(12.0), np.arange(12.0))
    plane = np.column_stack([x.ravel(), y.ravel(), np.zeros(144)])
    for side in (1.0, -1.0):
        found = features.normals(turn.apply(plane), 2.1, turn.apply([5.0, 5.0, side * 300]))
        assert found == pytest.approx(np.tile(turn.apply([0, 0, side]), (144, 1)), abs=1e-9)


def test_normals_of_a_sphere_are_radial():
    random = np.random.default_rng(0)
    points = random.standard_normal((4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    found = features.normals(20 * points, 3.0, np.zeros(3))
    cosine = -(found * points).sum(axis=1)  # seen from the centre: inwards
    # About 22 random points in a cap of 8.6 degrees: its lopsided sampling tilts the plane by some degrees at most.
    assert np.degrees(np.arccos(cosine.min())) < 10
    assert np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1, 1)) ** 2).mean())) < 1.5


def test_points_with_under_three_neighbours_have_no_normal():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0], [50, 0, 0], [51, 0, 0], [50, 1, 0]])
    found = features.normals(points, 2.0, np.array([0, 0, 9.0]))
    assert np.isfinite(found[:4]).all()
    assert np.isnan(found[4:]).all()


# --- ISS


def slow_iss(points, radius, non_maximum_radius, gamma_21, gamma_32, min_neighbours, weighted):
    """Eq. 18-19 point by point, from the paper's text; unweighted, and a sum rather than a mean, it is PCL's."""
    third = np.zeros(len(points))
    for i, p in enumerate(points):
        difference = points - p
        distance = np.linalg.norm(difference, axis=1)
        near = np.flatnonzero((distance <= radius) & (distance > 0))
        if len(near) < min_neighbours:
            continue
        weight = 1 / distance[near] if weighted else np.ones(len(near))
        scatter = sum(w * np.outer(difference[j], difference[j]) for w, j in zip(weight, near, strict=True))
        first, second, smallest = np.linalg.eigvalsh(scatter / (weight.sum() if weighted else 1.0))[::-1]
        if second <= gamma_21 * first and 1e-12 * first < smallest <= gamma_32 * second:
            third[i] = smallest
    found = []
    for i, p in enumerate(points):
        near = np.linalg.norm(points - p, axis=1) <= non_maximum_radius
        if third[i] > 0 and third[i] >= third[near].max():
            found.append(i)
    return found


def test_the_slow_iss_without_weights_finds_pcls_published_keypoints(bun0):
    """Shows that thresholds and suppression of the oracle are the published ones: six of six."""
    points, _, expected = bun0
    iss = expected["iss_without_boundary"]
    resolution = iss["params"]["cloud_resolution"]
    found = slow_iss(points, 6 * resolution, 4 * resolution, 0.975, 0.975, 5, weighted=False)
    wanted = np.array(iss["keypoints_xyz_line"])[:, :3]
    assert len(found) == len(wanted) == 6
    gaps = np.linalg.norm(points[found][:, None] - wanted[None], axis=2).min(axis=0)
    assert gaps.max() <= iss["tolerance"]


def test_iss_keypoints_are_the_papers(bun0):
    points, _, _ = bun0
    resolution = 0.0058329
    for factor in (4, 6):
        found = features.iss_keypoints(points, factor * resolution, 4 * resolution, 0.975, 0.975)
        assert found.index.tolist() == slow_iss(points, factor * resolution, 4 * resolution, 0.975, 0.975, 5, True)
        assert found.index.size > 0


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 1.0), st.integers(1, 8))
def test_iss_keypoints_of_random_clouds_are_the_slow_ones(seed, gamma, least):
    points = np.random.default_rng(seed).uniform(0, 1, (40, 3)) * [1, 1, 0.3]
    found = features.iss_keypoints(points, 0.35, 0.25, gamma, 0.975, min_neighbours=least)
    assert found.index.tolist() == slow_iss(points, 0.35, 0.25, gamma, 0.975, least, True)


def test_the_corner_of_a_cube_is_its_keypoint():
    """Three faces meet at the origin; inside a face the first two eigenvalues are alike: no keypoint."""
    steps = np.arange(0.0, 15.0)
    a, b = (g.ravel() for g in np.meshgrid(steps, steps))
    zero = np.zeros(a.size)
    faces = [np.column_stack(c) for c in ((a, b, zero), (zero, a, b), (a, zero, b))]
    points = np.unique(np.concatenate(faces), axis=0)
    points = points + 0.01 * np.random.default_rng(1).standard_normal(points.shape)
    found = features.iss_keypoints(points, 4.0, 3.0, 0.975, 0.975)
    best = points[found.index[found.saliency.argmax()]]
    assert np.linalg.norm(best) < 4.0
    inner = points[found.index]
    inner = inner[(inner < 10).all(axis=1)]  # away from where the sampled faces end
    on_faces = np.sort(np.abs(inner), axis=1)[:, 1] > 4.2  # farther than the radius from every edge
    assert not on_faces.any()
    assert np.all(found.n_neighbours >= 5)


def test_a_flat_sheet_without_thickness_has_no_keypoint():
    x, y = np.meshgrid(np.arange(10.0), np.arange(10.0))
    sheet = np.column_stack([x.ravel(), y.ravel(), np.zeros(100)])
    assert features.iss_keypoints(sheet, 2.5, 2.0, 0.975, 0.975).index.size == 0


@pytest.mark.parametrize("factors", [(6, 4), (5, 3)])
def test_iss_keypoints_under_pcls_definition_are_its_published_ones(bun0, factors):
    points, _, expected = bun0
    iss = expected["iss_without_boundary"]
    resolution = iss["params"]["cloud_resolution"]
    radii = [f * resolution for f in factors]
    found = features.iss_keypoints(points, *radii, 0.975, 0.975, definition="pcl")
    assert found.index.tolist() == slow_iss(points, *radii, 0.975, 0.975, 5, weighted=False)
    if factors == (6, 4):
        gaps = np.linalg.norm(points[found.index][:, None] - np.array(iss["keypoints_xyz_line"])[None, :, :3], axis=2)
        assert len(found.index) == 6
        assert gaps.min(axis=0).max() <= iss["tolerance"]


@pytest.mark.parametrize("factors", [(6, 4), (4, 3), (5, 4)])
def test_iss_keypoints_under_open3ds_definition_are_open3ds(bun0, factors):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    points, _, _ = bun0
    radii = [f * 0.0058329 for f in factors]
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    theirs = np.asarray(open3d.geometry.keypoint.compute_iss_keypoints(cloud, *radii, 0.975, 0.975, 5).points)
    ours = points[features.iss_keypoints(points, *radii, 0.975, 0.975, definition="open3d").index]
    assert {tuple(p) for p in ours} == {tuple(p) for p in theirs}
    assert len(theirs) > 3


def test_nearest_normals_are_pcls_published_ones(bun0):
    """In PCL's single-pass arithmetic to 1e-5 and better; exact sums differ from it by its rounding, 0.02 degrees."""
    points, normal, _ = bun0
    assert np.abs(features.nearest_normals(points, 10, np.zeros(3), precision="pcl") - normal).max() < 2e-6
    exact = features.nearest_normals(points, 10, np.zeros(3))
    assert 1e-5 < np.abs(exact - normal).max() < 4e-4


# --- pair features


def slow_pair(n_i, n_j, difference):
    """Eq. 20 in its mended form, component by component."""
    d = math.sqrt(sum(c * c for c in difference))
    line = [c / d for c in difference]
    dot = lambda a, b: sum(x * y for x, y in zip(a, b, strict=True))  # noqa: E731
    cross = lambda a, b: [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]  # noqa: E731
    source, target = n_i, n_j
    if math.acos(abs(dot(n_i, line))) > math.acos(abs(dot(n_j, line))):
        source, target, line = n_j, n_i, [-c for c in line]
    v = cross(line, source)
    length = math.sqrt(dot(v, v))
    v = [c / length for c in v]
    w = cross(source, v)
    return dot(v, target), dot(source, line), math.atan2(dot(w, target), dot(source, target))


def random_units(seed, n=60):
    """Three sets of independent unit vectors (n, 3): no ties, as in measured data."""
    v = np.random.default_rng(seed).standard_normal((3, n, 3))
    return v / np.linalg.norm(v, axis=2, keepdims=True)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100))
def test_pair_features_are_the_slow_ones(seed, distance):
    n_i, n_j, line = random_units(seed)
    found = np.array(features.pair_features(n_i, n_j, distance * line, np.full(60, distance))).T
    for row, a, b, d in zip(found, n_i, n_j, distance * line, strict=True):
        assert row == pytest.approx(slow_pair(a, b, d), abs=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 3.1))
def test_pair_features_do_not_feel_a_rotation_or_the_order_of_the_pair(seed, angle):
    n_i, n_j, line = random_units(seed)
    one = np.ones(60)
    base = np.array(features.pair_features(n_i, n_j, line, one))
    turn = Rotation.from_rotvec([0.3 * angle, -0.8 * angle, 0.5 * angle])
    turned = features.pair_features(turn.apply(n_i), turn.apply(n_j), turn.apply(line), one)
    assert np.array(turned) == pytest.approx(base, abs=1e-9)
    swapped = features.pair_features(n_j, n_i, -line, one)
    assert np.array(swapped) == pytest.approx(base, abs=1e-9)


def test_a_normal_along_the_line_gives_no_nan():
    up = np.array([[0.0, 0, 1]])
    found = features.pair_features(up, up, up, np.array([1.0]))
    assert np.isfinite(np.array(found)).all()


# --- histograms


def test_spfh_is_pcls_published_one(bun0):
    """Point 0 against all others: theta, alpha and phi are PCL's f1, f2 and f3, bin by bin."""
    points, normal, expected = bun0
    histogram, _ = features.spfh(points, normal, 10.0, np.array([0]))
    for k, name in enumerate(("spfh_f1", "spfh_f2", "spfh_f3")):
        values, tolerance = published(expected, name)
        assert np.all(np.abs(histogram[0, 11 * k : 11 * (k + 1)] - values) <= tolerance + 1e-5)


def in_percent(histogram):
    thirds = histogram.reshape(3, 11)
    return (100 * thirds / thirds.sum(axis=1, keepdims=True)).ravel()


def test_weighted_spfh_give_pcls_published_fpfh(bun0):
    """From our SPFH of every point: its sums with weights 1/rank, and with 1/d^2, without the point's own histogram."""
    points, normal, expected = bun0
    histogram, _ = features.spfh(points, normal, 10.0, np.arange(len(points)))
    for name, weight in (
        ("fpfh_weighted_rank_dists", 1 / np.arange(1, len(points))),
        ("fpfh0", 1 / ((points[1:] - points[0]) ** 2).sum(axis=1)),
    ):
        values, tolerance = published(expected, name)
        assert np.all(np.abs(in_percent(weight @ histogram[1:]) - values) <= tolerance)


def test_fpfh_is_the_points_own_histogram_and_the_weighted_mean_of_its_neighbours(bun0):
    """Eq. 21 in its mended form, written out; and it is not PCL's."""
    points, normal, expected = bun0
    radius, keypoints = 0.03, np.array([5, 100, 396])
    simple, _ = features.spfh(points, normal, radius, np.arange(len(points)))
    found = features.fpfh(points, normal, radius, keypoints)
    for row, i in zip(found, keypoints, strict=True):
        distance = np.linalg.norm(points - points[i], axis=1)
        near = np.flatnonzero((distance <= radius) & (distance > 0))
        total = simple[i] + (simple[near] / distance[near, None]).mean(axis=0)
        assert row == pytest.approx(in_percent(total), abs=1e-9)
    whole = features.fpfh(points, normal, 10.0, np.array([0]))[0]
    assert np.abs(whole - published(expected, "fpfh0")[0]).max() > 0.05


def test_fpfh_under_pcls_definition_is_the_published_one(bun0):
    points, normal, expected = bun0
    values, tolerance = published(expected, "fpfh0")
    found = features.fpfh(points, normal, 10.0, np.array([0]), definition="pcl")[0]
    assert np.all(np.abs(found - values) <= tolerance)


def test_fpfh_under_open3ds_definition_is_open3ds(bun0):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    points, normal, _ = bun0
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normal)
    search = open3d.geometry.KDTreeSearchParamRadius(0.03)
    theirs = open3d.pipelines.registration.compute_fpfh_feature(cloud, search).data.T
    assert features.fpfh(points, normal, 0.03, np.arange(397), definition="open3d") == pytest.approx(theirs, abs=1e-9)


@pytest.mark.parametrize("definition", ["paper", "pcl", "open3d"])
def test_fpfh_of_all_points_at_several_radii_are_those_of_each(bun0, definition):
    points, normal, _ = bun0
    for radius, found in zip(
        (0.02, 0.03), features.fpfh_of_all(points, normal, (0.02, 0.03), definition=definition), strict=True
    ):
        alone = features.fpfh(points, normal, radius, np.arange(397), definition=definition)
        # A pair whose normals make equal angles with its line has no first member: rounding decides, a bin at most moves.
        assert np.abs(found - alone).max(axis=1).mean() < 0.4
        assert np.median(np.abs(found - alone)) < 1e-9


def test_pairs_that_are_at_hand_give_the_same_as_pairs_that_are_found_anew(bun0):
    points, normal, _ = bun0
    pairs, some = features.neighbour_pairs(points, 0.05), np.arange(0, 397, 9)
    shared = features.fpfh(points, normal, 0.03, some, pairs=pairs.within(0.03))
    assert shared == pytest.approx(features.fpfh(points, normal, 0.03, some), abs=1e-12)
    origin = np.zeros(3)
    assert np.array_equal(
        features.normals(points, 0.02, origin, pairs.within(0.02)), features.normals(points, 0.02, origin)
    )
    for definition in ("paper", "pcl", "open3d"):
        one = features.iss_keypoints(points, 0.03, 0.02, 0.975, 0.975, definition=definition, pairs=pairs)
        two = features.iss_keypoints(points, 0.03, 0.02, 0.975, 0.975, definition=definition)
        assert one.index.tolist() == two.index.tolist()


def test_every_third_of_every_histogram_sums_to_one_hundred(bun0):
    points, normal, _ = bun0
    for radius in (0.02, 0.05):
        found = features.fpfh(points, normal, radius, np.arange(0, 397, 7))
        assert found.reshape(-1, 3, 11).sum(axis=2) == pytest.approx(100.0)
        assert found.min() >= 0
        simple, _ = features.spfh(points, normal, radius, np.arange(0, 397, 7))
        assert simple.reshape(-1, 3, 11).sum(axis=2) == pytest.approx(100.0)


def test_descriptors_do_not_feel_a_rigid_motion(bun0):
    points, normal, _ = bun0
    turn = Rotation.from_euler("xyz", [30, 70, -110], degrees=True)
    base = features.fpfh(points, normal, 0.03, np.arange(20))
    moved = features.fpfh(turn.apply(points) + np.array([1, -2, 3]), turn.apply(normal), 0.03, np.arange(20))
    # Rounding lets single pairs of hundreds change their bin.
    assert np.abs(moved - base).max() < 1.0
    assert np.median(np.abs(moved - base)) < 1e-6


def test_no_keypoints_have_no_descriptors_and_unknown_normals_do_not_count(bun0):
    points, normal, _ = bun0
    assert features.fpfh(points, normal, 0.03, np.empty(0, np.int64)).shape == (0, 33)
    holed = normal.copy()
    holed[50:] = np.nan
    found, pairs = features.spfh(points, holed, 10.0, np.array([0]))
    assert set(pairs.j) <= set(range(50))
    assert found.reshape(3, 11).sum(axis=1) == pytest.approx(100.0)
