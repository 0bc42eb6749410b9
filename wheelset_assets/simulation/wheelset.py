"""True wheelsets at 20 degC: every length, shape and defect, and the exact value of each of the format's quantities.

Here: the parameters, the surfaces of revolution made of them (run-out, ovality, flats, dirt), truths, random draws.
Not here: position, temperature and rotation in a scan (`stripes`), meridians (`meridian`, `profiles`).

Wheelset frame: X along the axis from the left to the right wheel, origin midway between the shoulders: its centre.
The angle phi about +X is fixed to the body.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .meridian import RUNNING, STEP_MM, JournalShape, Meridian, Wear, journal_meridian, wheel_meridian
from .profiles import DATUM_MM, PROFILES, Piece
from .streams import stream

Array = NDArray[np.float64]
SIDES = ("left", "right")
SECTIONS_MM = (25.0, 95.0)
"""Sections of a journal, from the shoulder."""
_TURN = np.linspace(0.0, 2 * np.pi, 14400, endpoint=False)


@dataclass(frozen=True)
class Harmonics:
    """sum over orders n of A_n cos(n phi + p_n), in mm; order 0 is not allowed (it would change the mean)."""

    orders: tuple[int, ...] = ()
    amplitudes_mm: tuple[float, ...] = ()
    phases_rad: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.orders) == len(self.amplitudes_mm) == len(self.phases_rad) or any(n < 1 for n in self.orders):
            raise ValueError(f"harmonics need one amplitude and phase an order, orders from 1, got {self}")

    def at(self, phi_rad: Array) -> Array:
        """Value (mm) at body angles of any shape."""
        terms = zip(self.orders, self.amplitudes_mm, self.phases_rad, strict=True)
        return sum((a * np.cos(n * phi_rad + p) for n, a, p in terms), np.zeros_like(phi_rad))

    def first(self) -> Array:
        """(cosine, sine) of order 1 (2,), mm: where the centre lies."""
        terms = [(a, p) for n, a, p in zip(self.orders, self.amplitudes_mm, self.phases_rad, strict=True) if n == 1]
        return np.array([sum(a * np.cos(p) for a, p in terms), -sum(a * np.sin(p) for a, p in terms)], float)

    def without(self, order: int) -> Harmonics:
        """The same without one order."""
        terms = [t for t in zip(self.orders, self.amplitudes_mm, self.phases_rad, strict=True) if t[0] != order]
        return Harmonics(tuple(t[0] for t in terms), tuple(t[1] for t in terms), tuple(t[2] for t in terms))

    def range_mm(self) -> float:
        """max - min over the turn."""
        values = self.at(_TURN)
        return float(values.max() - values.min())


@dataclass(frozen=True)
class Patch:
    """A local change of radius on a wheel: a flat (negative height, parabolic along the turn) or dirt (positive)."""

    centre_rad: float
    half_width_rad: float
    height_mm: float
    lateral_mm: float = DATUM_MM  # centre, from the inner face
    half_lateral_mm: float = 25.0

    def at(self, phi_rad: Array, lateral_mm: Array) -> Array:
        """Change of radius (mm); both arguments of one shape."""
        x = np.angle(np.exp(1j * (phi_rad - self.centre_rad))) / self.half_width_rad
        y = np.abs(lateral_mm - self.lateral_mm) / self.half_lateral_mm
        across = np.clip((1.0 - y) / 0.2, 0.0, 1.0)  # plateau with flanks over the outer fifth
        return self.height_mm * np.maximum(1.0 - x * x, 0.0) * across * across * (3.0 - 2.0 * across)


@dataclass(frozen=True)
class Wheel:
    """One wheel: diameter on the datum circle (harmonic 0), run-out of radius and of inner face, wear, defects."""

    diameter_mm: float = 920.0
    radial: Harmonics = Harmonics()
    axial: Harmonics = Harmonics()
    wear: Wear = field(default_factory=Wear)
    patches: tuple[Patch, ...] = ()

    def with_flat(self, centre_rad: float, length_mm: float) -> Wheel:
        """The wheel with a flat: a chord of that length along the tread, so its depth is length^2 / (4 diameter)."""
        depth = length_mm**2 / (4 * self.diameter_mm)
        return replace(self, patches=(*self.patches, Patch(centre_rad, length_mm / self.diameter_mm, -depth)))

    def with_polygon(self, order: int, amplitude_mm: float) -> Wheel:
        """The wheel with one more harmonic of its radius, unless the amplitude is 0."""
        if not amplitude_mm:
            return self
        old = self.radial
        more = Harmonics((*old.orders, order), (*old.amplitudes_mm, amplitude_mm), (*old.phases_rad, 0.0))
        return replace(self, radial=more)


@dataclass(frozen=True)
class Journal:
    """One journal: mean diameter, out-of-roundness, taper (outer minus inner diameter), other lengths."""

    diameter_mm: float = 130.0
    radial: Harmonics = Harmonics()
    taper_mm: float = 0.0
    shape: JournalShape = field(default_factory=JournalShape)


@dataclass(frozen=True)
class Surface:
    """A surface in the wheelset frame: x = sign (base + lateral + axial(phi)), rho = radius + radial + radial(phi)."""

    kind: str
    side: str
    meridian: Meridian
    base_mm: float
    radius_mm: float
    radial: Harmonics
    axial: Harmonics
    patches: tuple[Patch, ...] = ()

    @property
    def sign(self) -> float:
        """Direction of growing lateral coordinate along X."""
        return -1.0 if self.side == "left" else 1.0


@dataclass(frozen=True)
class Wheelset:
    """A wheelset at 20 degC; `wheels` and `journals` are (left, right). `offset_mm` moves both inner faces along X."""

    wheelset_id: str
    inner_distance_mm: float = 1353.0
    shoulder_distance_mm: float = 2180.0
    wheels: tuple[Wheel, Wheel] = (Wheel(), Wheel())
    journals: tuple[Journal, Journal] = (Journal(), Journal())
    type: str = "CRH3"
    profile: str = "S1002"
    pieces: tuple[Piece, ...] | None = None  # closed form or points of a profile that PROFILES does not know
    offset_mm: float = 0.0
    expansion_per_k: float = 11.5e-6

    def surface(self, kind: str, side: str, step_mm: float = STEP_MM) -> Surface:
        """The surface of one `kind` (wheel or journal) and side."""
        index = SIDES.index(side)
        if kind == "journal":
            journal = self.journals[index]
            meridian = journal_meridian(journal.diameter_mm, journal.taper_mm, journal.shape, step_mm)
            base = self.shoulder_distance_mm / 2
            return Surface(kind, side, meridian, base, 0.0, journal.radial, Harmonics())
        if kind != "wheel":
            raise ValueError(f"kind is wheel or journal, got {kind!r}")
        wheel = self.wheels[index]
        meridian = wheel_meridian(self.profile_pieces, wheel.wear, step_mm=step_mm)
        base = self.inner_distance_mm / 2 + (-self.offset_mm if side == "left" else self.offset_mm)
        radius = wheel.diameter_mm / 2
        return Surface(kind, side, meridian, base, radius, wheel.radial, wheel.axial, wheel.patches)

    @property
    def profile_pieces(self) -> tuple[Piece, ...]:
        """The nominal profile's pieces."""
        return self.pieces if self.pieces is not None else PROFILES[self.profile]

    def truths(self) -> dict[tuple[str, str], float]:
        """Exact values (mm) by (quantity, side), at 20 degC; flats and dirt excluded, as the format asks."""
        truth = {
            ("inner_distance", "both"): self.inner_distance_mm,
            ("shoulder_distance", "both"): self.shoulder_distance_mm,
        }
        for side, wheel, journal in zip(SIDES, self.wheels, self.journals, strict=True):
            truth["wheel_diameter", side] = wheel.diameter_mm
            truth["journal_diameter", side] = journal.diameter_mm
            truth["radial_runout", side] = wheel.radial.range_mm()
            truth["axial_runout", side] = wheel.axial.range_mm()
            truth |= {(quantity, side): value for quantity, value in journal_truths(journal).items()}
            truth |= {(quantity, side): value for quantity, value in self._wheel_truths(wheel).items()}
        return truth | self._axle_truths(truth)

    def _wheel_truths(self, wheel: Wheel) -> dict[str, float]:
        """Values of one wheel beside diameter and run-outs."""
        worn, new = (wheel_meridian(self.profile_pieces, wear) for wear in (wheel.wear, Wear()))
        truth = flange_truths(worn)
        flats = [-patch.height_mm for patch in wheel.patches if patch.height_mm < 0]
        depth = max(flats, default=0.0)
        radius = wheel.diameter_mm / 2 + wheel.radial.at(_TURN)
        slope = np.gradient(np.concatenate([radius[-1:], radius, radius[:1]]), _TURN[1])[1:-1]
        return truth | {
            "wheel_diameter_tape": float(np.hypot(radius, slope).mean() * 2.0),
            "tread_wear": truth["flange_height"] - flange_truths(new)["flange_height"],
            "tread_hollow": hollow_mm(worn),
            "rim_width": float(worn.nodes_mm[0].max()),
            "rollover": 0.0,
            "out_of_roundness": wheel.radial.without(1).range_mm(),
            "flat_depth": depth,
            "flat_length": 2.0 * float(np.sqrt(wheel.diameter_mm * depth)),
        }

    def _axle_truths(self, truth: dict[tuple[str, str], float]) -> dict[tuple[str, str], float]:
        """Values that need several stations."""
        left, right = self.wheels
        inner, thickness = self.inner_distance_mm, {s: truth["flange_thickness", s] for s in SIDES}
        apart = right.axial.at(_TURN) + left.axial.at(_TURN)
        reach = {
            s: (self.shoulder_distance_mm - inner) / 2 - sign * self.offset_mm
            for s, sign in zip(SIDES, (-1, 1), strict=True)
        }
        axle = {
            ("wheel_diameter_difference", "both"): abs(left.diameter_mm - right.diameter_mm),
            ("inner_distance_variation", "both"): float(np.ptp(apart)),
            ("flange_front_distance", "both"): inner + sum(thickness.values()),
            ("face_to_shoulder_difference", "both"): reach["left"] - reach["right"],
        }
        for side in SIDES:
            axle["flange_back_distance", side] = inner + thickness[side]
            axle["face_to_shoulder", side] = reach[side]
            for quantity, value in self._about_journals(side).items():
                axle[quantity, side] = value
        return axle

    def _about_journals(self, side: str) -> dict[str, float]:
        """Run-outs about the line through the two journals' centres, which are taken to be seen 60 mm from the shoulders."""
        sign = -1.0 if side == "left" else 1.0
        wheel = self.wheels[SIDES.index(side)]
        centres = np.array([journal.radial.first() for journal in self.journals])
        end = self.shoulder_distance_mm / 2 + 60.0
        tread = sign * (self.inner_distance_mm / 2 + DATUM_MM + sign * self.offset_mm)
        at_tread = centres[0] + (centres[1] - centres[0]) * (tread + end) / (2 * end)
        slope = (centres[1] - centres[0]) / (2 * end)
        face_radius = wheel.diameter_mm / 2 - 15.0  # middle of what a rim sensor sees of the inner face
        unit = np.stack([np.cos(_TURN), np.sin(_TURN)])
        return {
            "radial_runout_journal_axis": float(np.ptp(wheel.radial.at(_TURN) - at_tread @ unit)),
            "axial_runout_journal_axis": float(np.ptp(sign * wheel.axial.at(_TURN) + face_radius * slope @ unit)),
        }


