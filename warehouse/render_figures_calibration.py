"""Figures of the calibration page: which way corners miss, and where in depth and tilt the boards stood."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warehouse.render_panels import BAND, FAINT, POINT, REVIEW, Drawing, Group, Panel, Row, by, column, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VECTOR_SHARE = 0.03
"""Length of a vector as long as the RMS, in shares of the image's longer side."""


def residuals(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Vectors from each corner towards its projection, left and right camera; then tilt and distance of the poses."""
    stood = by(rows["board_poses"], "calibration_id", "sensor_id")
    covered = {(r["calibration_id"], r["sensor_id"]): r for r in rows["sensors"]}
    groups = []
    for index, (key, corners) in enumerate(by(rows["residuals"], "calibration_id", "sensor_id").items()):
        length = np.hypot(column(corners, "residual_u_px"), column(corners, "residual_v_px"))
        rms = float(np.sqrt(np.mean(length**2)))
        longer = max(corners[0]["image_width_px"], corners[0]["image_height_px"])
        enlarged = _round(VECTOR_SHARE * longer / max(rms, 1e-6))
        panels = []
        for (camera,), own in by(corners, "camera").items():
            title = f"{camera}, residuals × {enlarged:g}"
            alt = f"Residual vectors of {len(own)} corners in the {camera} image, RMS of both cameras {rms:.3f} px"
            panels.append(Panel(title, alt, svg(_vectors(own, enlarged), f"{salt}-{index}-{camera}")))
        if poses := stood.get(key):
            alt = f"Tilt and distance of {len(poses)} boards"
            panels.append(Panel("poses", alt, svg(_poses(poses, covered.get(key)), f"{salt}-{index}-poses")))
        groups.append(Group(f"{key[1]}, calibration {key[0]}", tuple(panels)))
    return Drawing(tuple(groups))


def _vectors(corners: list[Row], enlarged: float) -> Figure:
    figure, axes = _axes()
    u, v = column(corners, "u_px"), column(corners, "v_px")
    # One path for all vectors: a hundred times smaller than an arrow for each.
    ends = [u + enlarged * column(corners, "residual_u_px"), v + enlarged * column(corners, "residual_v_px")]
    gap = np.full(len(u), np.nan)
    lines = [np.column_stack([start, end, gap]).ravel() for start, end in zip((u, v), ends, strict=True)]
    axes.plot(*lines, color=REVIEW, linewidth=0.7)
    axes.plot(u, v, ".", markersize=1.6, color=POINT)
    axes.set_xlim(0, corners[0]["image_width_px"])
    axes.set_ylim(corners[0]["image_height_px"], 0)
    axes.set_aspect("equal")
    axes.set_xlabel("u (px)")
    axes.set_ylabel("v (px)")
    return figure


def _poses(poses: list[Row], sensor: Row | None) -> Figure:
    figure, axes = _axes()
    if sensor is not None and sensor["nearest_mm"] is not None:
        axes.axhspan(sensor["nearest_mm"], sensor["farthest_mm"], color=BAND, linewidth=0)
        for edge in ("nearest_mm", "farthest_mm"):
            axes.axhline(sensor[edge], color=FAINT, linewidth=0.6)
    axes.plot(column(poses, "tilt_deg"), column(poses, "distance_mm"), "o", markersize=4, color=POINT)
    axes.set_xlim(left=0)
    axes.set_xlabel("tilt of the board (°)")
    axes.set_ylabel("distance of its centre (mm)")
    return figure


def _axes() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4, 3.4), layout="constrained")
    return figure, figure.add_subplot()


def _round(value: float) -> float:
    """One significant digit: a scale that can be named."""
    digit = 10.0 ** np.floor(np.log10(value))
    return float(np.round(value / digit) * digit)
