"""Alignment of profiles in the frequency domain: shift by phase correlation, rotation from the spectrum's magnitude.

The paper's second method (3.2), independent of pairs of points and of iterations. A profile is taken as a thin line of
even density, blurred a little. Its Fourier transform is summed directly over its points: that is the transform of a
raster of any amplification without the raster's rounding, so the amplification sets the grid on which the peak is
looked for (1/rho mm), and not the size of an image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SHORTEST_MM = 4.0
"""Shortest wavelength that enters; the blur ends the spectrum there."""
LARGEST_GAP_MM = 3.0
"""Points of a profile farther apart than this have a gap between them."""
POLAR_ANGLES = 1024
"""Directions of the polar spectrum over half a turn."""


def line_weights(curve: Array, largest_gap_mm: float = LARGEST_GAP_MM) -> Array:
    """Length of line (n,) that each point of a curve (n, 2), given in order, stands for; none across a gap."""
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    step = np.where(step > largest_gap_mm, 0.0, step)
    return 0.5 * (np.concatenate([[0.0], step]) + np.concatenate([step, [0.0]]))


@dataclass(frozen=True)
class Shift:
    """Shift of a moved profile against a fixed one.

    `pixels` (2,): of a raster of that amplification, to a fraction of a pixel; `shift_mm` the same in mm. `peak`: height
    of the correlation, 1 for equal profiles.
    """

    shift_mm: Array
    pixels: Array
    peak: float


def phase_correlation(
    moved: Array, fixed: Array, rho: float, weights: tuple[Array, Array] | None = None, reach_mm: float | None = None
) -> Shift:
    """Shift (lateral, radial) from profile `fixed` (m, 2) to profile `moved` (n, 2), mm, by phase correlation at rho pixels/mm.

    The normalised cross-power spectrum of both, over wavelengths down to SHORTEST_MM, has its peak at the shift. The
    peak is found on a coarse grid, then on the raster's pixels, then between them by Newton's method. `reach_mm`: the
    largest shift looked for along each axis (default: half the profiles' extent).
    """
    both = np.concatenate([moved, fixed])
    middle = 0.5 * (both.min(axis=0) + both.max(axis=0))
    extent = float(np.ptp(both, axis=0).max())
    base = 2 * np.pi / (2.0 * extent)
    count = int(np.ceil(2 * np.pi / SHORTEST_MM / base))
    k = base * np.arange(-count, count + 1)
    w_moved, w_fixed = weights or (line_weights(moved), line_weights(fixed))
    cross = _spectrum(moved - middle, w_moved, k) * np.conj(_spectrum(fixed - middle, w_fixed, k))
    size = np.abs(cross)
    # Frequencies at which a profile has next to nothing carry noise only; the blur fades out the shortest waves.
    blur = np.exp(-0.5 * (k * SHORTEST_MM / 4) ** 2)
    unit = np.where(size > 1e-4 * size.max(), cross / np.maximum(size, 1e-300), 0.0) * blur[:, None] * blur[None, :]
    unit *= np.sqrt(size / size.max()) ** 0.5
    total = float(np.abs(unit).sum())
    limit = reach_mm if reach_mm is not None else extent / 2
    d = _grid_peak(unit, k, np.zeros(2), limit, min(1.0, limit / 2))
    for step in (0.25, 1.0 / rho) if rho > 4 else (1.0 / rho,):
        d = _grid_peak(unit, k, d, 4 * step, step) if step < 0.5 else d
    for _ in range(12):
        _value, slope, bend = _peak(unit, k, d)
        if np.linalg.eigvalsh(bend).max() >= 0:
            break
        move = np.linalg.solve(bend, slope)
        d = d - np.clip(move, -0.5, 0.5)
        if np.abs(move).max() < 1e-10:
            break
    return Shift(d, d * rho, _peak(unit, k, d)[0] / total)


def _spectrum(points: Array, weight: Array, k: Array) -> Array:
    """Fourier transform (len(k), len(k)) of a weighted point set at all pairs of wave numbers k, which are as -k too."""
    half = len(k) // 2  # where k is 0: the transform at -k is the conjugate of that at k
    n = half + 1
    lateral, radial = (np.concatenate([np.cos(p), np.sin(p)]) for p in (np.outer(k[half:], x) for x in points.T))
    products = (lateral * weight) @ radial.T  # real ones take a quarter of the time of complex ones
    cc, cs, sc, ss = products[:n, :n], products[:n, n:], products[n:, :n], products[n:, n:]
    made = np.empty((len(k), len(k)), complex)
    made.real[half:, half:], made.imag[half:, half:] = cc - ss, -(cs + sc)
    made.real[half:, half::-1], made.imag[half:, half::-1] = cc + ss, cs - sc
    made[:half] = made[:half:-1, ::-1].conj()
    return made


def _grid_peak(unit: Array, k: Array, centre: Array, reach: float, step: float) -> Array:
    grid = step * np.arange(-np.ceil(reach / step), np.ceil(reach / step) + 1)
    left, right = (np.exp(1j * np.outer(k, c + grid)) for c in centre)
    surface = (left.T @ unit @ right).real
    at = np.unravel_index(surface.argmax(), surface.shape)
    return centre + np.array([grid[at[0]], grid[at[1]]])


def _peak(unit: Array, k: Array, d: Array) -> tuple[float, Array, Array]:
    """Correlation at a shift d (2,), its gradient (2,) and second derivatives (2, 2)."""
    at = unit * np.exp(1j * (k[:, None] * d[0] + k[None, :] * d[1]))
    real, imaginary = at.real, at.imag
    kx, kz = k[:, None], k[None, :]
    slope = -np.array([(kx * imaginary).sum(), (kz * imaginary).sum()])
    xz = -(kx * kz * real).sum()
    bend = np.array([[-(kx**2 * real).sum(), xz], [xz, -(kz**2 * real).sum()]])
    return float(real.sum()), slope, bend


@dataclass(frozen=True)
class Turn:
    """Rotation of a moved profile against a fixed one, 0-360 degrees, then the shift in mm; `peak` as in Shift."""

    rotation_deg: float
    shift_mm: Array
    peak: float


def rotation_and_shift(
    moved: Array,
    fixed: Array,
    rho: float = 100.0,
    weights: tuple[Array, Array] | None = None,
    *,
    largest_deg: float = 180.0,
    reach_mm: float | None = None,
) -> Turn:
    """Rotation from `fixed` (m, 2) to `moved` (n, 2) about the origin, lateral towards radial, then the shift.

    The magnitude of the spectrum does not feel a shift and turns with the profile. It is sampled on a polar grid (the
    scale is known, so that the radius needs no logarithm) and correlated along the angle. It repeats after half a turn:
    of both candidates the one whose phases agree better is right, if largest_deg allows it.
    """
    w_moved, w_fixed = weights or (line_weights(moved), line_weights(fixed))
    a, b = _polar(moved, w_moved), _polar(fixed, w_fixed)
    half_turn = _angular_peak(a, b, largest_deg)
    found = []
    for candidate in (half_turn, half_turn + 180.0):
        if abs((candidate + 180) % 360 - 180) > largest_deg:
            continue
        turned = turn(fixed, candidate)
        shift = phase_correlation(moved, turned, rho, (w_moved, w_fixed), reach_mm)
        found.append(Turn(candidate % 360.0, shift.shift_mm, shift.peak))
    return max(found, key=lambda t: t.peak)


def turn(points: Array, degrees: float) -> Array:
    """Points (n, 2) turned about the origin from lateral towards radial."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s], [-s, c]])


def _polar(curve: Array, weight: Array) -> Array:
    """Magnitude of the spectrum (radii, POLAR_ANGLES) over half a turn, faded towards the shortest waves."""
    middle = (curve * weight[:, None]).sum(axis=0) / weight.sum()
    angle = np.pi * np.arange(POLAR_ANGLES) / POLAR_ANGLES
    along = np.outer(np.cos(angle), curve[:, 0] - middle[0]) + np.outer(np.sin(angle), curve[:, 1] - middle[1])
    extent = 2 * float(np.abs(along).max())
    first = 2 * np.pi / max(extent, 40.0)
    step = np.exp(-1j * first * along)
    wave, rows = step.copy(), []
    for m in range(1, int(2 * np.pi / 8.0 / first) + 1):
        rows.append(np.abs(wave @ weight) * np.exp(-0.5 * (first * m * SHORTEST_MM / 4) ** 2))
        wave = wave * step
    return np.array(rows)


def _angular_peak(moved: Array, fixed: Array, largest_deg: float) -> float:
    """Angle in degrees, 0-180, by which the polar spectrum `moved` is turned against `fixed`: circular correlation."""
    rows = min(len(moved), len(fixed))
    a, b = (np.fft.rfft(p[:rows] - p[:rows].mean(axis=1, keepdims=True), axis=1) for p in (moved, fixed))
    cross = (a * np.conj(b)).sum(axis=0)
    order = np.arange(len(cross))
    # Half way between plain and phase-only correlation: sharp, and not ruled by orders that hold noise alone.
    cross = cross / np.sqrt(np.maximum(np.abs(cross), 1e-6 * np.abs(cross).max()))
    correlation = np.fft.irfft(cross, POLAR_ANGLES)
    degrees = 180.0 * np.arange(POLAR_ANGLES) / POLAR_ANGLES
    allowed = np.minimum(degrees, 180.0 - degrees) <= largest_deg
    x = 2 * np.pi * float(np.where(allowed, correlation, -np.inf).argmax()) / POLAR_ANGLES
    for _ in range(20):
        at = cross * np.exp(1j * order * x)
        slope, bend = -float((order * at.imag).sum()), -float((order**2 * at.real).sum())
        if bend >= 0:
            break
        move = float(np.clip(slope / bend, -np.pi / POLAR_ANGLES, np.pi / POLAR_ANGLES))
        x -= move
        if abs(move) < 1e-13:
            break
    return float(np.degrees(x) / 2) % 180.0


@dataclass(frozen=True)
class PlanarMotion:
    """Motion in the meridian plane: a rotation about a pivot (the middle of the overlap), then a shift in mm."""

    rotation_deg: float
    shift_mm: Array
    pivot_mm: Array
    peak: float


def align_overlap(
    source: Array, target: Array, *, reach_mm: float = 3.0, taper_mm: float = 6.0, largest_mm: float = 3.0
) -> PlanarMotion | None:
    """Motion of a source profile (n, 2) onto a target profile (m, 2) that sees a neighbouring part; None without overlap.

    Both are cut to the part that both show, faded out over taper_mm at its ends, and phase correlation tells the shift.
    On so short and smooth a part the spectrum's magnitude tells little of a rotation: that is the difference between the
    shifts of its two halves across the line that joins them. The cut is that of the profiles as they lie: at the right
    pose the answer is no motion; near it the motion is told in full across the profile, and in part along it.
    """
    shared = _window(source, target, reach_mm, taper_mm)
    if shared is None:
        return None
    window, first, last = shared
    middle, chord = 0.5 * (first + last), last - first
    along = chord / np.linalg.norm(chord)

    def half(sign: float) -> Callable[[Array], Array]:
        return lambda p: (
            window(p) * 0.5 * (1 + np.sin(0.5 * np.pi * np.clip(sign * ((p - middle) @ along) / taper_mm, -1, 1)))
        )

    found = [_between(source, target, w, largest_mm) for w in (window, half(-1.0), half(1.0))]
    whole, low, high = found
    if whole is None or low is None or high is None:
        return None
    across = np.array([-along[1], along[0]])
    arm = float((high[1] - low[1]) @ along)
    degrees = float(np.degrees(((high[0].shift_mm - low[0].shift_mm) @ across) / arm))
    return PlanarMotion(degrees, whole[0].shift_mm, whole[1], whole[0].peak)


def _between(
    source: Array, target: Array, window: Callable[[Array], Array], largest_mm: float
) -> tuple[Shift, Array] | None:
    """Shift from the source to the target within a window, and the middle of what was seen there."""
    weights = [line_weights(p) * window(p) for p in (target, source)]
    seen = [w > 0 for w in weights]
    if min(int(s.sum()) for s in seen) < 15:
        return None
    middle = weights[0] @ target / weights[0].sum()
    kept = weights[0][seen[0]], weights[1][seen[1]]
    return phase_correlation(target[seen[0]] - middle, source[seen[1]] - middle, 100.0, kept, largest_mm), middle


def _window(
    moved: Array, target: Array, reach: float, taper_mm: float
) -> tuple[Callable[[Array], Array], Array, Array] | None:
    """A weight for points of the plane, and the two ends of what both profiles show: 1 along that part, fading to 0 at its ends.

    A function of the place alone, the same for both profiles: where they lie on each other, they are weighted alike.
    """
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(moved).query(target)
    inside = np.flatnonzero((distance < reach) & (nearest > 0) & (nearest < len(moved) - 1))
    if len(inside) < 20:
        return None
    # A gap in either profile ends the part: the longest one without a gap is taken.
    jump = np.linalg.norm(np.diff(target[inside], axis=0), axis=1)
    inside = max(np.split(inside, np.flatnonzero(jump > LARGEST_GAP_MM) + 1), key=len)
    if len(inside) < 20:
        return None
    first, last = target[inside[0]], target[inside[-1]]
    step = min(10, len(inside) // 2)
    ways = target[inside[step]] - first, target[inside[-1 - step]] - last

    def weight(points: Array) -> Array:
        value = np.ones(len(points))
        for end, way in zip((first, last), ways, strict=True):
            depth = (points - end) @ way / np.linalg.norm(way)
            value = value * np.sin(0.5 * np.pi * np.clip(depth / taper_mm, 0, 1)) ** 2
        return value

    return weight, first, last
