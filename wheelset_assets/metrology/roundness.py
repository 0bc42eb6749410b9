"""Harmonics of one turn: spectrum by order, run-out, out-of-roundness, polygon levels, run-out about another axis, flats.

Angles here are those of the wheelset's body: a sensor that looks at the wheelset from direction psi sees, when it has
turned by a, the body angle psi - a. Series of sensors that look from different directions so refer to one body.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.revolution import coverage, usual_arc
from wheelset_assets.quality import Flag

Array = NDArray[Any]
Mask = NDArray[np.bool_]

LEAK_ORDERS = 6
"""Orders that a real turn may have of some size (out of round, bent, polygonal)."""
KEEP_POWER = 3.0
"""Among many orders, one counts if its power exceeds this multiple of its noise's: noise alone does so in 5 of 100 cases."""
FEW_ORDERS = 6
"""Up to this many orders noise adds up to little: those count whose power exceeds their noise's."""


def body_angle_deg(turned_deg: Array, direction_deg: float) -> Array:
    """Body angle (n,) seen from direction_deg (from +Y towards +Z) when the wheelset has turned by turned_deg (n,)."""
    return np.mod(direction_deg - turned_deg, 360.0)


def mean_direction_deg(directions_deg: Iterable[float]) -> float:
    """Mean of directions, which 359 and 1 make 0; NaN are left out."""
    angle = np.radians([d for d in directions_deg if np.isfinite(d)])
    return float(np.degrees(np.arctan2(np.sin(angle).sum(), np.cos(angle).sum()))) if angle.size else float("nan")


