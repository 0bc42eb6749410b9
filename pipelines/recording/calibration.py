"""Reprojection residuals of the calibration that a scan was made with: vectors on both images of every sensor."""

from __future__ import annotations

import numpy as np
import rerun as rr

from pipelines.recording.canvas import GREY, PALE, RED, Canvas, ui
from pipelines.recording.report import escape

VECTOR_SHARE = 0.04
"""Length of a vector as long as the RMS, in shares of the image's longer side."""


def draw(canvas: Canvas) -> None:
    """Corners as found, and the way to their projection, enlarged; a table of the poses beside them."""
    corners = canvas.source.calibration_table("calibration_corners")
    calibrations = canvas.source.calibrations
    if corners is None or calibrations is None or not corners.num_rows:
        return
    sizes = {r["sensor_id"]: (r["image_width_px"], r["image_height_px"]) for r in calibrations.to_pylist()}
    sensor, camera = (np.asarray(corners[name].to_pylist(), object) for name in ("sensor_id", "camera"))
    at, miss = (
        np.column_stack([corners[f"{prefix}{axis}_px"].to_numpy() for axis in "uv"]) for prefix in ("", "residual_")
    )
    for name in dict.fromkeys(sensor.tolist()):
        own = sensor == name
        rms = float(np.sqrt(np.mean((miss[own] ** 2).sum(axis=1))))
        enlarged = VECTOR_SHARE * max(sizes[name]) / max(rms, 1e-6)
        for side in ("left", "right"):
            member = own & (camera == side)
            path = f"calibration/{name}/{side}"
            width, height = sizes[name]
            edge = rr.Boxes2D(mins=[[0, 0]], sizes=[[width, height]], colors=[GREY], radii=ui(0.5), draw_order=-10.0)
            canvas.static(f"{path}/edge", edge)
            label = f"{name} {side}, enlarged {enlarged:.0f} times"
            words = rr.Points2D(
                [[width / 2, -0.1 * height]], labels=[label], colors=[PALE], radii=ui(0.1), show_labels=True
            )
            canvas.static(f"{path}/name", words)
            canvas.static(f"{path}/corners", rr.Points2D(at[member], colors=[canvas.colour(name)], radii=ui(1.2)))
            arrows = rr.Arrows2D(origins=at[member], vectors=enlarged * miss[member], colors=[RED], radii=ui(0.8))
            canvas.static(f"{path}/residuals", arrows)
        canvas.note("calibration", name)
    canvas.document("calibration", _document(canvas))


def _document(canvas: Canvas) -> str:
    """What the fit says, sensor by sensor, and how the boards stood."""
    assert canvas.source.calibrations is not None
    lines = [
        "Vectors run from the corners as found towards their projection.",
        "",
        "| sensor | RMS left, right px | hold-out px | epipolar px | covers left, right | poses |",
        "|---|---|---|---|---|---|",
    ]
    for row in canvas.source.calibrations.to_pylist():
        if row["state"] != "usable":
            lines.append(
                f"| {row['sensor_id']} | refused: {escape(row['reason'])} | | | | {row['n_poses_used']} of {row['n_poses']} |"
            )
            continue
        covers = f"{100 * row['coverage_ratio']:.0f} %, {100 * row['right_coverage_ratio']:.0f} %"
        numbers = [
            f"{row[name]:.3f}" if row[name] is not None else "" for name in ("holdout_rms_px", "epipolar_rms_px")
        ]
        lines.append(
            f"| {row['sensor_id']} | {row['left_rms_px']:.3f}, {row['right_rms_px']:.3f} | {' | '.join(numbers)} | {covers} "
            f"| {row['n_poses_used']} of {row['n_poses']} |"
        )
    lines += ["", "| sensor | pose | tilt ° | distance mm | RMS left, right px |", "|---|---|---|---|---|"]
    poses = canvas.source.calibration_table("calibration_poses")
    for row in poses.to_pylist() if poses is not None else []:
        told = (
            f"{row['tilt_deg']:.1f} | {row['distance_mm']:.0f} | {row['left_rms_px']:.3f}, {row['right_rms_px']:.3f}"
            if row["used"]
            else f"| | left out: {escape(row['reason'] or '')}"
        )
        lines.append(f"| {row['sensor_id']} | {escape(row['pose'])} | {told} |")
    return "\n".join(lines)
