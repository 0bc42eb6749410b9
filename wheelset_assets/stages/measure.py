"""Stage 7, between tables and arrays: measurements against the master wheelset."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow as pa

from wheelset_assets.bundle import Rig, ScanHeader
from wheelset_assets.config import MeasurementConfig
from wheelset_assets.metrology.reading import Nominal, StationReading
from wheelset_assets.quality import Flag
from wheelset_assets.stages.comparison import Comparison, Results, no_values
from wheelset_assets.stages.drift import drift_flags
from wheelset_assets.stages.geometry import read_stations, scan_geometry, shifted, zero_readings
from wheelset_assets.stages.measured import (
    budget_table,
    flat_table,
    map_table,
    measurement_table,
    order_table,
    profile_table,
    reading_table,
    section_table,
    turn_table,
)
from wheelset_assets.stages.raw import Frames, Reference
from wheelset_assets.stages.watch import scan_flags, station_flags


def run_measurements(
    *,
    filtered_clouds: pa.Table,
    stripe_statistics: pa.Table,
    registrations: pa.Table,
    alignments: pa.Table,
    calibrations: pa.Table,
    rig: Rig,
    scan: ScanHeader,
    frames: Frames,
    reference: Reference,
    nominal: Nominal | str,
    reference_stripe_statistics: pa.Table | None,
    reference_registrations: pa.Table | None,
    reference_alignments: pa.Table | None,
    reference_readings: pa.Table | None,
    config: MeasurementConfig,
) -> Mapping[str, pa.Table]:
    """Stage 7: every quantity of the scan, zeroed by its reference, at 20 °C, with its budget.

    The geometry of the sensors (registration, squareness, K) is the one that the reference scan set: the sensors have
    not moved since, so its error is common to both scans and cancels. The scan's own registration and squareness are
    compared with it, and a difference beyond their uncertainty is flagged. A reference scan's readings, from which
    others are zeroed, are taken in its own geometry.
    """
    own = scan_geometry(rig, scan, stripe_statistics, registrations, alignments)
    own_readings: dict[str, StationReading] | None = None
    bases: dict[tuple[str, str], float] = {}
    if scan.purpose == "reference":
        own_readings, bases = zero_readings(filtered_clouds, rig, scan, frames, own, config)
    if (
        reference.scan is None
        or reference_stripe_statistics is None
        or reference_registrations is None
        or reference_alignments is None
        or reference_readings is None
    ):
        compared, values = own_readings or {}, no_values(rig, reference.reason or "no earlier reference")
    else:
        zero = scan_geometry(
            rig, reference.scan, reference_stripe_statistics, reference_registrations, reference_alignments
        )
        stored = {
            (r["quantity"].split("_")[0], r["side"]): r["reading"]
            for r in reference_readings.to_pylist()
            if r["quantity"].endswith("_radial_base")
        }
        zero = shifted(zero, rig, reference.scan.temperature_c.rig, stored)
        compared = read_stations(filtered_clouds, rig, scan, frames, zero, config, nominal, calibrations)
        moved = station_flags(
            rig,
            scan,
            reference.scan,
            registrations,
            reference_registrations,
            alignments,
            reference_alignments,
            calibrations,
            config,
        )
        for station, drift in drift_flags(rig, stripe_statistics, reference_stripe_statistics, config).items():
            moved[station] = moved.get(station, Flag.NONE) | drift
        job = Comparison(rig, scan, reference.scan, zero, compared, reference_readings, calibrations, moved, config)
        values = job.values()
    values = _with_causes(values, rig, calibrations)
    kept = own_readings or compared
    flags = scan_flags(scan, reference, calibrations, config)
    return {
        "measurements": measurement_table(scan, reference, values, flags, config),
        "readings": reading_table(scan, kept, bases),
        "budgets": budget_table(scan, values),
        "turns": turn_table(kept, frames),
        "roundness_orders": order_table(scan, rig, kept),
        "wheel_flats": flat_table(scan, rig, kept),
        "journal_sections": section_table(scan, rig, kept),
        "wheel_profiles": profile_table(kept),
        "tread_maps": map_table(kept),
    }


def _with_causes(values: Results, rig: Rig, calibrations: pa.Table) -> Results:
    """Reasons of stations without points, with what is known of their sensors' calibrations."""
    refused = {r["sensor_id"]: r["reason"] for r in calibrations.to_pylist() if r["state"] == "refused"}
    causes = {
        s.station: "; ".join(
            f"{n.sensor_id}: calibration refused, {refused[n.sensor_id]}"
            for n in rig.station_sensors(s.station)
            if n.sensor_id in refused
        )
        for s in rig.stations
    }
    told: Results = {}
    for key, (value, reason, flags) in values.items():
        hit = next((c for name, c in causes.items() if reason and c and f"station {name} delivered" in reason), None)
        told[key] = (value, f"{reason} ({hit})" if hit else reason, flags)
    return told
