"""Nominal wheel profiles as data and functions: closed forms of S1002 (EN 13715 / UIC 510-2) and LMA, splines.

Here: a profile's pieces, each with height and exact parametrisation. Not here: wear, faces, journals (`meridian`).
s is lateral, 0 on the datum circle, positive to the field side, inner face at s = -70; z is radial, 0 at s = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

DATUM_MM = 70.0  # lateral distance of the datum circle from the inner face


@dataclass(frozen=True)
class Arc:
    """Circular arc between laterals s0 < s1: z = zc + sqrt(R^2 - (s - sc)^2) (upper) or zc - sqrt(...) (lower)."""

    s0: float
    s1: float
    sc: float
    zc: float
    radius: float
    upper: bool = True

    def height(self, s_mm: Array) -> Array:
        root = np.sqrt(np.maximum(self.radius**2 - (s_mm - self.sc) ** 2, 0.0))
        return self.zc + (root if self.upper else -root)

    def sample(self, t: Array) -> Array:
        """(s, z, ds/dt, dz/dt) as (4, n) at parameters t in 0..1, equal in arc length."""
        a0, a1 = (np.arccos(np.clip((s - self.sc) / self.radius, -1, 1)) for s in (self.s0, self.s1))
        a, up = a0 + (a1 - a0) * t, 1.0 if self.upper else -1.0
        c, s = self.radius * np.cos(a), up * self.radius * np.sin(a)
        return np.stack([self.sc + c, self.zc + s, -up * s * (a1 - a0), up * c * (a1 - a0)])


@dataclass(frozen=True)
class Polynomial:
    """z = sum c_k s^k between s0 and s1; a line is one with two coefficients."""

    s0: float
    s1: float
    coefficients: tuple[float, ...]

    def height(self, s_mm: Array) -> Array:
        z = np.zeros_like(s_mm)
        for c in reversed(self.coefficients):  # Horner: the terms of segment C cancel from 1e3 down to 1
            z = z * s_mm + c
        return z

    def sample(self, t: Array) -> Array:
        """(s, z, ds/dt, dz/dt) as (4, n) at parameters t in 0..1, equal in s."""
        span = self.s1 - self.s0
        s = self.s0 + span * t
        slope = Polynomial(self.s0, self.s1, tuple(k * c for k, c in enumerate(self.coefficients))[1:])
        return np.stack([s, self.height(s), np.full_like(s, span), slope.height(s) * span])


@dataclass(frozen=True)
class Spline:
    """Cubic spline through points (s, z), parametrised by their chord length: a user's profile."""

    s_mm: tuple[float, ...]
    z_mm: tuple[float, ...]

    @property
    def s0(self) -> float:
        return self.s_mm[0]

    @property
    def s1(self) -> float:
        return self.s_mm[-1]

    def sample(self, t: Array) -> Array:
        """(s, z, ds/dt, dz/dt) as (4, n) at parameters t in 0..1, about equal in arc length."""
        from scipy.interpolate import CubicSpline

        points = np.array([self.s_mm, self.z_mm])
        chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=1)))])
        curve = CubicSpline(chord / chord[-1], points, axis=1)
        return np.concatenate([curve(t), curve(t, 1)])


Piece = Arc | Polynomial | Spline

# EN 13715 / UIC 510-2, h 28, e 32.5, 6.7 %: segments H G F E D C B A; its own rounding leaves jumps of 1.2e-4 mm (D|C).
# fmt: off
_S1002 = (
    Arc(-70.0, -62.764705882, -49.5, 9.519259302, 20.5),
    Arc(-62.764705882, -49.662510381, -55.0, 16.0, 12.0),
    Arc(-49.662510381, -39.764473993, -58.558326413, 8.834924130, 20.0),
    Polynomial(-39.764473993, -38.426669071, (-93.576667419, -2.747477419)),
    Arc(-38.426669071, -35.0, -26.210665, 16.446, 13.0, upper=False),
    Polynomial(-35.0, -26.0, (-4.320221063e3, -1.038384026e3, -1.065501873e2, -6.051367875e0,
                              -2.054332446e-1, -4.169739389e-3, -4.687195829e-5, -2.252755540e-7)),
    Polynomial(-26.0, 32.15796, (0.0, -3.358537058e-2, 1.565681624e-3, -2.810427944e-5, 5.844240864e-8,
                                 -1.562379023e-8, 5.309217349e-15, -5.957839843e-12, 2.646656573e-13)),
    Polynomial(32.15796, 60.0, (1.364323640, -0.066666667)),
    Polynomial(60.0, 65.0, (1.364323640 - 0.066666667 * 60.0 + 60.0, -1.0)),  # 45 deg chamfer
)
_LMA = (
    Arc(-70.0, -62.307692, -45.0, 6.6191685, 25.0),
    Arc(-62.307692, -52.557372, -54.0, 16.0, 12.0),
    Arc(-52.557372, -40.265268, -54.360657, 13.0217578, 15.0),
    Polynomial(-40.265268, -38.053345, (-92.4758546, -2.747477419)),
    Arc(-38.053345, -28.4709, -24.8976483, 16.8631350, 14.0, upper=False),
    Arc(-28.4709, -10.75, -5.5, 90.3459976, 90.0, upper=False),
    Arc(-10.75, 4.253514, 15.5, 449.7329748, 450.0, upper=False),
    Polynomial(4.253514, 30.0, (-0.02012777, -1 / 40)),
    Polynomial(30.0, 60.0, (1.22987223, -1 / 15)),
    Polynomial(60.0, 65.0, (57.22987223, -1.0)),
)
# fmt: on
PROFILES: dict[str, tuple[Piece, ...]] = {"S1002": _S1002, "LMA": _LMA}


def profile_from_points(s_mm: ArrayLike, z_mm: ArrayLike) -> tuple[Piece, ...]:
    """A profile from points ordered from the inner face (s = -70) to the outer face; z is 0 on the datum circle."""
    s, z = np.asarray(s_mm, float), np.asarray(z_mm, float)
    if s.ndim != 1 or s.shape != z.shape or s.size < 4:
        raise ValueError(f"a profile needs at least 4 points s, z of equal number, got {s.shape} and {z.shape}")
    if s[0] != -DATUM_MM:
        raise ValueError(f"a profile starts at the inner face, s = -70 mm, got {s[0]} mm")
    return (Spline(tuple(s.tolist()), tuple(z.tolist())),)


def nominal_height(pieces: tuple[Piece, ...], s_mm: ArrayLike) -> Array:
    """z (mm) of a closed-form profile at laterals s (mm); NaN outside it."""
    s = np.asarray(s_mm, float)
    z = np.full_like(s, np.nan)
    for piece in pieces:
        if isinstance(piece, Spline):
            raise TypeError("a profile from points has no closed form: sample its meridian")
        inside = (s >= piece.s0) & (s <= piece.s1)
        z[inside] = piece.height(s[inside])
    return z
