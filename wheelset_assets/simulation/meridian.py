"""Meridians: the curves that, turned about the axle, make a wheel or a journal. Pure geometry at 20 degC.

Here: smooth wear, a wheel's faces, the journal with fillet, shoulder and collar, and the sampled `Meridian`
that the stripe generator cuts. Not here: nominal profiles (`profiles`), what depends on the angle (`wheelset`).
A meridian's lateral coordinate counts from the inner face (wheel) or the shoulder (journal) outward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .profiles import DATUM_MM, Arc, Piece

Array = NDArray[np.float64]
Index = NDArray[np.intp]

STEP_MM = 0.08  # spacing of a meridian's nodes; cubic between them: 1e-9 mm on a 10 mm radius
MIN_ARC_EDGES = 32

INNER_FACE, RUNNING, OUTER_FACE = 0, 1, 2  # parts of a wheel
COLLAR, SHOULDER, FILLET, CYLINDER = 3, 4, 5, 6  # parts of a journal


@dataclass(frozen=True)
class Wear:
    """Metal lost: `tread_mm` radially, most at s = 2 mm; `flank_mm` laterally, most at s = -40 mm; both smooth."""

    tread_mm: float = 0.0
    flank_mm: float = 0.0

    def apply(self, curve: Array) -> Array:
        """Worn (s, z, ds/dt, dz/dt) (4, n) from new: a point moves by -flank w(s) in s and by -tread w(s) in z."""
        s, z, ds, dz = curve
        tread, tread_slope = _bump((s - 2.0) / 38.0)
        flank, flank_slope = _bump((s + 40.0) / 12.0)
        return np.stack(
            [
                s - self.flank_mm * flank,
                z - self.tread_mm * tread,
                ds * (1.0 - self.flank_mm * flank_slope / 12.0),
                dz - self.tread_mm * tread_slope / 38.0 * ds,
            ]
        )


def _bump(x: Array) -> tuple[Array, Array]:
    """(1 - x^2)^3 within |x| < 1 and its derivative: twice continuously differentiable."""
    y = np.maximum(1.0 - x * x, 0.0)
    return y**3, -6.0 * x * y * y


@dataclass(frozen=True)
class Meridian:
    """A plane curve as a chain of cubic Hermite edges. Metal lies to the right of the direction of travel.

    `nodes_mm` (2, K): lateral and radial. `start_mm`, `end_mm` (2, K-1): derivatives by the edge's fraction at its two
    ends (one-sided, so that corners stay sharp). `part` (K-1,): which part of the wheel or journal an edge belongs to.
    """

    nodes_mm: Array
    start_mm: Array
    end_mm: Array
    part: NDArray[np.int8]

    def at(self, edge: Index, fraction: Array) -> tuple[Array, Array]:
        """Points (2, n) and derivatives by the fraction (2, n), at fractions 0..1 of the given edges."""
        p0, p1 = self.nodes_mm[:, edge], self.nodes_mm[:, edge + 1]
        m0, m1, f = self.start_mm[:, edge], self.end_mm[:, edge], fraction
        rise = p1 - p0
        a, b = m0 + m1 - 2 * rise, 3 * rise - 2 * m0 - m1
        return p0 + f * (m0 + f * (b + f * a)), m0 + f * (2 * b + 3 * f * a)

    def crossings(self, axis: int, level_mm: float) -> Array:
        """Points (2, n) where the lateral (axis 0) or radial (axis 1) coordinate takes the level, along the curve."""
        below = self.nodes_mm[axis] < level_mm
        edge = np.flatnonzero(below[1:] != below[:-1])
        return self._bisect(edge, lambda point, slope: (point[axis] < level_mm) == below[edge])

    def top(self) -> Array:
        """The point (2,) of largest radial coordinate among the running surface's smooth stationary points."""
        edge = np.flatnonzero((self.start_mm[1] > 0) & (self.end_mm[1] <= 0) & (self.part == RUNNING))
        points = self._bisect(edge, lambda point, slope: slope[1] > 0)
        node = self.nodes_mm[:, int(np.argmax(self.nodes_mm[1]))]
        candidates = np.concatenate([points, node[:, None]], axis=1)
        return candidates[:, int(np.argmax(candidates[1]))]

    def _bisect(self, edge: Index, still_before: Callable[[Array, Array], NDArray[np.bool_]]) -> Array:
        low, high = np.zeros(edge.size), np.ones(edge.size)
        for _ in range(52):
            middle = 0.5 * (low + high)
            before = still_before(*self.at(edge, middle))
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        return self.at(edge, 0.5 * (low + high))[0]


