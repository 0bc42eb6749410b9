"""Surfaces of revolution about the rig's X axis: meridian coordinates, mean meridians, harmonics of the turn.

A stripe sensor sees one meridian while the wheelset turns; every frame repeats it. What is said here about lateral,
radial and tangential directions holds for wheels and journals alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.grids import blocks, nan_mean, nan_median

Array = NDArray[Any]
Mask = NDArray[np.bool_]

MOST_DIFFERENCES = 256
"""Frames that tell the noise of a frame: so many know a standard deviation to 4 %."""
LEAST_DIFFERENCES = 4
LEAST_COMMON = 8
"""Fewer frames that all views share are no turn."""
EDGE_SIGMAS = 2.5
"""A frame beside excluded ones is excluded from so many robust scatters on, if it is off to the same side."""
EDGE_FRAMES = 4
"""So many on either side at most."""


@dataclass(frozen=True)
class MeridianGrid:
    """One sensor and laser line as meridian coordinates (frames, rows): along the axle, and distance from it, in mm."""

    sensor_id: str
    line: int
    lateral_mm: Array
    radial_mm: Array
    direction_deg: float
    """Mean direction of the points about the axle, from +Y towards +Z."""
    u_mm: Array
    """Standard uncertainty of each point along its line of sight."""
    first_row: int = 0
    row_step: int = 1
    """Column k of the grid is image row first_row + k row_step."""


def to_meridian(
    sensor_id: str,
    line: int,
    x: Array,
    y: Array,
    z: Array,
    u_mm: Array,
    rig_from_sensor: Array,
    first_row: int = 0,
    row_step: int = 1,
) -> MeridianGrid:
    """Meridian coordinates of sensor-frame grids (frames, rows) in mm.

    Paper eq. 28 in its exact form: the radius is the distance from the axle, so a sideways offset of the laser plane is
    not mistaken for height (rho = K + z holds only where the plane contains the axle).
    """
    m = rig_from_sensor
    lateral, across, up = (np.empty(x.shape) for _ in range(3))
    for part in blocks(x.shape):
        for made, row in ((lateral, m[0]), (across, m[1]), (up, m[2])):
            here = row[0] * x[part]
            here += row[1] * y[part]
            here += row[2] * z[part]
            np.add(here, row[3], out=made[part])
    seen = np.isfinite(across)
    direction = float(np.degrees(np.arctan2(up[seen].sum(), across[seen].sum()))) if seen.any() else float("nan")
    return MeridianGrid(sensor_id, line, lateral, np.hypot(across, up, out=up), direction, u_mm, first_row, row_step)


def meridian_motion(
    direction_deg: float, pivot_mm: tuple[float, float], rotation_rad: float, lateral_mm: float, radial_mm: float
) -> Array:
    """Rigid motion (4, 4) of the rig frame within the meridian plane at direction_deg.

    (lateral, radial) turn by rotation_rad about pivot_mm from lateral towards radial, then shift.
    """
    psi = np.radians(direction_deg)
    axial, radial = np.array([1.0, 0.0, 0.0]), np.array([0.0, np.cos(psi), np.sin(psi)])
    rotation = rigid.rotation_from_vector(np.cross(axial, radial) * rotation_rad)
    pivot = pivot_mm[0] * axial + pivot_mm[1] * radial
    return rigid.transform(rotation, pivot - rotation @ pivot + lateral_mm * axial + radial_mm * radial)


@dataclass(frozen=True)
class RowNoise:
    """Noise of a meridian's rows: the vector (rows, 2) in mm, lateral and radial, by which one standard deviation moves
    each, and the integral length in rows of its correlation with its neighbours'."""

    vectors_mm: Array
    length_rows: float


