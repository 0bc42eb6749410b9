"""Rig presets: where sensors stand and what they look at, as data. `rig` turns a preset into cameras and planes.

All are given for the left side; the right side's sensors are the same turned by 180 degrees about the rig's Z axis.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SensorSpec:
    """One sensor of a station, both cameras aimed at a target point in the meridian plane.

    `target_mm`: lateral (from the nominal inner face or shoulder outward) and radial (from the tread or from the axis).
    `tilt_deg`: > 0 looks outward from the inboard side. `azimuth_deg`: turns the sensor about the axle, 0 is above it.
    `standoff_mm`: target to the cameras' baseline, in the meridian plane; `half_baseline_mm`: along the circumference.
    `lines_deg`: azimuth of each laser plane against the sensor's own; each plane holds the axle's axis.
    """

    name: str
    kind: str
    target_mm: tuple[float, float]
    tilt_deg: float
    standoff_mm: float
    half_baseline_mm: float
    focal_px: float
    image_size: tuple[int, int]
    lines_deg: tuple[float, ...] = (0.0,)
    azimuth_deg: float = 0.0


@dataclass(frozen=True)
class RigPreset:
    """Sensors of the left side in order of preference, and the board: inner corners (columns, rows) and square in mm.

    `coarse_board` replaces it in images so small that a square of the fine one would fall below 22 px.
    """

    name: str
    sensors: tuple[SensorSpec, ...]
    board: tuple[int, int, float]
    coarse_board: tuple[int, int, float]


_BENCH = (512, 1024)
_COMPACT = (768, 960)
_WIDE = (480, 800)

PRESETS: dict[str, RigPreset] = {
    preset.name: preset
    for preset in (
        RigPreset(
            "bench",  # two sensors a wheel, one a journal
            (
                SensorSpec("wheel_inner", "wheel", (28.5, 2.0), 30.0, 250.0, 60.0, 2000.0, _BENCH),
                SensorSpec("wheel_outer", "wheel", (85.5, -3.0), -12.0, 250.0, 60.0, 2000.0, _BENCH),
                SensorSpec("journal", "journal", (45.0, 68.0), -28.0, 250.0, 60.0, 2000.0, _BENCH),
            ),
            (6, 11, 8.0),
            (4, 7, 12.0),
        ),
        RigPreset(
            "compact",  # one sensor with two laser lines a wheel: the flange's flank stays unseen
            (
                SensorSpec("wheel", "wheel", (40.0, 4.0), 24.0, 190.0, 42.0, 1500.0, _COMPACT, (-1.9, 1.9), 25.0),
                SensorSpec("journal", "journal", (38.0, 68.0), -32.0, 160.0, 36.0, 1300.0, _COMPACT, (0.0,), -40.0),
            ),
            (8, 9, 9.0),
            (5, 6, 13.0),
        ),
        RigPreset(
            "wide",  # three sensors a wheel, two a journal
            (
                SensorSpec("wheel_inner", "wheel", (24.0, 2.0), 38.0, 300.0, 80.0, 1800.0, _WIDE),
                SensorSpec("wheel_top", "wheel", (62.0, 8.0), -2.0, 320.0, 70.0, 1800.0, _WIDE, (0.0,), 4.0),
                SensorSpec("wheel_outer", "wheel", (102.0, -6.0), -30.0, 300.0, 80.0, 1800.0, _WIDE, (0.0,), -5.0),
                SensorSpec("journal_shoulder", "journal", (34.0, 70.0), -34.0, 300.0, 75.0, 1800.0, _WIDE),
                SensorSpec("journal_end", "journal", (80.0, 65.0), -4.0, 280.0, 65.0, 1800.0, _WIDE, (0.0,), 8.0),
            ),
            (6, 9, 10.0),
            (4, 7, 12.5),
        ),
    )
}
