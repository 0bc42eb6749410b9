"""Fine registration of two clouds: ICP to points, to planes and generalised, both ways, and what the surfaces constrain.

For any clouds, in any unit of length. What a rig knows of its sensors, and the mean meridian, is used in `registration`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.surface import Surface
from wheelset_assets.quality import AlgorithmFailed

Array = NDArray[Any]
Method = Literal["generalised", "plane", "point"]

FLATNESS = 1e-3
"""Variance across a surface as a share of that along it, in generalised ICP (Segal 2009)."""


@dataclass(frozen=True)
class CloudRegistration:
    """Pose of a source cloud on a target cloud, and how well it is known.

    `inlier_rmse`: root mean square distance of the pairs, along the normals where the method has them (generalised,
    plane). `fitness`: share of the source's points with a partner. `information` (6, 6): of a small motion of the
    target's frame, x -> x + w cross x + t, w in rad first, then t, about the frame's origin; from the pairs' residuals
    taken as independent. `shares` (6,): eigenvalues of the constraint, see `constraints`; `n_constrained`: how many
    of them are not noise.
    """

    target_from_source: Array
    inlier_rmse: float
    fitness: float
    n_pairs: int
    n_iterations: int
    converged: bool
    information: Array
    shares: Array
    n_constrained: int


def refine(
    source: Surface,
    target: Surface,
    start: Array,
    *,
    reach: float,
    method: Method = "generalised",
    max_iterations: int = 60,
    both_ways: bool = True,
    least_cosine: float = 0.8,
) -> CloudRegistration:
    """ICP (eq. 25-26) of a source surface (n points) onto a target surface (m points) from the pose `start` (4, 4).

    Pairs: each source point and the nearest target point within `reach`, and, both ways, each target point and the
    nearest source point; without those at a border, and without those whose normals differ by more than least_cosine.
    `generalised` (Segal 2009) weighs the difference by the flatness of both neighbourhoods, `plane` takes its part along
    the target's normal, `point` all of it (Besl and McKay 1992). Raises AlgorithmFailed if fewer than 12 pairs are left.
    """
    pose = start.copy()
    size = float(np.sqrt(source.points.var(axis=0).sum()))
    step, done = np.inf, 0
    for done in range(1, max_iterations + 1):  # noqa: B007  (read after the loop)
        pairs = _pairs(source, target, pose, reach, both_ways, least_cosine)
        centre = pairs.p.mean(axis=0)
        normal, gradient = _normal_equations(pairs, centre, method)
        delta = -np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
        turn = rigid.rotation_from_vector(delta[:3])
        pose = rigid.transform(turn, centre - turn @ centre + delta[3:]) @ pose
        before, step = step, float(np.linalg.norm(delta[3:]) + size * np.linalg.norm(delta[:3]))
        # Once pairs only flip between neighbours, the steps no longer shrink.
        if step < 1e-7 * size or (step < 1e-4 * reach and step > 0.5 * before):
            break
    return _summary(
        source, _pairs(source, target, pose, reach, both_ways, least_cosine), pose, method, done, step < 1e-3 * reach
    )


@dataclass(frozen=True)
class _CloudPairs:
    """Paired points (k, 3) and normals (k, 3) in the target's frame; how many source points found a partner, and how many
    pairs there are that are not the same from the other side."""

    p: Array
    q: Array
    normal_p: Array
    normal_q: Array
    n_partners: int
    n_distinct: int


def _pairs(
    source: Surface, target: Surface, pose: Array, reach: float, both_ways: bool, least_cosine: float
) -> _CloudPairs:
    moved, normal = rigid.apply(pose, source.points), source.normal @ pose[:3, :3].T
    distance, nearest = target.tree.query(moved, distance_upper_bound=reach)
    partner = np.isfinite(distance)
    i = np.flatnonzero(partner)
    j = nearest[i]
    inner = ~target.border[j]
    i, j = i[inner], j[inner]
    if both_ways:
        distance, nearest = source.tree.query(
            rigid.apply(rigid.inverse(pose), target.points), distance_upper_bound=reach
        )
        back = np.flatnonzero(np.isfinite(distance))
        back = back[~source.border[nearest[back]]]
        i, j = np.concatenate([i, nearest[back]]), np.concatenate([j, back])
    alike = np.abs(np.einsum("nk,nk->n", normal[i], target.normal[j])) > least_cosine
    i, j = i[alike], j[alike]
    if len(i) < 12:
        raise AlgorithmFailed("too few points of the two clouds lie together", pairs=len(i), required=12, reach=reach)
    n_distinct = len(np.unique(i * np.int64(len(target.points)) + j)) if both_ways else len(i)
    return _CloudPairs(moved[i], target.points[j], normal[i], target.normal[j], int(partner.sum()), n_distinct)


def _metric(pairs: _CloudPairs, method: Method) -> Array:
    """Weight matrices (k, 3, 3) of the differences; 1 along a common normal."""
    if method == "point":
        return np.broadcast_to(np.eye(3), (len(pairs.p), 3, 3))
    outer_q = pairs.normal_q[:, :, None] * pairs.normal_q[:, None, :]
    if method == "plane":
        return outer_q
    outer_p = pairs.normal_p[:, :, None] * pairs.normal_p[:, None, :]
    return 2 * FLATNESS * np.linalg.inv(2 * np.eye(3) - (1 - FLATNESS) * (outer_p + outer_q))


def _normal_equations(pairs: _CloudPairs, centre: Array, method: Method) -> tuple[Array, Array]:
    x, r = pairs.p - centre, pairs.p - pairs.q
    if method == "plane":
        jacobian = np.hstack([np.cross(x, pairs.normal_q), pairs.normal_q])
        return jacobian.T @ jacobian, jacobian.T @ np.einsum("nk,nk->n", r, pairs.normal_q)
    metric = _metric(pairs, method)
    jacobian = np.zeros((len(x), 3, 6))
    jacobian[:, 0, 1], jacobian[:, 1, 2], jacobian[:, 2, 0] = x[:, 2], x[:, 0], x[:, 1]
    jacobian[:, 0, 2], jacobian[:, 1, 0], jacobian[:, 2, 1] = -x[:, 1], -x[:, 2], -x[:, 0]
    jacobian[:, :, 3:] = np.eye(3)
    weighted = (metric @ jacobian).reshape(-1, 6)
    return jacobian.reshape(-1, 6).T @ weighted, weighted.T @ r.ravel()


def _along_normals(pairs: _CloudPairs) -> Array:
    """Differences (k,) along the mean of both normals."""
    sign = np.where(np.einsum("nk,nk->n", pairs.normal_p, pairs.normal_q) < 0, -1.0, 1.0)
    mean = pairs.normal_q + sign[:, None] * pairs.normal_p
    return np.einsum("nk,nk->n", pairs.p - pairs.q, mean) / np.linalg.norm(mean, axis=1)


def _summary(
    source: Surface, pairs: _CloudPairs, pose: Array, method: Method, iterations: int, converged: bool
) -> CloudRegistration:
    along = _along_normals(pairs)
    residual = np.linalg.norm(pairs.p - pairs.q, axis=1) if method == "point" else along
    rmse = float(np.sqrt((residual**2).mean()))
    # What the pairs know lies along the normals, whatever was minimised: along the surface they are as far apart as its points.
    noise = max(float(np.sqrt((along**2).mean())), 1e-12 * float(np.abs(pairs.p).max() + 1))
    normal, _ = _normal_equations(pairs, np.zeros(3), "plane")
    shares, significant = constraints(pairs.p, pairs.normal_p, pairs.normal_q)
    return CloudRegistration(
        target_from_source=pose,
        inlier_rmse=rmse,
        fitness=pairs.n_partners / len(source.points),
        n_pairs=len(pairs.p),
        n_iterations=iterations,
        converged=converged,
        information=normal / noise**2 * (pairs.n_distinct / len(pairs.p)),
        shares=shares,
        n_constrained=int(significant.sum()),
    )


def constraints(
    points: Array, normal_p: Array, normal_q: Array, least: float = 1e-3, sigmas: float = 4.0
) -> tuple[Array, NDArray[np.bool_]]:
    """How strongly paired surfaces hold each of six directions (6,), largest first, and which of them are held at all.

    Eigenvalues of the mean of j_p j_q' (symmetrised), j = (x cross n / r, n), x from the centre of the points (k, 3), r
    their root mean square distance from it: the mean square displacement along the normals per unit of motion, the
    motion being counted where the points are. Each factor takes the normals of another cloud, so that noise of the
    normals, which looks like constraint, cancels but for its own scatter (Gelfand 2003 has the eigenvalues without
    this). The scatter follows from how much j_p and j_q differ. Held: larger than `least`, and than `sigmas` times it.
    """
    x = points - points.mean(axis=0)
    x = x / np.sqrt((x**2).sum(axis=1).mean())
    sign = np.where(np.einsum("nk,nk->n", normal_p, normal_q) < 0, -1.0, 1.0)
    j_p, j_q = (np.hstack([np.cross(x, n), n]) for n in (normal_p * sign[:, None], normal_q))
    mean = j_p.T @ j_q / len(x)
    values, directions = np.linalg.eigh((mean + mean.T) / 2)
    a, b = j_p @ directions, j_q @ directions
    # Neighbouring normals share their points: as if there were thirty times fewer.
    scatter = ((a - b) ** 2).mean(axis=0) / 2 * np.sqrt(30.0 / len(x))
    return values[::-1], ((values > least) & (values > sigmas * scatter))[::-1]
