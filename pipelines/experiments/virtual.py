"""Draws for the accuracy experiment: rig, calibration, master, wheelset and scans in memory, through stages 2 to 7.

A draw sees what a bundle would hold; its truth stays with the caller. Calibrations are made of corners, not of images:
corner noise is what an image leaves, and a draw of its own rig then takes a second instead of a minute.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipelines.experiments.bound import nuisance_bounds, other_bounds, registration_bounds, stripe_bounds
from wheelset_assets import bundle, stages
from wheelset_assets.config import Config
from wheelset_assets.metrology.calibration import BoardPose, calibrate_stereo
from wheelset_assets.simulation.boards import board_of, board_poses, project_corners
from wheelset_assets.simulation.noise import NoiseModel, add_noise
from wheelset_assets.simulation.plan import CERTIFICATE_U_MM
from wheelset_assets.simulation.rig import Rig, build_rig
from wheelset_assets.simulation.scan import perfect_stripes
from wheelset_assets.simulation.schedule import Conditions
from wheelset_assets.simulation.streams import in_ball
from wheelset_assets.simulation.wheelset import Patch, Wheelset, draw_master, draw_wheelset
from wheelset_assets.stages import raw
from wheelset_assets.stages.capture import calibration_row
from wheelset_assets.stages.pose import Register, register_by_icp, registered

CORNER_NOISE_PX = 0.02
POSES = 12
EXPANSION_U_PER_K = 0.3e-6
AXIS_UM = 0.5
"""Radius of the ball in which the axis of rotation lies in each scan (scan-bundle format)."""


@dataclass(frozen=True)
class Series:
    """What a series of draws knows exactly: `exact` inputs, or the errors that real ones have."""

    name: str
    thermometer_c: float
    certificate_scale: float
    expansion_u_per_k: float
    draws_a_rig: int


SERIES = {
    "exact": Series("exact", 0.01, 0.0, 0.0, 10),
    "realistic": Series("realistic", 0.03, 1.0, EXPANSION_U_PER_K, 1),
}
DEFECTS = ("none", "none", "none", "none", "none", "none", "gap", "grease", "flat", "outliers")


@dataclass(frozen=True)
class Job:
    """One draw: its number decides everything."""

    series: str
    index: int
    seed: int
    rows: int
    frames: int
    reference_frames: int | None = None
    """Frames of the rig's reference scan; as many as the draw's own if not given."""
    axis_um: float = AXIS_UM


def run_draw(job: Job) -> list[dict[str, Any]]:
    """One row a quantity: value, truth, uncertainty, or the reason for none."""
    draw = drawn(job)
    seen = draw.see()
    found = draw.world.process(seen, draw.world.reference, draw.world.config)
    least = draw.world.bounds(seen, found) if SERIES[job.series].certificate_scale == 0 else {}
    return [row | {"bound": least.get((row["quantity"], row["side"]))} for row in draw.errors(found["measurements"])]


@dataclass(frozen=True)
class Draw:
    """A wheelset in its world: what it is truly like, and the random stream of its scan."""

    job: Job
    world: World
    wheelset: Wheelset
    defect: str
    rng: np.random.Generator

    def see(self) -> Seen:
        """Its scan."""
        gap_deg = 40.0 if self.defect == "gap" else 0.0
        return self.world.see(self.wheelset, self.rng, gap_deg=gap_deg, outliers=self.defect == "outliers")

    def errors(self, measured: pa.Table) -> list[dict[str, Any]]:
        """A row for each measurement, with its truth beside it."""
        truth = self.wheelset.truths()
        return [
            {
                "series": self.job.series,
                "draw": self.job.index,
                "profile": self.wheelset.profile,
                "defect": self.defect,
                "quantity": row["quantity"],
                "side": row["side"],
                "value": row["value"],
                "truth": truth.get((row["quantity"], row["side"])),
                "u": row["expanded_uncertainty"] / row["coverage_factor"] if row["value"] is not None else None,
                "reason": row["reason"],
                "flags": row["quality_flags"],
            }
            for row in measured.to_pylist()
        ]


def drawn(job: Job) -> Draw:
    """The wheelset and world that a draw's number stands for."""
    series = SERIES[job.series]
    rng = np.random.default_rng([job.seed, job.index, 1])
    profile = ("S1002", "LMA")[job.index % 2]
    turns = (job.frames, job.reference_frames or job.frames)
    world = _world(job.series, job.seed, job.index // series.draws_a_rig, job.rows, turns, profile, job.axis_um)
    defect = DEFECTS[(job.index // 2) % len(DEFECTS)]
    wheelset = draw_wheelset(job.seed + 7, job.index, "W", profile)
    size = float(rng.uniform(-19.0, 19.0))  # within 20 mm of the master
    wheels = [replace(wheel, diameter_mm=round(wheel.diameter_mm + size, 4)) for wheel in wheelset.wheels]
    if defect == "grease":
        wheels[0] = replace(wheels[0], patches=(Patch(1.0, np.radians(12.5), 0.15),))
    if defect == "flat":
        wheels[0] = wheels[0].with_flat(2.0, 60.0)
    true_expansion = 11.5e-6 + series.expansion_u_per_k * rng.standard_normal()
    wheelset = replace(wheelset, wheels=(wheels[0], wheels[1]), expansion_per_k=true_expansion)
    return Draw(job, world, wheelset, defect, rng)


@lru_cache(maxsize=2)
def _world(series: str, seed: int, rig: int, rows: int, turns: tuple[int, int], profile: str, axis_um: float) -> World:
    frames, reference_frames = turns
    return World(
        SERIES[series], seed + 1000 * rig, rows, frames, profile, reference_frames=reference_frames, axis_um=axis_um
    )


def _knowing(series: Series, axis_um: float) -> Config:
    """The default configuration, with what a series knows of thermometers, expansion and the axis of rotation."""
    base = Config()
    known = {
        "thermometer_wheelset_u_c": series.thermometer_c,
        "thermometer_rig_u_c": series.thermometer_c,
        "expansion_wheelset_u_per_k": series.expansion_u_per_k,
        "expansion_rig_u_per_k": series.expansion_u_per_k,
        "axis_u_um": 0.5 * axis_um,
    }
    return base.model_copy(update={"measurement": base.measurement.model_copy(update=known)})


@dataclass(frozen=True)
class Seen:
    """A scan up to its points: header, and the tables of stage 2. wheelset and conditions are the truth behind it."""

    header: bundle.ScanHeader
    tables: dict[str, pa.Table]
    wheelset: Wheelset
    conditions: Conditions


class World:
    """One rig with its calibration, its master's certificate and the reference scan."""

    def __init__(
        self,
        series: Series,
        seed: int,
        rows: int,
        frames: int,
        profile: str,
        preset: str = "bench",
        reference_frames: int | None = None,
        axis_um: float = AXIS_UM,
    ) -> None:
        rng = np.random.default_rng([seed, 2])
        self.series, self.seed, self.axis_um, self.config = series, seed, axis_um, _knowing(series, axis_um)
        self.frames = {"production": frames, "reference": reference_frames or frames}
        expansion = 11.5e-6 + series.expansion_u_per_k * rng.standard_normal()
        self.true: Rig = build_rig(seed, preset, "bench-1", rows, expansion)
        declared = {**self.true.declaration(), "expansion_per_k": 11.5e-6}
        self.rig = bundle.Rig.model_validate(declared)
        self.calibrations = self._calibrate(rng)
        self.reference_c = float(rng.uniform(18.5, 27.5))
        master = draw_master(seed, "M", profile)
        master = replace(master, expansion_per_k=11.5e-6 + series.expansion_u_per_k * rng.standard_normal())
        certificate = [
            {
                "quantity": q,
                "side": side,
                "value_mm": value + series.certificate_scale * CERTIFICATE_U_MM[q] / 2 * rng.standard_normal(),
                "expanded_uncertainty_mm": series.certificate_scale * CERTIFICATE_U_MM[q],
            }
            for (q, side), value in sorted(master.truths().items())
            if q in CERTIFICATE_U_MM
        ]
        conditions = self._conditions(rng, 0.1, self.reference_c)
        header = self._header("R", "reference", master, conditions, certificate)
        self.references: dict[Any, dict[str, pa.Table]] = {}  # processed in other ways, by their names
        points = self._triangulated(master, conditions, rng, header, 0.0, False, self.true)
        self.master = Seen(header, points, master, conditions)

    @cached_property
    def reference(self) -> dict[str, pa.Table]:
        """Every table of the reference scan under the world's own configuration."""
        return self.process(self.master, None, self.config)

    def see(
        self,
        wheelset: Wheelset,
        rng: np.random.Generator,
        *,
        gap_deg: float = 0.0,
        outliers: bool = False,
        rig: Rig | None = None,
    ) -> Seen:
        """A production scan up to its points; `rig` is what the true rig has become since its reference scan."""
        return self.see_under(
            self._conditions(rng, 3.0, self.reference_c), wheelset, rng, gap_deg=gap_deg, outliers=outliers, rig=rig
        )

    def see_under(
        self,
        conditions: Conditions,
        wheelset: Wheelset,
        rng: np.random.Generator,
        *,
        gap_deg: float = 0.0,
        outliers: bool = False,
        rig: Rig | None = None,
    ) -> Seen:
        """The same under conditions that are given."""
        header = self._header("P", "production", wheelset, conditions, [])
        points = self._triangulated(wheelset, conditions, rng, header, gap_deg, outliers, rig or self.true)
        return Seen(header, points, wheelset, conditions)

    def bounds(self, seen: Seen, processed: dict[str, pa.Table]) -> dict[tuple[str, str], float]:
        """Least standard deviation in mm, by quantity and side, that this scan and the reference scan allow.

        processed: what the pipeline made of the scan; of it the budgets' sensitivities are used, see `bound`.
        """
        thermometers_c = (self.series.thermometer_c, self.config.measurement.thermometer_rig_u_c)
        least, of_reference = self._stripe_bounds(seen), self._reference_bounds
        others = other_bounds(processed["budgets"], *thermometers_c, self.axis_um)
        # Values are read in the geometry of the reference scan.
        geometry = (self.master.tables, self.true, self.master.conditions.rig_c, self.reference["registrations"])
        nuisances = nuisance_bounds(processed["budgets"], registration_bounds(*geometry))
        found = {}
        for key, own in least.items():
            if key[0] not in CERTIFICATE_U_MM:
                found[key] = float(np.hypot(own, nuisances.get(key, 0.0)))
            elif key in of_reference:
                found[key] = float(np.sqrt(own**2 + of_reference[key] ** 2 + others.get(key, 0.0) ** 2))
        return found

    @cached_property
    def _reference_bounds(self) -> dict[tuple[str, str], float]:
        return self._stripe_bounds(self.master)

    def _stripe_bounds(self, seen: Seen) -> dict[tuple[str, str], float]:
        c = seen.conditions
        growth = 1 + seen.wheelset.expansion_per_k * (c.wheelset_c - 20.0)
        return stripe_bounds(seen.tables, self.true, c.rig_c, seen.wheelset, growth, c.shift_mm)

    def process(
        self, seen: Seen, reference: dict[str, pa.Table] | None, config: Config, register: Register = register_by_icp
    ) -> dict[str, pa.Table]:
        """Tables of stages 2 to 7 of a scan; without a reference it is one."""
        tables = self._posed(seen, config, register)
        return tables | self._measure(seen.header, tables, reference, config)

    def _calibrate(self, rng: np.random.Generator) -> pa.Table:
        board, knobs, rows = board_of(self.true), self.config.calibration, []
        for index, sensor in enumerate(self.true.sensors):
            poses = []
            for k, pose in enumerate(board_poses(board, sensor, POSES, self.seed, 0, index)):
                seen = [
                    px + CORNER_NOISE_PX * rng.standard_normal(px.shape) for px in project_corners(board, sensor, pose)
                ]
                poses.append(BoardPose(f"{k:03d}", seen[0], seen[1]))
            found = calibrate_stereo(
                poses,
                board.corners().reshape(-1, 3),
                sensor.image_size,
                min_poses=knobs.min_poses,
                min_tilt_deg=knobs.min_tilt_deg,
                max_pose_rms_ratio=knobs.max_pose_rms_ratio,
            )
            base = {column.name: None for column in stages.CALIBRATION.outputs[0].columns if column.nullable}
            width, height = sensor.image_size
            rows.append(
                base
                | {
                    "calibration_id": "C",
                    "rig_id": "bench-1",
                    "sensor_id": sensor.sensor_id,
                    "captured_at": _WHEN - timedelta(days=6),
                    "rig_temperature_c": 21.5,
                    "image_width_px": width,
                    "image_height_px": height,
                    "n_poses": POSES,
                }
                | calibration_row(found)
            )
        return stages.CALIBRATION.outputs[0].from_rows(rows)

    def _conditions(self, rng: np.random.Generator, drift_c: float, about_c: float) -> Conditions:
        rig_c = about_c + (drift_c * rng.uniform(-1, 1) if drift_c > 1 else 0.0)
        wheelset_c = about_c + drift_c * rng.uniform(-1, 1)
        y, z, _ = in_ball(rng, 1e-3 * self.axis_um)
        error = self.series.thermometer_c * rng.standard_normal(2)
        return Conditions(
            rig_c,
            wheelset_c,
            rig_c + error[0],
            wheelset_c + error[1],
            float(rng.uniform(-1, 1)),
            (float(y), float(z)),
            0.0,
            float(rng.uniform(0, 360)),
        )

    def _header(
        self, scan_id: str, purpose: str, wheelset: Wheelset, conditions: Conditions, certificate: list[dict[str, Any]]
    ) -> bundle.ScanHeader:
        return bundle.ScanHeader.model_validate(
            {
                "format": "wheelset-scan/1",
                "scan_id": scan_id,
                "rig_id": "bench-1",
                "calibration_id": "C",
                "captured_at": (_WHEN + timedelta(hours=purpose == "production")).isoformat(),
                "purpose": purpose,
                "wheelset": {"wheelset_id": wheelset.wheelset_id, "type": "CRH3", "profile": wheelset.profile},
                "temperature_c": {
                    "wheelset": round(conditions.reported_wheelset_c, 3),
                    "rig": round(conditions.reported_rig_c, 3),
                },
                "files": {},
                "certificate": certificate,
            }
        )

    def _angles(self, header: bundle.ScanHeader) -> np.ndarray:
        """Angles (frames,) of a scan in degrees."""
        n = self.frames[header.purpose]
        return np.arange(n) * 360.0 / n

    def _triangulated(
        self,
        wheelset: Wheelset,
        conditions: Conditions,
        rng: np.random.Generator,
        header: bundle.ScanHeader,
        gap_deg: float,
        outliers: bool,
        rig: Rig,
    ) -> dict[str, pa.Table]:
        """Stage 2 over the noisy stripes of a scan."""
        angle = self._angles(header)
        keep = np.flatnonzero(angle >= gap_deg)
        noise = replace(NoiseModel(), outlier_share=0.01) if outliers else NoiseModel()
        seen = {}
        for sensor in rig.sensors:
            lines = perfect_stripes(wheelset, rig, sensor, conditions, angle + conditions.body_zero_deg)
            noisy = [add_noise(line, noise, sensor.image_size[0], rng) for line in lines]
            seen[sensor.sensor_id] = [
                raw.StripeTable(k, keep.astype(np.int32), line.left_u[keep], line.right_u[keep])
                for k, line in enumerate(noisy)
            ]
        stripes = raw.Stripes(tuple(seen), lambda name: seen[name])
        return dict(
            stages.TRIANGULATION.run(
                stripes=stripes, calibrations=self.calibrations, scan=header, config=self.config.triangulation
            )
        )

    def _posed(self, seen: Seen, config: Config, register: Register) -> dict[str, pa.Table]:
        """Stages 3 to 6 of a scan."""
        found = dict(seen.tables)
        found |= stages.FILTERING.run(**_named(stages.FILTERING, found), config=config.filtering)
        common: dict[str, Any] = {"rig": self.rig, "scan": seen.header}
        found |= stages.FEATURES.run(**_named(stages.FEATURES, found), **common, config=config.features)
        found |= registered(
            **_named(stages.REGISTRATION, found), **common, config=config.registration, register=register
        )
        found |= stages.ALIGNMENT.run(**_named(stages.ALIGNMENT, found), **common, config=config.alignment)
        return found

    def _measure(
        self,
        header: bundle.ScanHeader,
        tables: dict[str, pa.Table],
        reference: dict[str, pa.Table] | None,
        config: Config,
    ) -> dict[str, pa.Table]:
        from warehouse.nominal import nominal

        known = tables | {"calibrations": self.calibrations}
        held = {
            name: reference[name.removeprefix("reference_")] if reference else None
            for name in stages.MEASUREMENT.optional_inputs
        }
        return dict(
            stages.MEASUREMENT.run(
                **_named(stages.MEASUREMENT, known),
                **held,
                rig=self.rig,
                scan=header,
                frames=raw.Frames(self._angles(header)),
                reference=raw.Reference(
                    self.master.header if reference else None, None if reference else "no reference"
                ),
                nominal=nominal(Path(), header.wheelset.profile),
                config=config.measurement,
            )
        )


_WHEN = datetime(2025, 4, 5, 8, tzinfo=timezone(timedelta(hours=8)))


def _named(stage: Any, tables: dict[str, pa.Table]) -> dict[str, pa.Table]:
    return {name: tables[name] for name in stage.inputs}
