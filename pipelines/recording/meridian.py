"""Mean meridians in 2-D: each station's profile against the nominal one, and below it the departures, enlarged.

Wheels are drawn in the nominal profile's coordinates: lateral 0 on the datum circle, 70 mm from the inner face; height 0
on the tread there. Screens count downwards, so heights have the other sign in the viewer's read-out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import rerun as rr

from configs import nominal_profile, profile_names
from pipelines.recording.canvas import GREY, PALE, Array, Canvas, Frame, ui

DATUM_MM = 70.0
MARGIN_MM = 6.0
FACE_MM = 60.0
"""The nominal profile goes on for this much down the rim's faces, for distances."""
GAP_MM = 3.0
"""Rows farther apart than this on the profile are not joined."""
STRIP_MM = 12.0
"""Half height of an enlarged strip, in the drawing's mm."""
PERCENTILE = 99.0


@dataclass(frozen=True)
class Curve:
    """One sensor and line of a station, squared, in drawing coordinates: lateral and height in mm."""

    sensor_id: str
    line: int
    lateral_mm: Array
    height_mm: Array
    residual_um: Array


def draw(canvas: Canvas) -> None:
    """Every station that has a fused profile."""
    table = canvas.source.table("fused_profiles")
    if table is None or not table.num_rows:
        return
    alignments = {row["station"]: row for row in canvas.source.rows("alignments")}
    station = np.asarray(table["station"].to_pylist(), object)
    for name in dict.fromkeys(station):
        _station(canvas, name, table.filter(pa.array(station == name)), alignments.get(name))
        canvas.note("meridian", name)


def _station(canvas: Canvas, name: str, rows: pa.Table, alignment: dict | None) -> None:
    curves, title, on_datum = _curves(rows, alignment)
    path = f"meridian/{name}"
    for curve in curves:
        points = np.column_stack([curve.lateral_mm, -curve.height_mm])
        strips = rr.LineStrips2D(
            _joined(points), colors=[canvas.colour(curve.sensor_id)], radii=ui(1.8), draw_order=20.0
        )
        canvas.static(f"{path}/measured/{curve.sensor_id}/line{curve.line}", strips)
    low = max(float((-c.height_mm).max()) for c in curves)
    left, right = min(float(c.lateral_mm.min()) for c in curves), max(float(c.lateral_mm.max()) for c in curves)
    profile = canvas.source.header.wheelset.profile if canvas.source.header else None
    floor = low + 10.0
    if on_datum and profile in profile_names():
        s, z = nominal_profile(profile)
        canvas.static(
            f"{path}/nominal",
            rr.LineStrips2D([np.column_stack([s, -z])], colors=[PALE], radii=ui(1.0), draw_order=10.0),
        )
        _crosshair(canvas, path)
        left, right, floor = min(left, s[0]), max(right, s[-1]), max(floor, float(-z.min()) + 10.0)
        whole = np.column_stack([[s[0], *s, s[-1]], [z[0] - FACE_MM, *z, z[-1] - FACE_MM]])
        shown = [
            (c, c.lateral_mm, signed_distance(np.column_stack([c.lateral_mm, c.height_mm]), whole)) for c in curves
        ]
        floor = _strip(canvas, f"{path}/departure", "distance from nominal, outward", "mm", shown, (left, right), floor)
        title += f"; thin line: nominal {profile}"
    elif on_datum:
        _crosshair(canvas, path)
        title += f"; no nominal profile {profile} at hand" if profile else "; the scan names no profile"
    if any(np.isfinite(c.residual_um).any() for c in curves):
        floor = _strip(
            canvas,
            f"{path}/residual",
            "distance from the other sensors",
            "µm",
            [(c, c.lateral_mm, c.residual_um) for c in curves],
            (left, right),
            floor,
        )
    top = min(float((-c.height_mm).min()) for c in curves)
    canvas.frames[path] = Frame(title, (left - MARGIN_MM, right + 3 * MARGIN_MM), (top - MARGIN_MM, floor + MARGIN_MM))


