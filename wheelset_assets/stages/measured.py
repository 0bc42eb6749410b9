"""What the measurement stage stores: from values and readings to tables."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from wheelset_assets import tables
from wheelset_assets.bundle import Rig, ScanHeader
from wheelset_assets.config import MeasurementConfig
from wheelset_assets.metrology.reading import StationReading
from wheelset_assets.metrology.roundness import level_db
from wheelset_assets.metrology.uncertainty import COVERAGE_FACTOR, combined
from wheelset_assets.quality import Flag
from wheelset_assets.quantities import BY_NAME
from wheelset_assets.stages.comparison import Results
from wheelset_assets.stages.raw import Frames, Reference

ALIGNMENT = {"tread_wear": "alignment inner face and flange's top"}
"""Alignment to the nominal profile of the quantities that need one."""


def definition(quantity: str, config: MeasurementConfig) -> str | None:
    """Parameters and alignment of a quantity as one line, or None where it has none."""
    parts = []
    for name in BY_NAME[quantity].parameters:
        value = getattr(config, name)
        parts.append(f"{name} {'/'.join(f'{v:g}' for v in value) if isinstance(value, tuple) else f'{value:g}'}")
    if quantity in ALIGNMENT:
        parts.append(ALIGNMENT[quantity])
    return ", ".join(parts) or None


def measurement_table(
    scan: ScanHeader, reference: Reference, values: Results, flags_of_scan: Flag, config: MeasurementConfig
) -> pa.Table:
    """Rows of `measurements`."""
    common = {
        "scan_id": scan.scan_id,
        "wheelset_id": scan.wheelset.wheelset_id,
        "rig_id": scan.rig_id,
        "purpose": scan.purpose,
        "captured_at": scan.captured_at,
        "acquired_on": scan.acquired_on,
        "calibration_id": scan.calibration_id,
        "reference_scan_id": reference.scan.scan_id if reference.scan else None,
        "wheelset_temperature_c": scan.temperature_c.wheelset,
        "rig_temperature_c": scan.temperature_c.rig,
        "coverage_factor": COVERAGE_FACTOR,
        "wheelset_type": scan.wheelset.type,
        "profile": scan.wheelset.profile,
        "trainset": scan.trainset,
        "car": scan.car,
        "bogie": scan.bogie,
        "axle": scan.axle,
        "operator": scan.operator,
        "mileage_km": scan.mileage_km,
    }
    rows = []
    for (quantity, side), (value, reason, flags) in values.items():
        rows.append(
            common
            | {
                "quantity": quantity,
                "unit": BY_NAME[quantity].unit,
                "side": side,
                "value": value.value if value else None,
                "expanded_uncertainty": COVERAGE_FACTOR * combined(value.sources) if value else None,
                "value_uncompensated": value.uncompensated if value else None,
                "quality_flags": (flags | flags_of_scan).names(),
                "reason": reason,
                "definition": definition(quantity, config),
            }
        )
    return tables.MEASUREMENTS.from_rows(rows)


def budget_table(scan: ScanHeader, values: Results) -> pa.Table:
    rows = []
    for (quantity, side), (value, _, _) in values.items():
        if value is None:
            continue
        variance = combined(value.sources) ** 2
        for source in value.sources:
            rows.append(
                {
                    "scan_id": scan.scan_id,
                    "quantity": quantity,
                    "side": side,
                    "source": source.name,
                    "standard_uncertainty": source.standard_uncertainty,
                    "source_unit": source.unit,
                    "sensitivity": source.sensitivity,
                    "contribution": source.contribution,
                    "share": min(source.contribution**2 / variance, 1.0),
                }
            )
    return tables.BUDGETS.from_rows(rows)


def reading_table(
    scan: ScanHeader, read: dict[str, StationReading], bases_mm: Mapping[tuple[str, str], float]
) -> pa.Table:
    rows = []
    for (kind, side), base in bases_mm.items():
        rows.append(
            {
                "scan_id": scan.scan_id,
                "quantity": f"{kind}_radial_base",
                "side": side,
                "reading": base,
                "u_noise": 0.0,
                "n_frames": 0,
                "angular_coverage_ratio": 0.0,
                "excluded_ratio": 0.0,
                "reason": None,
                "quality_flags": [],
            }
        )
    for station in read.values():
        for r in station.readings:
            known = bool(np.isfinite(r.value)) and r.reason is None
            rows.append(
                {
                    "scan_id": scan.scan_id,
                    "quantity": r.quantity,
                    "side": r.side,
                    "reading": r.value if known else None,
                    "u_noise": r.u_noise if known else None,
                    "n_frames": r.n_frames,
                    "angular_coverage_ratio": min(r.coverage_ratio, 1.0),
                    "excluded_ratio": max(r.excluded_ratio, 0.0),
                    "reason": None if known else r.reason or "not supported",
                    "quality_flags": r.flags.names(),
                }
            )
    return tables.READINGS.from_rows(rows)


def turn_table(read: dict[str, StationReading], frames: Frames) -> pa.Table:
    parts = []
    for name, station in read.items():
        for turn in station.turns:
            seen = np.flatnonzero(np.isfinite(turn.value_mm))
            parts.append(
                tables.TURNS.from_columns(
                    {
                        "station": [name] * len(seen),
                        "series": pa.array([turn.series] * len(seen)).dictionary_encode(),
                        "frame": seen.astype(np.int32),
                        "angle_deg": frames.angle_deg[seen],
                        "value_mm": turn.value_mm[seen],
                        "used": turn.used[seen],
                        "fitted_mm": turn.fitted_mm[seen],
                    }
                )
            )
    return pa.concat_tables(parts).unify_dictionaries().combine_chunks() if parts else tables.TURNS.empty()


def order_table(scan: ScanHeader, rig: Rig, read: Mapping[str, StationReading]) -> pa.Table:
    """Rows of `roundness_orders`."""
    rows = []
    for side, found in _by_side(rig, read, "wheel"):
        turn = found.spectra.get("tread_radius")
        if turn is None:
            continue
        keep, amplitude, u = turn.keep(), turn.amplitude * 1e3, turn.u_amplitude * 1e3
        levels = level_db(amplitude)
        for k in range(turn.order):
            rows.append(
                {
                    "scan_id": scan.scan_id,
                    "side": side,
                    "harmonic": k + 1,
                    "wavelength_mm": 2 * np.pi * turn.mean / (k + 1),
                    "amplitude_um": amplitude[k],
                    "u_amplitude_um": u[k],
                    "phase_deg": float(np.degrees(np.arctan2(turn.sine[k], turn.cosine[k])) % 360.0) / (k + 1),
                    "level_db": levels[k] if np.isfinite(levels[k]) else None,
                    "significant": bool(keep[k]),
                }
            )
    return tables.ROUNDNESS_ORDERS.from_rows(rows) if rows else tables.ROUNDNESS_ORDERS.empty()


def flat_table(scan: ScanHeader, rig: Rig, read: Mapping[str, StationReading]) -> pa.Table:
    """Rows of `wheel_flats`."""
    rows = [
        {
            "scan_id": scan.scan_id,
            "side": side,
            "number": number,
            "position_deg": flat.body_deg,
            "length_mm": flat.length_mm,
            "u_length_mm": flat.u_length_mm,
            "depth_mm": flat.depth_mm,
            "u_depth_mm": flat.u_depth_mm,
            "n_frames": flat.n_frames,
        }
        for side, found in _by_side(rig, read, "wheel")
        for number, flat in enumerate(found.flats, 1)
    ]
    return tables.WHEEL_FLATS.from_rows(rows) if rows else tables.WHEEL_FLATS.empty()


def section_table(scan: ScanHeader, rig: Rig, read: Mapping[str, StationReading]) -> pa.Table:
    """Rows of `journal_sections`."""
    rows = [
        {"scan_id": scan.scan_id, "side": side} | vars(section)
        for side, found in _by_side(rig, read, "journal")
        for section in found.sections
    ]
    return tables.JOURNAL_SECTIONS.from_rows(rows) if rows else tables.JOURNAL_SECTIONS.empty()


def _by_side(rig: Rig, read: Mapping[str, StationReading], kind: str) -> list[tuple[str, StationReading]]:
    return [(s.side, read[s.station]) for s in rig.stations if s.kind == kind and s.station in read]


def profile_table(read: Mapping[str, StationReading]) -> pa.Table:
    """Rows of `wheel_profiles`, in the order of its key."""
    parts = []
    for station, found in sorted(read.items()):
        p = found.profile
        if p is None:
            continue
        order = np.lexsort((p.row, p.line, np.array(p.sensor_id)))
        deviation = p.deviation_mm if p.deviation_mm is not None else np.full(len(p.s_mm), np.nan)
        parts.append(
            tables.WHEEL_PROFILES.from_columns(
                {
                    "station": [station] * len(order),
                    "sensor_id": [p.sensor_id[i] for i in order],
                    "line": p.line[order],
                    "row": p.row[order],
                    "from_inner_face_mm": np.round(p.s_mm[order], 5),
                    "radius_mm": np.round(p.radius_mm[order], 5),
                    "height_mm": pa.array(np.round(p.height_mm[order], 5), from_pandas=True),
                    "u_um": np.round(p.u_mm[order] * 1e3, 3),
                    "deviation_um": pa.array(np.round(deviation[order] * 1e3, 2), from_pandas=True),
                }
            )
        )
    return pa.concat_tables(parts).combine_chunks() if parts else tables.WHEEL_PROFILES.empty()


def map_table(read: Mapping[str, StationReading]) -> pa.Table:
    """Rows of `tread_maps`, in the order of its key."""
    parts = []
    for station, found in sorted(read.items()):
        m = found.map
        if m is None or not len(m.s_mm):
            continue
        parts.append(
            tables.TREAD_MAPS.from_columns(
                {
                    "station": [station] * len(m.s_mm),
                    "angle_deg": m.body_deg.astype(np.float32),
                    "from_inner_face_mm": m.s_mm.astype(np.float32),
                    "deviation_um": np.round(m.deviation_mm * 1e3, 1).astype(np.float32),
                    "n_points": m.n_points,
                }
            )
        )
    return pa.concat_tables(parts).combine_chunks() if parts else tables.TREAD_MAPS.empty()
