"""Keypoints and descriptors of point clouds: normals, ISS (eq. 18-19), pair features, SPFH and FPFH (eq. 20-21).

Libraries give the same names to different definitions; `definition` says which one is meant, and docs/registration.md
sets them side by side. Clouds of thousands of points, whole arrays; neighbourhoods are pair lists, found once and
shared. Matching and poses live in registration and global_registration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Index = NDArray[np.int64]
IssDefinition = Literal["paper", "pcl", "open3d"]
FpfhDefinition = Literal["paper", "pcl", "open3d"]


@dataclass(frozen=True)
class Pairs:
    """All ordered pairs (i, j), i != j, closer than a radius, sorted by i: indices (n,), differences (n, 3), distances (n,)."""

    i: Index
    j: Index
    difference: Array
    distance: Array

    def only(self, keep: NDArray[np.bool_]) -> Pairs:
        """Those pairs for which `keep` (n,) is true."""
        at = np.flatnonzero(keep)
        if len(at) == len(keep):
            return self
        return Pairs(self.i[at], self.j[at], self.difference.take(at, axis=0), self.distance[at])

    def within(self, radius: float) -> Pairs:
        """Those pairs that are no farther apart than a smaller radius."""
        return self.only(self.distance <= radius)


def neighbour_pairs(points: Array, radius: float, queries: Index | None = None) -> Pairs:
    """Pairs of points (n, 3) within radius; only those whose first member is among `queries`, if given."""
    from scipy.spatial import cKDTree

    once = cKDTree(points).query_pairs(radius, output_type="ndarray").astype(np.int64)
    i, j = np.concatenate([once, once[:, ::-1]]).T
    if queries is not None:
        wanted = np.zeros(len(points), bool)
        wanted[queries] = True
        i, j = i[wanted[i]], j[wanted[i]]
    key = np.sort(i * len(points) + j)
    i, j = np.divmod(key, len(points))
    difference = points[j] - points[i]
    distance = np.sqrt(np.einsum("nk,nk->n", difference, difference))
    found = Pairs(i, j, difference, distance)
    return found if distance.size == 0 or distance.min() > 1e-12 else found.only(distance > 1e-12)


def normals(points: Array, radius: float, viewpoint: Array, pairs: Pairs | None = None) -> Array:
    """Unit normals (n, 3) by principal components within radius, turned towards the viewpoint (3,). NaN if under 3 neighbours.

    The scatter is taken about the neighbourhood's mean, the point itself included, as PCL and Open3D do. `pairs`: all
    pairs within radius, if they are at hand.
    """
    pairs = neighbour_pairs(points, radius) if pairs is None else pairs
    scatter, count = _scatter_about_mean(pairs, len(points))
    _, vectors = np.linalg.eigh(scatter)
    normal = vectors[:, :, 0]
    away = ((viewpoint - points) * normal).sum(axis=1) < 0
    normal[away] *= -1
    normal[count < 4] = np.nan
    return normal


def nearest_normals(
    points: Array, k: int, viewpoint: Array, *, precision: Literal["double", "pcl"] = "double"
) -> Array:
    """Unit normals (n, 3) from the k nearest points, the point itself among them, turned towards the viewpoint (3,).

    `precision` pcl repeats the Point Cloud Library's arithmetic, moments of the coordinates in one pass and in single
    precision: its published normals are met to 1e-6 so, and only to 3e-4 by exact sums, because rounding tilts them.
    """
    from scipy.spatial import cKDTree

    _, near = cKDTree(points).query(points, min(k, len(points)))
    around = points[near]
    if precision == "pcl":
        scatter = _single_pass_scatter(around.astype(np.float32)).astype(float)
    else:
        centred = around - around.mean(axis=1, keepdims=True)
        scatter = np.einsum("nki,nkj->nij", centred, centred)
    _, vectors = np.linalg.eigh(scatter)
    normal = vectors[:, :, 0]
    normal[((viewpoint - points) * normal).sum(axis=1) < 0] *= -1
    return normal


def _single_pass_scatter(around: NDArray[np.float32]) -> NDArray[np.float32]:
    """Covariance (n, 3, 3) as mean of squares minus square of the mean, neighbour after neighbour in single precision."""
    outer = around[:, :, :, None] * around[:, :, None, :]
    k = np.float32(around.shape[1])
    square, mean = np.zeros_like(outer[:, 0]), np.zeros_like(around[:, 0])
    for i in range(around.shape[1]):  # the order of summation is part of the definition
        square, mean = square + outer[:, i], mean + around[:, i]
    square, mean = square / k, mean / k
    return square - mean[:, :, None] * mean[:, None, :]


def _scatter_about_mean(pairs: Pairs, n: int) -> tuple[Array, Index]:
    """Covariance (n, 3, 3) of each point and its neighbours about their mean, and their number (n,), itself included."""
    count = np.bincount(pairs.i, minlength=n) + 1
    mean = _sum_by(pairs.i, pairs.difference, n) / count[:, None]
    scatter = _outer_sums(pairs.i, pairs.difference, None, n) / count[:, None, None]
    return scatter - mean[:, :, None] * mean[:, None, :], count


@dataclass(frozen=True)
class Keypoints:
    """Indices of the keypoints, their saliency (smallest eigenvalue) and the size of their neighbourhoods, (k,) each."""

    index: Index
    saliency: Array
    n_neighbours: Index


def iss_keypoints(
    points: Array,
    radius: float,
    non_maximum_radius: float,
    gamma_21: float,
    gamma_32: float,
    min_neighbours: int = 5,
    *,
    definition: IssDefinition = "paper",
    pairs: Pairs | None = None,
) -> Keypoints:
    """Intrinsic shape signature keypoints (Zhong 2009) of points (n, 3).

    A keypoint has eigenvalue ratios of its neighbourhood's scatter at most gamma_21 and gamma_32, and the largest third
    eigenvalue within non_maximum_radius. What the scatter is, is a matter of `definition`:

    - paper: eq. 18-19, weighted by 1/distance, about the point itself, divided by the sum of weights;
    - pcl: not weighted, about the point itself, a sum;
    - open3d: not weighted, about the neighbourhood's mean, the point included, divided by their number; ratios strictly
      below the thresholds, and at least min_neighbours within non_maximum_radius too (the point counts in both).

    `pairs`: all pairs within the larger of both radii, if they are at hand.
    """
    pairs = neighbour_pairs(points, max(radius, non_maximum_radius)) if pairs is None else pairs
    about, near = pairs.within(radius), pairs.within(non_maximum_radius)
    n = len(points)
    count = np.bincount(about.i, minlength=n)
    enough = count >= min_neighbours
    if definition == "open3d":
        scatter, itself_too = _scatter_about_mean(about, n)
        enough = itself_too >= min_neighbours
        enough_near = np.bincount(near.i, minlength=n) + 1 >= min_neighbours
    else:
        weight = 1.0 / about.distance if definition == "paper" else None
        scatter = _outer_sums(about.i, about.difference, weight, n)
        if weight is not None:
            total = np.bincount(about.i, weights=weight, minlength=n)
            scatter = scatter / np.where(total > 0, total, 1.0)[:, None, None]
        enough_near = np.ones(n, bool)
    values = np.linalg.eigvalsh(scatter)[:, ::-1]
    if definition == "open3d":
        with np.errstate(invalid="ignore", divide="ignore"):
            salient = (values[:, 1] < gamma_21 * values[:, 0]) & (values[:, 2] < gamma_32 * values[:, 1])
    else:
        salient = (values[:, 1] <= gamma_21 * values[:, 0]) & (values[:, 2] <= gamma_32 * values[:, 1])
    candidate = enough & salient
    candidate &= values[:, 2] > 1e-12 * values[:, 0]  # a flat neighbourhood's third eigenvalue is rounding
    saliency = np.where(candidate, values[:, 2], -1.0)
    rival = np.full(n, -1.0)
    np.maximum.at(rival, near.i, saliency[near.j])
    chosen = np.flatnonzero(candidate & enough_near & (saliency >= rival * (1 - 1e-12)))  # ties stay together
    return Keypoints(chosen, values[chosen, 2], count[chosen])


def pair_features(normal_i: Array, normal_j: Array, difference: Array, distance: Array) -> tuple[Array, Array, Array]:
    """Angles (alpha, phi, theta) of point pairs in the Darboux frame of the source point, each (n,).

    Eq. 20 with its misprint mended: alpha = V . n_t, phi = U . d, theta = atan2(W . n_t, U . n_t), with U = n_s,
    V = d x U, W = U x V. The source is the point whose normal makes the smaller angle with the connecting line.
    """
    line = difference / distance[:, None]
    cos_i, cos_j = _dot(normal_i, line), _dot(normal_j, line)
    swap = np.abs(cos_i) < np.abs(cos_j)
    source = np.where(swap[:, None], normal_j, normal_i)
    target = np.where(swap[:, None], normal_i, normal_j)
    direction = np.where(swap[:, None], -line, line)
    phi = np.where(swap, -cos_j, cos_i)
    v = _cross(direction, source)
    length = np.sqrt(_dot(v, v))
    v = v / np.where(length > 1e-12, length, 1.0)[:, None]
    w = _cross(source, v)
    return _dot(v, target), phi, np.arctan2(_dot(w, target), _dot(source, target))


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("nk,nk->n", a, b)


def _cross(a: Array, b: Array) -> Array:
    """As numpy's, several times faster on long lists."""
    x, y, z = a.T
    u, v, w = b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def spfh(
    points: Array, normal: Array, radius: float, queries: Index, pairs: Pairs | None = None
) -> tuple[Array, Pairs]:
    """Simplified point feature histograms (len(queries), 33) in percent, 11 bins an angle, and the pairs behind them.

    Thirds: theta, alpha, phi, as in PCL and Open3D. `pairs`: those within radius whose first member is a query, if they
    are at hand. Points without a normal do not count.
    """
    pairs = neighbour_pairs(points, radius, queries) if pairs is None else pairs
    known = np.asarray(np.isfinite(normal).all(axis=1))
    if not known.all():
        pairs = pairs.only(known[pairs.i] & known[pairs.j])
    alpha, phi, theta = pair_features(normal[pairs.i], normal[pairs.j], pairs.difference, pairs.distance)
    slot = np.full(len(points), -1)
    slot[queries] = np.arange(len(queries))
    at = slot[pairs.i]
    count = np.maximum(np.bincount(at, minlength=len(queries)), 1)
    histogram = np.zeros((len(queries), 33))
    for k, (value, low, high) in enumerate(((theta, -np.pi, np.pi), (alpha, -1.0, 1.0), (phi, -1.0, 1.0))):
        bins = np.clip(np.floor(11 * (value - low) / (high - low)), 0, 10).astype(np.int64)
        flat = np.bincount(at * 11 + bins, minlength=11 * len(queries)).reshape(len(queries), 11)
        histogram[:, 11 * k : 11 * (k + 1)] = 100.0 * flat / count[:, None]
    return histogram, pairs


