"""Stage 6, between tables and arrays: the datum of each station, and the rotation that squares it to the axle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
from numpy.typing import NDArray

from wheelset_assets import tables
from wheelset_assets.bundle import Rig, ScanHeader, Station
from wheelset_assets.config import AlignmentConfig
from wheelset_assets.metrology import datum
from wheelset_assets.quality import Flag

Array = NDArray[Any]


def run_alignments(
    *, fused_profiles: pa.Table, registrations: pa.Table, rig: Rig, scan: ScanHeader, config: AlignmentConfig
) -> Mapping[str, pa.Table]:
    """Stage 6: datum face or journal of each station on its fused meridian, and the rotation that squares it."""
    registered = {row["station"]: row["quality_flags"] for row in registrations.to_pylist()}
    rows = []
    for station in rig.stations:
        profile = fused_profiles.filter(pa.compute.equal(fused_profiles["station"], station.station))
        row = {"scan_id": scan.scan_id, "station": station.station, "kind": station.kind, "side": station.side}
        missing = station.station not in registered
        rows.append(
            row
            | _alignment(profile, station, config)
            | {"quality_flags": Flag.SENSOR_MISSING.names() if missing else []}
        )
    return {"alignments": tables.ALIGNMENTS.from_rows(rows)}


def _alignment(profile: pa.Table, station: Station, config: AlignmentConfig) -> dict[str, Any]:
    outward = 1.0 if station.side == "right" else -1.0
    points = np.column_stack([profile["lateral_mm"].to_numpy(), profile["radial_mm"].to_numpy()])
    sensors = np.asarray(profile["sensor_id"].to_pylist(), object)
    keys = np.array([f"{s}/{line}" for s, line in zip(sensors, profile["line"].to_pylist(), strict=True)])
    pivot = points.mean(axis=0) if len(points) else np.zeros(2)
    none = {column.name: None for column in tables.ALIGNMENTS.columns if column.nullable}
    row = none | {
        "squared_by": "none",
        "n_face_rows": 0,
        "pivot_lateral_mm": float(pivot[0]),
        "pivot_radial_mm": float(pivot[1]),
    }
    if len(points) < 20:
        return row | {"reason": "the station delivered no points"}
    across = _straight(points, keys, 90.0, config)
    if station.kind == "wheel":
        face = datum.find_face(points, across, -outward, sigmas=config.flat_sigmas, min_length_mm=config.min_face_mm)
        if face is None:
            return row | {"reason": "the inner face was not seen"}
        tilt = _posterior_tilt(face, config)
        return row | _face_columns(face, pivot, tilt[0]) | _squaring(tilt, "inner_face")
    cylinder = datum.find_cylinder(
        points,
        _straight(points, keys, 0.0, config),
        outward=outward,
        sigmas=config.flat_sigmas,
        min_length_mm=config.min_journal_mm,
    )
    if cylinder is None:
        return row | {"reason": "the journal's cylinder was not seen"}
    inboard = cylinder.low_mm if outward > 0 else cylinder.high_mm
    across &= (points[:, 0] - inboard) * outward < 0.5
    face = datum.find_face(points, across, outward, sigmas=config.flat_sigmas, min_length_mm=0.5 * config.min_face_mm)
    tilt = _posterior_tilt(cylinder, config)
    squaring = _squaring(tilt, "journal")
    return (
        row
        | (_face_columns(face, pivot, tilt[0]) if face else {"reason": "the shoulder's face was not seen"})
        | squaring
    )


def _straight(points: Array, keys: NDArray, towards_deg: float, config: AlignmentConfig) -> NDArray[np.bool_]:
    straight = np.zeros(len(points), bool)
    for key in dict.fromkeys(keys):
        member = np.flatnonzero(keys == key)
        straight[member] = datum.straight_rows(
            points[member, 0],
            points[member, 1],
            towards_deg,
            threshold_deg=config.tangent_threshold_deg,
            max_tilt_deg=config.max_tilt_deg,
            step_mm=config.step_mm,
        )
    return straight


def _posterior_tilt(line: datum.Line, config: AlignmentConfig) -> tuple[float, float]:
    """Tilt of a datum line and its standard uncertainty in rad, with the nominal pose as a prior.

    A face of which a few millimetres were seen tells less of the orientation than the nominal pose does.
    """
    prior = np.radians(config.nominal_rotation_deg) / np.sqrt(3.0)
    share = prior**2 / (prior**2 + line.u_tilt_rad**2)
    return line.tilt_rad * share, line.u_tilt_rad * float(np.sqrt(share))


def _squaring(tilt: tuple[float, float], by: str) -> dict[str, Any]:
    return {"squaring_deg": float(np.degrees(-tilt[0])), "u_squaring_deg": float(np.degrees(tilt[1])), "squared_by": by}


def _face_columns(face: datum.Line, pivot: Array, tilt_rad: float) -> dict[str, Any]:
    """Plane of the face as seen, and its place once the station is turned by -tilt about the pivot."""
    c, s = np.cos(-tilt_rad), np.sin(-tilt_rad)
    centre = face.centre_mm - pivot
    normal = np.array([np.cos(face.tilt_rad), np.sin(face.tilt_rad)])  # the face's direction, turned back by 90 degrees
    return {
        "plane_a": float(normal[0]),
        "plane_b": 0.0,
        "plane_c": float(normal[1]),
        "plane_d_mm": float(normal @ face.centre_mm),
        "face_lateral_mm": float(pivot[0] + c * centre[0] - s * centre[1]),
        "face_radial_min_mm": face.low_mm,
        "face_radial_max_mm": face.high_mm,
        "face_rms_um": face.rms_mm * 1e3,
        "n_face_rows": int(face.rows.sum()),
    }