def journal_truths(journal: Journal) -> dict[str, float]:
    """Values of one journal beside its diameter; its cylinder runs evenly from the fillet to its outer end."""
    shape = journal.shape
    slope = journal.taper_mm / (shape.length_mm - shape.fillet_mm)
    middle = 0.5 * (shape.length_mm + shape.fillet_mm)
    inner, outer = (journal.diameter_mm + slope * (place - middle) for place in SECTIONS_MM)
    return {
        "journal_ovality": ovality_mm(journal.radial),
        "journal_roundness": journal.radial.without(1).range_mm(),
        "journal_diameter_inner": inner,
        "journal_diameter_outer": outer,
        "journal_taper": outer - inner,
        "shoulder_squareness": 0.0,
    }


def hollow_mm(meridian: Meridian) -> float:
    """Largest rise towards the field side between the datum circle and the chamfer (or 130 mm), 0 if there is none."""
    lateral, radial = meridian.nodes_mm
    slope = np.diff(radial) / np.maximum(np.diff(lateral), 1e-12)
    tread = np.flatnonzero((lateral[:-1] >= DATUM_MM) & (lateral[:-1] <= 130.0) & (meridian.part == RUNNING))
    steep = tread[slope[tread] < -0.4]
    z = radial[tread[tread < steep[0]] if len(steep) else tread]
    return float((z - np.minimum.accumulate(z)).max())


