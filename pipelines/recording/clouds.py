"""Clouds: triangulated, removed by reason, fused by sensor and by residual; in the wheelset's frame, and frame by frame.

A cloud is thinned evenly to the recording's limit before it is moved.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from pipelines.recording.canvas import GREY, REASON_COLOURS, WHITE, Array, Canvas, sensor_codes, ui
from wheelset_assets.metrology import rigid

RESIDUAL_PERCENTILE = 98.0
RESIDUAL_FLOOR_UM = 5.0
KEPT, REMOVED = 1, 2
"""Class ids of the removal maps: nothing 0, kept 1, then one for each reason."""


def draw(canvas: Canvas) -> None:
    """Every cloud that is stored."""
    _turn(canvas)
    triangulated = canvas.source.table("triangulated_clouds")
    if triangulated is not None and triangulated.num_rows and canvas.source.poses:
        _triangulated(canvas, triangulated)
    removed = canvas.source.table("removed_points")
    if triangulated is not None and removed is not None and canvas.source.poses:
        _removed(canvas, triangulated, removed)
    filtered = canvas.source.table("filtered_clouds")
    if filtered is not None and filtered.num_rows and canvas.source.table("registrations") is not None:
        _fused(canvas, filtered)


def _turn(canvas: Canvas) -> None:
    """The wheelset's frame turns about the axle with the frames."""
    angle = canvas.source.angle_deg
    if angle is None:
        return
    half = np.radians(angle) / 2
    quaternion = np.column_stack([np.sin(half), np.zeros((len(half), 2)), np.cos(half)])
    canvas.rec.send_columns(
        "rig/wheelset",
        indexes=canvas.times(np.arange(len(angle))),
        columns=rr.Transform3D.columns(quaternion=quaternion),
    )


def _placed(canvas: Canvas, cloud: pa.Table, index: NDArray) -> tuple[Array, NDArray, NDArray, list[str]]:
    """Some points of a cloud in the rig frame, with their frames and sensors; those without a pose are left out."""
    codes, names = sensor_codes(cloud)
    codes = codes[index]
    xyz = np.column_stack([cloud[f"{axis}_mm"].to_numpy()[index] for axis in "xyz"]).astype(float)
    points = np.full(xyz.shape, np.nan)
    for code, name in enumerate(names):
        if name in canvas.source.poses:
            member = codes == code
            points[member] = rigid.apply(canvas.source.poses[name], xyz[member])
    good = np.isfinite(points[:, 0])
    return points[good], cloud["frame"].to_numpy()[index][good], codes[good], names


def _triangulated(canvas: Canvas, cloud: pa.Table) -> None:
    points, frame, codes, names = _placed(canvas, cloud, canvas.thin(cloud.num_rows))
    on_wheelset = canvas.unturned(points, frame)
    for code, name in enumerate(names):
        member = np.flatnonzero(codes == code)
        if not len(member):
            continue
        canvas.static(
            f"rig/wheelset/triangulated/{name}",
            rr.Points3D(on_wheelset[member].astype(np.float32), colors=[GREY], radii=ui(0.8)),
        )
        member = member[np.argsort(frame[member], kind="stable")]
        present, count = np.unique(frame[member], return_counts=True)
        path = f"rig/stripe/{name}"
        columns = rr.Points3D.columns(positions=points[member].astype(np.float32))
        canvas.rec.send_columns(path, indexes=canvas.times(present), columns=columns.partition(count))
        canvas.static(path, rr.Points3D.from_fields(colors=[WHITE], radii=ui(2.0)))
        canvas.note("triangulated", name)


def _keys(table: pa.Table, names: list[str]) -> NDArray[np.int64]:
    """One number for each (sensor, line, frame, row), with sensors numbered as in `names`."""
    codes, own = sensor_codes(table)
    renumbered = np.array([names.index(name) if name in names else len(names) for name in own] or [0], np.int64)[codes]
    line, frame, row = (table[name].to_numpy().astype(np.int64) for name in ("line", "frame", "row"))
    return ((renumbered * 2 + line) << 48) | (frame << 16) | row


def _removed(canvas: Canvas, cloud: pa.Table, removed: pa.Table) -> None:
    """Removed points by reason, found in the triangulated cloud; and a map of each sensor's frames and rows."""
    names = sensor_codes(cloud)[1]
    keys, wanted = _keys(cloud, names), _keys(removed, names)
    order = np.argsort(keys, kind="stable")
    at = order[np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)]
    there = keys[at] == wanted
    encoded = removed["reason"].combine_chunks()
    reason, reasons = encoded.indices.to_numpy(zero_copy_only=False)[there], encoded.dictionary.to_pylist()
    at = at[there]
    for code, name in enumerate(reasons):
        member = at[reason == code]
        if len(member):
            points, frame, _, _ = _placed(canvas, cloud, member[canvas.thin(len(member))])
            canvas.static(
                f"rig/wheelset/removed/{name}",
                rr.Points3D(
                    canvas.unturned(points, frame).astype(np.float32),
                    colors=[REASON_COLOURS.get(name, GREY)],
                    radii=ui(1.6),
                ),
            )
    canvas.note("removed")
    kinds = np.full(len(keys), KEPT, np.uint8)
    kinds[at] = REMOVED + reason
    _maps(canvas, cloud, kinds, reasons)
    _removal_legend(canvas, cloud, kinds, reasons)


