"""From stripe centres to points: undistortion, rectification, epipolar matching, and the paper's two triangulations.

Arrays are organised grids (frames, rows). Everything is in the sensor frame (left camera, OpenCV axes, mm). Filtering
and the choice of a configuration live elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import nan_mean, nan_median
from wheelset_assets.quality import AlgorithmFailed

Array = NDArray[Any]


BLOCK_CENTRES = 32_768
"""Centres that are matched at a time: their intermediate arrays stay in a core's cache."""
BEND_FRAMES = 128
"""So many frames tell the bend of a stripe as well as is needed: a tenth of a centre's noise, before its small share."""


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with Brown's distortion. `matrix` (3, 3) in px; `distortion` k1, k2, p1, p2, k3."""

    matrix: Array
    distortion: Array


@dataclass(frozen=True)
class StereoSensor:
    """Two cameras and the pose between them: x_right = rotation x_left + translation_mm."""

    left: Camera
    right: Camera
    rotation: Array
    translation_mm: Array

    @property
    def right_centre_mm(self) -> Array:
        """Projection centre of the right camera in the left camera's frame, (3,) mm."""
        return -self.rotation.T @ self.translation_mm


@dataclass(frozen=True)
class Rectification:
    """Rotations that make both images coplanar and their rows epipolar lines; the baseline becomes the x axis."""

    rectified_from_left: Array
    rectified_from_right: Array
    baseline_mm: float


@dataclass(frozen=True)
class MatchedStripe:
    """Rectified image coordinates (focal length 1) of left centres and of their right partners, NaN where none.

    weight: share of the upper one of the two right rows between which the partner lies; None where it is exact.
    """

    x_left: Array
    x_right: Array
    y: Array
    weight: Array | None = None

    def right_variance_ratio(self, neighbour_correlation: float = 0.0) -> Array | float:
        """Variance of the partner's abscissa over that of one right centre: the mean of two rows is less noisy.

        neighbour_correlation: correlation of the noise of two neighbouring rows' centres.
        """
        if self.weight is None:
            return 1.0
        return 1 - 2 * self.weight * (1 - self.weight) * (1 - neighbour_correlation)


def rectify(sensor: StereoSensor) -> Rectification:
    """Rectifying rotations with the baseline as the common x axis (after Fusiello, Trucco and Verri 2000).

    The baseline may point along either image axis; the rectified z axis stays as near to the left camera's as it can.
    """
    centre = sensor.right_centre_mm
    baseline_mm = float(np.linalg.norm(centre))
    if baseline_mm < 1e-6:
        raise AlgorithmFailed("the two cameras of a sensor stand in one place", baseline_mm=baseline_mm)
    x_axis = centre / baseline_mm
    y_axis = np.cross([0.0, 0.0, 1.0], x_axis)
    if np.linalg.norm(y_axis) < 0.05:
        raise AlgorithmFailed("the baseline lies along the left camera's axis: the epipole is inside the image")
    y_axis /= np.linalg.norm(y_axis)
    rectified_from_left = np.stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    return Rectification(rectified_from_left, rectified_from_left @ sensor.rotation.T, baseline_mm)