def ovality_mm(radial: Harmonics) -> float:
    """max - min over the turn of a section's diameter r(phi) + r(phi + pi)."""
    diameter = radial.at(_TURN) + radial.at(_TURN + np.pi)
    return float(diameter.max() - diameter.min())


def flange_truths(meridian: Meridian) -> dict[str, float]:
    """flange_height, flange_thickness and qr (mm) of a wheel's meridian, whose radial is 0 on the datum circle."""
    top = meridian.top()

    def flank(level_mm: float) -> float:
        laterals = meridian.crossings(1, level_mm)[0]
        return float(laterals[(laterals > top[0]) & (laterals < DATUM_MM)].min())

    at_10 = flank(10.0)
    return {"flange_height": float(top[1]), "flange_thickness": at_10, "qr": at_10 - flank(top[1] - 2.0)}


def draw_wheelset(seed: int, index: int, wheelset_id: str, profile: str, type_: str = "CRH3") -> Wheelset:
    """A production wheelset: near the nominal lengths, worn, out of round by hundredths of a millimetre."""
    rng = stream(seed, "wheelset", index)
    mean = rng.uniform(-1.5, 1.5)
    wheels, journals = [], []
    for _ in SIDES:
        radial = _harmonics(rng, (1, 2, 3, 4), (0.020, 0.012, 0.006, 0.003))
        axial = _harmonics(rng, (1, 2, 3), (0.030, 0.010, 0.004))
        wear = Wear(tread_mm=round(rng.uniform(0.0, 1.0), 3), flank_mm=round(rng.uniform(0.0, 0.5), 3))
        diameter = 920.0 + mean + rng.uniform(-0.25, 0.25)
        wheels.append(Wheel(round(diameter, 4), radial, axial, wear))
        oval = _harmonics(rng, (2, 3), (0.0015, 0.0008))
        journals.append(Journal(round(130.0 + rng.uniform(-0.4, 0.4), 4), oval))
    _off_centre(journals, seed, index)
    return Wheelset(
        wheelset_id,
        inner_distance_mm=round(1353.0 + rng.uniform(-1.0, 1.0), 4),
        shoulder_distance_mm=round(2180.0 + rng.uniform(-0.5, 0.5), 4),
        wheels=(wheels[0], wheels[1]),
        journals=(journals[0], journals[1]),
        type=type_,
        profile=profile,
        offset_mm=round(rng.uniform(-0.2, 0.2), 4),
    )


