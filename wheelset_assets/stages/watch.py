"""What a value should be read with: flags of the scan as a whole, and of the stations that changed since the reference."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pyarrow as pa

from wheelset_assets.bundle import Rig, ScanHeader
from wheelset_assets.config import MeasurementConfig
from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.thermal import grown_pose, growth
from wheelset_assets.quality import Flag
from wheelset_assets.stages.geometry import pose_of
from wheelset_assets.stages.raw import Reference


def station_flags(
    rig: Rig,
    scan: ScanHeader,
    reference: ScanHeader,
    registrations: pa.Table,
    base: pa.Table,
    alignments: pa.Table,
    base_alignments: pa.Table,
    calibrations: pa.Table,
    config: MeasurementConfig,
) -> dict[str, Flag]:
    """Flags by station: sensors missing or not registered, registration or squareness other than the reference's.

    Two registrations are compared at one point of the source sensor's working volume, and as they would be at 20 °C: a
    pose's translation grows with the rig.
    """
    before = {(r["station"], r["source_sensor_id"], r["source_line"]): r for r in base.to_pylist()}
    depth_mm = {
        r["sensor_id"]: float(np.mean(r["depth_range_mm"])) for r in calibrations.to_pylist() if r["depth_range_mm"]
    }
    nominal = {s.sensor_id: np.array(s.T_rig_sensor, float) for s in rig.sensors}
    growths = [1.0 / growth(rig.expansion_per_k, header.temperature_c.rig) for header in (scan, reference)]
    flags: dict[str, Flag] = defaultdict(lambda: Flag.NONE)
    for row in registrations.to_pylist():
        for flag in (Flag.SENSOR_MISSING, Flag.NO_REGISTRATION, Flag.FAR_FROM_NOMINAL):
            flags[row["station"]] |= flag if flag.names()[0] in row["quality_flags"] else Flag.NONE
        old = before.get((row["station"], row["source_sensor_id"], row["source_line"]))
        if (
            old is None
            or row["method"] != "icp"
            or old["method"] != "icp"
            or row["target_sensor_id"] != old["target_sensor_id"]
        ):
            continue
        point = np.array([0.0, 0.0, depth_mm.get(row["source_sensor_id"], 300.0)])
        now, then = (rigid.apply(grown_pose(pose_of(r), g), point) for r, g in zip((row, old), growths, strict=True))
        step = nominal[row["target_sensor_id"]][:3, :3] @ (now - then)
        psi = np.radians(row["direction_deg"])
        steps = {"lateral": abs(step[0]), "radial": abs(step[1] * np.cos(psi) + step[2] * np.sin(psi))}
        for name, length in steps.items():
            limit = max(
                config.moved_floor_um, config.moved_sigmas * float(np.hypot(row[f"u_{name}_um"], old[f"u_{name}_um"]))
            )
            if length * 1e3 > limit:
                flags[row["station"]] |= Flag.SENSOR_MOVED
    turned = {r["station"]: r for r in base_alignments.to_pylist()}
    for row in alignments.to_pylist():
        old = turned.get(row["station"])
        if old is None or row["squaring_deg"] is None or old["squaring_deg"] is None:
            continue
        limit = max(
            np.degrees(config.moved_floor_um * 1e-3 / 70.0),
            config.moved_sigmas * float(np.hypot(row["u_squaring_deg"], old["u_squaring_deg"])),
        )
        if abs(row["squaring_deg"] - old["squaring_deg"]) > limit:
            flags[row["station"]] |= Flag.SENSOR_MOVED
    return dict(flags)


def scan_flags(scan: ScanHeader, reference: Reference, calibrations: pa.Table, config: MeasurementConfig) -> Flag:
    """Flags that hold for every value of the scan: ages and temperatures."""
    flags = Flag.NONE
    if calibrations.num_rows:
        row = (
            calibrations.select(["captured_at", "valid_from", "valid_until", "rig_temperature_c"])
            .slice(0, 1)
            .to_pylist()[0]
        )
        age_days = (scan.captured_at - row["captured_at"]).total_seconds() / 86400.0
        flags |= Flag.CALIBRATION_OLD if age_days > config.max_calibration_age_days else Flag.NONE
        flags |= Flag.CALIBRATION_FROM_THE_FUTURE if age_days < 0 else Flag.NONE
        outside = (row["valid_from"] and scan.captured_at < row["valid_from"]) or (
            row["valid_until"] and scan.captured_at > row["valid_until"]
        )
        flags |= Flag.CALIBRATION_NOT_VALID if outside else Flag.NONE
        if abs(scan.temperature_c.rig - row["rig_temperature_c"]) > config.max_calibration_temperature_step_k:
            flags |= Flag.RIG_FAR_FROM_CALIBRATION_TEMPERATURE
    if reference.scan is not None:
        now, then = scan.temperature_c, reference.scan.temperature_c
        if max(abs(now.rig - then.rig), abs(now.wheelset - then.wheelset)) > config.max_reference_temperature_step_k:
            flags |= Flag.FAR_FROM_REFERENCE_TEMPERATURE
        flags |= Flag.REFERENCE_OF_ANOTHER_CALIBRATION if reference.recalibrated else Flag.NONE
    return flags