@dataclass(frozen=True)
class MeanMeridian:
    """Mean over the turn for each image row of one sensor and line: (rows,) and, leaving groups of frames out, (groups, rows)."""

    lateral_mm: Array
    radial_mm: Array
    u_mm: Array
    """Standard uncertainty of the mean along its larger component, from the scatter over the turn."""
    n_frames: NDArray[np.int64]
    left_out_lateral_mm: Array
    left_out_radial_mm: Array
    frame_noise_mm: tuple[Array, Array]
    """Lateral and radial of some frames (k, rows), less the mean of the frames before and after, as deviations of one frame."""

    def row_noise(self, neighbours: int = 7) -> RowNoise:
        """Noise of the rows that were seen, in their order.

        From frames less those beside them: run-out, which moves a row along the same line of sight, hardly differs between
        neighbours, whatever the number of frames. Of the standard deviation the median over some neighbours is taken.
        """
        known = np.isfinite(self.frame_noise_mm[0])
        count = known.sum(axis=0)
        seen = np.isfinite(self.lateral_mm) & (count >= LEAST_DIFFERENCES)
        scale = 1.0 / np.sqrt(np.maximum(count, 1) * np.maximum(self.n_frames, 1))
        a, r = (np.where(known, noise, 0.0)[:, seen] * scale[seen] for noise in self.frame_noise_mm)
        angle = 0.5 * np.arctan2(2 * (a * r).sum(axis=0), (a * a - r * r).sum(axis=0))
        along = a * np.cos(angle) + r * np.sin(angle)
        length = np.sqrt((along**2).sum(axis=0))
        padded = np.pad(length, neighbours, constant_values=np.nan)
        windows = (
            np.lib.stride_tricks.sliding_window_view(padded, 2 * neighbours + 1) if len(length) else padded[:, None]
        )
        even = nan_median(windows, axis=1)[: len(length)]
        vectors = np.full((len(self.lateral_mm), 2), np.nan)
        vectors[seen] = even[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return RowNoise(vectors[np.isfinite(self.lateral_mm)], _integral_length(along / np.maximum(length, 1e-12)))


def mean_meridian(
    lateral_mm: Array, radial_mm: Array, used: Mask, *, clip: float = 4.0, groups: int = 24, min_frames: int = 3
) -> MeanMeridian:
    """Mean meridian of grids (frames, rows) over the frames that are `used` (frames,), clipped at `clip` robust scatters.

    A point is judged by the frames about it, so that run-out is not clipped: from some rows more than from others.
    The rows of the image fix the lines of sight, so a point moves along its own line as the wheel turns and the mean
    stays on the profile up to (run-out)^2 / (2 radius of curvature). The delete-a-group means serve the jackknife:
    frames are independent of each other, rows are not.
    """
    a, r = lateral_mm[used], radial_mm[used]
    keep = np.isfinite(a)
    for values in (a, r):
        deviation = _from_frames_about(values)
        scatter = 1.4826 * nan_median(deviation, axis=0)
        with np.errstate(invalid="ignore"):
            keep &= deviation <= clip * np.maximum(scatter, 1e-6)
    groups = max(2, min(groups, len(a)))
    starts = [np.s_[g::groups] for g in range(groups)]
    count = np.stack([keep[i].sum(axis=0) for i in starts])
    sums = []
    for values in (a, r):
        kept = np.where(keep, values, 0.0)
        sums.append(np.stack([kept[i].sum(axis=0) for i in starts]))
    n = count.sum(axis=0)
    valid = n >= max(min_frames, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.where(valid, n, np.nan)
        mean_a, mean_r = (s.sum(axis=0) / total for s in sums)
        left = np.where(valid & (n - count > 0), n - count, np.nan)
        left_a, left_r = ((s.sum(axis=0) - s) / left for s in sums)
        square = np.zeros(a.shape[1])
        for part in blocks(a.shape):
            away_a, away_r = a[part] - mean_a, r[part] - mean_r
            np.square(away_a, out=away_a)
            np.square(away_r, out=away_r)
            away_a += away_r
            np.copyto(away_a, 0.0, where=~keep[part])
            away_a[0] += square  # frame after frame, as if there were no blocks
            square = away_a.sum(axis=0)
        u = np.sqrt(square / np.where(n > 1, n - 1, np.nan) / total)
    return MeanMeridian(mean_a, mean_r, u, n, left_a, left_r, _frame_noise(a, r, keep))


def _frame_noise(lateral_mm: Array, radial_mm: Array, keep: Mask) -> tuple[Array, Array]:
    """Some frames, spread over all, less the mean of both neighbours round the turn, over sqrt(1.5): the noise of a frame."""
    n = len(keep)
    at = np.arange(0, n, max(1, n // MOST_DIFFERENCES))
    before, after = at - 1, (at + 1) % max(n, 1)
    whole = keep[at] & keep[before] & keep[after] if n >= 3 else np.zeros((len(at), keep.shape[1]), bool)
    first, second = (
        np.where(whole, (v[at] - 0.5 * (v[before] + v[after])) / np.sqrt(1.5), np.nan) for v in (lateral_mm, radial_mm)
    )
    return first, second


def common_frames(depths: Sequence[Array]) -> Mask:
    """Frames (frames,) in which every view saw at least half of the rows that it sees in most; all if these are too few.

    Means of a station's views over different frames differ by the run-out of those that only some saw.
    """
    counts = [np.isfinite(depth).sum(axis=1) for depth in depths]
    seen = [c >= 0.5 * np.median(c[c > 0]) for c in counts if (c > 0).any()]
    common = np.logical_and.reduce(seen) if seen else np.zeros(len(depths[0]) if depths else 0, bool)
    return common if common.sum() >= LEAST_COMMON else np.ones(len(common), bool)


def _integral_length(noise: Array, least: float = 0.02, most: int = 60) -> float:
    """Integral over the lags of the correlation of noise (groups, rows) of unit sum of squares a row."""
    found = 1.0
    for lag in range(1, min(most, noise.shape[1] - 1)):
        rho = float((noise[:, lag:] * noise[:, :-lag]).sum(axis=0).mean())
        if rho < least:
            break
        found += 2.0 * rho
    return found


def _from_frames_about(values: Array) -> Array:
    """Distance (frames, rows) of each point from the median of its row in the two frames before and the two after, round
    the turn; from that of all frames where none of these saw it. NaN where the point is missing."""
    n = len(values)
    around = np.concatenate([values[np.arange(-2, 0) % n], values, values[np.arange(2) % n]])
    deviation = np.empty(values.shape)
    for part in blocks(values.shape):
        a, b, c, d = (around[part.start + k : part.stop + k] for k in (0, 1, 3, 4))
        # The middle two of four are the larger of both smaller ones and the smaller of both larger ones, of any two pairs.
        low = np.minimum(a, b)
        np.maximum(low, np.minimum(c, d), out=low)
        high = np.maximum(a, b)
        np.minimum(high, np.maximum(c, d), out=high)
        low += high
        low *= 0.5
        low -= values[part]
        np.abs(low, out=deviation[part])
    frame, row = np.nonzero(np.isnan(deviation) & np.isfinite(values))
    if frame.size:
        about = nan_median(np.stack([around[frame + k, row] for k in (0, 1, 3, 4)]), axis=0)
        alone = np.flatnonzero(np.isnan(about))
        if alone.size:
            columns, at = np.unique(row[alone], return_inverse=True)
            about[alone] = nan_median(values[:, columns], axis=0)[at]
        deviation[frame, row] = np.abs(values[frame, row] - about)
    return deviation


def grouped_meridians(lateral_mm: Array, radial_mm: Array, groups: int) -> tuple[Array, Array]:
    """Medians of `groups` interleaved sets of frames, (groups, rows) each: a turn folded into a few columns."""
    groups = max(1, min(groups, len(lateral_mm)))
    folded = [
        (nan_median(lateral_mm[g::groups], axis=0), nan_median(radial_mm[g::groups], axis=0)) for g in range(groups)
    ]
    return np.stack([f[0] for f in folded]), np.stack([f[1] for f in folded])


def frame_offsets(
    values: Array, expected: Array, rows: Mask, weights: Array | None = None
) -> tuple[Array, NDArray[np.int64]]:
    """Mean over `rows` of values - expected for each frame (frames,), clipped at four scatters, and the points in it.

    values (frames, rows); expected broadcasts against it; rows (rows,). NaN where a frame has no point there.
    """
    deviation = values[:, rows] - np.broadcast_to(expected, values.shape)[:, rows]
    middle = nan_median(deviation, axis=1)[:, None]
    spread = np.abs(deviation - middle)
    scatter = 1.4826 * float(np.median(spread[np.isfinite(spread)])) if np.isfinite(spread).any() else 0.0
    with np.errstate(invalid="ignore"):
        deviation = np.where(spread <= 4 * max(scatter, 1e-6), deviation, np.nan)
    w = None if weights is None else np.broadcast_to(weights[rows], deviation.shape)
    return nan_mean(deviation, axis=1, weights=w)


@dataclass(frozen=True)
class HarmonicFit:
    """Harmonics of a quantity over the turn: mean + sum of a_n cos(n angle) + b_n sin(n angle)."""

    mean: float
    u_mean: float
    cosine: Array
    sine: Array
    fitted: Array
    """Model at every given angle (frames,)."""
    used: Mask
    scatter: float
    """Standard deviation of the residuals of the used frames."""
    coverage_ratio: float
    max_gap_deg: float
    peak_to_peak: float
    """Maximum minus minimum of the model over the turn."""
    u_peak_to_peak: float

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the scatter."""
        return max(int(self.used.sum()) - 2 * len(self.cosine) - 1, 0)


def coverage(angle_deg: Array) -> tuple[float, float]:
    """Share of the turn that the angles (n,) cover, and the largest gap in degrees.

    Each angle stands for the arc to its neighbours, up to twice the usual one; a longer arc is a gap.
    """
    turn = np.unique(np.mod(angle_deg, 360.0))
    if turn.size < 2:
        return 0.0, 360.0
    arcs = np.diff(np.concatenate([turn, [turn[0] + 360.0]]))
    typical = max(2 * usual_arc(arcs), 1e-9)
    return float(np.minimum(arcs, typical).sum() / 360.0), float(arcs.max())


def usual_arc(arcs_deg: Array) -> float:
    """The arc between neighbours in whose like, or smaller ones, half of the turn lies; the largest, a gap perhaps, is left out.

    A plain median fails over more than one revolution, where as many arcs lie between frames at nearly the same angle.
    """
    rest = np.sort(arcs_deg)[:-1] if len(arcs_deg) > 2 else np.sort(arcs_deg)
    return float(rest[np.searchsorted(np.cumsum(rest), 0.5 * rest.sum())])


def fit_harmonics(angle_deg: Array, values: Array, order: int, exclude_sigmas: float) -> HarmonicFit | None:
    """Robust least-squares harmonics up to `order` of values (frames,) at angle_deg (frames,); None if too few.

    Frames are excluded while they lie farther from the model than exclude_sigmas robust scatters (dirt, flats). The
    order is lowered where the frames or a gap cannot support it: at least three frames a coefficient, and no gap
    longer than three quarters of a wavelength of the highest order.
    """
    seen = np.isfinite(values)
    if seen.sum() < 4:
        return None
    _, gap = coverage(angle_deg[seen])
    order = int(max(0, min(order, (seen.sum() // 3 - 1) // 2, np.floor(270.0 / gap) if gap > 0 else order)))
    used = _robust_use(angle_deg, values, seen, seen, min(order, 2), 1.5 * exclude_sigmas)
    used = _robust_use(angle_deg, values, used, seen, order, exclude_sigmas)
    used = _without_edges(angle_deg, values, seen, used, order)
    design = _harmonic_design(angle_deg, order)
    if used.sum() < max(4, design.shape[1] + 2):
        return None
    coefficients = np.linalg.lstsq(design[used], values[used], rcond=None)[0]
    fitted = design @ coefficients
    residual = values[used] - fitted[used]
    variance = float(residual @ residual) / max(used.sum() - design.shape[1], 1)
    covariance = np.linalg.pinv(design[used].T @ design[used]) * variance
    share, gap = coverage(angle_deg[used])
    shape = _harmonic_design(np.arange(0.0, 360.0, 0.5), order)
    shape[:, 0] = 0.0
    cosine, sine = coefficients[1 : order + 1], coefficients[order + 1 :]
    shrunk = _less_noise(cosine, sine, np.diag(covariance))
    wave = shape @ np.concatenate([[0.0], cosine * shrunk, sine * shrunk])
    slope = shape[wave.argmax()] - shape[wave.argmin()]
    least = 8.0 * variance / used.sum()  # that of a single harmonic: a run-out of zero is known no better
    return HarmonicFit(
        float(coefficients[0]),
        float(np.sqrt(covariance[0, 0])),
        cosine * shrunk,
        sine * shrunk,
        fitted,
        used,
        float(np.sqrt(variance)),
        share,
        gap,
        float(wave.max() - wave.min()),
        float(np.sqrt(max(slope @ covariance @ slope, least))),
    )


def _harmonic_design(angle_deg: Array, order: int) -> Array:
    theta = np.radians(angle_deg)[:, None] * np.arange(1, order + 1)
    return np.hstack([np.ones((len(theta), 1)), np.cos(theta), np.sin(theta)])


def _robust_use(angle_deg: Array, values: Array, first: Mask, allowed: Mask, order: int, sigmas: float) -> Mask:
    """Which of the allowed frames lie within `sigmas` robust scatters of harmonics up to `order` (redescending weights).

    It begins with the frames `first`: a pass of low order finds dirt and flats that a higher order would bend towards, and
    the frames that only the low order missed come back.
    """
    design = _harmonic_design(angle_deg, order)
    used, weight = first.copy(), np.ones(len(values))
    for step in range(30):
        if used.sum() < max(4, design.shape[1] + 2):
            return used
        coefficients = np.linalg.lstsq(design[used] * weight[used, None], values[used] * weight[used], rcond=None)[0]
        residual = values - design @ coefficients
        # Residuals are smaller than the noise by what the harmonics took from it.
        freedom = used.sum() / (used.sum() - design.shape[1])
        scatter = max(1.4826 * float(np.median(np.abs(residual[used]))) * np.sqrt(freedom), 1e-9)
        with np.errstate(invalid="ignore"):
            now = allowed & (np.abs(residual) <= sigmas * scatter)
        weight = 1.0 / np.sqrt(1.0 + (np.nan_to_num(residual) / (2.0 * scatter)) ** 2)
        if np.array_equal(now, used) and step > 3:
            break
        used = now
    return used


def _without_edges(angle_deg: Array, values: Array, seen: Mask, used: Mask, order: int) -> Mask:
    """Frames less those beside an excluded one that are off the same way, and those beside a run of excluded ones.

    Dirt and flats taper off at their ends; what is left of them there would bend the harmonics over the gap.
    """
    design = _harmonic_design(angle_deg, order)
    turn = np.argsort(angle_deg % 360.0, kind="stable")
    used = used.copy()
    for _ in range(EDGE_FRAMES):
        freedom = used.sum() - design.shape[1]
        if freedom < 2 or used.sum() == seen.sum():
            return used
        coefficients = np.linalg.lstsq(design[used], values[used], rcond=None)[0]
        residual = np.where(seen, values - design @ coefficients, 0.0)
        scatter = 1.4826 * float(np.median(np.abs(residual[used]))) * np.sqrt(used.sum() / freedom)
        off = np.where(seen & ~used, np.sign(residual), 0.0)[turn]
        beside = np.zeros(len(values), bool)
        for step in (-1, 1):
            beside[turn] |= np.roll(off, step) * residual[turn] > EDGE_SIGMAS * scatter
        if not (beside & used).any():
            break
        used &= ~beside
    out = (seen & ~used)[turn]
    run = out & np.roll(out, 1) & np.roll(out, -1)
    ends = np.zeros(len(values), bool)
    ends[turn] = np.roll(run, 2) | np.roll(run, -2)
    return used & ~ends


def _less_noise(cosine: Array, sine: Array, variance: Array) -> Array:
    """Factor for each harmonic that takes the noise's share out of its power, so that noise does not count as run-out."""
    order = len(cosine)
    power = cosine**2 + sine**2
    noise = variance[1 : order + 1] + variance[order + 1 :]
    return np.sqrt(np.clip(1.0 - noise / np.maximum(power, 1e-30), 0.0, 1.0))
