"""Registration of two clouds without an initial guess: descriptors, matches that agree in pairs, poses that fit the surfaces.

Most matches of descriptors are wrong, nine in ten where scans overlap by half. A rigid motion keeps distances, so right
matches agree with each other pairwise, and wrong ones with few: the poses proposed are those of groups whose members
agree with each other's partners too (second-order compatibility, Chen et al. 2022). No random draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology import features, rigid
from wheelset_assets.metrology.cloud_registration import CloudRegistration, Method, refine
from wheelset_assets.metrology.surface import Surface, oriented_normals, size_for, spacing, surface, voxel_thinned
from wheelset_assets.quality import AlgorithmFailed

Array = NDArray[Any]
Index = NDArray[np.int64]

POINTS = 4000
"""Points of the smaller cloud that get a descriptor."""
MOST_POINTS = 12000
"""And of the larger one at most."""
MATCHES = 1200
"""Matches kept for each sign of the normals and radius: the most distinctive ones. Compatibility is a square of these."""
LEAST_AGREEING, LEAST_SHARE = 12, 0.03
"""Matches that a pose needs behind it, and as a share of all: chance gathers one or two in a hundred."""
RADII = (6.0, 10.0)
"""Radii of the descriptors, in spacings of the thinned cloud."""


@dataclass(frozen=True)
class GlobalPose:
    """target_from_source (4, 4), the spacing of the thinned clouds, matches in all and those that agree with the pose."""

    target_from_source: Array
    spacing: float
    n_matches: int
    n_inliers: int


def register_globally(source: Array, target: Array) -> GlobalPose:
    """Coarse pose of a source cloud (n, 3) on a target cloud (m, 3) of the same unit, wherever they stand.

    Good to about the spacing of the thinned clouds, for fine registration to start from. The signs of normals are
    unknown in a bare cloud: both are tried. Raises AlgorithmFailed if no pose brings the surfaces together.
    """
    size = _size(source, target)
    clouds = [surface(voxel_thinned(points, size), k=16) for points in (source, target)]
    step = max(size, *(spacing(c.points) for c in clouds))
    i, j = _matches(clouds[0], clouds[1], step)
    if len(i) < 6:
        raise AlgorithmFailed("the clouds have too few features in common", matches=len(i), required=6)
    p, q = clouds[0].points[i], clouds[1].points[j]
    poses = proposed_poses(p, q, 1.5 * step)
    best = _best_on_surfaces(poses, clouds[0], clouds[1], step)
    inliers = int((np.linalg.norm(rigid.apply(best, p) - q, axis=1) < 2 * step).sum())
    required = max(LEAST_AGREEING, round(LEAST_SHARE * len(i)))
    if inliers < required:
        raise AlgorithmFailed(
            "no pose on which enough matches agree: the clouds overlap too little, or have too little relief",
            agreeing=inliers, required=required, matches=len(i),
        )  # fmt: skip
    return GlobalPose(best, step, len(i), inliers)


def _size(source: Array, target: Array) -> float:
    """Of a part against a whole, the part keeps its points as far as the whole stays manageable."""
    both = (source, target)
    return max(min(size_for(c, POINTS) for c in both), max(size_for(c, MOST_POINTS) for c in both))


def _matches(source: Surface, target: Surface, step: float) -> tuple[Index, Index]:
    """Matched points of both clouds, over the radii of descriptors and both signs of the source's normals."""
    described = []
    for cloud in (source, target):
        normal = oriented_normals(cloud.points, cloud.normal)
        histograms = features.fpfh_of_all(cloud.points, normal, tuple(r * step for r in RADII), definition="open3d")
        described.append([np.sqrt(h) for h in histograms])  # Hellinger distances between histograms
    found = [
        mutual(signed, theirs) for ours, theirs in zip(*described, strict=True) for signed in (ours, turned_over(ours))
    ]
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def turned_over(histogram: Array) -> Array:
    """FPFH (n, 33) as they would be with all normals turned over: theta and phi change sign, alpha stays."""
    thirds = histogram.reshape(-1, 3, 11)
    return np.stack([thirds[:, 0, ::-1], thirds[:, 1], thirds[:, 2, ::-1]], axis=1).reshape(-1, 33)