def _off_centre(journals: list[Journal], seed: int, index: int) -> None:
    """Give journals centres some micrometres off the axis of the centres between which the wheelset turns."""
    rng = stream(seed, "journal-centre", index)
    for k, journal in enumerate(journals):
        first, old = _harmonics(rng, (1,), (0.004,)), journal.radial
        radial = Harmonics(
            (*first.orders, *old.orders),
            (*first.amplitudes_mm, *old.amplitudes_mm),
            (*first.phases_rad, *old.phases_rad),
        )
        journals[k] = replace(journal, radial=radial)


def draw_master(seed: int, wheelset_id: str, profile: str, type_: str = "CRH3") -> Wheelset:
    """The master: nominal lengths to hundredths of a millimetre, unworn, rounder than what it is to judge."""
    worn = draw_wheelset(seed, 0, wheelset_id, profile, type_)
    rng = stream(seed, "master")
    wheels, journals = [], []
    for _ in SIDES:
        radial = _harmonics(rng, (1, 2, 3), (0.003, 0.002, 0.001))
        axial = _harmonics(rng, (1, 2), (0.003, 0.001))
        wheels.append(Wheel(round(920.0 + rng.uniform(-0.02, 0.02), 4), radial, axial))
        journals.append(Journal(round(130.0 + rng.uniform(-0.005, 0.005), 4), _harmonics(rng, (2,), (0.0003,))))
    return replace(
        worn,
        inner_distance_mm=round(1353.0 + rng.uniform(-0.02, 0.02), 4),
        shoulder_distance_mm=round(2180.0 + rng.uniform(-0.02, 0.02), 4),
        wheels=(wheels[0], wheels[1]),
        journals=(journals[0], journals[1]),
        offset_mm=round(rng.uniform(-0.02, 0.02), 4),
    )


def _harmonics(rng: np.random.Generator, orders: tuple[int, ...], typical_mm: tuple[float, ...]) -> Harmonics:
    amplitudes = [round(a * rng.uniform(0.3, 1.5), 6) for a in typical_mm]
    phases = [round(p, 6) for p in rng.uniform(0.0, 2 * np.pi, len(orders))]
    return Harmonics(orders, tuple(amplitudes), tuple(phases))
