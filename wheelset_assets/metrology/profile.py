"""Wheel profile quantities from a mean meridian: radius at the datum circle, flange height, flange thickness, qR.

Coordinates: s, lateral distance from the inner face towards the field side, and r, distance from the axis of rotation,
both in mm. The definitions' lengths (L1, L2, L3) are arguments; they are recorded with the result by the caller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[Any]


class NominalPoints(Protocol):
    """Points (n,) of a nominal profile, lateral from the inner face and radial from the datum circle, mm."""

    @property
    def s_mm(self) -> Array: ...
    @property
    def z_mm(self) -> Array: ...


@dataclass(frozen=True)
class LocalFit:
    """Polynomial of one coordinate over the other about a place: value and support."""

    value: float
    coefficients: Array
    """Highest power first, of (coordinate - place) / half_width."""
    place: float
    half_width: float
    n: int

    def __call__(self, coordinate: Array) -> Array:
        """Polynomial at the given coordinates."""
        return np.polyval(self.coefficients, (coordinate - self.place) / self.half_width)


def local_fit(
    x: Array, y: Array, weight: Array, place: float, half_width: float, degree: int, *, widen: float = 1.0
) -> LocalFit | None:
    """Weighted polynomial of y over x about `place`; None unless points support it on both sides.

    The window widens up to `widen` times until it holds twice as many points as coefficients, and is refused if either
    side of the place has less than an eighth of its points, or none within half its half width: nothing is
    interpolated over a gap that wide.
    """
    half = half_width
    while True:
        near = np.abs(x - place) <= half
        if near.sum() >= 2 * (degree + 1) or half >= half_width * widen:
            break
        half *= 1.25
    n = int(near.sum())
    left, right = x[near & (x < place)], x[near & (x >= place)]
    if n < degree + 2 or min(left.size, right.size) < max(1, n // 8):
        return None
    if max(place - left.max(), right.min() - place) > 0.5 * half:
        return None
    coefficients = np.polyfit((x[near] - place) / half, y[near], degree, w=np.sqrt(weight[near]))
    return LocalFit(float(coefficients[-1]), coefficients, place, half, n)


@dataclass(frozen=True)
class ProfileDefinition:
    """Lengths of the definitions, mm: datum L2, flank height L3, tip drop L1, and the half width of the tread fit."""

    datum_mm: float
    flank_height_mm: float
    tip_drop_mm: float
    tread_half_width_mm: float


@dataclass(frozen=True)
class ProfileValues:
    """Quantities of one mean meridian, mm; NaN where the profile does not support one."""

    tread_radius_mm: float
    flange_height_mm: float
    flange_thickness_mm: float
    qr_mm: float


def tread_fit(s: Array, r: Array, weight: Array, definition: ProfileDefinition) -> LocalFit | None:
    """Quartic through the tread about the datum circle: follows hollow wear over the window, quiet enough at its middle."""
    return local_fit(s, r, weight, definition.datum_mm, definition.tread_half_width_mm, 4, widen=1.6)


def profile_values(s: Array, r: Array, weight: Array, definition: ProfileDefinition) -> ProfileValues:
    """Tread radius, flange height (Sh), flange thickness (Sd) and qR of points (n,), weights (n,), in any order."""
    tread = tread_fit(s, r, weight, definition)
    radius = tread.value if tread else float("nan")
    top = flange_top(s, r, weight, definition)
    height = top[1] - radius if top else float("nan")
    if top is None:
        return ProfileValues(radius, height, float("nan"), float("nan"))
    thickness = _flank(s, r, weight, radius + definition.flank_height_mm, top[0], 1.5)
    upper = _flank(s, r, weight, top[1] - definition.tip_drop_mm, top[0], 0.6)
    return ProfileValues(radius, height, thickness, thickness - upper)


def flange_top(s: Array, r: Array, weight: Array, definition: ProfileDefinition) -> tuple[float, float] | None:
    """Place and radius of the flange's highest point: vertex of a quartic about the highest points."""
    flange = np.flatnonzero((s > 0) & (s < 0.75 * definition.datum_mm))
    if flange.size < 8:
        return None
    top = s[flange[np.argsort(r[flange])[-max(5, flange.size // 50) :]]].mean()
    for _ in range(3):
        fit = local_fit(s, r, weight, float(top), 3.0, 4, widen=3.0)
        if fit is None:
            return None
        t = np.linspace(-0.6, 0.6, 241)
        best = int(np.argmax(np.polyval(fit.coefficients, t)))
        if best in (0, len(t) - 1):  # no maximum inside: the top itself was not seen
            return None
        vertex = np.polyfit(t[best - 1 : best + 2], np.polyval(fit.coefficients, t[best - 1 : best + 2]), 2)
        shift = -vertex[1] / (2 * vertex[0])
        top = fit.place + shift * fit.half_width
        if abs(shift) < 1e-3:
            break
    return float(top), float(np.polyval(vertex, shift))


def profile_deviation(
    s: Array, r: Array, top: tuple[float, float] | None, nominal: NominalPoints, definition: ProfileDefinition
) -> Array:
    """Signed distance (n,) of points from a nominal profile along its normal, mm; positive where there is more metal.

    Aligned by the inner face (lateral) and the flange's top (radial), both of which wear least (Greenwood Engineering's
    first choice is face and outer tread; a worn wheel has no unworn tread in view). NaN where the flange's top was not
    seen, and beyond the ends of the nominal profile.
    """
    new_top = flange_top(nominal.s_mm, nominal.z_mm, np.ones(len(nominal.s_mm)), definition)
    if top is None or new_top is None:
        return np.full(len(s), np.nan)
    z = r - top[1] + new_top[1]
    line = np.column_stack([nominal.s_mm, nominal.z_mm])
    _, nearest = cKDTree(line).query(np.column_stack([s, z]))
    slope = np.gradient(line, axis=0)
    slope /= np.linalg.norm(slope, axis=1)[:, None]
    # From the inner face over the flange to the field side the metal lies to the right of the direction of travel.
    offset = np.column_stack([s, z]) - line[nearest]
    across = -slope[nearest, 1] * offset[:, 0] + slope[nearest, 0] * offset[:, 1]
    along = np.einsum("ij,ij->i", slope[nearest], offset)
    step = np.linalg.norm(np.diff(line, axis=0), axis=1).max()
    return np.where(np.abs(along) <= step, across, np.nan)


def _flank(s: Array, r: Array, weight: Array, height_mm: float, top_s_mm: float, half_width_mm: float) -> float:
    """Lateral place where the gauge-side flank crosses a radius: cubic of s over r about it."""
    side = (s > top_s_mm) & (s < top_s_mm + 40.0)
    fit = local_fit(r[side], s[side], weight[side], height_mm, half_width_mm, 3, widen=3.0)
    return fit.value if fit else float("nan")