@dataclass(frozen=True)
class Spectrum:
    """Harmonics of a series over the body angle: mean + sum of c_n cos(n phi) + s_n sin(n phi), in the series' unit."""

    mean: float
    u_mean: float
    cosine: Array
    """(order,), the first of order 1; as fitted, noise included."""
    sine: Array
    covariance: Array
    """(2 order + 1, 2 order + 1) of mean, cosines, sines."""
    scatter: float
    """Standard deviation of the residuals."""
    n_frames: int

    @property
    def order(self) -> int:
        """Highest order."""
        return len(self.cosine)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the scatter."""
        return max(self.n_frames - 2 * self.order - 1, 0)

    @property
    def amplitude(self) -> Array:
        """Amplitude of each order (order,), noise included."""
        return np.hypot(self.cosine, self.sine)

    @property
    def u_amplitude(self) -> Array:
        """Standard uncertainty of each amplitude (order,): that of one component, the mean of both."""
        variance = np.diag(self.covariance)[1:]
        return np.sqrt(0.5 * (variance[: self.order] + variance[self.order :]))

    def keep(self) -> Mask:
        """Orders whose power stands out of the noise."""
        return self.amplitude**2 > KEEP_POWER * 2.0 * self.u_amplitude**2


def spectrum(body_deg: Array, values: Array, used: Mask, order: int, noise: float = 0.0) -> Spectrum | None:
    """Least-squares harmonics of values (n,) at body_deg (n,) over the `used` frames; None if they are too few.

    The order is lowered to what the frames and the largest gap support: three frames a coefficient, and no gap longer
    than three quarters of a wavelength. What an order that is left out for a gap puts into the mean is in its uncertainty;
    noise: standard deviation of a value that is known to be noise, the rest of the residuals being such orders.
    """
    ok = used & np.isfinite(values)
    if ok.sum() < 6:
        return None
    gap, wanted = coverage(body_deg[ok])[1], order
    order = int(max(0, min(order, (ok.sum() // 3 - 1) // 2, np.floor(270.0 / gap))))
    design = harmonic_design(body_deg[ok], order)
    coefficients, *_ = np.linalg.lstsq(design, values[ok], rcond=None)
    residual = values[ok] - design @ coefficients
    variance = float(residual @ residual) / (ok.sum() - design.shape[1])
    covariance = np.linalg.pinv(design.T @ design) * variance
    unexplained = max(variance - (noise**2 if np.isfinite(noise) else 0.0), 0.0)
    covariance[0, 0] += unexplained * _leak(body_deg[ok], order, min(wanted, LEAK_ORDERS))
    return Spectrum(
        float(coefficients[0]),
        float(np.sqrt(covariance[0, 0])),
        coefficients[1 : order + 1],
        coefficients[order + 1 :],
        covariance,
        float(np.sqrt(variance)),
        int(ok.sum()),
    )


def _leak(angle_deg: Array, order: int, wanted: int) -> float:
    """Largest square that an order from order + 1 to wanted puts into the mean of a fit up to `order`, for a mean square of 1
    of what it leaves in the residuals.

    Over a whole turn they are orthogonal; over a gap the mean takes up a part of them, which scatter does not tell.
    """
    if wanted <= order:
        return 0.0
    design = harmonic_design(angle_deg, order)
    inverse = np.linalg.pinv(design)
    others = harmonic_design(angle_deg, wanted)
    cosine, sine = others[:, 1 + order : 1 + wanted], others[:, 1 + wanted + order :]
    into = (inverse[0] @ cosine) ** 2 + (inverse[0] @ sine) ** 2
    left = [((c - design @ (inverse @ c)) ** 2).mean(axis=0) for c in (cosine, sine)]
    return float((into / np.maximum(left[0] + left[1], 1e-12)).max())


def harmonic_design(angle_deg: Array, order: int) -> Array:
    """Columns 1, cos(n angle), sin(n angle) for n = 1..order, (n, 2 order + 1)."""
    theta = np.radians(angle_deg)[:, None] * np.arange(1, order + 1)
    return np.hstack([np.ones((len(theta), 1)), np.cos(theta), np.sin(theta)])


@dataclass(frozen=True)
class Range:
    """Largest less smallest value over the turn, and its standard uncertainty from the noise."""

    value: float
    u: float

    @property
    def flags(self) -> Flag:
        """NOT_DETECTED where no order stands out of the noise: the zero stands for what may hide in it."""
        return Flag.NONE if self.value > 0 else Flag.NOT_DETECTED


_TURN_DEG = np.arange(0.0, 360.0, 0.5)


def peak_to_peak(
    found: Spectrum, first: int = 1, last: int | None = None, *, shift: Array | None = None, even: bool = False
) -> Range:
    """Maximum less minimum over the turn of the orders first..last, of the even ones only if asked.

    Orders that do not stand out of the noise are left out, of the others the noise's share of the power is taken off:
    noise does not count as run-out. What may hide in an order that was left out counts in the uncertainty. A range is not
    negative, so a true one below some two u reads high: of six orders without any run-out 2u holds 78 % (a joint test of them
    all would mend that and lose values of two u). shift: added
    to the (cosine, sine) of order 1 beforehand, with no noise of its own.
    """
    last = found.order if last is None else min(last, found.order)
    cosine, sine = found.cosine.copy(), found.sine.copy()
    if shift is not None and found.order:
        cosine[0] += shift[0]
        sine[0] += shift[1]
    orders = np.arange(1, found.order + 1)
    u = found.u_amplitude
    power = cosine**2 + sine**2
    member = (orders >= first) & (orders <= last) & ((orders % 2 == 0) | (not even))
    least = KEEP_POWER if member.sum() > FEW_ORDERS else 1.0
    kept = member & (power > least * 2.0 * u**2)
    share = np.where(kept, np.sqrt(np.clip(1.0 - 2.0 * u**2 / np.maximum(power, 1e-30), 0.0, 1.0)), 0.0)
    shape = harmonic_design(_TURN_DEG, found.order)
    shape[:, 0] = 0.0
    wave = shape @ np.concatenate([[0.0], cosine * share, sine * share])
    slope = shape[wave.argmax()] - shape[wave.argmin()]
    slope[1:] *= np.tile(kept, 2)
    hidden = 1.5 * float((u[member & ~kept] ** 2).sum())
    return Range(float(np.ptp(wave)), float(np.sqrt(slope @ found.covariance @ slope + hidden)))


def level_db(amplitude_um: Array) -> Array:
    """Level of a harmonic's effective value over 1 um: 20 log10(A / sqrt(2) / 1 um); minus infinity for none."""
    with np.errstate(divide="ignore"):
        return 20.0 * np.log10(amplitude_um / np.sqrt(2.0))