def mutual(source: Array, target: Array, most: int = MATCHES) -> tuple[Index, Index]:
    """Pairs of rows of two descriptor tables (n, c), (m, c) that are each other's nearest; the `most` distinctive ones.

    Distinctive: the second nearest is far in comparison.
    """
    a, b = source.astype(np.float32), target.astype(np.float32)
    square = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)[None] - 2 * (a @ b.T)
    forth, back = square.argmin(axis=1), square.argmin(axis=0)
    i = np.flatnonzero(back[forth] == np.arange(len(a)))
    two = np.partition(square[i], 1, axis=1)[:, :2] if len(b) > 1 else np.repeat(square[i], 2, axis=1)
    ratio = np.maximum(two[:, 0], 0) / np.maximum(two[:, 1], 1e-12)
    i = np.sort(i[np.argsort(ratio, kind="stable")[:most]])
    return i, forth[i]


def proposed_poses(source: Array, target: Array, tolerance: float, seeds: int = 200, group: int = 24) -> Array:
    """Poses (k, 4, 4), target from source, of groups of matches (n, 3) that agree pairwise in distance, best first.

    Two matches agree if the distance between their points differs by less than the tolerance; their rank counts the
    third matches with which both agree. Each of the `seeds` best-connected matches gathers its `group` best partners;
    the leading eigenvector of their agreement weighs them in the pose (eq. 22-24). Ranked by the matches within the
    tolerance.
    """
    distances = [np.sqrt(np.maximum(_squares(p), 0)) for p in (source, target)]
    off = np.abs(distances[0] - distances[1])
    far = np.minimum(*distances) > 2 * tolerance  # near pairs agree whatever the motion
    agree = ((off < tolerance) & far).astype(np.float32)
    second = agree * (agree @ agree)
    strength = second.sum(axis=1)
    seed = _spread_seeds(source, target, strength, tolerance, seeds)
    group = min(group, len(source) - 1)
    partners = np.argpartition(-second[seed], group, axis=1)[:, :group]
    members = np.concatenate([seed[:, None], partners], axis=1)
    soft = np.maximum(0.0, 1 - (off[members[:, :, None], members[:, None, :]] / tolerance) ** 2)
    weight = np.ones(members.shape)
    for _ in range(12):
        weight = np.einsum("nij,nj->ni", soft, weight)
        weight /= np.linalg.norm(weight, axis=1, keepdims=True)
    poses = weighted_poses(source[members], target[members], weight)
    near = _near(poses, source, target, 2 * tolerance)
    for _ in range(2):
        poses = weighted_poses(np.broadcast_to(source, (len(poses), *source.shape)), target[None], near)
        near = _near(poses, source, target, 2 * tolerance)
    count = near.sum(axis=1)
    return poses[np.argsort(-count, kind="stable")]


def _squares(points: Array) -> Array:
    p = (points - points.mean(axis=0)).astype(np.float32)
    norm = (p * p).sum(axis=1)
    return norm[:, None] + norm[None] - 2 * (p @ p.T)


def _spread_seeds(source: Array, target: Array, strength: Array, tolerance: float, seeds: int) -> Index:
    """The strongest matches, few of which repeat a stronger one near by."""
    order = np.argsort(-strength, kind="stable")[: 4 * seeds]
    p, q = source[order], target[order]
    same = (((p[:, None] - p[None]) ** 2).sum(axis=2) < (2 * tolerance) ** 2) & (
        ((q[:, None] - q[None]) ** 2).sum(axis=2) < (2 * tolerance) ** 2
    )
    repeats = np.tril(same, -1).sum(axis=1)
    return order[np.argsort(repeats, kind="stable")][:seeds]


def _near(poses: Array, source: Array, target: Array, reach: float) -> Array:
    moved = np.einsum("kij,nj->kni", poses[:, :3, :3], source) + poses[:, None, :3, 3]
    return (((moved - target) ** 2).sum(axis=2) < reach**2).astype(float)


def weighted_poses(source: Array, target: Array, weight: Array) -> Array:
    """Poses (k, 4, 4) of paired points (k, n, 3) with weights (k, n): eq. 22-24 for many groups at once."""
    w = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    cs, ct = np.einsum("kn,kni->ki", w, source), np.einsum("kn,kni->ki", w, np.broadcast_to(target, source.shape))
    cross = np.swapaxes((source - cs[:, None]) * w[:, :, None], 1, 2) @ (target - ct[:, None])
    u, _, vt = np.linalg.svd(cross)
    v = np.swapaxes(vt, 1, 2)
    v[:, :, 2] *= np.linalg.det(v @ np.swapaxes(u, 1, 2))[:, None]
    rotation = v @ np.swapaxes(u, 1, 2)
    poses = np.zeros((len(source), 4, 4))
    poses[:, :3, :3], poses[:, 3, 3] = rotation, 1.0
    poses[:, :3, 3] = ct - np.einsum("kij,kj->ki", rotation, cs)
    return poses


