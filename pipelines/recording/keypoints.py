"""Keypoints of each station's sensors in the meridian, before registration, and which pairs it brings together.

Matches are not stored, only their number; the lines here follow from the stored pose, not from the descriptors.
"""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from pipelines.recording.canvas import GREY, WHITE, Array, Canvas, Frame, ui
from wheelset_assets.config import Config
from wheelset_assets.metrology import rigid

TOGETHER_MM = Config().registration.coarse_inlier_mm
MARGIN_MM = 8.0


def draw(canvas: Canvas) -> None:
    """Keypoints by station and sensor, and pairs by registration."""
    table = canvas.source.table("features")
    if table is None or not table.num_rows or canvas.source.rig is None:
        return
    places = np.column_stack([table[f"{axis}_mm"].to_numpy() for axis in "xyz"])
    names = np.asarray(table["sensor_id"].to_pylist(), object)
    for station in canvas.source.rig.stations:
        sensors = [s.sensor_id for s in canvas.source.rig.station_sensors(station.station)]
        member = np.isin(names, sensors)
        if not member.any():
            continue
        path = f"keypoints/{station.station}"
        for name in sensors:
            points = rr.Points2D(
                _drawn(places[names == name]), colors=[canvas.colour(name)], radii=ui(3.0), draw_order=20.0
            )
            canvas.static(f"{path}/sensors/{name}", points)
        _profile(canvas, path, station.station)
        low, high = _drawn(places[member]).min(axis=0) - MARGIN_MM, _drawn(places[member]).max(axis=0) + MARGIN_MM
        canvas.frames[path] = Frame(
            f"{station.station}: rig X to the right, radius upwards", (low[0], high[0]), (low[1], high[1])
        )
        canvas.note("keypoints", station.station)
    _matches(canvas, places, names)


def _drawn(places: Array) -> Array:
    """Places (n, 3) in the rig frame as (lateral, radius downwards), which is how a 2-D view counts."""
    return np.column_stack([places[:, 0], -np.hypot(places[:, 1], places[:, 2])])


def _profile(canvas: Canvas, path: str, station: str) -> None:
    """The fused profile in grey: in the first sensor's pose, so that the others' keypoints lie off it by their correction."""
    table = canvas.source.table("fused_profiles")
    if table is None:
        return
    own = np.asarray(table["station"].to_pylist(), object) == station
    points = np.column_stack([table["lateral_mm"].to_numpy()[own], -table["radial_mm"].to_numpy()[own]])
    canvas.static(f"{path}/profile", rr.Points2D(points, colors=[GREY], radii=ui(0.8)))


def _matches(canvas: Canvas, places: Array, names: NDArray) -> None:
    lines = [
        "| station | source → target | keypoints | matches that agree (stored) | pairs drawn |",
        "|---|---|---:|---:|---:|",
    ]
    for row in canvas.source.rows("registrations"):
        source, target = row["source_sensor_id"], row["target_sensor_id"]
        if source == target:
            continue
        a, b = places[names == source], places[names == target]
        pairs = _pairs(canvas, row, a, b)
        lines.append(
            f"| {row['station']} | {source} → {target} | {len(a)}, {len(b)} | {row['n_matches']} | {len(pairs)} |"
        )
        if len(pairs):
            strips = list(np.stack([_drawn(a)[pairs[:, 0]], _drawn(b)[pairs[:, 1]]], axis=1))
            thing = rr.LineStrips2D(strips, colors=[WHITE], radii=ui(1.0), draw_order=30.0)
            canvas.static(f"keypoints/{row['station']}/matches/{source}", thing)
    if len(lines) > 2:
        text = (
            f"Lines join keypoints, drawn before registration, that lie within {TOGETHER_MM:g} mm of each other in the meridian "
            "once the stored registration has moved them: their length is the correction. Grey: the fused profile."
        )
        canvas.document("keypoints", "\n".join([*lines, "", text]))


def _pairs(canvas: Canvas, row: dict, source: Array, target: Array) -> NDArray[np.int64]:
    """Indices (n, 2) of keypoints that are each other's nearest after registration, and near enough."""
    poses = canvas.source.poses_before
    if not len(source) or not len(target) or not {row["source_sensor_id"], row["target_sensor_id"]} <= set(poses):
        return np.zeros((0, 2), np.int64)
    rotation = rigid.rotation_from_quaternion([row[k] for k in ("qw", "qx", "qy", "qz")])
    target_from_source = rigid.transform(rotation, [row[k] for k in ("tx_mm", "ty_mm", "tz_mm")])
    motion = poses[row["target_sensor_id"]] @ target_from_source @ rigid.inverse(poses[row["source_sensor_id"]])
    a, b = _drawn(rigid.apply(motion, source)), _drawn(target)
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    i = np.arange(len(a))
    j = distance.argmin(axis=1)
    mutual = (distance.argmin(axis=0)[j] == i) & (distance[i, j] <= TOGETHER_MM)
    return np.column_stack([i[mutual], j[mutual]])
