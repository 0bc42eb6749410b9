"""What a station reads from one turn: readings, series, spectra, and the mean meridians that they rest on.

Readings are indications at the scan's temperature in the geometry that the caller gives; comparison with the master
wheelset, temperature and the rest of the uncertainty are the comparator's work. `wheel_reading` and `journal_reading`
make them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.datum import Line, find_face, straight_rows
from wheelset_assets.metrology.frame_series import FULL_COVERAGE, FrameSeries, frame_series
from wheelset_assets.metrology.profile import ProfileDefinition
from wheelset_assets.metrology.revolution import HarmonicFit, MeridianGrid, common_frames, fit_harmonics, mean_meridian
from wheelset_assets.metrology.roundness import Flat, Range, Spectrum
from wheelset_assets.quality import Flag

Array = NDArray[Any]
Mask = NDArray[np.bool_]

UNEVEN_LEVEL = 1e-4
"""Chance of noise alone to call a turn uneven."""


@dataclass(frozen=True)
class DatumSettings:
    """Knobs of the datum search: mm and degrees."""

    threshold_deg: float
    step_mm: float
    max_tilt_deg: float
    min_face_mm: float
    min_journal_mm: float
    flat_sigmas: float
    edge_margin_mm: float


@dataclass(frozen=True)
class TurnSettings:
    """Knobs of the readings."""

    definition: ProfileDefinition
    datum: DatumSettings
    runout_order: int
    min_coverage: float
    max_gap_deg: float
    min_frames: int
    exclude_sigmas: float
    outlier_flag_ratio: float
    spectrum_order: int = 30
    max_scatter_mm: float = 0.2
    uneven_floor_mm: float = 0.004
    hollow_to_mm: float = 130.0
    journal_sections_mm: tuple[float, ...] = (25.0, 95.0)
    section_half_width_mm: float = 5.0
    map_angle_bins: int = 180
    map_step_mm: float = 1.5


@dataclass(frozen=True)
class Nominal:
    """A nominal profile: name, and points (n,) lateral from the inner face, and radial from the datum circle, mm."""

    name: str
    s_mm: Array
    z_mm: Array


@dataclass(frozen=True)
class Lever:
    """Derivatives of a value, in mm, by what its station's geometry may be wrong in."""

    views: dict[tuple[str, int], tuple[float, float, float]]
    """By a lateral and a radial step (1) and a turn in the meridian plane (mm / rad) of each sensor and line against the
    first; what is not named is the first, or has no part."""
    tilt_mm: float
    """By a turn of the whole station in the meridian plane, from lateral towards radial, per rad."""
    strains: dict[tuple[str, int], tuple[float, float, float]]
    """By strains of each sensor's meridian, once the others are registered to it or it to them: along the axle, away from
    it, and shear (radius with the place along the axle)."""
    u_calibration_mm: float | None
    """Standard uncertainty of the value by the sensors' calibrations; None where these were not known."""


@dataclass(frozen=True)
class Reading:
    """One indication: NaN with a reason if it is not supported."""

    quantity: str
    side: str
    value: float
    u_noise: float = 0.0
    n_frames: int = 0
    coverage_ratio: float = 0.0
    excluded_ratio: float = 0.0
    reason: str | None = None
    flags: Flag = Flag.NONE
    lever: Lever | None = None


@dataclass(frozen=True)
class Turn:
    """One series over the frames: values, those used, and the harmonics fitted to them."""

    series: str
    value_mm: Array
    used: Mask
    fitted_mm: Array


@dataclass(frozen=True)
class ProfileRows:
    """A wheel's mean meridian as measured: rows (n,) of its sensors, lateral from the inner face, radius, noise, mm."""

    sensor_id: list[str]
    line: NDArray[np.int8]
    row: NDArray[np.int16]
    s_mm: Array
    radius_mm: Array
    u_mm: Array
    height_mm: Array
    """Above the tread at the datum circle; NaN where the tread was not seen there."""
    deviation_mm: Array | None
    """From the nominal profile along its normal, positive where there is more metal; None without a nominal profile."""


@dataclass(frozen=True)
class DeviationMap:
    """Unrolled deviation of a wheel from its mean meridian along the normal, by body angle and lateral place: (n,) each."""

    body_deg: Array
    s_mm: Array
    deviation_mm: Array
    n_points: NDArray[np.int32]