def fit_of(pose: Array, source: Surface, target: Surface, reach: float) -> float:
    """How many points of both surfaces find each other: each counts 1 at no distance, 0 at `reach` or with another normal."""
    total = 0.0
    for a, b, m in ((source, target, pose), (target, source, rigid.inverse(pose))):
        distance, nearest = b.tree.query(rigid.apply(m, a.points), distance_upper_bound=reach)
        hit = np.flatnonzero(np.isfinite(distance))
        cosine = np.abs(np.einsum("nk,nk->n", a.normal[hit] @ m[:3, :3].T, b.normal[nearest[hit]]))
        inner = ~b.border[nearest[hit]]
        total += float(((1 - (distance[hit] / reach) ** 2) * np.clip((cosine - 0.6) / 0.4, 0, 1) * inner).sum())
    return total


def _best_on_surfaces(
    poses: Array, source: Surface, target: Surface, step: float, tried: int = 40, kept: int = 8
) -> Array:
    """The pose under which the surfaces fit best, after a short fine registration of the best few."""
    distinct: list[Array] = []
    size = float(np.sqrt(source.points.var(axis=0).sum()))
    centre = source.points.mean(axis=0)
    for pose in poses:
        if all(_apart(pose, other, centre, size) > 2 * step for other in distinct):
            distinct.append(pose)
        if len(distinct) == tried:
            break
    rough = sorted(distinct, key=lambda pose: -fit_of(pose, source, target, 3 * step))[:kept]
    finer = []
    for pose in rough:
        try:
            finer.append(refine(source, target, pose, reach=3 * step, max_iterations=15).target_from_source)
        except AlgorithmFailed:
            continue
    if not finer:
        raise AlgorithmFailed("no pose brings the surfaces together", poses=len(distinct))
    return max(finer, key=lambda pose: fit_of(pose, source, target, 1.5 * step))


def _apart(a: Array, b: Array, centre: Array, size: float) -> float:
    shift = float(np.linalg.norm(rigid.apply(a, centre) - rigid.apply(b, centre)))
    return shift + size * float(np.linalg.norm(a[:3, :3] - b[:3, :3])) / np.sqrt(2)


FULL_POINTS = 150_000
"""Points of a cloud that enter the fine registration at most; more are thinned evenly."""


@dataclass(frozen=True)
class Registered:
    """A registration of two clouds, the pose it started from, and the largest distance of a pair at its end."""

    fine: CloudRegistration
    start: GlobalPose | None
    reach: float


def register_clouds(
    source: Array,
    target: Array,
    initial: Array | None = None,
    *,
    method: Method = "generalised",
    reach: float | None = None,
) -> Registered:
    """target_from_source of two clouds (n, 3), (m, 3) in one unit of length, from coarse to fine.

    Without `initial` (4, 4) the coarse pose is found by register_globally. The fine registration runs on thinned clouds
    first, then on all points (at most FULL_POINTS of each), with pairs no longer than `reach` at the end (default: four
    spacings of the coarser cloud). Raises AlgorithmFailed with its reason where no pose is found.
    """
    for name, cloud in (("source", source), ("target", target)):
        if len(cloud) < 30:
            raise AlgorithmFailed(f"the {name} cloud has too few points", points=len(cloud), required=30)
    start = register_globally(source, target) if initial is None else None
    pose = initial if start is None else start.target_from_source
    assert pose is not None
    step = start.spacing if start else max(_size(source, target), spacing(source), spacing(target))
    full_s, full_t = (voxel_thinned(points, size_for(points, FULL_POINTS)) for points in (source, target))
    last = reach or 4.0 * max(spacing(full_s), spacing(full_t))
    thin_s, thin_t = (surface(voxel_thinned(points, 0.6 * step), k=20) for points in (full_s, full_t))
    for limit in (3.0 * step, 1.5 * step):
        if limit > last:
            pose = refine(thin_s, thin_t, pose, reach=limit, method=method).target_from_source
    fine = refine(surface(full_s), surface(full_t), pose, reach=last, method=method)
    return Registered(fine, start, last)
