"""A small world in memory: a bench rig of six sensors at 256 rows, its calibration, a master and a production wheelset.

Nothing is read or written; stripes and board images come from the simulator, everything after them from the stages.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import duckdb
import numpy as np
import pyarrow as pa

from warehouse.nominal import nominal
from wheelset_assets import bundle, stages
from wheelset_assets.config import Config
from wheelset_assets.declare import Stage
from wheelset_assets.simulation.boards import board_of, board_poses, pixel_rays, render
from wheelset_assets.simulation.noise import NoiseModel, add_noise
from wheelset_assets.simulation.rig import Rig, build_rig
from wheelset_assets.simulation.scan import perfect_stripes
from wheelset_assets.simulation.schedule import Conditions
from wheelset_assets.simulation.wheelset import Wheelset, draw_master
from wheelset_assets.stages import raw

SEED, ROWS, FRAMES, POSES = 5, 256, 48, 7
CONFIG = Config()
NOMINAL = nominal(Path(), "S1002")
NOISE = replace(NoiseModel(), gaps_per_frame=0.02)


def audited(stage: Stage, made: dict[str, pa.Table]) -> SimpleNamespace:
    """A stage's tables by name, each of its declared schema and passing all its checks in DuckDB."""
    assert list(made) == [t.name for t in stage.outputs]
    con = duckdb.connect()
    for table in stage.outputs:
        found = made[table.name]
        assert found.schema.equals(table.schema), table.name
        assert all(found[c.name].null_count == 0 for c in table.columns if not c.nullable), table.name
        con.register("t", found)
        for check in table.generated_checks():
            assert con.sql(check.sql.format(table="t")).fetchall() == [], f"{table.name}: {check.name}"
    return SimpleNamespace(**made)


def one(table: pa.Table, **where) -> dict:
    """The one row of a table with these values."""
    (row,) = [r for r in table.to_pylist() if all(r[k] == v for k, v in where.items())]
    return row


@dataclass
class Scan:
    """What a rig hands over of one turn, and what every stage made of it."""

    header: bundle.ScanHeader
    frames: raw.Frames
    tables: SimpleNamespace