def _curves(rows: pa.Table, alignment: dict | None) -> tuple[list[Curve], str, bool]:
    """Curves of a station, what their coordinates are, and whether they are laid on the datum of a nominal profile."""
    lateral, radial = rows["lateral_mm"].to_numpy(), rows["radial_mm"].to_numpy()
    kind, side = (
        (alignment["kind"], alignment["side"]) if alignment else ("station", "right" if lateral.mean() > 0 else "left")
    )
    if alignment and alignment["squaring_deg"] is not None:
        angle, pivot = (
            np.radians(alignment["squaring_deg"]),
            (alignment["pivot_lateral_mm"], alignment["pivot_radial_mm"]),
        )
        a, r = lateral - pivot[0], radial - pivot[1]
        lateral, radial = (
            pivot[0] + np.cos(angle) * a - np.sin(angle) * r,
            pivot[1] + np.sin(angle) * a + np.cos(angle) * r,
        )
    outward = 1.0 if side == "right" else -1.0
    face = alignment["face_lateral_mm"] if alignment else None
    on_datum = False
    if face is None:
        across, origin = outward * lateral, float(np.mean(outward * lateral))
        title = f"lateral 0 = {origin:.1f} mm outward, for want of a datum face"
    else:
        across, origin = outward * (lateral - face), DATUM_MM if kind == "wheel" else 0.0
        title = "lateral 0 = datum circle" if kind == "wheel" else "lateral 0 = shoulder"
    across = across - origin
    base = float(np.median(radial))
    if kind == "wheel" and face is not None and (near := np.abs(across) < 2.0).any():
        base, on_datum = float(np.median(radial[near])), True
    title = f"{side} {kind}: height 0 = radius {base:.3f} mm, {title}"
    sensor, line = np.asarray(rows["sensor_id"].to_pylist(), object), rows["line"].to_numpy()
    order, residual = rows["row"].to_numpy(), rows["residual_um"].to_numpy(zero_copy_only=False)
    curves = []
    for key in dict.fromkeys(zip(sensor, line.tolist(), strict=True)):
        member = np.flatnonzero((sensor == key[0]) & (line == key[1]))
        member = member[np.argsort(order[member])]
        curves.append(Curve(key[0], key[1], across[member], radial[member] - base, residual[member].astype(float)))
    return curves, title, on_datum


def _joined(points: Array) -> list[Array]:
    """Points (n, 2) cut where neighbours are far apart; single points become short strokes."""
    cuts = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) > GAP_MM) + 1
    return [
        piece if len(piece) > 1 else np.array([piece[0], piece[0] + [0.2, 0.0]])
        for piece in np.split(points, cuts)
        if len(piece)
    ]


def _crosshair(canvas: Canvas, path: str) -> None:
    lines = [[[-DATUM_MM, -32.0], [-DATUM_MM, 8.0]], [[0.0, -10.0], [0.0, 8.0]]]
    labels = ["inner face", "datum circle"]
    canvas.static(
        f"{path}/datum",
        rr.LineStrips2D(lines, labels=labels, colors=[GREY], radii=ui(0.6), draw_order=5.0, show_labels=False),
    )


def _strip(
    canvas: Canvas,
    path: str,
    name: str,
    unit: str,
    shown: list[tuple[Curve, Array, Array]],
    span: tuple[float, float],
    top: float,
) -> float:
    """An enlarged plot below the profile, with its scale written beside it; returns where the next one may begin."""
    values = np.concatenate([v for _, _, v in shown])
    known = np.abs(values[np.isfinite(values)])
    if not len(known):
        return top
    limit = max(_rounded_up(float(np.percentile(known, PERCENTILE))), 1e-3)
    middle = top + STRIP_MM
    grid = [[[span[0], middle + k * STRIP_MM], [span[1], middle + k * STRIP_MM]] for k in (-1, 0, 1)]
    canvas.static(
        f"{path}/grid", rr.LineStrips2D(grid, colors=[(75, 80, 90), GREY, (75, 80, 90)], radii=ui(0.6), draw_order=5.0)
    )
    places = [[span[1] + 10.0, middle + k * STRIP_MM] for k in (-1, 1)] + [
        [0.5 * (span[0] + span[1]), middle - STRIP_MM - 8.0]
    ]
    labels = [f"+{limit:g} {unit}", f"−{limit:g} {unit}", name]
    canvas.static(f"{path}/scale", rr.Points2D(places, labels=labels, colors=[PALE], radii=ui(0.1), show_labels=True))
    for curve, lateral, value in shown:
        good = np.isfinite(value)
        if good.any():
            y = middle - np.clip(value[good] / limit, -1.15, 1.15) * STRIP_MM
            thing = rr.Points2D(
                np.column_stack([lateral[good], y]),
                colors=[canvas.colour(curve.sensor_id)],
                radii=ui(1.2),
                draw_order=20.0,
            )
            canvas.static(f"{path}/values/{curve.sensor_id}/line{curve.line}", thing)
    return middle + STRIP_MM + 10.0


def signed_distance(points: Array, line: Array) -> Array:
    """Distance (n,) of points (n, 2) from a polyline (m, 2), positive on its left side, seen along it."""
    start, step = line[:-1], np.diff(line, axis=0)
    length = np.maximum((step**2).sum(axis=1), 1e-12)
    offset = points[:, None] - start
    along = np.clip((offset * step).sum(axis=2) / length, 0.0, 1.0)
    rest = offset - along[:, :, None] * step
    distance = np.hypot(rest[..., 0], rest[..., 1])
    nearest = distance.argmin(axis=1)
    index = np.arange(len(points))
    side = step[nearest, 0] * offset[index, nearest, 1] - step[nearest, 1] * offset[index, nearest, 0]
    return np.where(side < 0, -1.0, 1.0) * distance[index, nearest]


def _rounded_up(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten."""
    if value <= 0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(m * power for m in (1, 2, 5, 10) if m * power >= value * (1 - 1e-9)))
