"""Perfect laser stripes: a plane cuts a turning, grown, shifted, out-of-round surface; two cameras see the cut.

Here: the exact curve u(v) at integer image rows, with occlusion and grazing limits. Not here: noise (`noise`), files.
How: the meridian's nodes are lifted onto the surface, intersected with the plane in closed form and projected. Every
edge between two nodes marks the rows that it crosses; the nearest crossing of a row wins; the surface is then evaluated
exactly there, and the remaining fraction of a row (< 1e-2 px) is carried along the curve's slope.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..metrology.rigid import inverse
from .optics import Camera
from .rig import LaserPlane, Sensor
from .wheelset import Harmonics, Surface

Array = NDArray[np.float64]
Index = NDArray[np.intp]

GRAZING_DEG = 81.0  # a surface seen or lit at a steeper incidence gives no stripe
CHUNK_NODES = 150_000
MARGIN = 0.12  # of the image's height: how far outside it nodes still count


@dataclass(frozen=True)
class Placement:
    """A wheelset in the rig: shift along X, displacement of its axis (y, z), growth factor from 20 degC."""

    shift_mm: float = 0.0
    axis_mm: tuple[float, float] = (0.0, 0.0)
    growth: float = 1.0


@dataclass(frozen=True)
class Stripes:
    """Columns (px) of one sensor's and line's stripe for each frame and image row, (frames, rows), NaN where unseen."""

    left_u: Array
    right_u: Array


@dataclass(frozen=True)
class _Cut:
    """The plane in rig coordinates, split for a surface of revolution: x n_x + q n_perp = d, with q the component of
    (y, z) along `e`; `f` points along the light towards the sensor, `azimuth_rad` is the angle of f about X."""

    n_x: float
    n_perp: float
    d_mm: float
    e: Array
    f: Array
    handed: float
    azimuth_rad: float


@dataclass(frozen=True)
class _View:
    """One camera: projection rows (3, 4) from rig coordinates, its centre, the emitter's place (mm, rig)."""

    camera: Camera
    rows: Array
    centre: Array
    emitter: Array


@dataclass(frozen=True)
class _Nodes:
    """The part of the meridian that is near the image: edges `first` .. `last` - 1, and run-out at the nodes (F, K)."""

    surface: Surface
    placement: Placement
    cut: _Cut
    first: int
    last: int
    radial_mm: Array = field(repr=False)
    axial_mm: Array = field(repr=False)


