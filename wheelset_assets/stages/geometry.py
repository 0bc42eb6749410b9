"""The geometry of a rig as one scan knows it, and what the stations read in it. Tables in, poses and readings out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelset_assets.bundle import Rig, ScanHeader
from wheelset_assets.config import MeasurementConfig
from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.journal_reading import JOURNAL_READINGS, read_journal
from wheelset_assets.metrology.laser_plane import Sensing
from wheelset_assets.metrology.levers import CalibrationField
from wheelset_assets.metrology.profile import ProfileDefinition
from wheelset_assets.metrology.reading import DatumSettings, Nominal, StationReading, TurnSettings, refuse
from wheelset_assets.metrology.revolution import MeridianGrid, meridian_motion
from wheelset_assets.metrology.thermal import grown_pose, growth
from wheelset_assets.metrology.wheel_reading import WHEEL_READINGS, read_wheel
from wheelset_assets.stages.capture import parameter_covariances
from wheelset_assets.stages.pose import View, standing, station_grids
from wheelset_assets.stages.raw import Frames

Array = NDArray[Any]


@dataclass(frozen=True)
class Geometry:
    """rig_from_sensor (4, 4) of each sensor at 20 °C of the rig, as one scan knows it, and how well it is squared."""

    poses: dict[View, Array]
    u_squaring_rad: dict[str, float]
    registration_u: dict[View, tuple[float, float, float]]
    """Lateral and radial in mm and rotation in rad, against the first sensor of the station; of each other one."""
    direction_deg: dict[str, float]
    sensing: dict[View, Sensing]


def scan_geometry(
    rig: Rig, scan: ScanHeader, stripe_statistics: pa.Table, registrations: pa.Table, alignments: pa.Table
) -> Geometry:
    """Poses at 20 °C: squaring of the station, times the first sensor's pose before it, times target_from_source."""
    g = growth(rig.expansion_per_k, scan.temperature_c.rig)
    before = standing(rig, scan.temperature_c.rig, stripe_statistics)
    squaring = {row["station"]: row for row in alignments.to_pylist()}
    poses: dict[View, Array] = {}
    u_squaring: dict[str, float] = {}
    registration_u: dict[View, tuple[float, float, float]] = {}
    direction: dict[str, float] = {}
    for row in registrations.to_pylist():
        at = (row["target_sensor_id"], row["target_line"])
        target = poses[at] = before.poses[at]
        if row["method"] != "nominal":  # a sensor that is known to 2 mm only must not enter any value
            poses[row["source_sensor_id"], row["source_line"]] = target @ pose_of(row)
        direction[row["station"]] = row["direction_deg"]
        registration_u[row["source_sensor_id"], row["source_line"]] = (
            1e-3 * (row["u_lateral_um"] or 0.0),
            1e-3 * (row["u_radial_um"] or 0.0),
            float(np.radians(row["u_meridian_deg"] or 0.0)),
        )
    stations = {s.sensor_id: s.station for s in rig.sensors}
    for view, pose in poses.items():
        row = squaring.get(stations[view[0]])
        motion = np.eye(4)
        if row and row["squaring_deg"] is not None:
            motion = meridian_motion(
                direction[stations[view[0]]],
                (row["pivot_lateral_mm"], row["pivot_radial_mm"]),
                np.radians(row["squaring_deg"]),
                0.0,
                0.0,
            )
            u_squaring[stations[view[0]]] = float(np.radians(row["u_squaring_deg"]))
        poses[view] = grown_pose(motion @ pose, 1.0 / g)
    return Geometry(poses, u_squaring, registration_u, direction, before.sensing)


def pose_of(row: dict[str, Any]) -> Array:
    """target_from_source (4, 4) of a row of the registrations."""
    return rigid.transform(
        rigid.rotation_from_quaternion([row[k] for k in ("qw", "qx", "qy", "qz")]),
        [row[k] for k in ("tx_mm", "ty_mm", "tz_mm")],
    )


def shifted(
    geometry: Geometry, rig: Rig, rig_temperature_c: float, bases_mm: Mapping[tuple[str, str], float]
) -> Geometry:
    """Geometry with each station moved radially by its base K, by (kind, side), at a rig temperature."""
    g = growth(rig.expansion_per_k, rig_temperature_c)
    poses = dict(geometry.poses)
    for station in rig.stations:
        psi = np.radians(geometry.direction_deg.get(station.station, 0.0))
        shift = rigid.transform(
            np.eye(3), bases_mm.get((station.kind, station.side), 0.0) * np.array([0.0, np.cos(psi), np.sin(psi)])
        )
        names = {s.sensor_id for s in rig.station_sensors(station.station)}
        for view in [v for v in poses if v[0] in names]:
            poses[view] = grown_pose(shift @ grown_pose(poses[view], g), 1.0 / g)
    return Geometry(poses, geometry.u_squaring_rad, geometry.registration_u, geometry.direction_deg, geometry.sensing)


