"""Drift watch: whether a sensor still is what its calibration and its reference scan saw, before its numbers are used.

Cameras against each other by the stripes' epipolar residual, laser and cameras by the laser plane in the sensor's frame,
and the cameras' instants frame by frame by the distance from that plane.
All stand in `stripe_statistics`; they know nothing of the wheelset and do not change with the rig's temperature.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import pyarrow as pa

from wheelset_assets.bundle import Rig
from wheelset_assets.config import MeasurementConfig
from wheelset_assets.metrology.laser_plane import LaserPlane, plane_shift
from wheelset_assets.quality import Flag

FIELD_FACTOR = 3.0
"""Noise of a fitted plane at the corner of its field over that at its middle: two standard deviations along both axes."""


def drift_flags(rig: Rig, now: pa.Table, then: pa.Table | None, config: MeasurementConfig) -> dict[str, Flag]:
    """Flags by station, from stripe statistics of a scan and of its reference scan under the same calibration.

    Without a reference the scan is compared with its calibration alone, which knows of no laser plane.
    """
    stations = {sensor.sensor_id: sensor.station for sensor in rig.sensors}
    before = {(r["sensor_id"], r["line"]): r for r in then.to_pylist()} if then is not None else {}
    flags: dict[str, Flag] = defaultdict(lambda: Flag.NONE)
    for row in now.to_pylist():
        if row["sensor_id"] not in stations:
            continue
        old = before.get((row["sensor_id"], row["line"]))
        if _cameras_moved(row, old, config):
            flags[stations[row["sensor_id"]]] |= Flag.CAMERAS_MOVED
        if _out_of_step(row, config):
            flags[stations[row["sensor_id"]]] |= Flag.CAMERAS_OUT_OF_STEP
        if old is not None and _plane_moved(row, old, config):
            flags[stations[row["sensor_id"]]] |= Flag.LASER_PLANE_MOVED
    return dict(flags)


def _out_of_step(row: dict[str, Any], config: MeasurementConfig) -> bool:
    """Single frames that were left out, or all frames off by more than noise: its mean square varies by 2 / frames."""
    frames = max(row["n_frames"], 1)
    limit = max(config.max_frame_pull**2, 1.0 + config.moved_sigmas * float(np.sqrt(2.0 / frames)))
    return row["n_frames_out_of_step"] > config.max_out_of_step_ratio * frames or bool(
        row["frame_pull"] is not None
        and row["frame_pull"] ** 2 > limit
        and row["frame_scatter_um"] > config.frame_scatter_floor_um
    )


def _cameras_moved(row: dict[str, Any], old: dict[str, Any] | None, config: MeasurementConfig) -> bool:
    value, u = row["epipolar_residual_px"], row["u_epipolar_residual_px"]
    if value is None:
        return False
    if abs(value) > max(config.epipolar_calibration_px, config.moved_sigmas * u):
        return True
    if old is None or old["epipolar_residual_px"] is None:
        return False
    limit = max(config.epipolar_floor_px, config.moved_sigmas * float(np.hypot(u, old["u_epipolar_residual_px"])))
    return bool(abs(value - old["epipolar_residual_px"]) > limit)


def _plane_moved(row: dict[str, Any], old: dict[str, Any], config: MeasurementConfig) -> bool:
    now, then = plane_of(row), plane_of(old)
    if now is None or then is None:
        return False
    shift_mm, _ = plane_shift(now, then)
    limit = max(config.plane_floor_um, config.moved_sigmas * float(np.hypot(_plane_u_um(row), _plane_u_um(old))))
    return bool(1e3 * shift_mm > limit)


def _plane_u_um(row: dict[str, Any]) -> float:
    """Noise of a fitted plane at the corner of its field, neighbouring rows counted by their correlation."""
    independent = row["n_points"] / max(row["noise_correlation_rows"] or 1.0, 1.0)
    return FIELD_FACTOR * float(row["plane_rms_um"]) / float(np.sqrt(max(independent, 1.0)))


def plane_of(row: dict[str, Any]) -> LaserPlane | None:
    """Laser plane of a row of `stripe_statistics`, if one was found."""
    if row["plane_normal"] is None:
        return None
    return LaserPlane(
        np.array(row["plane_normal"]),
        row["plane_distance_mm"],
        np.array(row["plane_centre_mm"]),
        row["plane_rms_um"] * 1e-3,
        row["n_points"],
        (row["plane_extent_mm"][0], row["plane_extent_mm"][1]),
        np.array(row["plane_direction"]),
    )