def _maps(canvas: Canvas, cloud: pa.Table, kinds: NDArray[np.uint8], reasons: list[str]) -> None:
    """Frame by image row, what became of every point: an image a sensor and laser line."""
    classes = [(0, "no point", (18, 20, 24)), (KEPT, "kept", (70, 76, 88))]
    classes += [(REMOVED + i, name, REASON_COLOURS.get(name, GREY)) for i, name in enumerate(reasons)]
    canvas.static("removed", rr.AnnotationContext(classes))
    codes, names = sensor_codes(cloud)
    line, frame, row = (cloud[name].to_numpy() for name in ("line", "frame", "row"))
    height = int(frame.max()) + 1
    for code, name in enumerate(names):
        for number in np.unique(line[codes == code]):
            member = (codes == code) & (line == number)
            image = np.zeros((height, int(row[member].max()) + 1), np.uint8)
            image[frame[member], row[member]] = kinds[member]
            path = f"removed/{name}/line{number}"
            canvas.static(path, rr.SegmentationImage(image))
            canvas.note("removal maps", path)


def _removal_legend(canvas: Canvas, cloud: pa.Table, kinds: NDArray[np.uint8], reasons: list[str]) -> None:
    codes, names = sensor_codes(cloud)
    colours = {"range": "red", "outlier": "yellow", "isolated": "light blue"}
    lines = ["| sensor | points | " + " | ".join(f"{r} ({colours.get(r, 'grey')})" for r in reasons) + " | removed |"]
    lines.append("|---|---:|" + "---:|" * (len(reasons) + 1))
    for code, name in enumerate(names):
        count = Counter(kinds[codes == code].tolist())
        total = sum(count.values())
        gone = total - count[KEPT]
        if total:
            parts = " | ".join(f"{count[REMOVED + i]:,}" for i in range(len(reasons)))
            lines.append(f"| {name} | {total:,} | {parts} | {100 * gone / total:.2f} % |")
    text = (
        "\n".join(lines)
        + "\n\nMaps: image rows to the right, frames downwards. Dark: no point; grey: kept. In the 3-D view, triangulated points are grey."
    )
    canvas.document("removed", text)


def _fused(canvas: Canvas, cloud: pa.Table) -> None:
    """Filtered points after registration and squaring, by sensor; and by their meridian row's residual."""
    index = canvas.thin(cloud.num_rows)
    points, frame, codes, names = _placed(canvas, cloud, index)
    on_wheelset = canvas.unturned(points, frame).astype(np.float32)
    for code, name in enumerate(names):
        member = codes == code
        if member.any():
            thing = rr.Points3D(on_wheelset[member], colors=[canvas.colour(name)], radii=ui(1.2))
            canvas.static(f"rig/wheelset/fused/{name}", thing)
            canvas.note("fused", name)
    profiles = canvas.source.table("fused_profiles")
    if profiles is None or not profiles.num_rows or len(points) != len(index):
        return
    residual = _residuals(cloud, index, names, profiles)
    known = np.isfinite(residual)
    if not known.any():
        return
    limit = max(RESIDUAL_FLOOR_UM, float(np.percentile(np.abs(residual[known]), RESIDUAL_PERCENTILE)))
    colours = diverging(residual / limit)
    for code, name in enumerate(names):
        member = codes == code
        if member.any():
            canvas.static(
                f"rig/wheelset/residual/{name}", rr.Points3D(on_wheelset[member], colors=colours[member], radii=ui(1.8))
            )
    canvas.note("residual")
    canvas.document("residual", _residual_legend(residual[known], limit))


def _residual_legend(residual_um: Array, limit_um: float) -> str:
    low, middle, high = np.percentile(residual_um, [5, 50, 95])
    return (
        "Distance of each meridian row from the fused profile of the station's other sensors: "
        f"blue −{limit_um:.1f} µm, white 0, red +{limit_um:.1f} µm; grey where no other sensor saw it. "
        f"Of the points shown, 5 %, 50 % and 95 % lie below {low:.1f}, {middle:.1f} and {high:.1f} µm."
    )


def _residuals(cloud: pa.Table, index: NDArray, names: list[str], profiles: pa.Table) -> Array:
    """Residual of the fused profile at each point's (sensor, line, row), in um; NaN where there is none."""
    codes, own = sensor_codes(profiles)
    sensor = np.array([names.index(name) if name in names else len(names) for name in own])[codes]
    last_row = max(int(profiles["row"].to_numpy().max()), int(cloud["row"].to_numpy().max()))
    grid = np.full((len(names) + 1, 2, last_row + 1), np.nan)
    grid[sensor, profiles["line"].to_numpy(), profiles["row"].to_numpy()] = profiles["residual_um"].to_numpy(
        zero_copy_only=False
    )
    return grid[sensor_codes(cloud)[0][index], cloud["line"].to_numpy()[index], cloud["row"].to_numpy()[index]]


def diverging(share: Array) -> NDArray[np.uint8]:
    """Colours (n, 3) from blue at -1 through white at 0 to red at +1; grey where NaN."""
    share = np.asarray(share, float)
    t = np.clip(np.nan_to_num(share), -1, 1)[:, None]
    white, red, blue = np.array([245.0, 245, 245]), np.array([225.0, 50, 45]), np.array([50.0, 110, 230])
    mixed = np.where(t > 0, white + (red - white) * t, white + (blue - white) * -t)
    mixed[~np.isfinite(share)] = GREY
    return mixed.astype(np.uint8)