EDGE_SCATTERS = 2.5
"""Frames less deep than so many scatters belong to no flat."""


@dataclass(frozen=True)
class Flat:
    """A wheel flat as a chord of the tread: place of its middle, length along the tread and depth."""

    body_deg: float
    length_mm: float
    depth_mm: float
    u_length_mm: float
    u_depth_mm: float
    n_frames: int


def find_flats(
    body_deg: Array, deviation_mm: Array, excluded: Mask, scatter_mm: float, diameter_mm: float
) -> list[Flat]:
    """Flats among frames that were excluded from the turn's harmonics, deepest first.

    deviation_mm (n,): radius less its harmonics; frames that are excluded for their neighbours alone lie about it and
    belong to no flat. A run of excluded frames that lie below them is fitted by a chord,
    delta(x) = (x - x0)^2 / D - depth over the arc x: its curvature is known, so two frames suffice. Its length is
    2 sqrt(D depth).
    """
    order = np.argsort(body_deg, kind="stable")
    low = (excluded & (deviation_mm < -EDGE_SCATTERS * scatter_mm))[order]
    if not low.any():
        return []
    step_deg = usual_arc(np.diff(np.sort(body_deg)))
    angle, value = body_deg[order], deviation_mm[order]
    start = int(np.argmin(low)) if not low.all() else 0
    index = np.roll(np.arange(len(low)), -start)  # begin the walk outside a run
    member = low[index]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], member.astype(np.int8), [0]])))
    flats = []
    for first, last in edges.reshape(-1, 2):
        rows = index[first:last]
        unwrapped = angle[rows[0]] + np.mod(angle[rows] - angle[rows[0]], 360.0)
        if np.ptp(unwrapped) > len(rows) * 2.5 * step_deg:
            continue
        found = _chord(unwrapped, value[rows], scatter_mm, diameter_mm, np.radians(step_deg) * diameter_mm / 2)
        if found is not None:
            flats.append(found)
    return sorted(flats, key=lambda flat: -flat.depth_mm)


def _chord(angle_deg: Array, deviation_mm: Array, scatter_mm: float, diameter_mm: float, step_mm: float) -> Flat | None:
    middle = float(angle_deg.mean())
    x = np.radians(angle_deg - middle) * diameter_mm / 2
    y = deviation_mm - x**2 / diameter_mm  # = -2 x0 x / D + x0^2 / D - depth
    sigma = max(scatter_mm, 1e-4)
    if len(x) == 1:  # one frame only: its place within a step is not known
        place, depth = 0.0, -float(deviation_mm[0])
        u_depth = float(np.hypot(sigma, step_mm**2 / (8.0 * diameter_mm)))
    else:
        design = np.column_stack([x, np.ones_like(x)])
        (slope, level), *_ = np.linalg.lstsq(design, y, rcond=None)
        covariance = np.linalg.inv(design.T @ design) * sigma**2
        place = -0.5 * slope * diameter_mm
        depth = float(place**2 / diameter_mm - level)
        gradient = np.array([0.5 * slope * diameter_mm, -1.0])
        u_depth = float(np.sqrt(gradient @ covariance @ gradient))
        misfit = float(np.sqrt(np.mean((y - design @ (slope, level)) ** 2)))
        u_depth = float(np.hypot(u_depth, misfit))
    if depth <= 0:
        return None
    length = 2.0 * float(np.sqrt(diameter_mm * depth))
    return Flat(
        float(np.mod(middle + np.degrees(2 * place / diameter_mm), 360.0)),
        length,
        depth,
        0.5 * length * u_depth / depth,
        u_depth,
        len(x),
    )