def distort(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Pixel coordinates (u, v) of ideal image coordinates (x, y) at focal length 1 (Brown 1971)."""
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    m = camera.matrix
    return m[0, 0] * xd + m[0, 1] * yd + m[0, 2], m[1, 1] * yd + m[1, 2]


def undistort(camera: Camera, u: Array, v: Array) -> tuple[Array, Array]:
    """Ideal image coordinates (x, y) at focal length 1 of pixels (u, v), by Newton's method to 1e-13; NaN stays NaN.

    Raises AlgorithmFailed if it does not converge: the distortion model is then not one-to-one over these pixels.
    """
    m = camera.matrix
    yd = (v - m[1, 2]) / m[1, 1]
    xd = (u - m[0, 2] - m[0, 1] * yd) / m[0, 0]
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = xd.copy(), yd.copy()
    worst = np.inf
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
        ex = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - xd
        ey = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - yd
        jxx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        jyy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        jxy = slope * x * y + 2 * p1 * x + 2 * p2 * y
        determinant = jxx * jyy - jxy * jxy
        x -= (jyy * ex - jxy * ey) / determinant
        y -= (jxx * ey - jxy * ex) / determinant
        error = np.maximum(np.abs(ex), np.abs(ey))
        worst = float(np.nanmax(error)) if np.isfinite(error).any() else 0.0
        if worst < 1e-13:
            return x, y
    if worst > 1e-9:
        raise AlgorithmFailed("the distortion cannot be inverted over the image", residual=worst)
    return x, y


class RowPolynomials:
    """Rectified coordinates as a polynomial of u for every image row, so that millions of centres cost two Horner loops.

    Fitted at Chebyshev nodes between the smallest and largest u that occur; the degree is raised until the
    polynomials agree with the exact inverse to 1e-11 (2e-8 px at f = 2,000 px) at points between the nodes.
    """

    def __init__(
        self, camera: Camera, rectified_from_camera: Array, n_rows: int, u_min_px: float, u_max_px: float
    ) -> None:
        self.middle_px = 0.5 * (u_min_px + u_max_px)
        self.half_px = max(0.5 * (u_max_px - u_min_px), 1.0)
        for degree in (5, 8, 12, 17):
            self._x, self._y = self._fit(camera, rectified_from_camera, n_rows, degree)
            t = np.linspace(-1, 1, 23)
            exact = self._exact(camera, rectified_from_camera, n_rows, t)
            error = max(
                float(np.abs(_horner(c, t[:, None]) - e).max()) for c, e in zip((self._x, self._y), exact, strict=True)
            )
            if error < 1e-11:
                return
        raise AlgorithmFailed("the lens distortion is too strong to tabulate", residual=error)

    def _exact(self, camera: Camera, rotation: Array, n_rows: int, t: Array) -> tuple[Array, Array]:
        u = np.broadcast_to((self.middle_px + self.half_px * t)[:, None], (len(t), n_rows)).astype(float)
        v = np.broadcast_to(np.arange(n_rows, dtype=float), u.shape)
        x, y = undistort(camera, u, v)
        return rotate_image(rotation, x, y)

    def _fit(self, camera: Camera, rotation: Array, n_rows: int, degree: int) -> tuple[Array, Array]:
        nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
        values = self._exact(camera, rotation, n_rows, nodes)
        vandermonde = np.vander(nodes, degree + 1)
        x, y = (np.linalg.solve(vandermonde, value) for value in values)
        return x, y

    def __call__(self, u_px: Array) -> tuple[Array, Array]:
        """Rectified (x, y), each (frames, rows), of u (frames, rows) in px."""
        t = (u_px - self.middle_px) / self.half_px
        return _horner(self._x, t), _horner(self._y, t)


def _horner(coefficients: Array, t: Array) -> Array:
    value = np.broadcast_to(coefficients[0], np.broadcast_shapes(coefficients[0].shape, t.shape)).copy()
    for c in coefficients[1:]:
        value *= t
        value += c
    return value


def rotate_image(b_from_a: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Image coordinates at focal length 1 after the camera frame is turned by b_from_a (3, 3)."""
    m = b_from_a
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2]
    return (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / depth, (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / depth


def rectified_scales(
    sensor: StereoSensor, rectification: Rectification, left_u_px: Array, right_u_px: Array
) -> tuple[float, float]:
    """Change of the rectified abscissa (f = 1) with one pixel of u, left and right, in the middle of what was seen.

    1 / f in the middle of a camera that looks along its normal; lens and rectification make it a tenth more or less.
    """
    found = []
    for camera, rotation, u in (
        (sensor.left, rectification.rectified_from_left, left_u_px),
        (sensor.right, rectification.rectified_from_right, right_u_px),
    ):
        some = u[:: max(1, len(u) // 16)]
        frame, row = np.nonzero(np.isfinite(some))
        u_px, v_px = (
            (np.median(some[frame, row]), np.median(row)) if len(row) else (camera.matrix[0, 2], camera.matrix[1, 2])
        )
        x, _ = rotate_image(rotation, *undistort(camera, u_px + np.array([-0.5, 0.5]), np.full(2, v_px)))
        found.append(abs(float(x[1] - x[0])))
    return found[0], found[1]


def match_stripes(
    sensor: StereoSensor, rectification: Rectification, left_u_px: Array, right_u_px: Array, max_step_px: float
) -> MatchedStripe:
    """Partner of every left centre on its epipolar line, by interpolation of the right stripe between two rows.

    Linear in the frame's own centres, which keeps their noise, less the sagitta of the stripe's bend there: on a flank that
    is seen at a grazing angle a chord would be off by some um. The bend is that of the whole turn, row by row.
    left_u_px, right_u_px: (frames, rows), NaN where no stripe was seen; rows of the two images may differ in number. No
    partner is made across a missing row or a jump of the stripe of more than max_step_px.
    """
    shape = left_u_px.shape
    if not (np.isfinite(left_u_px).any() and np.isfinite(right_u_px).any()):
        nothing = np.full(shape, np.nan)
        return MatchedStripe(nothing, nothing, nothing, nothing)
    left_u_px, right_u_px = _without_far_reflections(left_u_px), _without_far_reflections(right_u_px)
    left, right = (
        RowPolynomials(camera, rotation, u.shape[1], np.nanmin(u), np.nanmax(u))
        for camera, rotation, u in (
            (sensor.left, rectification.rectified_from_left, left_u_px),
            (sensor.right, rectification.rectified_from_right, right_u_px),
        )
    )
    seen = np.isfinite(right_u_px)
    count = seen.sum(axis=0)
    row_mean = np.where(seen, right_u_px, 0.0).sum(axis=0) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    row_mean = np.interp(np.arange(right_u_px.shape[1]), known, row_mean[known])
    sagitta = _bend(right_u_px, max_step_px) * (right(row_mean[None] + 0.5)[0] - right(row_mean[None] - 0.5)[0])[0]
    out = [np.empty(shape) for _ in range(4)]
    per_block = max(1, BLOCK_CENTRES // max(shape[1], 1))
    for start in range(0, shape[0], per_block):  # blocks that stay in the cache
        part = slice(start, start + per_block)
        matched = _match_block(left, right, left_u_px[part], right_u_px[part], row_mean, sagitta, max_step_px)
        for whole, piece in zip(out, matched, strict=True):
            whole[part] = piece
    return MatchedStripe(*out)


def _bend(u_px: Array, max_step_px: float) -> Array:
    """Second difference of a stripe (frames, rows) from row to row, half of it: (rows,), of the interval from each row to
    the next. The median over the turn, along which a profile repeats itself; zero where it is not known.
    """
    some = u_px[:: max(1, len(u_px) // BEND_FRAMES)]
    step = np.diff(some, axis=1)
    with np.errstate(invalid="ignore"):
        step[np.abs(step) > max_step_px] = np.nan
    bend = np.full(u_px.shape[1], np.nan)
    bend[1:-1] = nan_median(np.diff(step, axis=1), axis=0)
    of_interval, _ = nan_mean(np.stack([bend[:-1], bend[1:]]), axis=0)
    return 0.5 * np.append(np.nan_to_num(of_interval), 0.0)


def _match_block(
    left: RowPolynomials,
    right: RowPolynomials,
    left_u: Array,
    right_u: Array,
    row_mean: Array,
    sagitta: Array,
    max_step_px: float,
) -> tuple[Array, Array, Array, Array]:
    """x_left, x_right, y and weight of some frames; a missing right row is bridged for the search only."""
    x_left, y_left = left(left_u)
    x_right, y_right = right(np.where(np.isnan(right_u), row_mean, right_u))
    step = right_u[:, 1:] - right_u[:, :-1]
    with np.errstate(invalid="ignore"):
        joined = np.abs(step) <= max_step_px  # false where either row is missing
    rise = np.where(joined, y_right[:, 1:] - y_right[:, :-1], np.nan)
    run = x_right[:, 1:] - x_right[:, :-1]
    lower, target = _bracket(y_left, y_right)
    last = right_u.shape[1] - 1
    frames = np.arange(len(left_u))[:, None]
    at, gap = frames * (last + 1) + lower, frames * last + lower
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = (target - y_right.ravel()[at]) / rise.ravel()[gap]
        good = (weight >= 0) & (weight <= 1) & ~np.isnan(left_u)
    partner = x_right.ravel()[at] + weight * run.ravel()[gap]
    partner -= weight * (1.0 - weight) * sagitta.take(lower)
    bad = ~good
    for values in (x_left, partner, y_left, weight):
        values[bad] = np.nan
    return x_left, partner, y_left, weight


def _without_far_reflections(u_px: Array) -> Array:
    """The same centres without those farther outside all others than these are wide: no lens model holds out there."""
    sample = u_px.ravel()[:: max(1, u_px.size // 200_000)]
    if not np.isfinite(sample).any():
        sample = u_px
    low, high = np.nanpercentile(sample, [0.5, 99.5])
    reach = high - low + 100.0
    with np.errstate(invalid="ignore"):
        far = (u_px < low - reach) | (u_px > high + reach)
    return np.where(far, np.nan, u_px) if far.any() else u_px


def _bracket(y_left: Array, y_right: Array) -> tuple[NDArray[np.int64], Array]:
    """Row of the right image below each left centre: y_right[row] <= y_left < y_right[row + 1], frame by frame; and
    y_left with zeros for what is missing.

    Rows are almost equidistant in y, so an affine guess and a few secant steps find it for all centres at once; the
    rows of the right image run with y or against it.
    """
    n_rows = y_right.shape[1]
    mean = y_right.mean(axis=0)
    per_row = (mean[-1] - mean[0]) / (n_rows - 1)
    target = np.nan_to_num(y_left)
    row = np.clip((target - mean[0]) / per_row, 0, n_rows - 2).astype(np.int64)
    offset = np.arange(len(y_left))[:, None] * n_rows
    flat = y_right.ravel()
    for _ in range(4):
        step = np.floor((target - flat[offset + row]) / per_row).astype(np.int64)
        if not step.any():
            break
        moved = np.clip(row + step, 0, n_rows - 2)
        if np.array_equal(moved, row):
            break
        row = moved
    return row, target


def triangulate_disparity(rectification: Rectification, matched: MatchedStripe) -> Array:
    """Points (frames, rows, 3) in mm, sensor frame, from the disparity of rectified centres.

    Paper eq. 11-13 with f = 1 and (u0, v0) = 0: Z = B / d, X = x_left Z, Y = y Z. No disparity (parallel rays) gives NaN.
    """
    disparity = matched.x_left - matched.x_right
    z = rectification.baseline_mm / np.where(disparity == 0, np.nan, disparity)
    m = rectification.rectified_from_left  # rows are the rectified axes: left = m.T @ rectified
    points = np.empty((*z.shape, 3))
    for i in range(3):
        points[..., i] = (m[0, i] * matched.x_left + m[1, i] * matched.y + m[2, i]) * z
    return points


def triangulate_least_squares(sensor: StereoSensor, rectification: Rectification, matched: MatchedStripe) -> Array:
    """Points (frames, rows, 3) in mm, sensor frame, by linear least squares over the four planes of the two rays.

    Paper eq. 8-10 with its misprint mended: the rows are (u m3 - m1) and (v m3 - m2) of each camera. Image coordinates
    are undistorted and at focal length 1, which conditions the system well. Parallel rays give NaN.
    """
    x_l, y_l = rotate_image(rectification.rectified_from_left.T, matched.x_left, matched.y)
    x_r, y_r = rotate_image(rectification.rectified_from_right.T, matched.x_right, matched.y)
    left = np.hstack([np.eye(3), np.zeros((3, 1))])
    right = np.hstack([sensor.rotation, sensor.translation_mm.reshape(3, 1)])
    normal = np.zeros((*x_l.shape, 3, 3))
    moment = np.zeros((*x_l.shape, 3))
    for x, y, p in ((x_l, y_l, left), (x_r, y_r, right)):
        for value, line in ((x, 0), (y, 1)):
            a = value[..., None] * p[2] - p[line]  # plane a . (X, Y, Z, 1) = 0
            normal += a[..., :3, None] * a[..., None, :3]
            moment -= a[..., :3] * a[..., 3:]
    points = np.full((*x_l.shape, 3), np.nan)
    good = np.asarray(np.isfinite(moment).all(axis=-1))
    good[good] = np.linalg.det(normal[good]) > 1e-20  # the square of the rays' angle: over 1e-10 rad
    points[good] = np.linalg.solve(normal[good], moment[good][..., None])[..., 0]
    return points


def intersect_rays(sensor: StereoSensor, x_left: Array, y_left: Array, x_right: Array, y_right: Array) -> Array:
    """Midpoints (..., 3) in mm of the shortest line between two rays, given at focal length 1; parallel rays give NaN."""
    left = np.stack([x_left, y_left, np.ones_like(x_left)], axis=-1)
    right = np.stack([x_right, y_right, np.ones_like(x_right)], axis=-1) @ sensor.rotation
    centre = sensor.right_centre_mm
    ll, rr, lr = (left * left).sum(-1), (right * right).sum(-1), (left * right).sum(-1)
    lc, rc = left @ centre, right @ centre
    determinant = ll * rr - lr * lr
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (rr * lc - lr * rc) / determinant, (lr * lc - ll * rc) / determinant
        return np.where(
            (determinant > 1e-20 * ll * rr)[..., None],
            0.5 * (left * a[..., None] + centre + right * b[..., None]),
            np.nan,
        )


def triangulate_general(
    x_left: Array, y_left: Array, x_right: Array, y_right: Array, rotation: Array, translation_mm: Array
) -> tuple[Array, Array]:
    """Depth along the left camera's axis from one match in general position: from the right x, and from the right y.

    Paper eq. 5 in its standard form (the second expression is misprinted there), f_l = f_r = 1; arrays of one shape.
    Both agree on exact input; the one along the baseline is the well-conditioned one. Returns two depths in mm.
    """
    ray = np.stack([x_left, y_left, np.ones_like(x_left)], axis=-1) @ rotation.T
    t = np.asarray(translation_mm, float).ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        from_x = (t[0] - x_right * t[2]) / (x_right * ray[..., 2] - ray[..., 0])
        from_y = (t[1] - y_right * t[2]) / (y_right * ray[..., 2] - ray[..., 1])
    return from_x, from_y


def depth_uncertainty(
    rectification: Rectification,
    matched: MatchedStripe,
    left_u: float,
    right_u: float,
    neighbour_correlation: float = 0.0,
) -> Array:
    """Standard uncertainty (frames, rows) in mm along the line of sight, from that of the centres in units of f = 1.

    First order in Z = B / d: u(Z) = Z^2 / B * sqrt(u_left^2 + u_partner^2), times the ray's length for Z = 1.
    """
    disparity = matched.x_left - matched.x_right
    z = rectification.baseline_mm / disparity
    across = np.sqrt(left_u**2 + right_u**2 * matched.right_variance_ratio(neighbour_correlation))
    return z * z / rectification.baseline_mm * across * np.sqrt(1 + matched.x_left**2 + matched.y**2)


def point_covariance(
    rectification: Rectification,
    matched: MatchedStripe,
    left_u: Array | float,
    right_u: Array | float,
    neighbour_correlation: float = 0.0,
) -> Array:
    """Noise part of each point's covariance (..., 3, 3) in mm^2, sensor frame, from the centres' standard uncertainties
    in units of f = 1 (numbers, or one for each centre).

    First order in eq. 11-13: dP/dx_right moves a point along its line of sight, dP/dx_left along it and across. Image
    rows are taken as epipolar lines: a baseline rolled by 12 degrees against them raises pulls to 1.08.
    """
    disparity = matched.x_left - matched.x_right
    z = rectification.baseline_mm / disparity
    sight = np.stack([matched.x_left, matched.y, np.ones_like(matched.y)], axis=-1)
    by_right = sight * (z / disparity)[..., None]
    by_left = -by_right
    by_left[..., 0] += z
    variance = np.broadcast_to(np.asarray(right_u) ** 2 * matched.right_variance_ratio(neighbour_correlation), z.shape)
    total = np.zeros((*z.shape, 3, 3))
    for by, square in ((by_left, np.broadcast_to(np.asarray(left_u) ** 2, z.shape)), (by_right, variance)):
        turned = by @ rectification.rectified_from_left
        total += square[..., None, None] * turned[..., :, None] * turned[..., None, :]
    return total


def off_plane_uncertainty(
    rectification: Rectification,
    matched: MatchedStripe,
    left_u: float,
    right_u: float,
    normal: Array,
    neighbour_correlation: float = 0.0,
) -> Array:
    """Standard uncertainty (frames, rows) in mm across a plane of that normal (3,), sensor frame, first order.

    A left centre's error moves a point along the right ray, a right centre's along the left ray: a sheet that lies along
    one of the rays still sees the other's noise. Image rows are taken as epipolar lines, as in `point_covariance`.
    """
    n = rectification.rectified_from_left @ np.asarray(normal, float)
    z = rectification.baseline_mm / (matched.x_left - matched.x_right)
    by_left, by_right = _across(n, matched.x_left, matched.y, z, rectification.baseline_mm)
    ratio = matched.right_variance_ratio(neighbour_correlation)
    return np.sqrt((by_left * left_u) ** 2 + (by_right * right_u) ** 2 * ratio)


def _across(n: Array, x_left: Array, y: Array, z: Array, baseline_mm: float) -> tuple[Array, Array]:
    """Change of a point's distance from a plane of rectified normal n with the left and with the right abscissa."""
    by_right = (n[0] * x_left + n[1] * y + n[2]) * z * z / baseline_mm
    return n[0] * z - by_right, by_right


def triangulate_optimal(
    rectification: Rectification,
    matched: MatchedStripe,
    left_u: Array | float,
    right_u: Array | float,
    plane: tuple[Array, float, float] | None = None,
    neighbour_correlation: float = 0.0,
) -> Array:
    """Points (frames, rows, 3) in mm, sensor frame, that fit all rows best by the variances of the centres.

    The four rows of eq. 8-10 hold three unknowns, and the match puts both rays into one epipolar plane: whatever the
    variances, their best point is the disparity's. A laser plane (normal (3,) in the sensor frame, distance in mm, its
    standard uncertainty in mm) is a fifth row; both abscissae then give way to it by their share of its variance
    (adjustment with one condition, first order).
    """
    if plane is None:
        return triangulate_disparity(rectification, matched)
    normal, distance_mm, plane_u_mm = plane
    left_variance = np.asarray(left_u) ** 2
    right_variance = np.asarray(right_u) ** 2 * matched.right_variance_ratio(neighbour_correlation)
    n = rectification.rectified_from_left @ np.asarray(normal, float)
    x_left, x_right = matched.x_left, matched.x_right
    for _ in range(2):  # the second step takes what is left of second order
        z = rectification.baseline_mm / (x_left - x_right)
        by_left, by_right = _across(n, x_left, matched.y, z, rectification.baseline_mm)
        along = by_right * rectification.baseline_mm / z
        first = by_left * (matched.x_left - x_left) + by_right * (matched.x_right - x_right)
        gap = (along - distance_mm + first) / (
            by_left**2 * left_variance + by_right**2 * right_variance + plane_u_mm**2
        )
        x_left = matched.x_left - gap * by_left * left_variance
        x_right = matched.x_right - gap * by_right * right_variance
    return triangulate_disparity(rectification, MatchedStripe(x_left, x_right, matched.y))