class World:
    """The true rig, its declaration and calibration, and scans on demand."""

    def __init__(self) -> None:
        self.true: Rig = build_rig(SEED, "bench", "bench-1", ROWS)
        self.rig = bundle.Rig.model_validate(self.true.declaration())
        self.ids = tuple(s.sensor_id for s in self.true.sensors)
        self.calibration = bundle.CalibrationHeader.model_validate(
            {
                "format": "wheelset-calibration/1",
                "calibration_id": "cal-1",
                "rig_id": "bench-1",
                "captured_at": "2025-03-30T06:00:00+08:00",
                "temperature_c": {"rig": 21.0},
                "board": {
                    "type": "chessboard",
                    "inner_corners": list(self.true.inner_corners),
                    "square_mm": self.true.square_mm,
                },
                "files": {},
            }
        )
        self.images = {name: self._boards(i) for i, name in enumerate(self.ids)}
        self.calibrated = self.calibrate(self.images)
        self.master: Wheelset = draw_master(SEED, "MASTER-1", "S1002")
        self.reference = self.scan(self.master, 0, "reference")
        self.reference.tables = self.process(self.reference)

    def _boards(self, index: int) -> list[tuple[str, np.ndarray, np.ndarray]]:
        sensor, board = self.true.sensors[index], board_of(self.true)
        rays = [pixel_rays(c) for c in (sensor.left, sensor.right)]
        found = []
        for k, pose in enumerate(board_poses(board, sensor, POSES, SEED, 0, index)):
            random = np.random.default_rng([SEED, index, k])
            right = render(board, sensor.right_from_left @ pose, rays[1], random)
            found.append((f"{k:03d}", render(board, pose, rays[0], random), right))
        return found

    def calibrate(self, images, header=None, rig=None) -> SimpleNamespace:
        """Stage 1 over images by sensor."""
        boards = raw.Boards(header or self.calibration, tuple(images), lambda name: iter(images[name]))
        made = stages.CALIBRATION.run(boards=boards, rig=rig or self.rig, config=CONFIG.calibration)
        return audited(stages.CALIBRATION, made)

    def true_calibrations(self) -> pa.Table:
        """The calibration table with the true cameras in it."""
        rows = []
        for row in self.calibrated.calibrations.to_pylist():
            true = self.true.sensor(row["sensor_id"])
            for side, camera in (("left", true.left), ("right", true.right)):
                row[f"{side}_camera"] = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
                row[f"{side}_distortion"] = list(camera.distortion)
            rows.append(row | {"right_from_left": true.right_from_left.ravel().tolist()})
        return stages.CALIBRATION.outputs[0].from_rows(rows)

    def scan(self, wheelset: Wheelset, seed: int, purpose="production", *, conditions=None, noise=NOISE, frames=FRAMES):
        """A scan of a wheelset with its stripes; `tables` holds the stripes by sensor."""
        random = np.random.default_rng([SEED, 77, seed])
        if conditions is None:
            rig_c, wheelset_c = 22.0 + random.uniform(-1, 1, 2) + (0 if purpose == "reference" else 1.5)
            axis = tuple(2.5e-4 * random.uniform(-1, 1, 2))
            conditions = Conditions(
                rig_c, wheelset_c, rig_c, wheelset_c, random.uniform(-0.5, 0.5), axis, 0.0, random.uniform(0, 360)
            )
        angle = np.arange(frames) * 360.0 / frames
        stripes = {}
        for sensor in self.true.sensors:
            lines = perfect_stripes(wheelset, self.true, sensor, conditions, angle + conditions.body_zero_deg)
            made = []
            for number, line in enumerate(lines):
                noisy = add_noise(line, noise, sensor.image_size[0], random)
                made.append(raw.StripeTable(number, np.arange(frames, dtype=np.int32), noisy.left_u, noisy.right_u))
            stripes[sensor.sensor_id] = made
        certificate = [
            {"quantity": q, "side": s, "value_mm": v, "expanded_uncertainty_mm": 0.001}
            for (q, s), v in wheelset.truths().items()
            if q in ("wheel_diameter", "journal_diameter", "inner_distance", "shoulder_distance", "face_to_shoulder")
        ]
        header = bundle.ScanHeader.model_validate(
            {
                "format": "wheelset-scan/1",
                "scan_id": f"{purpose}-{seed}",
                "rig_id": "bench-1",
                "calibration_id": "cal-1",
                "captured_at": f"2025-04-05T0{8 if purpose == 'reference' else 9}:00:00+08:00",
                "purpose": purpose,
                "wheelset": {"wheelset_id": wheelset.wheelset_id, "type": "CRH3"},
                "temperature_c": {"wheelset": conditions.reported_wheelset_c, "rig": conditions.reported_rig_c},
                "files": {},
                "certificate": certificate if purpose == "reference" else [],
            }
        )
        return Scan(header, raw.Frames(angle), SimpleNamespace(stripes=stripes))

    def triangulate(self, scan: Scan, *, stripes=None, calibrations=None, **knobs) -> SimpleNamespace:
        """Stage 2."""
        known = scan.tables.stripes if stripes is None else stripes
        made = stages.TRIANGULATION.run(
            stripes=raw.Stripes(tuple(known), lambda name: known[name]),
            calibrations=self.calibrated.calibrations if calibrations is None else calibrations,
            scan=scan.header,
            config=CONFIG.triangulation.model_copy(update=knobs),
        )
        return audited(stages.TRIANGULATION, made)

    def filter(self, triangulated: SimpleNamespace, **knobs) -> SimpleNamespace:
        """Stage 3."""
        made = stages.FILTERING.run(**vars(triangulated), config=CONFIG.filtering.model_copy(update=knobs))
        return audited(stages.FILTERING, made)

    def pose(self, scan: Scan, cloud: pa.Table, statistics: pa.Table | None = None) -> SimpleNamespace:
        """Stages 4 to 6; the scan's own statistics unless others are given."""
        common = {"rig": self.rig, "scan": scan.header}
        known = scan.tables.stripe_statistics if statistics is None else statistics
        seen = {"filtered_clouds": cloud, "stripe_statistics": known}
        found = audited(stages.FEATURES, stages.FEATURES.run(**seen, config=CONFIG.features, **common))
        registered = audited(
            stages.REGISTRATION,
            stages.REGISTRATION.run(**seen, features=found.features, config=CONFIG.registration, **common),
        )
        aligned = audited(stages.ALIGNMENT, stages.ALIGNMENT.run(**vars(registered), config=CONFIG.alignment, **common))
        return SimpleNamespace(**vars(found), **vars(registered), **vars(aligned))

    def measure(self, scan: Scan, tables: SimpleNamespace, reference: Scan | None, *, rig=None, why=None, **knobs):
        """Stage 7; without a reference, the reason why."""
        held = reference.tables if reference else None
        made = stages.MEASUREMENT.run(
            filtered_clouds=tables.filtered_clouds, stripe_statistics=tables.stripe_statistics,
            registrations=tables.registrations, alignments=tables.alignments,
            calibrations=self.calibrated.calibrations, rig=rig or self.rig, scan=scan.header, frames=scan.frames,
            reference=raw.Reference(reference.header if reference else None, why), nominal=NOMINAL,
            reference_stripe_statistics=held.stripe_statistics if held else None,
            reference_registrations=held.registrations if held else None,
            reference_alignments=held.alignments if held else None,
            reference_readings=held.readings if held else None,
            config=CONFIG.measurement.model_copy(update=knobs),
        )  # fmt: skip
        return audited(stages.MEASUREMENT, made)

    def process(self, scan: Scan, reference: Scan | None = None, stripes=None) -> SimpleNamespace:
        """Stages 2 to 7 of a scan."""
        triangulated = self.triangulate(scan, stripes=stripes)
        filtered = self.filter(triangulated)
        posed = self.pose(scan, filtered.filtered_clouds, triangulated.stripe_statistics)
        tables = SimpleNamespace(**vars(triangulated), **vars(filtered), **vars(posed))
        why = None if reference else "no reference"
        return SimpleNamespace(**vars(tables), **vars(self.measure(scan, tables, reference, why=why)))