def fpfh(
    points: Array,
    normal: Array,
    radius: float,
    keypoints: Index,
    *,
    definition: FpfhDefinition = "paper",
    pairs: Pairs | None = None,
) -> Array:
    """Fast point feature histograms (k, 33) at the keypoints. Only these and their neighbours get an SPFH.

    - paper: eq. 21 with its misprint mended (Rusu 2009), SPFH(q) + 1/k sum of SPFH(q_k) / distance; each third scaled to
      a sum of 100;
    - pcl: sum of SPFH(q_k) / distance squared, without the point's own; each third scaled to 100;
    - open3d: PCL's thirds scaled to 100, and then the point's own SPFH added: each third sums to 200.

    `pairs`: all pairs within radius, if they are at hand.
    """
    if len(keypoints) == 0:
        return np.empty((0, 33))
    order = np.full(len(points), -1)
    order[keypoints] = np.arange(len(keypoints))
    if pairs is None:
        around = neighbour_pairs(points, radius, keypoints)
        needed = np.unique(np.concatenate([keypoints, around.j]))
        simple, _ = spfh(points, normal, radius, needed)
    else:
        around = pairs.only(order[pairs.i] >= 0)
        wanted = np.zeros(len(points), bool)
        wanted[keypoints] = wanted[around.j] = True
        needed = np.flatnonzero(wanted)
        simple, _ = spfh(points, normal, radius, needed, pairs if wanted.all() else pairs.only(wanted[pairs.i]))
    slot = np.full(len(points), -1)
    slot[needed] = np.arange(len(needed))
    weight = 1.0 / around.distance if definition == "paper" else 1.0 / around.distance**2
    sums = _weighted_rows(order[around.i], slot[around.j], weight, simple, len(keypoints))
    own = simple[slot[keypoints]]
    if definition == "paper":
        count = np.maximum(np.bincount(order[around.i], minlength=len(keypoints)), 1)
        return _in_percent(own + sums / count[:, None])
    return _in_percent(sums) if definition == "pcl" else _in_percent(sums) + own


