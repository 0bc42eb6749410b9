"""When each scan and calibration of a campaign is taken, and under which true and reported conditions.

Here: dates, identifiers, temperatures, the wheelset's place and angle. Not here: the knobs (`plan`), files, stripes.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from .plan import SimulationPlan
from .streams import in_ball, stream

RECALIBRATION_DAYS = 150
GOLDEN = 0.6180339887498949  # its multiples modulo 1 spread evenly, however many are asked for


@dataclass(frozen=True)
class Conditions:
    """True circumstances of a scan and what its instruments report (`reported_*`)."""

    rig_c: float
    wheelset_c: float
    reported_rig_c: float
    reported_wheelset_c: float
    shift_mm: float
    axis_mm: tuple[float, float]
    first_angle_deg: float  # where the encoder stands at frame 0
    body_zero_deg: float  # rotation of the body where the encoder reads 0


@dataclass(frozen=True)
class ScheduledScan:
    """One scan to simulate. `key` (day, wheelset + 1 or 0 for the master, repeat) seeds its random streams."""

    scan_id: str
    purpose: str
    wheelset_index: int | None
    captured_at: datetime
    calibration: int
    key: tuple[int, int, int]
    conditions: Conditions


@dataclass(frozen=True)
class ScheduledCalibration:
    """One calibration of the rig, at its temperature."""

    calibration_id: str
    captured_at: datetime
    rig_c: float
    reported_rig_c: float


def calibrations(plan: SimulationPlan) -> list[ScheduledCalibration]:
    """The first six days before the campaign, a fresh one every RECALIBRATION_DAYS."""
    out = []
    for k in range((plan.day(plan.days - 1) - plan.first_day).days // RECALIBRATION_DAYS + 1):
        captured = plan.at(plan.first_day + timedelta(days=k * RECALIBRATION_DAYS - 6), -120)
        rng = stream(plan.seed, "calibration", k)
        rig_c = round(rng.uniform(20.0, 23.0), 3)
        reported = round(rig_c + plan.noise.thermometer_c * rng.standard_normal(), 3)
        out.append(ScheduledCalibration(f"{plan.mark}cal-{captured:%Y-%m-%d}", captured, rig_c, reported))
    return out


def schedule(plan: SimulationPlan) -> list[ScheduledScan]:
    """All scans in order of time: on each day the reference first, then repeat by repeat each wheelset."""
    scans = []
    pace = min(7.0, 840.0 / max(1, plan.wheelsets * plan.repeats))
    for d in range(plan.days):
        day = plan.day(d)
        calibration = (day - plan.first_day).days // RECALIBRATION_DAYS
        stamp = f"{day:%Y%m%d}"
        base = _day_temperature(plan, d)
        key = (d, 0, 0)
        at = plan.at(day, 0.0)
        scans.append(
            ScheduledScan(
                f"{plan.mark}ref-{stamp}", "reference", None, at, calibration, key, _conditions(plan, key, base)
            )
        )
        minutes = 20.0
        for r in range(plan.repeats):
            for w in range(plan.wheelsets):
                key = (d, w + 1, r)
                scan_id = f"{plan.mark}{plan.wheelset_label(w)}-{stamp}-{r:02d}"
                at = plan.at(day, minutes)
                scans.append(
                    ScheduledScan(scan_id, "production", w, at, calibration, key, _conditions(plan, key, base))
                )
                minutes += pace
    return scans


def _day_temperature(plan: SimulationPlan, day: int) -> float:
    """Rig temperature at the reference scan: spread evenly over the range, whatever the number of days."""
    low, high = plan.rig_temperature_c
    start = stream(plan.seed, "day").uniform()
    return low + (high - low) * float((start + day * GOLDEN) % 1.0)


def _conditions(plan: SimulationPlan, key: tuple[int, int, int], reference_c: float) -> Conditions:
    rng, sensor = stream(plan.seed, "conditions", *key), stream(plan.seed, "thermometer", *key)
    low, high = plan.rig_temperature_c
    # The master rests in the rig; a production wheelset comes from elsewhere, and the hall's temperature drifts.
    drift = plan.scan_difference_c * (rng.uniform(-1.0, 1.0, 2) if key[1] else np.array([0.0, rng.uniform(-0.1, 0.1)]))
    rig_c = float(np.clip(reference_c + drift[0], low, high))
    wheelset_c = reference_c + float(drift[1])
    shift = rng.uniform(-plan.shift_mm, plan.shift_mm)
    y, z, _ = in_ball(rng, plan.axis_error_um * 1e-3)
    angles = rng.uniform(0.0, 360.0, 2)
    reported = plan.noise.thermometer_c * sensor.standard_normal(2)
    return Conditions(
        rig_c,
        wheelset_c,
        round(rig_c + reported[0], 3),
        round(wheelset_c + reported[1], 3),
        float(shift),
        (float(y), float(z)),
        float(angles[0]),
        float(angles[1]),
    )