def wheel_meridian(
    pieces: tuple[Piece, ...], wear: Wear, rim_depth_mm: float = 45.0, step_mm: float = STEP_MM
) -> Meridian:
    """Meridian of a wheel: inner face from `rim_depth_mm` below the flange's foot, profile, outer face inward.

    Lateral from the inner face; radial 0 on the (worn) datum circle.
    """
    worn = [wear.apply(piece.sample(np.linspace(0.0, 1.0, _edges(piece, step_mm) + 1))) for piece in pieces]
    for curve in worn:
        curve[0] += DATUM_MM
    first, last = worn[0][:2, 0], worn[-1][:2, -1]
    inner = _straight((first[0], first[1] - rim_depth_mm), first, step_mm)
    outer = _straight(last, (last[0], last[1] - rim_depth_mm + 15.0), step_mm)
    raw = _join([inner, *worn, outer], [INNER_FACE, *[RUNNING] * len(worn), OUTER_FACE])
    running = [p for p in raw.crossings(0, DATUM_MM).T if p[1] > last[1] - rim_depth_mm]
    nodes = raw.nodes_mm - np.array([[0.0], [running[0][1]]])
    return Meridian(nodes, raw.start_mm, raw.end_mm, raw.part)


@dataclass(frozen=True)
class JournalShape:
    """Lengths (mm) of a journal beside its diameter: cylinder from the shoulder outward, fillet, collar inboard."""

    length_mm: float = 190.0
    fillet_mm: float = 2.5
    collar_diameter_mm: float = 166.0
    collar_length_mm: float = 40.0
    edge_mm: float = 0.5  # 45 deg break of the collar's edge


def journal_meridian(diameter_mm: float, taper_mm: float, shape: JournalShape, step_mm: float = STEP_MM) -> Meridian:
    """Meridian of a journal; lateral from the shoulder, radial from the axis. Taper: outer - inner diameter."""
    radius, collar, fillet = diameter_mm / 2, shape.collar_diameter_mm / 2, shape.fillet_mm
    inner, outer = radius - taper_mm / 4, radius + taper_mm / 4
    angle = np.linspace(np.pi, 1.5 * np.pi, max(MIN_ARC_EDGES, int(fillet * np.pi / 2 / step_mm)) + 1)
    c, s = fillet * np.cos(angle), fillet * np.sin(angle)
    arc = np.stack([fillet + c, inner + fillet + s, -s * np.pi / 2, c * np.pi / 2])
    edge = shape.edge_mm
    return _join(
        [
            _straight((-shape.collar_length_mm, collar), (-edge, collar), step_mm),
            _straight((-edge, collar), (0.0, collar - edge), step_mm),
            _straight((0.0, collar - edge), (0.0, inner + fillet), step_mm),
            arc,
            _straight((fillet, inner), (shape.length_mm, outer), step_mm),
        ],
        [COLLAR, COLLAR, SHOULDER, FILLET, CYLINDER],
    )


def _edges(piece: Piece, step_mm: float) -> int:
    curve = piece.sample(np.linspace(0.0, 1.0, 65))
    length = float(np.hypot(*np.diff(curve[:2], axis=1)).sum())
    fewest = MIN_ARC_EDGES if isinstance(piece, Arc) else 1
    return max(fewest, int(np.ceil(length / step_mm)))


def _straight(start: ArrayLike, end: ArrayLike, step_mm: float) -> Array:
    a, b = np.asarray(start, float), np.asarray(end, float)
    n = max(1, int(np.ceil(np.hypot(*(b - a)) / step_mm)))
    t = np.linspace(0.0, 1.0, n + 1)
    return np.concatenate([a[:, None] + (b - a)[:, None] * t, np.repeat((b - a)[:, None], n + 1, axis=1)])


def _join(curves: list[Array], parts: list[int]) -> Meridian:
    """Chain sampled curves (4, n); where two meet, the later one's first point stands for both (jumps < 2e-4 mm)."""
    nodes = np.concatenate([c[:2, :-1] for c in curves] + [curves[-1][:2, -1:]], axis=1)
    per_edge = [c[2:] / (c.shape[1] - 1) for c in curves]
    start = np.concatenate([d[:, :-1] for d in per_edge], axis=1)
    end = np.concatenate([d[:, 1:] for d in per_edge], axis=1)
    part = np.concatenate([np.full(c.shape[1] - 1, p, np.int8) for c, p in zip(curves, parts, strict=True)])
    return Meridian(nodes, start, end, part)