def fpfh_of_all(
    points: Array, normal: Array, radii: tuple[float, ...], *, definition: FpfhDefinition = "paper"
) -> list[Array]:
    """FPFH (n, 33) of every point, for each of several radii: as `fpfh`, but each pair is looked at once for all of them.

    A pair's angles do not depend on its order, so half of the ordered pairs are enough.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    n = len(points)
    known = np.asarray(np.isfinite(normal).all(axis=1))
    i, j = cKDTree(points).query_pairs(max(radii), output_type="ndarray").T
    keep = known[i] & known[j]
    i, j = i[keep], j[keep]
    difference = points[j] - points[i]
    distance = np.sqrt(_dot(difference, difference))
    apart = np.flatnonzero(distance > 1e-12)
    i, j, difference, distance = i[apart], j[apart], difference[apart], distance[apart]
    alpha, phi, theta = pair_features(normal[i], normal[j], difference, distance)
    bins = [
        np.clip(np.floor(11 * (v - low) / (high - low)), 0, 10).astype(np.int64) + 11 * k
        for k, (v, low, high) in enumerate(((theta, -np.pi, np.pi), (alpha, -1.0, 1.0), (phi, -1.0, 1.0)))
    ]
    found = []
    for radius in radii:
        near = np.flatnonzero(distance <= radius)
        a, b, d = i[near], j[near], distance[near]
        count = np.maximum(np.bincount(a, minlength=n) + np.bincount(b, minlength=n), 1)
        flat = sum(np.bincount(end * 33 + c[near], minlength=33 * n) for c in bins for end in (a, b))
        simple = 100.0 * np.reshape(flat, (n, 33)) / count[:, None]
        weight = 1.0 / d if definition == "paper" else 1.0 / d**2
        half = csr_array((weight, (a, b)), shape=(n, n))
        sums = half @ simple + half.T @ simple
        if definition == "paper":
            found.append(_in_percent(simple + sums / count[:, None]))
        else:
            found.append(_in_percent(sums) if definition == "pcl" else _in_percent(sums) + simple)
    return found


def _in_percent(histogram: Array) -> Array:
    thirds = histogram.reshape(-1, 3, 11)
    sums = thirds.sum(axis=2, keepdims=True)
    return (100.0 * thirds / np.where(sums > 0, sums, 1.0)).reshape(-1, 33)


def _weighted_rows(at: Index, of: Index, weight: Array, rows: Array, n: int) -> Array:
    """Sums (n, c) over pairs of weight times rows[of], by at: a sparse matrix times a dense one."""
    from scipy.sparse import csr_array

    return csr_array((weight, (at, of)), shape=(n, len(rows))) @ rows


def _outer_sums(index: Index, difference: Array, weight: Array | None, n: int) -> Array:
    """Sums (n, 3, 3) of weighted outer products of differences (m, 3) over equal index."""
    sums = np.empty((n, 3, 3))
    for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        product = difference[:, a] * difference[:, b]
        sums[:, a, b] = np.bincount(index, product if weight is None else product * weight, minlength=n)
        sums[:, b, a] = sums[:, a, b]
    return sums


def _sum_by(index: Index, values: Array, n: int) -> Array:
    """Sums of values (m, c) over equal index, (n, c)."""
    return np.stack([np.bincount(index, weights=column, minlength=n) for column in values.T], axis=1)
