"""What a wheel station reads: inner face, tread, profile, rim, run-outs, roundness, flats, and the unrolled deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.datum import Line, find_face
from wheelset_assets.metrology.frame_series import FrameSeries, frame_series, sensors_missed
from wheelset_assets.metrology.levers import CalibrationField, Steps, station_steps
from wheelset_assets.metrology.profile import (
    ProfileValues,
    flange_top,
    local_fit,
    profile_deviation,
    profile_values,
    tread_fit,
)
from wheelset_assets.metrology.reading import (
    DeviationMap,
    Meridians,
    Nominal,
    ProfileRows,
    Reading,
    StationReading,
    Turn,
    TurnSettings,
    described,
    face_series,
    jackknife,
    mean_at,
    over_the_turn,
    refuse,
    uneven,
    unsupported,
    wheel_face,
)
from wheelset_assets.metrology.revolution import HarmonicFit, MeridianGrid, fit_harmonics
from wheelset_assets.metrology.roundness import (
    Flat,
    Range,
    Spectrum,
    body_angle_deg,
    find_flats,
    mean_direction_deg,
    peak_to_peak,
    spectrum,
)
from wheelset_assets.quality import Flag

Array = NDArray[Any]
Mask = NDArray[np.bool_]

FACE_QUANTITIES = ("face_lateral", "face_radial", "axial_runout", "rim_width", "rollover")
TREAD_QUANTITIES = (
    "wheel_diameter",
    "wheel_diameter_tape",
    "radial_runout",
    "out_of_roundness",
    "flat_depth",
    "flat_length",
    "flange_height",
    "flange_thickness",
    "qr",
    "tread_hollow",
    "tread_wear",
)
WHEEL_READINGS = (*FACE_QUANTITIES, *TREAD_QUANTITIES)
MIN_RIM_MM = 100.0
"""The outer face lies at least this far from the inner face."""
HOLLOW_STEP_MM = 0.5
HOLLOW_MISFIT = 2.5
"""Parabolas whose points scatter about them by more than so many standard uncertainties say nothing of the tread."""
CHAMFER_SLOPE = 0.4
"""Where the tread falls steeper than this towards the field side, the chamfer begins."""


def read_wheel(
    grids: list[MeridianGrid],
    angle_deg: Array,
    side: str,
    settings: TurnSettings,
    nominal: Nominal | str = "no nominal profile",
    fields: Mapping[tuple[str, int], CalibrationField] | None = None,
) -> StationReading:
    """Readings of a wheel station from its sensors' grids (frames, rows), in a geometry squared to the axle.

    nominal: the nominal profile, or why there is none. fields: the calibrations behind the grids, by sensor and line.
    """
    outward = 1.0 if side == "right" else -1.0
    wheel = _Wheel(grids, angle_deg, side, outward, settings, np.ones(len(angle_deg), bool), fields or {})
    if wheel.refused:
        return StationReading(refuse(WHEEL_READINGS, side, wheel.refused))
    fit = wheel.tread_fit
    if fit is not None and not unsupported(fit, settings) and fit.used.sum() < np.isfinite(wheel.tread.value_mm).sum():
        # Dirt and flats must not enter the mean meridian either.
        wheel = _Wheel(grids, angle_deg, side, outward, settings, fit.used, fields or {})
        if wheel.refused:
            return StationReading(refuse(WHEEL_READINGS, side, f"{wheel.refused} in the clean frames"))
    return wheel.readings(nominal)


class _Wheel:
    """One wheel's turn with the frames that count: datum face, tread series, and what follows from them."""

    def __init__(
        self,
        grids: list[MeridianGrid],
        angle_deg: Array,
        side: str,
        outward: float,
        settings: TurnSettings,
        used: Mask,
        fields: Mapping[tuple[str, int], CalibrationField],
    ) -> None:
        self.fields = fields
        self.grids, self.angle_deg, self.side, self.outward, self.settings = grids, angle_deg, side, outward, settings
        self.body_deg = body_angle_deg(angle_deg, mean_direction_deg(g.direction_deg for g in grids))
        self.meridians = Meridians(grids, used)
        self.refused = ""
        face = wheel_face(self.meridians, outward, settings.datum)
        if face is None:
            self.refused = "the inner face was not seen"
            return
        self.face: Line = face
        face_fit, self.face_turn = face_series(self.meridians, face, angle_deg, settings)
        if reason := unsupported(face_fit, settings):
            self.refused = f"inner face: {reason}"
            return
        assert face_fit is not None
        self.face_fit: HarmonicFit = face_fit
        self.face_rows = self.meridians.inside(face, 1, settings.datum.edge_margin_mm)
        self.level = mean_at(self.meridians.lateral, self.meridians.weight, self.face_rows)
        self.s = (self.meridians.lateral - self.level) * outward
        self.tread, self.tread_fit = self._tread()

    @cached_property
    def steps(self) -> Steps:
        """What moves the rows, for the values' levers."""
        return station_steps(self.meridians, self.face_rows, self.fields)

    def _tread(self) -> tuple[FrameSeries, HarmonicFit | None]:
        """Radius at the datum circle frame by frame, measured from the inner face of the same meridian."""
        meridians, settings = self.meridians, self.settings
        shape = tread_fit(self.s, meridians.radial, meridians.weight, settings.definition)
        if shape is None:
            return FrameSeries(np.full(len(self.angle_deg), np.nan), float("nan"), 0, Flag.NONE), None
        band = np.abs(self.s - settings.definition.datum_mm) <= shape.half_width
        wobble = self.face_fit.fitted[:, None]  # offset of the face in each frame against its mean meridian
        expected = [
            shape((grid.lateral_mm - self.level - wobble) * self.outward)
            if meridians.rows(band, k).any()
            else np.zeros((1, 1))
            for k, grid in enumerate(meridians.grids)
        ]
        about = frame_series(meridians, band, "radial_mm", expected, self.angle_deg)
        series = replace(about, value_mm=shape.value + about.value_mm)
        return series, fit_harmonics(self.angle_deg, series.value_mm, settings.runout_order, settings.exclude_sigmas)

    def readings(self, nominal: Nominal | str) -> StationReading:
        """Everything that the turn supports."""
        settings, side = self.settings, self.side
        groups = self.meridians.left_out()
        faces = np.array([mean_at(a, self.meridians.weight, self.face_rows) for a, _ in groups])
        found = self._at_the_face(groups, faces)
        full = profile_values(self.s, self.meridians.radial, self.meridians.weight, settings.definition)
        reason = (
            unsupported(self.tread_fit, settings)
            if np.isfinite(full.tread_radius_mm)
            else f"nothing was seen {settings.definition.datum_mm:g} mm from the inner face"
        )
        turns = [
            Turn(
                "face_lateral",
                self.level + self.face_turn.value_mm,
                self.face_fit.used,
                self.level + self.face_fit.fitted,
            )
        ]
        face_spectrum = spectrum(
            self.body_deg, self.face_turn.value_mm, self.face_fit.used, settings.runout_order, self.face_turn.noise_mm
        )
        spectra = {"face_lateral": face_spectrum} if face_spectrum else {}
        fit = self.tread_fit
        tread = (
            spectrum(self.body_deg, self.tread.value_mm, fit.used, settings.spectrum_order, self.tread.noise_mm)
            if fit
            else None
        )
        if reason or fit is None or tread is None:
            found += refuse(TREAD_QUANTITIES, side, f"tread: {reason or 'too few frames see it'}")
            return StationReading(found, turns, spectra, profile=self._rows(full, nominal), map=self._map())
        about = described(fit, self.tread, settings, uneven(tread.scatter, tread.freedom, self.tread, settings))
        found += self._turn_readings(fit, tread, full, groups, faces, about)
        flats, some = self._flats(fit, about)
        found += some
        everywhere = about | {"flags": about["flags"] | sensors_missed(self.meridians, self.angle_deg)}
        found += self._profile_readings(full, groups, faces, nominal, everywhere)
        turns.append(Turn("tread_radius", self.tread.value_mm, fit.used, fit.fitted))
        spectra["tread_radius"] = tread
        return StationReading(found, turns, spectra, flats, self._rows(full, nominal), self._map())

    def _at_the_face(self, groups: list[tuple[Array, Array]], faces: Array) -> list[Reading]:
        """Readings that need the inner face alone, and those of the outer face."""
        m, side = self.meridians, self.side
        fit, settings = self.face_fit, self.settings
        about = described(fit, self.face_turn, settings, uneven(fit.scatter, fit.freedom, self.face_turn, settings))
        own = spectrum(self.body_deg, self.face_turn.value_mm, fit.used, settings.runout_order, self.face_turn.noise_mm)
        mean, u_mean = (own.mean, own.u_mean) if own else (self.face_fit.mean, self.face_fit.u_mean)
        runout = peak_to_peak(own) if own else Range(self.face_fit.peak_to_peak, self.face_fit.u_peak_to_peak)
        return [
            Reading("face_lateral", side, self.level + mean, u_mean, **about),
            Reading("face_radial", side, mean_at(m.radial, m.weight, self.face_rows), **about),
            over_the_turn("axial_runout", side, runout, about),
            *self._outer_face(groups, faces, about),
        ]

    def _outer_face(self, groups: list[tuple[Array, Array]], faces: Array, about: dict) -> list[Reading]:
        m, s = self.meridians, self.settings.datum
        line = find_face(
            m.points, m.straight(90.0, s), self.outward, sigmas=s.flat_sigmas, min_length_mm=0.5 * s.min_face_mm
        )
        if line is None or (line.centre_mm[0] - self.level) * self.outward < MIN_RIM_MM:
            return refuse(("rim_width", "rollover"), self.side, "the outer face was not seen")
        rows = m.inside(line, 1, s.edge_margin_mm)
        width = (mean_at(m.lateral, m.weight, rows) - self.level) * self.outward
        widths = np.array(
            [(mean_at(a, m.weight, rows) - f) * self.outward for (a, _), f in zip(groups, faces, strict=True)]
        )
        u_width = jackknife(widths)
        above = m.radial >= line.low_mm

        def values(a: Array, r: Array) -> Array:
            """Rim width, and how far the rim stands beyond its outer face."""
            s = (a - mean_at(a, m.weight, self.face_rows)) * self.outward
            to_face = mean_at(s, m.weight, rows)
            most = -np.inf
            for k in range(len(m.grids)):  # three rows together stand clear of one row's noise
                own = np.flatnonzero(m.owner == k)
                if len(own) >= 3:
                    three = np.lib.stride_tricks.sliding_window_view(s[own], 3).mean(axis=1)
                    most = max(most, float(three[above[own[1:-1]]].max(initial=-np.inf)) - to_face)
            return np.array([to_face, most])

        beyond = float(values(m.lateral, m.radial)[1])
        u_row = float(np.median(1.0 / np.sqrt(m.weight[rows])))
        u_beyond = float(np.hypot(u_width, 1.5 * u_row))
        of_width, of_beyond = self.steps.levers(values)
        return [
            Reading("rim_width", self.side, width, u_width, **about, lever=of_width),
            Reading("rollover", self.side, max(beyond, 0.0), u_beyond, **about, lever=of_beyond),
        ]

    def _turn_readings(
        self,
        fit: HarmonicFit,
        tread: Spectrum,
        full: ProfileValues,
        groups: list[tuple[Array, Array]],
        faces: Array,
        about: dict,
    ) -> list[Reading]:
        """Diameters, run-out and roundness from the tread's turn."""
        band = np.abs(self.s - self.settings.definition.datum_mm) <= self.settings.definition.tread_half_width_mm
        sets, means = [], []
        for (a, r), left_face in zip(groups, faces, strict=True):
            ok = np.isfinite(a)
            shape = tread_fit(
                (a[ok] - left_face) * self.outward, r[ok], self.meridians.weight[ok], self.settings.definition
            )
            sets.append(shape.value if shape else np.nan)
            means.append(mean_at(r, self.meridians.weight, band & ok))
        # The harmonic fit knows the noise of the tread's mean height, the groups that of the fitted shape about it.
        u_shape = jackknife(np.array(sets) - np.array(means))
        u_radius = float(np.hypot(tread.u_mean, u_shape if np.isfinite(u_shape) else 0.0))
        # Perimeter over pi: integral of sqrt(r^2 + r'^2), to second order in the harmonics.
        orders = np.arange(1, tread.order + 1)
        kept = tread.keep()
        ripple = float((orders**2 * tread.amplitude**2)[kept].sum() / (2.0 * tread.mean))
        runout = peak_to_peak(tread, 1, self.settings.runout_order)
        oval = peak_to_peak(tread, 2)
        refused_roundness = tread.order < self.settings.runout_order
        side = self.side
        found = [
            Reading("wheel_diameter", side, 2 * tread.mean, 2 * u_radius, **about),
            Reading("wheel_diameter_tape", side, 2 * tread.mean + ripple, 2 * u_radius, **about),
        ]
        if refused_roundness:
            why = f"the frames tell harmonics to order {tread.order} only, {self.settings.runout_order} are needed"
            return found + refuse(("radial_runout", "out_of_roundness"), side, why)
        return [
            *found,
            over_the_turn("radial_runout", side, runout, about),
            over_the_turn("out_of_roundness", side, oval, about),
        ]

    def _flats(self, fit: HarmonicFit, about: dict) -> tuple[list[Flat], list[Reading]]:
        """Flats, and depth and length of the deepest; zero where none was found, with what could have escaped as U."""
        excluded = np.isfinite(self.tread.value_mm) & ~fit.used
        diameter = 2 * fit.mean
        flats = find_flats(self.body_deg, self.tread.value_mm - fit.fitted, excluded, fit.scatter, diameter)
        if flats:
            worst = flats[0]
            return flats, [
                Reading("flat_depth", self.side, worst.depth_mm, worst.u_depth_mm, **about),
                Reading("flat_length", self.side, worst.length_mm, worst.u_length_mm, **about),
            ]
        step_mm = np.pi * diameter / len(self.angle_deg)
        # A chord shorter than the frames' spacing may lie between two frames.
        escaped_depth = max(self.settings.exclude_sigmas * fit.scatter, step_mm**2 / (4 * diameter))
        escaped_length = 2 * float(np.sqrt(diameter * escaped_depth))
        about = about | {"flags": about["flags"] | Flag.NOT_DETECTED}
        return [], [
            Reading("flat_depth", self.side, 0.0, 0.5 * escaped_depth, **about),
            Reading("flat_length", self.side, 0.0, 0.5 * escaped_length, **about),
        ]

    def _profile_readings(
        self,
        full: ProfileValues,
        groups: list[tuple[Array, Array]],
        faces: Array,
        nominal: Nominal | str,
        about: dict,
    ) -> list[Reading]:
        """Flange, hollow and wear from the mean meridian; noise by leaving groups of frames out."""
        m, settings, side = self.meridians, self.settings, self.side
        names = {"flange_height": "flange_height_mm", "flange_thickness": "flange_thickness_mm", "qr": "qr_mm"}

        def values(a: Array, r: Array) -> Array:
            s = (a - mean_at(a, m.weight, self.face_rows)) * self.outward
            read = profile_values(s, r, m.weight, settings.definition)
            return np.array([getattr(read, name) for name in names.values()])

        lever = dict(zip(names, self.steps.levers(values), strict=True))
        sets = []
        for (a, r), left_face in zip(groups, faces, strict=True):
            ok = np.isfinite(a)
            sets.append(profile_values((a[ok] - left_face) * self.outward, r[ok], m.weight[ok], settings.definition))
        found: dict[str, Reading] = {}
        for quantity, name in names.items():
            value, u = getattr(full, name), jackknife(np.array([getattr(v, name) for v in sets]))
            if np.isfinite(value) and np.isfinite(u):
                found[quantity] = Reading(quantity, side, float(value), u, **about, lever=lever[quantity])
            else:
                part = "flange's top" if quantity == "flange_height" else "flange's flank"
                found[quantity] = refuse((quantity,), side, f"the {part} was not seen")[0]
        found["tread_hollow"] = self._hollow(groups, faces, about)
        height = found["flange_height"]
        if isinstance(nominal, str):
            found["tread_wear"] = refuse(("tread_wear",), side, nominal)[0]
        elif height.reason:
            found["tread_wear"] = refuse(("tread_wear",), side, height.reason)[0]
        else:
            new = profile_values(nominal.s_mm, nominal.z_mm, np.ones(len(nominal.s_mm)), settings.definition)
            if np.isfinite(new.flange_height_mm):
                wear = height.value - new.flange_height_mm
                found["tread_wear"] = Reading("tread_wear", side, wear, height.u_noise, **about, lever=height.lever)
            else:
                why = f"the nominal profile {nominal.name} has no flange to align by"
                found["tread_wear"] = refuse(("tread_wear",), side, why)[0]
        return list(found.values())

    def _hollow(self, groups: list[tuple[Array, Array]], faces: Array, about: dict) -> Reading:
        """Largest rise of the tread towards the field side between the datum circle and the chamfer."""
        m, settings = self.meridians, self.settings
        places, heights = [], []
        for place in np.arange(settings.definition.datum_mm, settings.hollow_to_mm + 0.1, HOLLOW_STEP_MM):
            fit = local_fit(self.s, m.radial, m.weight, float(place), 2.5, 2)
            if fit is None or fit.coefficients[-2] / fit.half_width < -CHAMFER_SLOPE:
                break
            near = np.abs(self.s - place) <= fit.half_width
            misfit = m.weight[near] * (m.radial[near] - fit(self.s[near])) ** 2
            if misfit.mean() > HOLLOW_MISFIT**2:  # a chamfer's edge, which a parabola overshoots
                continue
            places.append(float(place))
            heights.append(fit.value)
        if len(places) * HOLLOW_STEP_MM < 16.0:
            return refuse(("tread_hollow",), self.side, "the tread outside the datum circle was not seen")[0]
        z = np.array(heights)
        lowest = np.minimum.accumulate(z)
        high = int(np.argmax(z - lowest))
        low = int(np.argmin(z[: high + 1]))
        if high == low:  # falls all the way: nothing is hollow
            high, low = min(low + 1, len(z) - 1), low - (low == len(z) - 1)

        def rise(a: Array, r: Array, face: float) -> float:
            ok = np.isfinite(a)
            s, radial, weight = (a[ok] - face) * self.outward, r[ok], m.weight[ok]
            ends = [local_fit(s, radial, weight, places[i], 2.5, 2) for i in (low, high)]
            return ends[1].value - ends[0].value if ends[0] and ends[1] else np.nan

        u = jackknife(np.array([rise(a, r, face) for (a, r), face in zip(groups, faces, strict=True)]))
        (lever,) = self.steps.levers(lambda a, r: np.array([rise(a, r, mean_at(a, m.weight, self.face_rows))]))
        return Reading("tread_hollow", self.side, max(0.0, float(z[high] - z[low])), u, **about, lever=lever)

    def _rows(self, full: ProfileValues, nominal: Nominal | str) -> ProfileRows:
        """The mean meridian for storage, beside the nominal profile."""
        m = self.meridians
        height = m.radial - full.tread_radius_mm
        deviation = None
        if isinstance(nominal, Nominal):
            top = flange_top(self.s, m.radial, m.weight, self.settings.definition)
            deviation = profile_deviation(self.s, m.radial, top, nominal, self.settings.definition)
        return ProfileRows(
            [m.grids[k].sensor_id for k in m.owner],
            np.array([m.grids[k].line for k in m.owner], np.int8),
            np.concatenate(m.row_of).astype(np.int16),
            self.s,
            m.radial,
            1.0 / np.sqrt(m.weight),
            height,
            deviation,
        )

    def _map(self) -> DeviationMap:
        return deviation_map(self.meridians, self.s, self.body_deg, self.settings)


