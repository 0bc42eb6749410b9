"""Surfaces sampled by points, of any origin: thinning, spacing, normals and borders. Unorganised clouds, any unit of length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Mask = NDArray[np.bool_]


def voxel_thinned(points: Array, size: float) -> Array:
    """Means (m, 3) of the points (n, 3) in each cube of edge `size`, in the order of the cubes."""
    if size <= 0:
        return points
    cell = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    edge = cell.max(axis=0) + 1
    _, index = np.unique((cell[:, 0] * edge[1] + cell[:, 1]) * edge[2] + cell[:, 2], return_inverse=True)
    count = np.bincount(index)
    return np.stack([np.bincount(index, column) / count for column in points.T], axis=1)


def lonely(points: Array, radius: float, fewest: int) -> Mask:
    """True for points (n, 3) with fewer than `fewest` others within the radius (radius outlier removal)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    return np.asarray(tree.query_ball_point(points, radius, return_length=True) - 1 < fewest)


def far_from_others(points: Array, neighbours: int = 20, sigmas: float = 2.0) -> Mask:
    """True for points (n, 3) whose mean distance to their nearest `neighbours` exceeds the cloud's mean of it by more than
    `sigmas` standard deviations (statistical outlier removal, Rusu 2008; Open3D and PCL do the same)."""
    from scipy.spatial import cKDTree

    k = min(neighbours, len(points) - 1)
    if k < 1:
        return np.zeros(len(points), bool)
    distance = cKDTree(points).query(points, k + 1)[0][:, 1:].mean(axis=1)
    return np.asarray(distance > distance.mean() + sigmas * distance.std(ddof=1))


def spacing(points: Array, sample: int = 4000) -> float:
    """Median distance of a point from its nearest neighbour, from an even sample of the points (n, 3)."""
    from scipy.spatial import cKDTree

    chosen = points[:: max(1, len(points) // sample)]
    return float(np.median(cKDTree(points).query(chosen, 2)[0][:, 1]))


def size_for(points: Array, wanted: int) -> float:
    """Edge of the cubes that leave about `wanted` of the points (n, 3); 0 if there are no more of them than that.

    The number of occupied cubes of a surface falls with the square of their edge.
    """
    if len(points) <= wanted:
        return 0.0
    size = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())) * 4.0 / np.sqrt(wanted)
    for _ in range(6):
        left = len(voxel_thinned(points, size))
        if abs(left / wanted - 1) < 0.1:
            break
        size *= np.sqrt(left / wanted)
    return size


@dataclass(frozen=True)
class Surface:
    """Points (n, 3) with unit normals (n, 3), unsigned, which of them lie at the border of what was seen, and their tree."""

    points: Array
    normal: Array
    border: Mask
    tree: Any


def surface(points: Array, k: int = 30, border_share: float = 0.25) -> Surface:
    """Normals by principal components of the k nearest points; a border point's neighbours lie to one side of it.

    Border: their mean lies farther from the point than border_share of the neighbourhood's radius. There a nearest
    point of another scan is none: its true partner lies beyond (Turk and Levoy 1994 leave such pairs out as well).
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    distance, near = tree.query(points, min(k, len(points)))
    around = points[near]
    mean = around.mean(axis=1)
    centred = around - mean[:, None, :]
    _, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred)
    aside = np.linalg.norm(mean - points, axis=1)
    return Surface(points, vectors[:, :, 0], aside > border_share * distance[:, -1], tree)


def oriented_normals(points: Array, normal: Array, k: int = 10) -> Array:
    """Normals (n, 3) with consistent signs: passed on along the flattest tree over the k nearest neighbours (Hoppe 1992).

    In each connected part most of them point away from the centre of all points.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
    from scipy.spatial import cKDTree

    n = len(points)
    _, near = cKDTree(points).query(points, min(k + 1, n))
    i, j = np.repeat(np.arange(n), near.shape[1] - 1), near[:, 1:].ravel()
    bend = 1.0 - np.abs(np.einsum("nk,nk->n", normal[i], normal[j])) + 1e-6
    tree = minimum_spanning_tree(csr_array((bend, (i, j)), shape=(n, n)))
    parts, part = connected_components(tree, directed=False)
    before = np.arange(n)
    for root in [int(np.flatnonzero(part == p)[0]) for p in range(parts)]:  # parts are few
        order, found = breadth_first_order(tree, root, directed=False)
        before[order[1:]] = found[order[1:]]
    sign = np.where(np.einsum("nk,nk->n", normal, normal[before]) < 0, -1.0, 1.0)
    while not np.array_equal(before, before[before]):  # each step doubles the length of path that a sign has come along
        sign, before = sign * sign[before], before[before]
    turned = normal * sign[:, None]
    outward = np.bincount(part, np.einsum("nk,nk->n", turned, points - points.mean(axis=0)), minlength=parts)
    return np.where(outward[part] < 0, -1.0, 1.0)[:, None] * turned
