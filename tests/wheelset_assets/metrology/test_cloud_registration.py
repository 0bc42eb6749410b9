"""Clouds of any origin: the bunny's published pose beside Open3D and small_gicp, and surfaces that leave directions open."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from wheelset_assets.metrology import global_registration as glob
from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.cloud_registration import refine
from wheelset_assets.metrology.surface import oriented_normals, size_for, spacing, surface, voxel_thinned
from wheelset_assets.quality import AlgorithmFailed


@pytest.fixture(scope="module")
def bunny(shared_data):
    """Two scans (n, 3) in metres, 045 and 000, and the published pose of the first on the second."""
    poses = {}
    for line in (shared_data / "bunny" / "bun.conf").read_text().splitlines():
        fields = line.split()
        if fields and fields[0] == "bmesh":
            t, q = np.array(fields[2:5], float), np.array(fields[5:], float)
            poses[fields[1][:6]] = rigid.transform(Rotation.from_quat(q).as_matrix().T, t)
    clouds = []
    for name in ("bun045", "bun000"):
        lines = (shared_data / "bunny" / f"{name}.ply").read_text().splitlines()
        n = next(int(x.split()[2]) for x in lines if x.startswith("element vertex"))
        head = lines.index("end_header") + 1
        clouds.append(np.array([x.split()[:3] for x in lines[head : head + n]], float))
    return clouds[0], clouds[1], rigid.inverse(poses["bun000"]) @ poses["bun045"]


def displacement(pose, truth, points):
    """Root mean square distance of the points (n, 3) under two poses."""
    return float(np.sqrt(((rigid.apply(pose, points) - rigid.apply(truth, points)) ** 2).sum(axis=1).mean()))


def thrown(seed, scale):
    """An arbitrary pose."""
    random = np.random.default_rng(seed)
    return rigid.transform(Rotation.random(rng=random).as_matrix(), scale * random.standard_normal(3))


# --- the bunny


@pytest.mark.parametrize("seed", [0, 1])
def test_the_bunny_from_anywhere_is_as_near_to_the_published_pose_as_the_better_library(bunny, seed):
    """Both libraries start from our coarse pose, at their usual settings: 1 mm voxels, pairs up to 2 mm."""
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    import small_gicp

    source, target, published = bunny
    throw = thrown(seed, 0.3)
    thrown_source, truth = rigid.apply(throw, source), published @ rigid.inverse(throw)
    found = glob.register_clouds(thrown_source, target)
    start = found.start.target_from_source
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p)) for p in (thrown_source, target)]
    thin = [c.voxel_down_sample(0.001) for c in clouds]
    thin[1].estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(0.002, 30))
    icp = open3d.pipelines.registration
    plane = icp.registration_icp(
        *thin, 0.002, start, icp.TransformationEstimationPointToPlane(), icp.ICPConvergenceCriteria(max_iteration=60)
    ).transformation
    scaled = start.copy()
    scaled[:3, 3] *= 1e3  # small_gicp's grids are made for lengths of about one
    gicp = small_gicp.align(
        target * 1e3, thrown_source * 1e3, scaled, downsampling_resolution=1.0, max_correspondence_distance=2.0
    ).T_target_source.copy()
    gicp[:3, 3] /= 1e3
    ours, *theirs = (displacement(p, truth, thrown_source) for p in (found.fine.target_from_source, plane, gicp))
    assert ours <= 1.1 * min(theirs)
    assert ours < 1.5e-4
    assert found.fine.converged
    assert found.fine.n_constrained == 6
    assert 0.9 < found.fine.fitness < 0.97
    assert 5e-5 < found.fine.inlier_rmse < 3e-4


def test_parts_of_the_scans_that_overlap_by_less_than_half_are_registered(bunny):
    source, target, truth = bunny
    moved = rigid.apply(truth, source)
    order_s, order_t = np.argsort(moved[:, 0]), np.argsort(target[:, 0])
    part_s, part_t = source[order_s[: int(0.6 * len(source))]], target[order_t[int(0.4 * len(target)) :]]
    distance, _ = cKDTree(part_t).query(rigid.apply(truth, part_s))
    assert 0.3 < (distance < 1e-3).mean() < 0.55
    throw = thrown(5, 0.3)
    found = glob.register_clouds(rigid.apply(throw, part_s), part_t)
    assert displacement(found.fine.target_from_source @ throw, truth, part_s) < 6e-4


def test_clouds_of_different_things_are_refused_with_a_reason(bunny):
    random = np.random.default_rng(0)
    blob = random.standard_normal((4000, 3))
    blob /= np.linalg.norm(blob, axis=1, keepdims=True) / 0.06
    with pytest.raises(AlgorithmFailed, match=r"agree|in common"):
        glob.register_clouds(blob, bunny[1])
    with pytest.raises(AlgorithmFailed, match="too few points"):
        glob.register_clouds(blob[:20], bunny[1])


# --- wrong matches


@pytest.mark.parametrize("wrong", [0.8, 0.9])
def test_nine_wrong_matches_in_ten_do_not_matter(wrong):
    for seed in range(20):
        random = np.random.default_rng(seed)
        truth = thrown(seed, 50.0)
        source = random.uniform(-50, 50, (500, 3))
        target = rigid.apply(truth, source) + 0.3 * random.standard_normal((500, 3))
        bad = random.permutation(500)[: int(wrong * 500)]
        target[bad] = rigid.apply(truth, random.uniform(-50, 50, (len(bad), 3)))
        best = glob.proposed_poses(source, target, 1.5)[0]
        right = 500 - len(bad)
        # Pose of that many points of 0.3 mm over +-29 mm: five standard deviations of its displacement.
        assert displacement(best, truth, source) < 5 * 0.3 * np.sqrt(6 / right)


def test_poses_of_weighted_groups_are_scipys():
    random = np.random.default_rng(3)
    source, target, weight = random.normal(size=(4, 9, 3)), random.normal(size=(4, 9, 3)), random.random((4, 9))
    for pose, s, t, w in zip(glob.weighted_poses(source, target, weight), source, target, weight, strict=True):
        cs, ct = (w @ s) / w.sum(), (w @ t) / w.sum()
        theirs, _ = Rotation.align_vectors(t - ct, s - cs, weights=w)
        assert pose[:3, :3] == pytest.approx(theirs.as_matrix(), abs=1e-7)
        assert rigid.apply(pose, cs) == pytest.approx(ct, abs=1e-9)


# --- directions that a surface leaves open


def bodies(kind, random, n=6000, sigma=0.02):
    """Two samples (n, 3) of one surface with noise, in mm."""
    made = []
    for _ in range(2):
        a, b = random.uniform(-30, 30, n), random.uniform(-30, 30, n)
        if kind == "plane":
            points = np.column_stack([a, b, 0 * a])
        elif kind == "cylinder":
            points = np.column_stack([20 * np.cos(a / 20), 20 * np.sin(a / 20), b])
        elif kind == "sphere":
            v = random.standard_normal((n, 3))
            points = 25 * v / np.linalg.norm(v, axis=1, keepdims=True)
        elif kind == "cone":
            r = 20 + 0.4 * b
            points = np.column_stack([r * np.cos(a / 12), r * np.sin(a / 12), b])
        else:
            points = np.column_stack([a, b, 4 * np.sin(a / 6) * np.cos(b / 8) + 0.05 * a * b])
        made.append(points + sigma * random.standard_normal((n, 3)))
    return made


@pytest.mark.parametrize(("kind", "held"), [("plane", 3), ("cylinder", 4), ("sphere", 3), ("cone", 5), ("hills", 6)])
def test_directions_that_the_surface_holds_are_counted(kind, held):
    for seed in range(4):
        source, target = (surface(p) for p in bodies(kind, np.random.default_rng(seed)))
        found = refine(source, target, np.eye(4), reach=3.0)
        assert found.n_constrained == held, (seed, found.shares)


@pytest.mark.parametrize("method", ["generalised", "plane", "point"])
def test_refinement_finds_the_pose_and_its_information_says_how_well(method):
    """Ten pairs of samples of one surface: displacement of a point within a few of its standard uncertainties."""
    errors = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        source, target = bodies("hills", random)
        throw = rigid.transform(
            rigid.rotation_from_vector(0.01 * random.standard_normal(3)), random.normal(size=3) * 0.3
        )
        found = refine(
            surface(rigid.apply(throw, source)), surface(target), rigid.inverse(throw), reach=3.0, method=method
        )
        off = found.target_from_source @ throw
        errors.append(np.concatenate([rigid.vector_from_rotation(off[:3, :3]), off[:3, 3]]))
        assert found.information == pytest.approx(found.information.T, rel=1e-9)
        assert np.linalg.eigvalsh(found.information).min() > 0
    spread = np.sqrt((np.array(errors)[:, 3:] ** 2).mean())
    assert spread < (0.05 if method == "point" else 0.004)


def test_a_pair_that_is_found_from_both_sides_is_known_once():
    """The information of pairs of one way and of both ways is the same but for the pairs that only one of them has."""
    random = np.random.default_rng(4)
    source, target = bodies("hills", random)
    ways = [
        refine(surface(source), surface(target), np.eye(4), reach=3.0, method="plane", both_ways=both)
        for both in (True, False)
    ]
    u = [np.sqrt(np.diag(np.linalg.inv(found.information))) for found in ways]
    assert ways[0].n_pairs > 1.5 * ways[1].n_pairs
    assert (u[0] / u[1] > 0.78).all()  # 0.71 if each pair counted twice
    assert (u[0] / u[1] < 1.1).all()


# --- surfaces


def test_thinning_keeps_the_mean_of_each_cube():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [1.4, 0.1, 0.1], [0.1, 0.1, 3.0]])
    thin = voxel_thinned(points, 1.0)
    assert sorted(map(tuple, thin.round(9))) == [(0.1, 0.1, 3.0), (0.2, 0.1, 0.1), (1.4, 0.1, 0.1)]
    cloud = np.random.default_rng(0).uniform(0, 10, (30000, 3)) * [1, 1, 0.001]
    size = size_for(cloud, 1000)
    assert 800 < len(voxel_thinned(cloud, size)) < 1250
    assert size_for(cloud, 40000) == 0
    assert spacing(np.column_stack([np.arange(50.0), np.zeros((50, 2))])) == 1.0


def test_signs_of_normals_agree_over_a_closed_and_an_open_surface():
    random = np.random.default_rng(1)
    points = random.standard_normal((3000, 3))
    points *= [1, 2, 3] / np.linalg.norm(points, axis=1, keepdims=True)
    s = surface(points, k=16)
    signs = np.einsum("nk,nk->n", oriented_normals(points, s.normal), points / [1, 4, 9])
    assert (signs > 0).all()
    half = points[points[:, 2] > 0]
    assert (np.einsum("nk,nk->n", oriented_normals(half, surface(half, 16).normal), half / [1, 4, 9]) > 0).all()


def test_the_border_is_where_the_sheet_ends():
    x, y = (g.ravel().astype(float) for g in np.meshgrid(np.arange(30), np.arange(30)))
    s = surface(np.column_stack([x, y, 0 * x]), k=20)
    edge = (np.minimum(x, y) == 0) | (np.maximum(x, y) == 29)
    inner = (np.minimum(x, y) > 3) & (np.maximum(x, y) < 26)
    assert s.border[edge].all()
    assert not s.border[inner].any()
