"""Datum of a station: the flat faces square to the axle, the journal's cylinder, and the rotation that squares them.

Works on mean meridians (lateral, radial) in image-row order. Lateral coordinates are along the rig's X axis here; the
sign `outward` (+1 right, -1 left) says which way the field side lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Mask = NDArray[np.bool_]


def tangent_angles(lateral_mm: Array, radial_mm: Array, step_mm: float) -> tuple[Array, Array]:
    """Direction of the meridian before and after each point, in degrees from the axle modulo 180, (n,) each.

    Eq. 27: the difference vectors to the neighbours before and after, taken to the first that is step_mm away along the
    profile rather than to the next row, so that they stand clear of the noise; on a face seen at a grazing angle the
    next row may be farther than that. NaN at the ends, and where a gap lies between: a chord beyond 2.5 steps and three
    times the usual one thereabouts.
    """
    points = np.column_stack([lateral_mm, radial_mm])
    n = len(points)
    before, after = np.full(n, np.nan), np.full(n, np.nan)
    if n < 3:
        return before, after
    chord = np.linalg.norm(np.diff(points, axis=0), axis=1)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(chord, 5, mode="reflect" if n > 6 else "edge"), 11)
    gap = chord > np.maximum(2.5 * step_mm, 3 * np.median(around, axis=1))
    arc = np.concatenate([[0.0], np.cumsum(chord)])
    gaps = np.concatenate([[0], np.cumsum(gap)])
    j = np.searchsorted(arc, arc + 0.99 * step_mm)
    i = np.flatnonzero(j < n)
    i = i[gaps[j[i]] == gaps[i]]
    difference = points[j[i]] - points[i]
    after[i] = np.degrees(np.arctan2(difference[:, 1], difference[:, 0]))
    k = np.searchsorted(arc, arc - 0.99 * step_mm, side="right") - 1
    i = np.flatnonzero(k >= 0)
    i = i[gaps[k[i]] == gaps[i]]
    difference = points[i] - points[k[i]]
    before[i] = np.degrees(np.arctan2(difference[:, 1], difference[:, 0]))
    return before, after


def straight_rows(
    lateral_mm: Array,
    radial_mm: Array,
    towards_deg: float,
    *,
    threshold_deg: float,
    max_tilt_deg: float,
    step_mm: float,
) -> Mask:
    """Rows whose surroundings are straight and run along towards_deg (90 across the axle, 0 along it), (n,).

    Eq. 27: the angle between successive difference vectors stays under the threshold; one of them may be missing at an
    end of the profile.
    """
    before, after = tangent_angles(lateral_mm, radial_mm, step_mm)
    bend = np.abs(_wrap(after - before))
    tilts = np.stack([np.abs(_wrap(a - towards_deg)) for a in (before, after)])
    with np.errstate(invalid="ignore"):
        level = np.where(np.isnan(tilts), np.inf, tilts).min(axis=0) <= max_tilt_deg
        level &= ~(np.where(np.isnan(tilts), 0.0, tilts).max(axis=0) > 2 * max_tilt_deg)
        return level & ~(bend > threshold_deg)


def _wrap(angle_deg: Array) -> Array:
    return (angle_deg + 90.0) % 180.0 - 90.0


@dataclass(frozen=True)
class Line:
    """Straight part of a meridian: total-least-squares line with its rows.

    `tilt_rad` is the angle by which its direction deviates from the wanted one, positive from lateral towards radial.
    """

    rows: Mask
    centre_mm: Array
    tilt_rad: float
    u_tilt_rad: float
    rms_mm: float
    low_mm: float
    high_mm: float
    """Ends of the part along its direction: radii for a face, lateral places for a cylinder."""


def fit_line(
    points: Array, candidate: Mask, across: bool, *, sigmas: float, min_length_mm: float, min_rows: int = 12
) -> Line | None:
    """Total-least-squares line through candidate rows of points (n, 2), outliers removed, then grown; None if too short.

    across: the line should stand across the axle (a face); else along it (a cylinder). Rows within `sigmas` robust
    scatters join it as far as the straight part reaches.
    """
    rows = candidate.copy()
    along = 1 if across else 0
    for _ in range(12):
        if rows.sum() < min_rows:
            return None
        centre, direction = _principal(points[rows], along)
        normal = np.array([-direction[1], direction[0]])
        distance = (points - centre) @ normal
        scatter = max(1.4826 * float(np.median(np.abs(distance[rows]))), 2e-4)
        inside = np.abs(distance) <= sigmas * scatter
        reach = candidate & inside
        low, high = (
            points[reach, along].min() if reach.any() else np.inf,
            points[reach, along].max() if reach.any() else -np.inf,
        )
        now = inside & (points[:, along] >= low) & (points[:, along] <= high)
        if np.array_equal(now, rows):
            break
        rows = now
    if rows.sum() < min_rows or np.ptp(points[rows, along]) < min_length_mm:
        return None
    centre, direction = _principal(points[rows], along)
    distance = (points[rows] - centre) @ np.array([-direction[1], direction[0]])
    rms = float(np.sqrt((distance**2).sum() / max(rows.sum() - 2, 1)))
    spread = float(np.sqrt((((points[rows] - centre) @ direction) ** 2).sum()))
    wanted = np.pi / 2 if across else 0.0
    tilt = float(np.arctan2(direction[1], direction[0]) - wanted)
    inflation = np.sqrt(_correlation(distance))
    return Line(
        rows,
        centre,
        tilt,
        rms / spread * inflation,
        rms,
        float(points[rows, along].min()),
        float(points[rows, along].max()),
    )


def _principal(points: Array, along: int) -> tuple[Array, Array]:
    centre = points.mean(axis=0)
    _, _, vt = np.linalg.svd(points - centre, full_matrices=False)
    direction = vt[0]
    return centre, direction if direction[along] > 0 else -direction


def _correlation(residuals: Array) -> float:
    variance = float((residuals**2).mean())
    if variance <= 0 or len(residuals) < 8:
        return 1.0
    length = 1.0
    for lag in range(1, min(40, len(residuals) // 3)):
        rho = float((residuals[lag:] * residuals[:-lag]).mean()) / variance
        if rho < 0.05:
            break
        length += 2 * rho
    return length


def find_face(points: Array, straight: Mask, prefer: float, *, sigmas: float, min_length_mm: float) -> Line | None:
    """The flat face among straight rows of points (n, 2) (lateral, radial): the long one that lies farthest towards `prefer`.

    Faces are separated by their lateral place (a millimetre apart or more). prefer: sign of the lateral direction to
    choose among several (the inner face lies towards the wheelset's middle).
    """
    best: Line | None = None
    for candidate in _groups(points[:, 0], straight, gap_mm=1.0):
        line = fit_line(points, candidate, True, sigmas=sigmas, min_length_mm=min_length_mm)
        if line is not None and (best is None or (line.centre_mm[0] - best.centre_mm[0]) * prefer > 0):
            best = line
    return best


def find_cylinder(points: Array, straight: Mask, *, outward: float, sigmas: float, min_length_mm: float) -> Line | None:
    """The journal among straight rows along the axle: the longest cylinder; of two alike, the one farther outward.

    Cylinders are separated by their radius (the collar beyond the shoulder is another one).
    """
    found = []
    for candidate in _groups(points[:, 1], straight, gap_mm=1.0):
        line = fit_line(points, candidate, False, sigmas=sigmas, min_length_mm=min_length_mm)
        if line is not None:
            found.append(line)
    if not found:
        return None
    outermost = max(found, key=lambda line: line.centre_mm[0] * outward)
    longest = max(found, key=lambda line: line.high_mm - line.low_mm)
    long_enough = (outermost.high_mm - outermost.low_mm) > 0.25 * (longest.high_mm - longest.low_mm)
    return outermost if long_enough else longest


def _groups(coordinate: Array, member: Mask, gap_mm: float) -> list[Mask]:
    """Members split where their sorted coordinate jumps by more than gap_mm, as masks."""
    index = np.flatnonzero(member)
    if index.size == 0:
        return []
    order = index[np.argsort(coordinate[index], kind="stable")]
    cuts = np.flatnonzero(np.diff(coordinate[order]) > gap_mm) + 1
    groups = []
    for part in np.split(order, cuts):
        mask = np.zeros(len(coordinate), bool)
        mask[part] = True
        groups.append(mask)
    return groups
