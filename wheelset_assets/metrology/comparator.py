"""The comparator: values at 20 °C from a scan's readings, the reference scan's readings and the master's certificate.

K, the radial base of a station, and the lateral bases are what the reference scan sets to zero; the rest is the
temperature model and the budget of uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wheelset_assets.metrology.laser_plane import half_square_uncertainty
from wheelset_assets.metrology.uncertainty import Source

CORRELATED = frozenset(
    {
        "wheelset temperature",
        "master temperature",
        "rig temperature",
        "rig temperature at the reference",
        "expansion of the wheelset",
        "expansion of the master",
        "expansion of the rig",
    }
)
"""Sources that all values of one scan share: the same thermometers and coefficients."""


@dataclass(frozen=True)
class Conditions:
    """Temperatures in °C and expansion coefficients in 1/K of the scan and of its reference."""

    wheelset_c: float
    rig_c: float
    reference_wheelset_c: float
    reference_rig_c: float
    wheelset_per_k: float
    master_per_k: float
    rig_per_k: float

    @property
    def growth(self) -> float:
        """Growth of the wheelset from 20 °C."""
        return 1 + self.wheelset_per_k * (self.wheelset_c - 20.0)

    @property
    def master_growth(self) -> float:
        """Growth of the master at the reference scan."""
        return 1 + self.master_per_k * (self.reference_wheelset_c - 20.0)

    @property
    def rig_step(self) -> float:
        """Strain of the rig from the reference scan to the scan."""
        return self.rig_per_k * (self.rig_c - self.reference_rig_c)


@dataclass(frozen=True)
class Tolerances:
    """Standard uncertainties that do not come from the scan: K, 1/K, mm, rad."""

    wheelset_c: float
    rig_c: float
    wheelset_per_k: float
    rig_per_k: float
    axis_mm: float
    pose_rad: float


@dataclass(frozen=True)
class Difference:
    """How far a scan's feature stands from the reference's, as one sensor sees it, and that sensor's lever on the rig.

    displacement_mm: along the measured direction; cross_mm: across it, in the meridian plane. scale: relative standard
    uncertainty of displacements along, and across. lever_mm: change of the reading for a unit strain of the rig.
    tangent_rad: angle between the sensing plane and the measured direction, with its standard uncertainty; on the
    sensor's slide along the turn, and on its turns about the axle and the radial direction, the data are silent.
    """

    displacement_mm: float
    cross_mm: float
    scale: float
    cross_scale: float
    lever_mm: float
    tangent_rad: float
    tangent_u_rad: float
    tilt_u_rad: float


@dataclass(frozen=True)
class Standing:
    """How well a station's geometry is known, as standard uncertainties, and how a value follows it (mm).

    calibration_mm, registration_mm, sensing_mm: of the value by the calibration of its sensors, by their registration,
    and by how their sensing planes lie to the axle. tilt_u_rad: of the squaring.
    """

    calibration_mm: float
    registration_mm: float
    sensing_mm: float
    tilt_u_rad: float
    tilt_mm: float


@dataclass(frozen=True)
class Value:
    """Value at 20 °C, the one without temperature correction, and the budget."""

    value: float
    uncompensated: float
    sources: list[Source]


def compare(
    nominal_mm: float,
    certificate_u_mm: float,
    reading_mm: float,
    u_noise: float,
    reference_u_noise: float,
    conditions: Conditions,
    tolerances: Tolerances,
    parts: list[Difference],
    factor: float,
) -> Value:
    """Value of a zeroed quantity.

    reading_mm: the scan's indication at its temperature with the reference's zero applied, so that the master would
    read nominal_mm (its certified value) times its growth. factor: 2 for a diameter (its parts are radii), 1 for a
    distance (its parts are the two sides). Sensitivities are first derivatives of
    L20 = [reading + zero] / (1 + alpha (T - 20)).
    """
    c, t = conditions, tolerances
    value = reading_mm / c.growth
    lever = factor * sum(part.lever_mm for part in parts)
    uncompensated = (reading_mm - lever * c.rig_step) / c.master_growth
    step_ws, step_ref = c.wheelset_c - 20.0, c.reference_wheelset_c - 20.0
    sources = [
        Source("certificate of the master", certificate_u_mm, "mm", 1.0),
        Source("noise of the scan", u_noise, "mm", 1.0),
        Source("noise of the reference scan", reference_u_noise, "mm", 1.0),
        Source("wheelset temperature", t.wheelset_c, "K", value * c.wheelset_per_k),
        Source("master temperature", t.wheelset_c, "K", nominal_mm * c.master_per_k),
        Source("rig temperature", t.rig_c, "K", lever * c.rig_per_k),
        Source("rig temperature at the reference", t.rig_c, "K", lever * c.rig_per_k),
        Source("expansion of the wheelset", t.wheelset_per_k, "1/K", value * step_ws),
        Source("expansion of the master", t.wheelset_per_k, "1/K", nominal_mm * step_ref),
        Source("expansion of the rig", t.rig_per_k, "1/K", lever * (c.rig_c - c.reference_rig_c)),
    ]
    if factor == 2.0:
        sources.append(Source("axis of rotation", t.axis_mm * np.sqrt(2.0), "mm", 2.0))
    scale = float(np.sqrt(sum((p.scale * p.displacement_mm) ** 2 for p in parts)))
    sources.append(Source("calibration: scale along the reading", scale, "mm", factor))
    cross = float(np.sqrt(sum((np.hypot(p.tilt_u_rad, p.cross_scale) * p.cross_mm) ** 2 for p in parts)))
    sources.append(Source("calibration and squareness across the reading", cross, "mm", factor))
    pose = float(
        np.sqrt(sum((p.displacement_mm * half_square_uncertainty(p.tangent_rad, p.tangent_u_rad)) ** 2 for p in parts))
    )
    sources.append(Source("sensor pose in unconstrained directions", pose, "mm", factor))
    return Value(value, uncompensated, sources)


def absolute(
    reading_mm: float,
    u_noise: float,
    conditions: Conditions,
    tolerances: Tolerances,
    standing: Standing,
) -> Value:
    """Value of a quantity that needs no zero: it lies within one station."""
    value = reading_mm / conditions.growth
    sources = [
        Source("noise of the scan", u_noise, "mm", 1.0),
        Source("registration of the sensors", standing.registration_mm, "mm", 1.0),
        Source("calibration of the sensors", standing.calibration_mm, "mm", 1.0),
        Source("squareness to the axle", standing.tilt_u_rad, "rad", standing.tilt_mm),
        Source("sensing plane beside the axle", standing.sensing_mm, "mm", 1.0),
        Source("wheelset temperature", tolerances.wheelset_c, "K", value * conditions.wheelset_per_k),
        Source("expansion of the wheelset", tolerances.wheelset_per_k, "1/K", value * (conditions.wheelset_c - 20.0)),
    ]
    return Value(value, reading_mm / conditions.master_growth, sources)


def derived(parts: list[tuple[float, Value]], more: list[Source] | None = None) -> Value:
    """Weighted sum of values of one scan; its budget adds what they share with sign, the rest by squares (JCGM 100, 5.2).

    more: sources of the sum itself.
    """
    value = sum(weight * part.value for weight, part in parts)
    uncompensated = sum(weight * part.uncompensated for weight, part in parts)
    names = dict.fromkeys(source.name for _, part in parts for source in part.sources)
    sources = []
    for name in names:
        hits = [(weight, source) for weight, part in parts for source in part.sources if source.name == name]
        unit = hits[0][1].unit
        if name in CORRELATED:
            total = sum(weight * source.sensitivity for weight, source in hits)
            sources.append(Source(name, hits[0][1].standard_uncertainty, unit, total))
        elif len(hits) == 1:
            weight, source = hits[0]
            sources.append(Source(name, source.standard_uncertainty, unit, weight * source.sensitivity))
        else:
            total = float(np.sqrt(sum((weight * source.contribution) ** 2 for weight, source in hits)))
            sources.append(Source(name, total, "mm", 1.0))
    return Value(value, uncompensated, sources + (more or []))
