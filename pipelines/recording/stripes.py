"""Raw stripes, read from the bundle if it is still there unchanged: curves u(v) by sensor, camera and frame; or images.

What cannot be shown is said in the document `stripes`.
"""

from __future__ import annotations

from pathlib import PurePosixPath

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from pipelines.recording.canvas import PALE, Canvas, ui
from warehouse.inbox import ScanReader, read_frames
from wheelset_assets.quality import ScanUnusable
from wheelset_assets.stages.raw import StripeTable

POINTS_RATIO = 4
"""Stripes may hold this many times the points of a cloud: there are two cameras, and most rows are worth a look."""
MAX_JUMP_PX = 4.0
"""A larger step between neighbouring rows breaks the curve."""
IMAGES_A_CAMERA = 8
TROUBLES = 12
LINE_SHADES = (1.0, 0.6)
EDGE = (70, 76, 88)
STROKE = np.array([[0, -2], [0, 2]], np.float32)


def draw(canvas: Canvas) -> None:
    """Stripes of every sensor that can be read, and the document that says what could not."""
    if reason := _unavailable(canvas):
        canvas.document("stripes", f"Raw stripes are not available: {reason}")
        return
    source = canvas.source
    assert source.bundle_folder is not None
    assert source.rig is not None
    intact = {name: source.unchanged(name) for name in source.bundle_files}
    usable = [name for name, good in intact.items() if good]
    troubles = [f"{name} is missing or is not the file that was processed" for name, good in intact.items() if not good]
    lines = ["| sensor | camera | line | frames | centres |", "|---|---|---:|---:|---:|"]
    try:
        reader = ScanReader(source.bundle_folder, usable, source.rig, len(read_frames(source.bundle_folder).angle_deg))
        stripes = reader.stripes()
    except ScanUnusable as error:
        canvas.document("stripes", f"Raw stripes are not available: {error}")
        return
    for sensor_id in stripes.sensor_ids:
        try:
            loaded = stripes.load(sensor_id)
        except ScanUnusable as error:
            troubles.append(str(error))
            continue
        canvas.note("stripes", sensor_id)
        _labels(canvas, sensor_id)
        if isinstance(loaded, list):
            lines += _curves(canvas, sensor_id, loaded, len(stripes.sensor_ids))
        else:
            lines += _images(canvas, sensor_id, usable)
    canvas.document("stripes", _document(troubles, lines))


def _document(troubles: list[str], lines: list[str]) -> str:
    said = [f"- {trouble}" for trouble in troubles[:TROUBLES]]
    if len(troubles) > TROUBLES:
        said.append(f"- and {len(troubles) - TROUBLES} more")
    if len(lines) == 2:
        return "\n".join(["Raw stripes are not available: no stripe file could be read.", "", *said])
    text = "Frames in which a stripe was seen, and centres in all; curves are thinned along the rows."
    return "\n".join([*said, "", *lines, "", text])


def _labels(canvas: Canvas, sensor_id: str) -> None:
    """The camera's name at the top of its image, and the image's edge."""
    assert canvas.source.rig is not None
    width, height = next(s.image_size for s in canvas.source.rig.sensors if s.sensor_id == sensor_id)
    for side in ("left", "right"):
        name = rr.Points2D(
            [[width / 2, -0.1 * height]], labels=[f"{sensor_id} {side}"], colors=[PALE], radii=ui(0.1), show_labels=True
        )
        canvas.static(f"stripes/{sensor_id}/{side}/name", name)
        edge = rr.Boxes2D(mins=[[0, 0]], sizes=[[width, height]], colors=[EDGE], radii=ui(0.5), draw_order=-10.0)
        canvas.static(f"stripes/{sensor_id}/{side}/edge", edge)


def _unavailable(canvas: Canvas) -> str | None:
    source = canvas.source
    if source.inbox is None:
        return "no inbox was named when the recording was written."
    if not source.bundle_files:
        return "the bundle was refused, so it is not on record which files it should hold."
    if source.bundle_folder is None:
        return f"the inbox no longer has the scan {source.scan_id}."
    if source.rig is None:
        return "the rig is not on record."
    if not source.unchanged("frames.parquet"):
        return "frames.parquet is missing or is not the file that was processed."
    return None


def _curves(canvas: Canvas, sensor_id: str, tables: list[StripeTable], n_sensors: int) -> list[str]:
    """Log the curves of one sensor; rows of the document's table."""
    rows = []
    total = sum(t.left_u_px.size + t.right_u_px.size for t in tables) * n_sensors
    step = max(1, int(np.ceil(total / (POINTS_RATIO * canvas.max_points))))
    for table in tables:
        for side, u_px in (("left", table.left_u_px), ("right", table.right_u_px)):
            path = f"stripes/{sensor_id}/{side}/line{table.line}"
            strips, count = _strips(u_px, step)
            seen = np.isfinite(u_px)
            rows.append(
                f"| {sensor_id} | {side} | {table.line} | {int(seen.any(axis=1).sum())} of {len(u_px)} | {int(seen.sum()):,} |"
            )
            shade = LINE_SHADES[min(table.line, 1)]
            colour = tuple(int(c * shade) for c in canvas.colour(sensor_id))
            canvas.static(path, rr.LineStrips2D.from_fields(colors=[colour], radii=ui(1.5)))
            if strips:
                columns = rr.LineStrips2D.columns(strips=strips)
                canvas.rec.send_columns(path, indexes=canvas.times(table.frame), columns=columns.partition(count))
    return rows


def _strips(u_px: NDArray[np.float64], step: int) -> tuple[list[NDArray], NDArray[np.int64]]:
    """Unbroken pieces (n, 2) of (u, v) of every frame, and how many each frame has; one row in `step` of a piece, and its ends.

    A centre that stands alone becomes a short stroke, so that outliers stay visible.
    """
    strips: list[NDArray] = []
    count = np.zeros(len(u_px), np.int64)
    for frame, u in enumerate(u_px):
        seen = np.flatnonzero(np.isfinite(u))
        if not len(seen):
            continue
        broken = (np.diff(seen) > 1) | (np.abs(np.diff(u[seen])) > MAX_JUMP_PX)
        for piece in np.split(seen, np.flatnonzero(broken) + 1):
            rows = piece[::step] if (len(piece) - 1) % step == 0 else np.append(piece[::step], piece[-1])
            line = np.column_stack([u[rows], rows]).astype(np.float32)
            strips.append(line if len(line) > 1 else line[0] + STROKE)
        count[frame] = int(broken.sum()) + 1
    return strips, count


def _images(canvas: Canvas, sensor_id: str, files: list[str]) -> list[str]:
    """Log a few of one sensor's camera frames as they were delivered; rows of the document's table."""
    folder = canvas.source.bundle_folder
    assert folder is not None
    rows = []
    for side in ("left", "right"):
        own = sorted(f for f in files if PurePosixPath(f).parts[:3] == ("images", sensor_id, side))
        chosen = [own[i] for i in np.unique(np.linspace(0, len(own) - 1, min(len(own), IMAGES_A_CAMERA)).astype(int))]
        frames = np.array([int(PurePosixPath(f).stem) for f in chosen])
        columns = rr.EncodedImage.columns(
            blob=[(folder / f).read_bytes() for f in chosen], media_type=["image/png"] * len(chosen)
        )
        canvas.rec.send_columns(f"stripes/{sensor_id}/{side}/image", indexes=canvas.times(frames), columns=columns)
        rows.append(f"| {sensor_id} | {side} | images | {len(own)} ({len(chosen)} shown) | |")
    return rows
