"""One scan against its reference: value, or reason, and flags of every quantity. The model itself is metrology.comparator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelset_assets.bundle import CertificateValue, Rig, ScanHeader, Station
from wheelset_assets.config import MeasurementConfig
from wheelset_assets.metrology import comparator
from wheelset_assets.metrology.comparator import Conditions, Difference, Standing, Tolerances, Value
from wheelset_assets.metrology.laser_plane import Sensing
from wheelset_assets.metrology.point_uncertainty import scale_uncertainty
from wheelset_assets.metrology.reading import Lever, Reading, StationReading
from wheelset_assets.metrology.roundness import Range, Spectrum, harmonic_design, peak_to_peak
from wheelset_assets.metrology.uncertainty import Source
from wheelset_assets.quality import Flag
from wheelset_assets.quantities import BY_NAME, quantities_of
from wheelset_assets.stages.capture import parameter_covariances
from wheelset_assets.stages.geometry import Geometry
from wheelset_assets.stages.pose import View

Array = NDArray[Any]


DIAMETERS = {
    "wheel_diameter": ("wheel", "wheel_diameter"),
    "wheel_diameter_tape": ("wheel", "wheel_diameter"),
    "journal_diameter": ("journal", "journal_diameter"),
    "journal_diameter_inner": ("journal", "journal_diameter"),
    "journal_diameter_outer": ("journal", "journal_diameter"),
}
"""Station of each zeroed diameter, and the certified diameter that its zero comes from."""
DISTANCES = {"inner_distance": ("face_lateral", "wheel"), "shoulder_distance": ("shoulder_lateral", "journal")}
PLACES_DEG = {"inner_distance_0": 0.0, "inner_distance_120": 120.0, "inner_distance_240": 240.0}


def wanted_quantities(rig: Rig) -> list[tuple[str, str]]:
    """Quantities and sides that a rig of these stations measures, each once."""
    sides = {(s.kind, s.side) for s in rig.stations}
    return [
        (name, side)
        for name, side in quantities_of({s.kind for s in rig.stations})
        if side == "both" or BY_NAME[name].station == "wheelset" or (BY_NAME[name].station, side) in sides
    ]


Result = tuple[Value | None, str | None, Flag]
Results = dict[tuple[str, str], Result]


def no_values(rig: Rig, reason: str) -> Results:
    return dict.fromkeys(wanted_quantities(rig), (None, reason, Flag.NONE))


class Comparison:
    """One scan against its reference: everything that a value needs, looked up once."""

    def __init__(
        self,
        rig: Rig,
        scan: ScanHeader,
        reference: ScanHeader,
        zero: Geometry,
        readings: dict[str, StationReading],
        reference_readings: pa.Table,
        calibrations: pa.Table,
        moved: dict[str, Flag],
        config: MeasurementConfig,
    ) -> None:
        self.rig, self.scan, self.reference, self.zero, self.moved, self.config = (
            rig,
            scan,
            reference,
            zero,
            moved,
            config,
        )
        self.read = {(r.quantity, r.side): r for s in readings.values() for r in s.readings}
        self.spectra: dict[tuple[str, str], Spectrum] = {
            (series, station.side): found
            for station in rig.stations
            for series, found in readings.get(station.station, StationReading()).spectra.items()
        }
        self.reference_read = {(r["quantity"], r["side"]): r for r in reference_readings.to_pylist()}
        self.certificate: dict[tuple[str, str], CertificateValue] = {
            (c.quantity, c.side): c for c in reference.certificate
        }
        self.stations: dict[tuple[str, str], Station] = {(s.kind, s.side): s for s in rig.stations}
        self.conditions = Conditions(
            scan.temperature_c.wheelset,
            scan.temperature_c.rig,
            reference.temperature_c.wheelset,
            reference.temperature_c.rig,
            scan.wheelset.expansion_per_k,
            reference.wheelset.expansion_per_k,
            rig.expansion_per_k,
        )
        self.tolerances = Tolerances(
            config.thermometer_wheelset_u_c,
            config.thermometer_rig_u_c,
            config.expansion_wheelset_u_per_k,
            config.expansion_rig_u_per_k,
            config.axis_u_um * 1e-3,
            np.radians(config.nominal_rotation_deg) / np.sqrt(3),
        )
        self.scales = _scales(calibrations)

    def values(self) -> Results:
        """Value, or reason, and flags of every quantity."""
        low, high = self.config.min_temperature_c, self.config.max_temperature_c
        for who, header in (("the scan", self.scan), ("its reference", self.reference)):
            for what, t in (("wheelset", header.temperature_c.wheelset), ("rig", header.temperature_c.rig)):
                if not low <= t <= high:
                    return no_values(
                        self.rig, f"{what} temperature of {who} {t:g} °C is outside {low:g} to {high:g} °C"
                    )
        self.result: Results = {}
        for quantity, side in wanted_quantities(self.rig):
            self.result[quantity, side] = self._value(quantity, side)
        return self.result

    def _value(self, quantity: str, side: str) -> Result:
        """Value of one quantity; derived ones come after what they derive from."""
        if quantity in DIAMETERS:
            return self._diameter(quantity, side)
        if quantity in DISTANCES:
            return self._distance(quantity)
        if quantity in PLACES_DEG:
            return self._place(PLACES_DEG[quantity])
        if quantity == "inner_distance_variation":
            return self._variation()
        if quantity == "face_to_shoulder":
            return self._face_to_shoulder(side)
        if quantity.endswith("_journal_axis"):
            return self._about_journals(quantity, side)
        if quantity == "wheel_diameter_difference":
            left, right = (self.result["wheel_diameter", s][0] for s in ("left", "right"))
            sign = -1.0 if left and right and left.value < right.value else 1.0
            return self._derived([(sign, "wheel_diameter", "left"), (-sign, "wheel_diameter", "right")])
        if quantity == "flange_front_distance":
            return self._derived(
                [(1.0, "inner_distance", "both"), *((1.0, "flange_thickness", s) for s in ("left", "right"))]
            )
        if quantity == "flange_back_distance":
            return self._derived([(1.0, "inner_distance", "both"), (1.0, "flange_thickness", side)])
        if quantity == "face_to_shoulder_difference":
            return self._derived([(1.0, "face_to_shoulder", "left"), (-1.0, "face_to_shoulder", "right")])
        return self._absolute(quantity, side)

    def _derived(self, parts: list[tuple[float, str, str]]) -> Result:
        found, flags = [], Flag.NONE
        for weight, quantity, side in parts:
            if (quantity, side) not in self.result:
                self.result[quantity, side] = self._value(quantity, side)
            value, reason, flag = self.result[quantity, side]
            if value is None:
                return None, f"{quantity} {side}: {reason}", Flag.NONE
            found.append((weight, value))
            flags |= flag
        return comparator.derived(found), None, flags

    def _face_spectra(self) -> tuple[Spectrum, Spectrum] | str:
        for side in ("left", "right"):
            if ("face_lateral", side) not in self.spectra:
                return f"{side} wheel: {self._pair_reason('face_lateral', side)}"
        return self.spectra["face_lateral", "left"], self.spectra["face_lateral", "right"]

    def _pair_reason(self, quantity: str, side: str) -> str:
        reading = self.read.get((quantity, side))
        return (reading.reason if reading else None) or "not read"

    def _place(self, place_deg: float) -> Result:
        """Inner distance at one place of the turn: its mean, and how far the two faces stand off their means there."""
        base, reason, flags = self.result["inner_distance", "both"]
        faces = self._face_spectra()
        if base is None or isinstance(faces, str):
            return None, reason if base is None else str(faces), Flag.NONE
        offset, variance = 0.0, 0.0
        for sign, face in zip((-1.0, 1.0), faces, strict=True):
            row = harmonic_design(np.array([place_deg]), face.order)[0]
            row[0] = 0.0
            offset += sign * float(row[1:] @ np.concatenate([face.cosine, face.sine]))
            variance += float(row @ face.covariance @ row)
        noise = Source("noise of the scan at this place", float(np.sqrt(variance)), "mm", 1.0)
        moved = comparator.derived([(1.0, base)], [noise])
        return (
            Value(base.value + offset / self.conditions.growth, base.uncompensated + offset, moved.sources),
            None,
            flags,
        )

    def _variation(self) -> Result:
        faces = self._face_spectra()
        if isinstance(faces, str):
            return None, faces, Flag.NONE
        left, right = faces
        order = min(left.order, right.order)
        both = Spectrum(
            right.mean - left.mean,
            float(np.hypot(left.u_mean, right.u_mean)),
            right.cosine[:order] - left.cosine[:order],
            right.sine[:order] - left.sine[:order],
            _truncated(left, order) + _truncated(right, order),
            float(np.hypot(left.scatter, right.scatter)),
            min(left.n_frames, right.n_frames),
        )
        if order < self.config.runout_order:
            return (
                None,
                f"the frames tell harmonics to order {order} only, {self.config.runout_order} are needed",
                Flag.NONE,
            )
        flags = self.read["face_lateral", "left"].flags | self.read["face_lateral", "right"].flags
        found = peak_to_peak(both)
        return self._from_range(found), None, flags | found.flags

    def _from_range(self, found: Range, more: list[Source] | None = None) -> Value:
        """A run-out as a value: noise, scale, temperature."""
        value = comparator.absolute(
            found.value, found.u, self.conditions, self.tolerances, _within_one_sensor(found.value)
        )
        return Value(value.value, value.uncompensated, value.sources + (more or []))

    def _about_journals(self, quantity: str, side: str) -> Result:
        """Run-out about the line through the journals' centres: harmonic 1 less what that line's offset explains."""
        series = "tread_radius" if quantity.startswith("radial") else "face_lateral"
        own = self.spectra.get((series, side))
        if own is None:
            name = "wheel_diameter" if series == "tread_radius" else "face_lateral"
            return None, self._pair_reason(name, side), Flag.NONE
        centres, places, variances = [], [], []
        for at in ("left", "right"):
            journal = self.spectra.get(("journal_radius", at))
            if journal is None or journal.order < 1:
                return None, f"{at} journal: {self._pair_reason('journal_diameter', at)}", Flag.NONE
            centres.append(np.array([journal.cosine[0], journal.sine[0]]))
            variances.append(float(journal.u_amplitude[0]) ** 2)
            places.append(self.read["journal_lateral", at].value)
        if own.order < self.config.runout_order:
            return (
                None,
                f"the frames tell harmonics to order {own.order} only, {self.config.runout_order} are needed",
                Flag.NONE,
            )
        face, span = self.read["face_lateral", side], places[1] - places[0]
        if series == "tread_radius":
            outward = 1.0 if side == "right" else -1.0
            t = (face.value + outward * self.config.datum_mm - places[0]) / span
            shift = -((1 - t) * centres[0] + t * centres[1])
            u = np.sqrt((1 - t) ** 2 * variances[0] + t**2 * variances[1])
        else:
            lever = self.read["face_radial", side].value / span
            shift = lever * (centres[1] - centres[0])
            u = lever * np.sqrt(variances[0] + variances[1])
        found = peak_to_peak(own, 1, self.config.runout_order, shift=shift)
        flags = face.flags | self.read["journal_diameter", "left"].flags | self.read["journal_diameter", "right"].flags
        more = [Source("noise of the journals' centres", float(u), "mm", 2.0)]
        return self._from_range(found, more), None, flags | found.flags

    def _face_to_shoulder(self, side: str) -> Result:
        certified = self.certificate.get(("face_to_shoulder", side))
        if certified is None:
            return None, f"the certificate of {self.reference.scan_id} has no face_to_shoulder {side}", Flag.NONE
        sign = 1.0 if side == "right" else -1.0
        total, noise, base_noise, parts, flags = 0.0, [], [], [], Flag.NONE
        for name, kind, direction in (("shoulder_lateral", "journal", sign), ("face_lateral", "wheel", -sign)):
            if (kind, side) not in self.stations:
                return None, f"the rig has no {side} {kind} station", Flag.NONE
            pair = self._pair(name, side)
            if isinstance(pair, str):
                return None, f"{side} {kind}: {pair}", Flag.NONE
            reading, base = pair
            station = self.stations[kind, side]
            shift = reading.value - base["reading"]
            total += direction * shift
            parts.append(
                self._difference(station, shift, 1.0, direction * np.array([1.0, 0, 0]), self._radial(station))
            )
            noise.append(reading.u_noise)
            base_noise.append(base["u_noise"])
            flags |= reading.flags | self.moved.get(station.station, Flag.NONE)
        value = comparator.compare(
            certified.value_mm,
            0.5 * certified.expanded_uncertainty_mm,
            certified.value_mm * self.conditions.master_growth + total,
            float(np.linalg.norm(noise)),
            float(np.linalg.norm(base_noise)),
            self.conditions,
            self.tolerances,
            parts,
            1.0,
        )
        return value, None, flags

    def _pair(self, quantity: str, side: str) -> tuple[Reading, dict[str, Any]] | str:
        """The scan's and the reference's readings, or why one is missing."""
        reading, base = self.read.get((quantity, side)), self.reference_read.get((quantity, side))
        if reading is None or reading.reason:
            return (reading.reason if reading else None) or "not read"
        if base is None or base["reading"] is None:
            return f"reference {self.reference.scan_id}: {base['reason'] if base else 'not read'}"
        return reading, base

    def _view(self, station: Station) -> View:
        """The sensor and line that the station's others are registered to."""
        names = [s.sensor_id for s in self.rig.station_sensors(station.station)]
        return next(v for name in names for v in sorted(self.zero.poses) if v[0] == name)

    def _sensing(self, view: View) -> Sensing:
        """How a sensing plane lies to the axle; as the nominal pose allows where no plane was found."""
        if (known := self.zero.sensing.get(view)) is not None:
            return known
        reach = float(np.hypot(*self.zero.poses[view][1:3, 3]))
        name = next(s.station for s in self.rig.sensors if s.sensor_id == view[0])
        station = next(s for s in self.rig.stations if s.station == name)
        diameter = self.read.get((f"{station.kind}_diameter", station.side))
        radius = 0.5 * diameter.value if diameter is not None and diameter.reason is None else reach
        u_offset = float(np.hypot(reach * self.tolerances.pose_rad, self.config.nominal_translation_mm / np.sqrt(3)))
        return Sensing(radius, 0.0, 0.0, u_offset, self.tolerances.pose_rad)

    def _difference(
        self,
        station: Station,
        displacement: float,
        cross: float,
        direction: Array,
        across: Array,
        radius_mm: float | None = None,
    ) -> Difference:
        """A displacement along the axle, or away from it at radius_mm."""
        view = self._view(station)
        sensing = self._sensing(view)
        pose = self.zero.poses[view]
        depth, lateral = self.scales.get(view[0], (1e-3, 1e-3))
        share, cross_share = abs(float(pose[:3, 2] @ direction)), abs(float(pose[:3, 2] @ across))
        tangent = (
            (sensing.yaw_rad, sensing.u_yaw_rad)
            if radius_mm is None
            else (sensing.offset_mm / radius_mm, sensing.u_offset_mm / radius_mm)
        )
        return Difference(
            displacement,
            cross,
            float(np.hypot(share * depth, np.sqrt(max(1 - share**2, 0)) * lateral)),
            float(np.hypot(cross_share * depth, np.sqrt(max(1 - cross_share**2, 0)) * lateral)),
            float(pose[:3, 3] @ direction),
            *tangent,
            self.zero.u_squaring_rad.get(station.station, 1e-3),
        )

    def _radial(self, station: Station) -> Array:
        psi = np.radians(self.zero.direction_deg.get(station.station, 0.0))
        return np.array([0.0, np.cos(psi), np.sin(psi)])

    def _diameter(self, quantity: str, side: str) -> Result:
        kind, zeroed_by = DIAMETERS[quantity]
        reading = self.read.get((quantity, side))
        if reading is None or reading.reason:
            return None, self._pair_reason(quantity, side), Flag.NONE
        pair = self._pair(zeroed_by, side)
        if isinstance(pair, str):
            return None, pair, Flag.NONE
        base = pair[1]
        certified = self.certificate.get((zeroed_by, side))
        if certified is None:
            return None, f"the certificate of {self.reference.scan_id} has no {zeroed_by} {side}", Flag.NONE
        station = self.stations[kind, side]
        face = "face_lateral" if kind == "wheel" else "shoulder_lateral"
        moved = self._pair(face, side)
        cross = moved[0].value - moved[1]["reading"] if not isinstance(moved, str) else 1.0
        indication = (
            reading.value + certified.value_mm * self.conditions.master_growth - base["reading"]
        )  # the rest of K: nanometres
        displacement = 0.5 * (indication - certified.value_mm * self.conditions.master_growth)
        part = self._difference(
            station, displacement, cross, self._radial(station), np.array([1.0, 0, 0]), 0.5 * reading.value
        )
        value = comparator.compare(
            certified.value_mm,
            0.5 * certified.expanded_uncertainty_mm,
            indication,
            reading.u_noise,
            base["u_noise"],
            self.conditions,
            self.tolerances,
            [part],
            2.0,
        )
        if quantity in ("journal_diameter_inner", "journal_diameter_outer"):
            # A section lies aside of the cylinder's middle, of which the certificate holds and which squares the station.
            aside = float(np.ptp(self.config.journal_sections_mm))  # half of it, and both radii
            value.sources.append(Source("squareness to the axle", part.tilt_u_rad, "rad", aside))
            names = {s.sensor_id for s in self.rig.station_sensors(station.station)}
            # Each of two sensors sees a half: its end lies a quarter of the length from its own middle. Half of it counts, in
            # both radii.
            apart = [
                np.hypot(u[1], u[2] * aside / 4) for view, u in self.zero.registration_u.items() if view[0] in names
            ]
            value.sources.append(Source("registration of the sensors", float(max(apart, default=0.0)), "mm", 1.0))
        return value, None, reading.flags | self.moved.get(station.station, Flag.NONE)

    def _distance(self, quantity: str) -> Result:
        face, kind = DISTANCES[quantity]
        certified = self.certificate.get((quantity, "both"))
        parts, noise, base_noise, total, flags = [], [], [], 0.0, Flag.NONE
        for side, sign in (("left", -1.0), ("right", 1.0)):
            pair = self._pair(face, side)
            if (kind, side) not in self.stations:
                return None, f"the rig has no {side} {kind} station", Flag.NONE
            if isinstance(pair, str):
                return None, f"{side} {kind}: {pair}", Flag.NONE
            reading, base = pair
            station = self.stations[kind, side]
            shift = reading.value - base["reading"]
            total += sign * shift
            seen_at = self._pair(face.replace("lateral", "radial"), side)
            cross = seen_at[0].value - seen_at[1]["reading"] if not isinstance(seen_at, str) else 1.0
            parts.append(self._difference(station, shift, cross, sign * np.array([1.0, 0, 0]), self._radial(station)))
            noise.append(reading.u_noise)
            base_noise.append(base["u_noise"])
            flags |= reading.flags | self.moved.get(station.station, Flag.NONE)
        if certified is None:
            return None, f"the certificate of {self.reference.scan_id} has no {quantity}", Flag.NONE
        indication = certified.value_mm * self.conditions.master_growth + total
        value = comparator.compare(
            certified.value_mm,
            0.5 * certified.expanded_uncertainty_mm,
            indication,
            float(np.linalg.norm(noise)),
            float(np.linalg.norm(base_noise)),
            self.conditions,
            self.tolerances,
            parts,
            1.0,
        )
        return value, None, flags

    def _absolute(self, quantity: str, side: str) -> Result:
        reading = self.read.get((quantity, side))
        if reading is None or reading.reason:
            return None, (reading.reason if reading else None) or "not read", Flag.NONE
        kind = BY_NAME[quantity].station
        station = self.stations[kind, side]
        value = comparator.absolute(
            reading.value, reading.u_noise, self.conditions, self.tolerances, self._standing(station, quantity, reading)
        )
        return value, None, reading.flags | self.moved.get(station.station, Flag.NONE)

    def _standing(self, station: Station, quantity: str, reading: Reading) -> Standing:
        """What the station's geometry may be wrong in, and how a value within it follows.

        Values without levers lie in one sensor's view and keep their size when it turns, but for a journal's taper.
        """
        across = TAPER_MM if quantity == "journal_taper" else 0.0
        # Of a journal that several sensors see, one end may lie in each: both radii follow.
        apart = dict.fromkeys(self.zero.registration_u, (0.0, 2.0, 2.0 * TAPER_MM / 4)) if across else {}
        lever = reading.lever
        if lever is None:
            length = abs(reading.value)
            strained = (length, 0.0, 0.0) if quantity in ALONG_THE_AXLE else (0.0, length, 0.0)
            lever = Lever(apart, across, {self._view(station): strained}, None)
        calibration = lever.u_calibration_mm
        if calibration is None:
            sensors = self.rig.station_sensors(station.station)
            scales = max((self.scales.get(s.sensor_id, (1e-3, 1e-3)) for s in sensors), default=(1e-3, 1e-3))
            calibration = float(np.hypot(scales[0] * (0.0 if across else abs(reading.value)), scales[1] * across))
        names = {s.sensor_id for s in self.rig.station_sensors(station.station)}
        registration = [
            float(step * u)
            for view, steps in sorted(self.zero.registration_u.items())
            if view[0] in names
            for step, u in zip(lever.views.get(view, (0.0, 0.0, 0.0)), steps, strict=True)
        ]
        sensing = [np.multiply(by, self._sensing(view).u_strains) for view, by in sorted(lever.strains.items())]
        return Standing(
            calibration,
            float(np.linalg.norm(registration)),
            float(np.linalg.norm(sensing)),
            self.zero.u_squaring_rad.get(station.station, 1e-3),
            lever.tilt_mm,
        )


ALONG_THE_AXLE = frozenset({"axial_runout", "shoulder_squareness"})
"""Values within one sensor's view that are lengths along the axle; the others lie away from it."""
TAPER_MM = 70.0
"""Length of a journal over which its taper is told, about."""


def _within_one_sensor(value_mm: float) -> Standing:
    """Of a small length that one sensor sees: its scale is known to a thousandth."""
    return Standing(1e-3 * value_mm, 0.0, 0.0, 0.0, 0.0)


def _truncated(found: Spectrum, order: int) -> Array:
    """Covariance of mean, cosines and sines up to an order."""
    index = np.concatenate([[0], np.arange(1, order + 1), found.order + np.arange(1, order + 1)])
    return found.covariance[np.ix_(index, index)]


def _scales(calibrations: pa.Table) -> dict[str, tuple[float, float]]:
    """Relative standard uncertainty of displacements in depth and across, for each sensor at its boards' mean depth."""
    depth = {r["sensor_id"]: r["depth_range_mm"] for r in calibrations.to_pylist()}
    return {
        sensor: scale_uncertainty(*known, float(np.mean(depth[sensor])))
        for sensor, known in parameter_covariances(calibrations).items()
    }
