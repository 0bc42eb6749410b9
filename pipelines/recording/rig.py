"""The rig: axle, stations, sensors with both cameras, and the datum faces that the alignment found."""

from __future__ import annotations

import numpy as np
import rerun as rr

from pipelines.recording.canvas import PALE, WHITE, Array, Canvas, ui
from wheelset_assets.metrology import rigid

AXLE_MARGIN_MM = 250.0
IMAGE_PLANE_MM = 70.0
RING_STEPS = 96


def draw(canvas: Canvas) -> None:
    """Everything of the rig that is on record."""
    canvas.static("rig", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    if not canvas.source.poses:
        return
    _axle(canvas)
    _sensors(canvas)
    _stations(canvas)
    for row in canvas.source.rows("alignments"):
        if row["face_lateral_mm"] is not None and row["face_radial_min_mm"] is not None:
            _face(canvas, row)


def half_length_mm(canvas: Canvas) -> float:
    """Half the length of the rig along the axle, for lines and cameras of the views."""
    places = [abs(float(pose[0, 3])) for pose in canvas.source.poses.values()]
    return max(places, default=1000.0)


def _axle(canvas: Canvas) -> None:
    end = half_length_mm(canvas) + AXLE_MARGIN_MM
    axis = rr.LineStrips3D([[[-end, 0, 0], [end, 0, 0]]], colors=[PALE], radii=ui(1.2))
    canvas.static("rig/axle", axis)
    arrows = rr.Arrows3D(
        origins=np.zeros((3, 3)),
        vectors=np.eye(3) * 120.0,
        colors=[(230, 70, 70), (80, 190, 90), (80, 120, 235)],
        labels=["X: left to right", "Y", "Z: up"],
        show_labels=False,
        radii=ui(2.0),
    )
    canvas.static("rig/origin", arrows)
    canvas.note("rig")


def _stations(canvas: Canvas) -> None:
    """Labels above the place that each station's sensors look at: where the profile was seen, or else between them."""
    rig = canvas.source.rig
    assert rig is not None
    profiles = canvas.source.table("fused_profiles")
    for station in rig.stations:
        poses = [canvas.source.poses[s.sensor_id] for s in rig.station_sensors(station.station)]
        if not poses:
            continue
        place = np.mean([p[:3, 3] for p in poses], axis=0) + np.array([0.0, 0.0, 110.0])
        if profiles is not None and profiles.num_rows:
            member = np.asarray(profiles["station"].to_pylist(), object) == station.station
            if member.any():
                place[0] = float(np.median(profiles["lateral_mm"].to_numpy()[member]))
        label = rr.Points3D([place], labels=[station.station], colors=[WHITE], radii=ui(0.1), show_labels=True)
        canvas.static(f"rig/stations/{station.station}", label)


def _sensors(canvas: Canvas) -> None:
    rig = canvas.source.rig
    assert rig is not None
    table = canvas.source.calibrations
    calibrated = {r["sensor_id"]: r for r in (table.to_pylist() if table is not None else []) if r["state"] == "usable"}
    for sensor in rig.sensors:
        path, colour = f"rig/sensors/{sensor.sensor_id}", canvas.colour(sensor.sensor_id)
        canvas.static(path, _transform(canvas.source.poses[sensor.sensor_id]))
        row = calibrated.get(sensor.sensor_id)
        if row is None:  # no lens is known: the axes of its nominal pose
            axes = rr.Arrows3D(
                origins=np.zeros((3, 3)),
                vectors=np.eye(3) * 60.0,
                colors=[(230, 70, 70), (80, 190, 90), (80, 120, 235)],
                radii=ui(1.5),
            )
            canvas.static(f"{path}/not_calibrated", axes)
            continue
        left_from_right = rigid.inverse(np.array(row["right_from_left"]).reshape(4, 4))
        canvas.static(f"{path}/right", _transform(left_from_right))
        for side in ("left", "right"):
            fx, fy, cx, cy = row[f"{side}_camera"]
            pinhole = rr.Pinhole(
                image_from_camera=[[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
                resolution=list(sensor.image_size),
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=IMAGE_PLANE_MM,
                color=colour,
                line_width=-1.2,
            )
            canvas.static(f"{path}/{side}", pinhole)


def _transform(parent_from_child: Array) -> rr.Transform3D:
    return rr.Transform3D(translation=parent_from_child[:3, 3], mat3x3=parent_from_child[:3, :3])


def _face(canvas: Canvas, row: dict) -> None:
    """Datum face as a ring about the axle, between the radii at which it was seen as flat."""
    turn = np.linspace(0.0, 2 * np.pi, RING_STEPS, endpoint=False)
    ring = np.column_stack([np.full(RING_STEPS, row["face_lateral_mm"]), np.cos(turn), np.sin(turn)])
    inner, outer = (ring * [1.0, radius, radius] for radius in (row["face_radial_min_mm"], row["face_radial_max_mm"]))
    i, j = np.arange(RING_STEPS), (np.arange(RING_STEPS) + 1) % RING_STEPS
    triangles = np.concatenate(
        [np.column_stack([i, j, i + RING_STEPS]), np.column_stack([j, j + RING_STEPS, i + RING_STEPS])]
    )
    mesh = rr.Mesh3D(
        vertex_positions=np.concatenate([inner, outer]), triangle_indices=triangles, albedo_factor=(255, 235, 120, 90)
    )
    canvas.static(f"rig/faces/{row['station']}", mesh)
    name = "inner face" if row["kind"] == "wheel" else "shoulder"
    edges = rr.LineStrips3D(
        [np.concatenate([edge, edge[:1]]) for edge in (inner, outer)],
        colors=[(255, 235, 120)],
        radii=ui(1.0),
        labels=[f"{name}, {row['side']}: X = {row['face_lateral_mm']:.3f} mm"],
        show_labels=False,
    )
    canvas.static(f"rig/faces/{row['station']}/edges", edges)
    canvas.note("faces", row["station"])