@dataclass(frozen=True)
class Section:
    """One section of a journal, in mm: place from the shoulder outward, mean diameter, ovality, roundness."""

    place_mm: float
    diameter_mm: float
    u_diameter_mm: float
    ovality_mm: float
    u_ovality_mm: float
    roundness_mm: float
    u_roundness_mm: float


@dataclass(frozen=True)
class StationReading:
    """All readings of a station, its series over the turn with their spectra, and what else is stored of it."""

    readings: list[Reading] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    spectra: dict[str, Spectrum] = field(default_factory=dict)
    """By series, over the body angle."""
    flats: list[Flat] = field(default_factory=list)
    profile: ProfileRows | None = None
    map: DeviationMap | None = None
    sections: list[Section] = field(default_factory=list)


class Meridians:
    """The mean meridians of a station's sensors and lines, concatenated, with where each row belongs."""

    def __init__(self, grids: list[MeridianGrid], used: Mask) -> None:
        self.grids = grids
        if grids:
            used = used & common_frames([g.lateral_mm for g in grids])
        self.means = [mean_meridian(g.lateral_mm, g.radial_mm, used) for g in grids]
        good = [np.isfinite(m.lateral_mm) & np.isfinite(m.u_mm) for m in self.means]
        self.row_of = [np.flatnonzero(g) for g in good]
        self.owner = (
            np.concatenate([np.full(len(rows), k) for k, rows in enumerate(self.row_of)]) if grids else np.empty(0, int)
        )
        self.lateral = self._join([m.lateral_mm for m in self.means])
        self.radial = self._join([m.radial_mm for m in self.means])
        u = self._join([m.u_mm for m in self.means])
        floor = np.median(u) * 0.3 if u.size else 1.0
        self.weight = 1.0 / np.maximum(u, floor) ** 2

    def _join(self, values: list[Array]) -> Array:
        return np.concatenate([v[rows] for v, rows in zip(values, self.row_of, strict=True)]) if values else np.empty(0)

    @property
    def points(self) -> Array:
        """(n, 2) lateral, radial."""
        return np.column_stack([self.lateral, self.radial])

    def left_out(self) -> list[tuple[Array, Array]]:
        """(lateral, radial) with each group of frames left out; NaN where a row has no other group."""
        n = min(len(m.left_out_lateral_mm) for m in self.means)
        return [
            (
                self._join([m.left_out_lateral_mm[g] for m in self.means]),
                self._join([m.left_out_radial_mm[g] for m in self.means]),
            )
            for g in range(n)
        ]

    def straight(self, towards_deg: float, s: DatumSettings) -> Mask:
        """Rows of straight parts along towards_deg, judged sensor by sensor in image-row order (eq. 27)."""
        parts = []
        for mean, rows in zip(self.means, self.row_of, strict=True):
            parts.append(
                straight_rows(
                    mean.lateral_mm[rows],
                    mean.radial_mm[rows],
                    towards_deg,
                    threshold_deg=s.threshold_deg,
                    max_tilt_deg=s.max_tilt_deg,
                    step_mm=s.step_mm,
                )
            )
        return np.concatenate(parts) if parts else np.empty(0, bool)

    def rows(self, mask: Mask, k: int) -> Mask:
        """Mask over the image rows of grid k of the concatenated rows in mask."""
        out = np.zeros(self.grids[k].lateral_mm.shape[1], bool)
        out[self.row_of[k][mask[self.owner == k]]] = True
        return out

    def inside(self, line: Line, along: int, margin_mm: float) -> Mask:
        """Rows of a straight part without its ends."""
        coordinate = self.points[:, along]
        margin = min(margin_mm, 0.2 * (line.high_mm - line.low_mm))
        return line.rows & (coordinate >= line.low_mm + margin) & (coordinate <= line.high_mm - margin)


def wheel_face(meridians: Meridians, outward: float, s: DatumSettings) -> Line | None:
    """The inner face: of the flat faces across the axle, the one farthest inboard that reaches to a wheel's rim."""
    return find_face(
        meridians.points, meridians.straight(90.0, s), -outward, sigmas=s.flat_sigmas, min_length_mm=s.min_face_mm
    )