def trace(
    surface: Surface,
    placement: Placement,
    sensor: Sensor,
    rig_from_sensor: Array,
    plane: LaserPlane,
    rotation_rad: Array,
    hidden_parts: tuple[int, ...] = (),
) -> Stripes:
    """Stripes at body rotations (F,), in a sensor at its pose of the moment. `hidden_parts` give no light back."""
    cut = _cut(plane, rig_from_sensor, placement)
    views = _views(sensor, rig_from_sensor, plane)
    first, last = _near_image(surface, placement, cut, views)
    rows = sensor.image_size[1]
    out = np.full((2, rotation_rad.size, rows), np.nan)
    per_chunk = max(1, CHUNK_NODES // max(1, last - first + 1))
    for start in range(0, rotation_rad.size if last > first else 0, per_chunk):
        part = slice(start, min(start + per_chunk, rotation_rad.size))
        nodes = _nodes(surface, placement, cut, first, last, rotation_rad[part])
        points = _on_plane(nodes, *_lifted(nodes))
        for camera, view in enumerate(views):
            out[camera, part] = _columns(nodes, view, points, hidden_parts)
    return Stripes(out[0], out[1])


def _cut(plane: LaserPlane, rig_from_sensor: Array, placement: Placement) -> _Cut:
    n = rig_from_sensor[:3, :3] @ np.asarray(plane.normal)
    emitter = rig_from_sensor[:3, :3] @ np.asarray(plane.emitter_mm) + rig_from_sensor[:3, 3]
    n_perp = float(np.hypot(n[1], n[2]))
    e = n[1:] / n_perp
    f = np.array([-e[1], e[0]])
    handed = 1.0 if f @ emitter[1:] > 0 else -1.0
    f = handed * f
    d = plane.offset_mm + float(n @ rig_from_sensor[:3, 3]) - float(n[1:] @ np.asarray(placement.axis_mm))
    return _Cut(float(n[0]), n_perp, d, e, f, handed, float(np.arctan2(f[1], f[0])))


def _views(sensor: Sensor, rig_from_sensor: Array, plane: LaserPlane) -> tuple[_View, _View]:
    emitter = rig_from_sensor[:3, :3] @ np.asarray(plane.emitter_mm) + rig_from_sensor[:3, 3]
    left = inverse(rig_from_sensor)
    right = sensor.right_from_left @ left
    one, two = (
        _View(camera, camera_from_rig[:3], inverse(camera_from_rig)[:3, 3], emitter)
        for camera, camera_from_rig in ((sensor.left, left), (sensor.right, right))
    )
    return one, two


def _near_image(surface: Surface, placement: Placement, cut: _Cut, views: tuple[_View, _View]) -> tuple[int, int]:
    """First and last node that an unrotated, perfectly round surface shows within the image or its margin."""
    count = surface.meridian.nodes_mm.shape[1]
    zero = np.zeros((1, count))
    nodes = _Nodes(surface, placement, cut, 0, count - 1, zero, zero)
    points = _on_plane(nodes, *_lifted(nodes))
    inside = np.zeros(count, bool)
    for view in views:
        x, y, z = _in_camera(view, points)
        v = view.camera.fy_px * y / z + view.camera.cy_px
        u = view.camera.fx_px * x / z + view.camera.cx_px
        width, height = view.camera.image_size
        slack = MARGIN * height
        inside |= ((z > 0) & (abs(v - height / 2) < height / 2 + slack) & (abs(u - width / 2) < width / 2 + slack))[0]
    seen = np.flatnonzero(inside)
    return (0, 0) if seen.size < 2 else (int(seen[0]), int(seen[-1]))


def _nodes(surface: Surface, placement: Placement, cut: _Cut, first: int, last: int, rotation_rad: Array) -> _Nodes:
    """Run-out at the nodes (F, K): body angle = angle of the point about X - rotation."""
    lateral, radial = surface.meridian.nodes_mm[:, first : last + 1]
    x = surface.sign * (surface.base_mm + lateral)
    q = (cut.d_mm - cut.n_x * (placement.shift_mm + placement.growth * x)) / cut.n_perp
    angle = cut.azimuth_rad - cut.handed * np.arcsin(q / (placement.growth * (surface.radius_mm + radial)))
    dr, dx = (_runout(h, angle, rotation_rad) for h in (surface.radial, surface.axial))
    for patch in surface.patches:
        dr = dr + patch.at(angle - rotation_rad[:, None], np.broadcast_to(lateral, dr.shape))
    return _Nodes(surface, placement, cut, first, last, dr, dx)


def _runout(harmonics: Harmonics, angle_rad: Array, rotation_rad: Array) -> Array:
    """Harmonics at angle - rotation for all pairs, (F, K), by the addition theorem: one matrix product."""
    if not harmonics.orders:
        return np.zeros((rotation_rad.size, angle_rad.size))
    n = np.array(harmonics.orders, float)[:, None]
    a, p = np.array(harmonics.amplitudes_mm)[:, None], np.array(harmonics.phases_rad)[:, None]
    here, turned = n * angle_rad + p, (n * rotation_rad).T
    return np.cos(turned) @ (a * np.cos(here)) + np.sin(turned) @ (a * np.sin(here))


def _lifted(nodes: _Nodes) -> tuple[Array, Array]:
    """x (from the rig's origin) and distance from the axis of the nodes, grown and shifted: (F, K) each."""
    lateral, radial = nodes.surface.meridian.nodes_mm[:, nodes.first : nodes.last + 1]
    return _grown(nodes, lateral + nodes.axial_mm, radial + nodes.radial_mm)


def _grown(nodes: _Nodes, lateral_mm: Array, radial_mm: Array) -> tuple[Array, Array]:
    surface, place = nodes.surface, nodes.placement
    x = place.shift_mm + place.growth * surface.sign * (surface.base_mm + lateral_mm)
    return x, place.growth * (surface.radius_mm + radial_mm)


def _on_plane(nodes: _Nodes, x_mm: Array, rho_mm: Array) -> tuple[Array, Array, Array]:
    """The point of each circle (x, rho) on the laser plane's lit side, rig coordinates."""
    cut, (axis_y, axis_z) = nodes.cut, nodes.placement.axis_mm
    q = (cut.d_mm - cut.n_x * x_mm) / cut.n_perp
    along = np.sqrt(rho_mm * rho_mm - q * q)
    return x_mm, axis_y + q * cut.e[0] + along * cut.f[0], axis_z + q * cut.e[1] + along * cut.f[1]


def _in_camera(view: _View, points: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    x, y, z = points
    one, two, three = (r[0] * x + r[1] * y + r[2] * z + r[3] for r in view.rows)
    return one, two, three


def _columns(nodes: _Nodes, view: _View, points: tuple[Array, Array, Array], hidden_parts: tuple[int, ...]) -> Array:
    """u (F, rows) of one camera for a chunk of frames, NaN where nothing is seen."""
    width, height = view.camera.image_size
    x, y, depth = _in_camera(view, points)
    u, v = view.camera.pixels(x / depth, y / depth)
    frame, edge, row, fraction = _nearest(v, depth, height)
    out = np.full((depth.shape[0], height), np.nan)
    if frame.size == 0:
        return out
    lateral_radial, slope = nodes.surface.meridian.at(nodes.first + edge, fraction)
    dr, dx = (_between(a, frame, edge, fraction) for a in (nodes.radial_mm, nodes.axial_mm))
    exact = _on_plane(nodes, *_grown(nodes, lateral_radial[0] + dx, lateral_radial[1] + dr))
    x, y, z = _in_camera(view, exact)
    u_there, v_there = view.camera.pixels(x / z, y / z)
    rise = (u[frame, edge + 1] - u[frame, edge]) / (v[frame, edge + 1] - v[frame, edge])
    columns = u_there + rise * (row - v_there)
    seen = _faces(nodes, view, exact, slope) & (columns >= -0.5) & (columns <= width - 0.5)
    if hidden_parts:
        seen &= ~np.isin(nodes.surface.meridian.part[nodes.first + edge], hidden_parts)
    out[frame[seen], row[seen]] = columns[seen]
    return out


def _between(values: Array, frame: Index, edge: Index, fraction: Array) -> Array:
    low = values[frame, edge]
    return low + fraction * (values[frame, edge + 1] - low)


def _nearest(v: Array, depth: Array, height: int) -> tuple[Index, Index, Index, Array]:
    """For every (frame, row) that the curve crosses: the edge nearest to the camera and the fraction along it."""
    frames, count = v.shape
    ceiling = np.ceil(np.clip(v, -2.0, height + 1.0)).astype(np.int32)
    low = np.maximum(np.minimum(ceiling[:, 1:], ceiling[:, :-1]), 0)
    high = np.minimum(np.maximum(ceiling[:, 1:], ceiling[:, :-1]), height)
    crossed = np.maximum(high - low, 0).ravel()
    flat = np.repeat(np.arange(crossed.size), crossed)
    nth = np.arange(flat.size) - np.repeat(np.cumsum(crossed) - crossed, crossed)
    frame, edge = np.divmod(flat, count - 1)
    row = low.ravel()[flat] + nth
    v0 = v[frame, edge]
    fraction = (row - v0) / (v[frame, edge + 1] - v0)
    far = _between(depth, frame, edge, fraction)
    key = frame * height + row
    winner = np.full(frames * height, -1)
    winner[key] = np.arange(flat.size)
    while True:  # once for each branch of the curve that shares a row
        nearer = np.flatnonzero(far < far[winner[key]])
        if nearer.size == 0:
            break
        winner[key[nearer]] = nearer
    chosen = winner[winner >= 0]
    return frame[chosen], edge[chosen], row[chosen], fraction[chosen]


def _faces(nodes: _Nodes, view: _View, points: tuple[Array, Array, Array], slope: Array) -> NDArray[np.bool_]:
    """Whether points (n,) with meridian slopes (2, n) face both camera and laser at less than the grazing limit."""
    axis_y, axis_z = nodes.placement.axis_mm
    x, y, z = points
    rho = np.hypot(y - axis_y, z - axis_z)
    length = np.hypot(slope[0], slope[1])
    n_x, n_rho = -nodes.surface.sign * slope[1] / length, slope[0] / (length * rho)
    n_y, n_z = n_rho * (y - axis_y), n_rho * (z - axis_z)
    limit = np.cos(np.deg2rad(GRAZING_DEG))
    seen = np.ones(x.shape, bool)
    for eye in (view.centre, view.emitter):
        dx, dy, dz = eye[0] - x, eye[1] - y, eye[2] - z
        seen &= n_x * dx + n_y * dy + n_z * dz > limit * np.sqrt(dx * dx + dy * dy + dz * dz)
    return seen
