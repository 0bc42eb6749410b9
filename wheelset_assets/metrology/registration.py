"""Registration: matches of keypoints, robust coarse pose (eq. 22-24), ICP (eq. 25-26), and what the data constrain.

On a surface of revolution a stripe cuts one meridian, so two sensors of a station can tell each other's pose in three
directions only. The fine registration therefore carries the nominal pose as a prior with its tolerance, and says which
directions the data decided.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.revolution import RowNoise
from wheelset_assets.quality import AlgorithmFailed

Array = NDArray[Any]
Index = NDArray[np.int64]


def rigid_from_pairs(source: Array, target: Array) -> Array:
    """Least-squares target_from_source (4, 4) of paired points (n, 3), by singular value decomposition.

    Eq. 22-24 with two corrections: with E = sum (m - C_m)(n - C_n)' = U L V' the rotation is V diag(1, 1, det(V U')) U'
    (the guard against reflections), and T = C_n - R C_m (Arun 1987, Umeyama 1991).
    """
    c_source, c_target = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - c_source).T @ (target - c_target))
    rotation = vt.T @ np.diag([1.0, 1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return rigid.transform(rotation, c_target - rotation @ c_source)


def mutual_matches(source_features: Array, target_features: Array, allowed: NDArray[np.bool_]) -> tuple[Index, Index]:
    """Pairs that are each other's nearest neighbours in descriptor space among the `allowed` pairs (n_source, n_target)."""
    if not allowed.any():
        return np.empty(0, np.int64), np.empty(0, np.int64)
    distance = np.linalg.norm(source_features[:, None, :] - target_features[None, :, :], axis=2)
    distance = np.where(allowed, distance, np.inf)
    best_target, best_source = distance.argmin(axis=1), distance.argmin(axis=0)
    source = np.flatnonzero(np.isfinite(distance.min(axis=1)))
    source = source[best_source[best_target[source]] == source]
    return source, best_target[source]


@dataclass(frozen=True)
class CoarsePose:
    """Pose in the meridian plane from keypoints: rotation (rad) about the origin, then shift (lateral, radial) in mm."""

    rotation_rad: float
    shift_mm: Array
    n_inliers: int


def coarse_meridian_pose(
    source: Array,
    target: Array,
    *,
    max_rotation_rad: float,
    max_shift_mm: float,
    inlier_mm: float,
    trials: int,
    seed: int,
) -> CoarsePose | None:
    """Robust pose of matched keypoints (n, 2) (lateral, radial) within the tolerance of the nominal pose, or None.

    Random pairs of matches propose a pose (the minimal set in a plane), the one with most matches within inlier_mm is
    refined over its inliers by eq. 22-24 in two dimensions. Proposals beyond the tolerance are not considered: the
    nominal pose is known that well, and a profile repeats itself enough to mislead.
    """
    n = len(source)
    if n < 2:
        return None
    random = np.random.default_rng(seed)
    best: CoarsePose | None = None
    for _ in range(trials):
        chosen = random.choice(n, size=2, replace=False)
        pose = _planar_pose(source[chosen], target[chosen])
        inside = np.linalg.norm(_move(pose, source) - target, axis=1) <= inlier_mm
        if inside.sum() < 2 or (best is not None and inside.sum() <= best.n_inliers):
            continue
        pose = _planar_pose(source[inside], target[inside])
        centre_shift = _move(pose, source.mean(axis=0)[None])[0] - source.mean(axis=0)
        if abs(pose.rotation_rad) <= max_rotation_rad and np.abs(centre_shift).max() <= max_shift_mm:
            best = CoarsePose(pose.rotation_rad, pose.shift_mm, int(inside.sum()))
    return best if best is not None and best.n_inliers >= 3 else None


def _planar_pose(source: Array, target: Array) -> CoarsePose:
    c_source, c_target = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - c_source).T @ (target - c_target))
    rotation = vt.T @ np.diag([1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    return CoarsePose(float(np.arctan2(rotation[1, 0], rotation[0, 0])), c_target - rotation @ c_source, len(source))


def _move(pose: CoarsePose, points: Array) -> Array:
    c, s = np.cos(pose.rotation_rad), np.sin(pose.rotation_rad)
    return points @ np.array([[c, s], [-s, c]]) + pose.shift_mm


@dataclass(frozen=True)
class CurveProjection:
    """Projection of points onto a curve: signed distances (n,), unit normals (n, 2), and which points have a foot."""

    distance_mm: Array
    normal: Array
    valid: NDArray[np.bool_]
    nearest_mm: Array
    nearest: Index
    """Which of the curve's points is nearest."""


SIDE_POINTS = 4
"""Points of a curve that a foot needs on either side."""
TUKEY = 4.685
"""Residuals of so many robust standard deviations have no weight; 95 % efficient where all of them are normal."""
NORMAL_WEIGHT, NORMAL_SQUARE, NORMAL_VARIANCE = 0.9151, 0.7578, 1.0526
"""Of normal residuals under these weights: their mean, that of weighted squares, and the estimate's variance over that of
least squares."""
LEAST_SIGMA_MM = 1e-4
"""Stored coordinates are rounded to about this: nothing is told apart below."""


def project_on_curve(points: Array, curve: Array, half_width_mm: float = 1.5, half_count: int = 24) -> CurveProjection:
    """Distance of points (n, 2) from a noisy curve (m, 2) given in order, by local quadratics about the nearest point.

    A local line would be short of the curve by its sagitta (12 um over +-1 mm at a radius of 14 mm); a quadratic is
    right to third order. A point beyond the curve's end, or at a gap, has no foot, nor has one with fewer than
    SIDE_POINTS of the curve's points to either side: there the quadratic leans on one side and is off by the curve's
    third order. The curve's normal points to the left of its direction of travel.
    """
    spacing = float(np.median(np.linalg.norm(np.diff(curve, axis=0), axis=1))) if len(curve) > 1 else half_width_mm
    half_width_mm = max(half_width_mm, 6 * spacing)  # coarse images need a wider window for the same number of points
    nearest = _nearest(points, curve)
    window = np.clip(nearest[:, None] + np.arange(-half_count, half_count + 1), 0, len(curve) - 1)
    repeated = np.zeros(window.shape, bool)
    repeated[:, 1:] = window[:, 1:] == window[:, :-1]
    u, v = (curve[:, i][window] - curve[nearest, i][:, None] for i in (0, 1))
    distance = np.sqrt(u * u + v * v)
    weight = np.where((distance < half_width_mm) & ~repeated, (1 - (distance / half_width_mm) ** 2) ** 2, 0.0)
    tangent = _directions(u, v, weight)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    x = u * tangent[:, :1] + v * tangent[:, 1:]
    y = u * normal[:, :1] + v * normal[:, 1:]
    moments, right = _quadratic_equations(x, y, weight)
    count = (weight > 0).sum(axis=1)
    solvable = (count >= 7) & (np.linalg.cond(moments) < 1e10)
    coefficients = np.zeros((len(points), 3))
    coefficients[solvable] = np.linalg.solve(moments[solvable], right[solvable][..., None])[..., 0]
    relative = points - curve[nearest]
    px, py = (relative * tangent).sum(axis=1), (relative * normal).sum(axis=1)
    slope = coefficients[:, 1] + 2 * coefficients[:, 2] * px
    stretch = np.sqrt(1 + slope * slope)
    gap = py - (coefficients[:, 0] + coefficients[:, 1] * px + coefficients[:, 2] * px * px)
    before = ((weight > 0) & (x < px[:, None])).sum(axis=1)
    inside = np.minimum(before, count - before) >= SIDE_POINTS
    curve_normal = (normal - slope[:, None] * tangent) / stretch[:, None]
    return CurveProjection(gap / stretch, curve_normal, solvable & inside, np.linalg.norm(relative, axis=1), nearest)


def _nearest(points: Array, curve: Array) -> Index:
    nearest = np.empty(len(points), np.int64)
    x, y = np.ascontiguousarray(curve.T)
    for start in range(0, len(points), 16):  # curves have at most some thousand points: blocks stay in the cache
        part = points[start : start + 16]
        square, other = part[:, :1] - x, part[:, 1:] - y
        np.square(square, out=square)
        np.square(other, out=other)
        square += other
        nearest[start : start + 16] = square.argmin(axis=1)
    return nearest


def _quadratic_equations(x: Array, y: Array, weight: Array) -> tuple[Array, Array]:
    """Normal equations (n, 3, 3) and right sides (n, 3) of weighted quadratics y over x, each (n, k)."""
    moments, right = np.empty((len(x), 3, 3)), np.empty((len(x), 3))
    power = weight  # times x to the power of i + j
    for order in range(5):
        total = power.sum(axis=1)
        for i in range(max(0, order - 2), min(order, 2) + 1):
            moments[:, i, order - i] = total
        if order < 3:
            right[:, order] = np.einsum("nk,nk->n", power, y)
        power = power * x
    return moments, right


def _directions(u: Array, v: Array, weight: Array) -> Array:
    """Principal direction (n, 2) of each weighted neighbourhood (n, k), pointing along the order of the curve."""
    total = np.maximum(weight.sum(axis=1), 1e-12)
    mean_u, mean_v = (np.einsum("nk,nk->n", weight, a) / total for a in (u, v))
    du, dv = u - mean_u[:, None], v - mean_v[:, None]
    weighted_u, weighted_v = weight * du, weight * dv
    sxx, syy, sxy = (np.einsum("nk,nk->n", *pair) for pair in ((weighted_u, du), (weighted_v, dv), (weighted_u, dv)))
    angle = 0.5 * np.arctan2(2 * sxy, sxx - syy)
    tangent = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    order = weight * (np.arange(u.shape[1]) - u.shape[1] // 2)
    along = np.einsum("nk,nk->n", order, u) * tangent[:, 0] + np.einsum("nk,nk->n", order, v) * tangent[:, 1]
    return np.where(along[:, None] < 0, -tangent, tangent)


@dataclass(frozen=True)
class MeridianRegistration:
    """Motion of the source sensor's points in the rig frame that brings its meridian onto the target's.

    `motion` (4, 4) acts on rig coordinates at the nominal pose. `information` (6, 6), rotation in rad first, then mm,
    about `centre_mm`; from the data alone. `covariance`: of the data in the directions that they constrain, elsewhere
    of the prior. Standard uncertainties are of the
    three directions of the meridian plane.
    """

    motion: Array
    centre_mm: Array
    information: Array
    covariance: Array
    rmse_mm: float
    fitness: float
    n_pairs: int
    n_iterations: int
    converged: bool
    n_constrained: int
    rotation_rad: float
    lateral_mm: float
    radial_mm: float
    u_rotation_rad: float
    u_lateral_mm: float
    u_radial_mm: float


@dataclass(frozen=True)
class IcpSettings:
    """Knobs of the fine registration, in mm and rad."""

    prior_translation_mm: float
    prior_rotation_rad: float
    max_iterations: int
    convergence_mm: float
    max_pair_mm: float
    min_pairs: int
    form_floor_mm: float
    constrained_ratio: float


def register_meridians(
    source: Array,
    target: Array,
    direction_deg: float,
    start: Array,
    settings: IcpSettings,
    noise: tuple[RowNoise, RowNoise] | None = None,
) -> MeridianRegistration:
    """ICP (eq. 25-26, point to curve) of a source meridian onto a target meridian, with the nominal pose as a prior.

    source (n, 2), target (m, 2): (lateral, radial) in mm at the nominal poses, in image-row order; start (4, 4): motion
    of the rig frame to begin with. All six directions are free; those on which the data are silent stay where the
    prior holds them. The form floor is an error that is common to all pairs: it keeps directions that change the
    profile by less than that from counting as known. Raises AlgorithmFailed if too few pairs are left.

    Residuals tell the uncertainty, but they are few that are independent, and the target's noise, which each foot smooths,
    hides in their slowest part: where the noise of both curves' rows is given, no less is claimed than it leaves.
    """
    if (fewest := min(len(source), len(target))) < settings.min_pairs:
        raise AlgorithmFailed("a sensor saw too few rows to be registered", rows=fewest, required=settings.min_pairs)
    psi = np.radians(direction_deg)
    radial_axis = np.array([0.0, np.cos(psi), np.sin(psi)])
    points = source[:, :1] * np.array([1.0, 0, 0]) + source[:, 1:] * radial_axis
    centre = points.mean(axis=0)
    prior = np.diag(np.repeat([settings.prior_rotation_rad**-2.0, settings.prior_translation_mm**-2.0], 3))
    motion, reach, step = start.copy(), settings.max_pair_mm, np.inf
    pairs = _pairs(points, motion, target, reach)
    done = 0
    for done in range(1, settings.max_iterations + 1):  # noqa: B007  (read after the loop)
        if pairs.n < settings.min_pairs:
            break
        weight = 1.0 / (pairs.sigma**2 + pairs.weight.sum() * settings.form_floor_mm**2)
        jacobian = np.hstack([np.cross(pairs.moved - centre, pairs.normal), pairs.normal])
        offset = _offset_from_nominal(motion, centre)
        normal = jacobian.T @ (jacobian * (weight * pairs.weight)[:, None]) + prior
        delta = -np.linalg.solve(normal, jacobian.T @ (weight * pairs.weight * pairs.distance) + prior @ offset)
        rotation = rigid.rotation_from_vector(delta[:3])
        motion = rigid.transform(rotation, centre - rotation @ centre + delta[3:]) @ motion
        step = float(np.abs(delta[3:]).max() + np.abs(delta[:3]).max() * np.ptp(points, axis=0).max())
        pairs = _pairs(points, motion, target, reach)
        reach = float(np.clip(4 * pairs.sigma, 0.05, reach))
        if step < settings.convergence_mm and reach <= 4.5 * pairs.sigma + 0.051:
            break
    if pairs.n < settings.min_pairs:
        raise AlgorithmFailed("too few points of two sensors lie together", pairs=pairs.n, required=settings.min_pairs)
    found = _summarise(
        points, motion, centre, pairs, prior, settings, radial_axis, done, step < settings.convergence_mm * 100
    )
    if noise is None:
        return found
    least = _least_u(pairs, centre, radial_axis, (_steps(points), _steps(target)), noise)
    names = ("u_rotation_rad", "u_lateral_mm", "u_radial_mm")
    return replace(found, **{name: max(getattr(found, name), u) for name, u in zip(names, least, strict=True)})


def _least_u(
    pairs: _Pairs, centre: Array, radial_axis: Array, steps: tuple[Array, Array], noise: tuple[RowNoise, RowNoise]
) -> tuple[float, float, float]:
    """Standard uncertainties of turn (rad), lateral and radial shift (mm) that the rows' own noise leaves of the weighted
    fit; zero where it is not known. Of the target as many rows go to one of the source's as it has more of a millimetre."""
    tangential = np.cross([1.0, 0, 0], radial_axis)
    in_plane = np.column_stack([pairs.normal[:, 0], pairs.normal @ radial_axis])
    turned = np.cross(pairs.moved - centre, pairs.normal) @ tangential
    columns = np.column_stack([turned, in_plane])
    across = [(n.vectors_mm[rows] * in_plane).sum(axis=1) ** 2 for n, rows in zip(noise, pairs.rows, strict=True)]
    denser = steps[1][pairs.rows[1]] / steps[0][pairs.rows[0]]
    variance = noise[0].length_rows * across[0] + noise[1].length_rows * across[1] * denser
    if not (known := np.isfinite(variance)).any():
        return 0.0, 0.0, 0.0
    variance = np.where(known, variance, np.median(variance[known]))
    weighted = columns * pairs.weight[:, None]
    inverse = np.linalg.pinv(columns.T @ weighted)
    covariance = inverse @ (weighted.T @ (weighted * variance[:, None])) @ inverse
    turn, lateral, radial = np.sqrt(np.nan_to_num(np.diag(covariance)))
    return float(turn), float(lateral), float(radial)


def _steps(curve: Array, rows: int = 4) -> Array:
    """Distance from row to row of a curve (n, k) in mm, over some rows to either side."""
    at = np.arange(len(curve))
    low, high = np.maximum(at - rows, 0), np.minimum(at + rows, len(curve) - 1)
    return np.asarray(np.maximum(np.linalg.norm(curve[high] - curve[low], axis=1) / np.maximum(high - low, 1), 1e-6))


@dataclass(frozen=True)
class _Pairs:
    n: int
    moved: Array
    normal: Array
    distance: Array
    weight: Array
    """Tukey's, of the distance: where a profile has a kink, or dirt, neither sensor's curve is the surface."""
    sigma: float
    share: float
    rows: tuple[Index, Index]
    """Of each pair, which point of the source, and which is nearest to it of the target."""


def _pairs(points: Array, motion: Array, target: Array, reach: float) -> _Pairs:
    moved = rigid.apply(motion, points)
    radius = np.hypot(moved[:, 1], moved[:, 2])
    projection = project_on_curve(np.column_stack([moved[:, 0], radius]), target)
    keep = projection.valid & (np.abs(projection.distance_mm) <= reach) & (projection.nearest_mm <= reach + 1.0)
    outward = moved[:, 1:] / radius[:, None]
    normal = np.column_stack([projection.normal[:, 0], projection.normal[:, 1:] * outward])[keep]
    distance = projection.distance_mm[keep]
    sigma = max(1.4826 * float(np.median(np.abs(distance))), LEAST_SIGMA_MM) if keep.any() else reach
    weight = np.clip(1.0 - (distance / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
    rows = (np.flatnonzero(keep), projection.nearest[keep])
    return _Pairs(int(keep.sum()), moved[keep], normal, distance, weight, sigma, float(keep.mean()), rows)


def _offset_from_nominal(motion: Array, centre: Array) -> Array:
    return np.concatenate([rigid.vector_from_rotation(motion[:3, :3]), rigid.apply(motion, centre) - centre])


def _summarise(
    points: Array,
    motion: Array,
    centre: Array,
    pairs: _Pairs,
    prior: Array,
    settings: IcpSettings,
    radial_axis: Array,
    iterations: int,
    converged: bool,
) -> MeridianRegistration:
    jacobian = np.hstack([np.cross(pairs.moved - centre, pairs.normal), pairs.normal])
    total = float(pairs.weight.sum())
    # What weights take off the squares and off the information of normal residuals is given back.
    square = (pairs.weight * pairs.distance**2).sum() / total * NORMAL_WEIGHT / NORMAL_SQUARE
    rmse = float(np.sqrt(square))
    correlation = _correlation_length(pairs.distance, pairs.weight)
    # The fit has taken three of the independent residuals' freedoms.
    freedom = max(1.0 - 3.0 * correlation / total, 0.25)
    variance = max(rmse, LEAST_SIGMA_MM) ** 2 / freedom * correlation * NORMAL_VARIANCE * NORMAL_WEIGHT
    weighted = jacobian.T @ (jacobian * pairs.weight[:, None])
    information = weighted / variance
    known = weighted / (variance + total * settings.form_floor_mm**2)
    root = np.sqrt(np.diag(1.0 / np.diag(prior)))
    # In units of the prior: an eigenvalue of 1 / ratio^2 cuts the prior's uncertainty to that ratio.
    gain, directions = np.linalg.eigh(root @ known @ root)
    constrained = gain >= settings.constrained_ratio**-2.0
    n_constrained = int(constrained.sum())
    # In the other directions the noise of the curve's normals looks like information: there only what stands clear of
    # the form floor counts.
    told = directions[:, constrained]
    data = told @ (told.T @ root @ information @ root @ told) @ told.T
    data += (directions * np.where(constrained, 0.0, gain)) @ directions.T
    covariance = root @ np.linalg.inv(data + np.eye(6)) @ root
    offset = _offset_from_nominal(motion, centre)
    tangential = np.cross([1.0, 0, 0], radial_axis)
    axes = (np.r_[tangential, 0, 0, 0], np.r_[0, 0, 0, 1.0, 0, 0], np.r_[0, 0, 0, radial_axis])
    values = [float(axis @ offset) for axis in axes]
    u = [float(np.sqrt(axis @ covariance @ axis)) for axis in axes]
    return MeridianRegistration(
        motion,
        centre,
        information,
        covariance,
        rmse,
        pairs.share,
        pairs.n,
        iterations,
        converged,
        n_constrained,
        *values,
        *u,
    )


def _correlation_length(residuals: Array, weight: Array) -> float:
    """Factor by which correlation between neighbouring residuals inflates the variance of their weighted mean."""
    centred = np.sqrt(weight) * (residuals - (weight * residuals).sum() / weight.sum())
    variance = float((centred**2).mean())
    if variance == 0:
        return 1.0
    length = 1.0
    for lag in range(1, min(60, len(centred) // 3)):
        rho = float((centred[lag:] * centred[:-lag]).mean()) / variance
        if rho < 0.05:
            break
        length += 2 * rho
    return length