def unsupported(fit: HarmonicFit | None, settings: TurnSettings) -> str | None:
    """Why a harmonic fit does not support a value, or None."""
    if fit is None:
        return "too few frames see it"
    if fit.used.sum() < settings.min_frames:
        return f"only {int(fit.used.sum())} frames see it, {settings.min_frames} are needed"
    if fit.coverage_ratio < settings.min_coverage:
        return f"only {100 * fit.coverage_ratio:.0f} % of the turn was seen, {100 * settings.min_coverage:.0f} % are needed"
    if fit.max_gap_deg > settings.max_gap_deg:
        return f"a gap of {fit.max_gap_deg:.0f} degrees in the turn, at most {settings.max_gap_deg:.0f} is allowed"
    if fit.scatter > settings.max_scatter_mm:
        return (
            f"the frames scatter by {1e3 * fit.scatter:.0f} um about their harmonics, "
            f"at most {1e3 * settings.max_scatter_mm:.0f} um is allowed"
        )
    return None


def described(fit: HarmonicFit, series: FrameSeries, settings: TurnSettings, more: Flag = Flag.NONE) -> dict:
    """What a reading says beside its value: frames, coverage, excluded share, flags."""
    seen = np.isfinite(series.value_mm)
    excluded = 1.0 - fit.used.sum() / max(seen.sum(), 1)
    flags = series.flags | more
    if fit.coverage_ratio < FULL_COVERAGE:
        flags |= Flag.COVERAGE_GAP
    if excluded > settings.outlier_flag_ratio:
        flags |= Flag.OUTLIERS
    if seen.mean() < 0.999:
        flags |= Flag.FRAMES_MISSING
    return {
        "n_frames": int(fit.used.sum()),
        "coverage_ratio": fit.coverage_ratio,
        "excluded_ratio": float(excluded),
        "flags": flags,
    }


def over_the_turn(quantity: str, side: str, found: Range, about: dict) -> Reading:
    """Reading of a largest less smallest value."""
    return Reading(quantity, side, found.value, found.u, **(about | {"flags": about["flags"] | found.flags}))


def uneven(scatter_mm: float, freedom: int, series: FrameSeries, settings: TurnSettings) -> Flag:
    """UNEVEN_TURN if frames scatter about their harmonics by more than the noise that their rows show.

    scatter_mm: standard deviation of the residuals, with `freedom` degrees of freedom. An F test whose level is so low
    that noise alone does not flag a fleet; what lies below the floor is texture of the surface.
    """
    if not series.freedom or freedom < 1 or not np.isfinite(series.noise_mm):
        return Flag.NONE
    excess = float(np.sqrt(max(scatter_mm**2 - series.noise_mm**2, 0.0)))
    if excess <= max(settings.uneven_floor_mm, series.noise_mm):
        return Flag.NONE
    from scipy.stats import f

    limit = float(f.isf(UNEVEN_LEVEL, freedom, series.freedom))
    return Flag.UNEVEN_TURN if scatter_mm**2 > limit * series.noise_mm**2 else Flag.NONE


def jackknife(estimates: Array) -> float:
    """Standard uncertainty from delete-a-group estimates (groups,): sqrt((g - 1) / g sum (x - mean)^2)."""
    finite = estimates[np.isfinite(estimates)]
    if len(finite) < 2:
        return float("nan")
    return float(np.sqrt((len(finite) - 1) / len(finite) * ((finite - finite.mean()) ** 2).sum()))


def mean_at(values: Array, weight: Array, mask: Mask) -> float:
    ok = mask & np.isfinite(values)
    return float((values[ok] * weight[ok]).sum() / weight[ok].sum()) if ok.any() else float("nan")


def refuse(quantities: tuple[str, ...], side: str, reason: str) -> list[Reading]:
    """Readings without a value."""
    return [Reading(quantity, side, float("nan"), reason=reason) for quantity in quantities]


def face_series(
    meridians: Meridians, face: Line, angle_deg: Array, settings: TurnSettings
) -> tuple[HarmonicFit | None, FrameSeries]:
    """Where a face stands frame by frame against its mean, and the harmonics of that."""
    mask = meridians.inside(face, 1, settings.datum.edge_margin_mm)
    series = frame_series(meridians, mask, "lateral_mm", [m.lateral_mm for m in meridians.means], angle_deg)
    return fit_harmonics(angle_deg, series.value_mm, settings.runout_order, settings.exclude_sigmas), series