@dataclass
class _Bins:
    total: Array
    count: Array


def deviation_map(meridians: Meridians, s: Array, body_deg: Array, settings: TurnSettings) -> DeviationMap:
    """Mean deviation from the mean meridian along its normal in bins of the body angle and of the lateral place.

    Rows steeper than 60 degrees (the faces) are left out: there the lateral place does not tell points apart.
    """
    n_angle = min(settings.map_angle_bins, len(body_deg))
    n_place = int(np.ceil(140.0 / settings.map_step_mm))
    angle_bin = np.minimum((body_deg / 360.0 * n_angle).astype(np.int64), n_angle - 1)
    sums = _Bins(np.zeros((n_angle, n_place)), np.zeros((n_angle, n_place)))
    frame_order = np.argsort(angle_bin, kind="stable")
    frame_starts = np.flatnonzero(np.diff(np.concatenate([[-1], angle_bin[frame_order]])))
    angles = angle_bin[frame_order][frame_starts]
    for k, grid in enumerate(meridians.grids):
        own = meridians.owner == k
        rows, place = meridians.row_of[k], s[own]
        mean_a, mean_r = meridians.lateral[own], meridians.radial[own]
        if len(rows) < 5:
            continue
        along_a, along_r = np.gradient(mean_a), np.gradient(mean_r)
        length = np.hypot(along_a, along_r)
        with np.errstate(invalid="ignore", divide="ignore"):
            normal_a, normal_r = -along_r / length, along_a / length
        flip = np.sign(normal_r)
        normal_a, normal_r = normal_a * flip, normal_r * flip
        place_bin = np.floor(place / settings.map_step_mm).astype(np.int64)
        good = (normal_r > 0.5) & (place_bin >= 0) & (place_bin < n_place)
        index = np.flatnonzero(good)[np.argsort(place_bin[good], kind="stable")]
        if not len(index):
            continue
        starts = np.flatnonzero(np.diff(np.concatenate([[-1], place_bin[index]])))
        columns = rows[index]
        value = (grid.lateral_mm[:, columns] - mean_a[index]) * normal_a[index]
        value += (grid.radial_mm[:, columns] - mean_r[index]) * normal_r[index]
        seen = np.isfinite(value)
        value = np.add.reduceat(np.where(seen, value, 0.0), starts, axis=1)
        count = np.add.reduceat(seen, starts, axis=1, dtype=np.int64)
        block = np.ix_(angles, place_bin[index][starts])
        sums.total[block] += np.add.reduceat(value[frame_order], frame_starts, axis=0)
        sums.count[block] += np.add.reduceat(count[frame_order], frame_starts, axis=0)
    filled = np.nonzero(sums.count)
    return DeviationMap(
        (filled[0] + 0.5) * 360.0 / n_angle,
        (filled[1] + 0.5) * settings.map_step_mm,
        sums.total[filled] / sums.count[filled],
        sums.count[filled].astype(np.int32),
    )


__all__ = ["TREAD_QUANTITIES", "WHEEL_READINGS", "deviation_map", "read_wheel"]