def zero_readings(
    cloud: pa.Table, rig: Rig, scan: ScanHeader, frames: Frames, own: Geometry, config: MeasurementConfig
) -> tuple[dict[str, StationReading], dict[tuple[str, str], float]]:
    """Readings of a reference scan with the radial bases K that make it read its certified diameters, and those bases.

    K of eq. 28. A shift by K changes the radius by K times the cosine of each point's offset from the shift's
    direction, so K is found by repeated reading; three rounds leave nanometres.
    """
    certified = {
        (c.quantity, c.side): c.value_mm * growth(scan.wheelset.expansion_per_k, scan.temperature_c.wheelset)
        for c in scan.certificate
    }
    bases: dict[tuple[str, str], float] = {}
    read = read_stations(cloud, rig, scan, frames, own, config)
    for _ in range(4):
        worst = 0.0
        values = {(r.quantity, r.side): r.value for s in read.values() for r in s.readings if r.reason is None}
        for station in rig.stations:
            key = (f"{station.kind}_diameter", station.side)
            if key in certified and key in values:
                step = 0.5 * (certified[key] - values[key])
                bases[station.kind, station.side] = bases.get((station.kind, station.side), 0.0) + step
                worst = max(worst, abs(step))
        if worst < 1e-6:
            break
        read = read_stations(cloud, rig, scan, frames, shifted(own, rig, scan.temperature_c.rig, bases), config)
    return read, bases


def _settings(config: MeasurementConfig) -> TurnSettings:
    definition = ProfileDefinition(
        config.datum_mm, config.flank_height_mm, config.tip_drop_mm, config.tread_half_width_mm
    )
    datum = DatumSettings(
        config.tangent_threshold_deg,
        config.step_mm,
        config.max_tilt_deg,
        config.min_face_mm,
        config.min_journal_mm,
        config.flat_sigmas,
        config.edge_margin_mm,
    )
    return TurnSettings(
        definition,
        datum,
        config.runout_order,
        config.min_coverage,
        config.max_gap_deg,
        config.min_frames,
        config.exclude_sigmas,
        config.outlier_flag_ratio,
        config.spectrum_order,
        config.max_scatter_um * 1e-3,
        config.uneven_floor_um * 1e-3,
        config.hollow_to_mm,
        config.journal_sections_mm,
        config.section_half_width_mm,
        config.map_angle_bins,
        config.map_step_mm,
    )


def _fields(calibrations: pa.Table | None, poses: Mapping[View, Array]) -> dict[View, CalibrationField]:
    if calibrations is None:
        return {}
    known = parameter_covariances(calibrations)
    return {view: CalibrationField(*known[view[0]], pose) for view, pose in poses.items() if view[0] in known}


def read_stations(
    cloud: pa.Table,
    rig: Rig,
    scan: ScanHeader,
    frames: Frames,
    geometry: Geometry,
    config: MeasurementConfig,
    nominal: Nominal | str = "no nominal profile",
    calibrations: pa.Table | None = None,
) -> dict[str, StationReading]:
    """Readings of every station in a geometry, at the scan's rig temperature.

    calibrations: for how values within one station follow them; without, that is not told.
    """
    g = growth(rig.expansion_per_k, scan.temperature_c.rig)
    poses = {name: grown_pose(pose, g) for name, pose in geometry.poses.items()}
    found = station_grids(cloud, poses, len(frames.angle_deg))
    settings, fields = _settings(config), _fields(calibrations, poses)
    result = {}
    for station in rig.stations:
        members: list[MeridianGrid] = [
            grid for s in rig.station_sensors(station.station) for view, grid in found.items() if view[0] == s.sensor_id
        ]
        quantities = WHEEL_READINGS if station.kind == "wheel" else JOURNAL_READINGS
        if not members:
            result[station.station] = StationReading(
                refuse(quantities, station.side, f"station {station.station} delivered no points")
            )
        elif station.kind == "wheel":
            result[station.station] = read_wheel(members, frames.angle_deg, station.side, settings, nominal, fields)
        else:
            result[station.station] = read_journal(members, frames.angle_deg, station.side, settings)
    return result
