"""A calibration in one picture: residual vectors of both cameras, and where in depth and tilt the boards stood."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    from wheelset_assets.metrology.adjustment import BoardPose
    from wheelset_assets.metrology.calibration import StereoCalibration

INK, ACCENT, PALE = "#2a3440", "#c2571a", "#8a97a6"


def draw(
    found: StereoCalibration, poses: list[BoardPose], sizes: tuple[tuple[int, int], tuple[int, int]], path: Path
) -> None:
    """Write the picture in the format of the path's ending."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    used = [p for p, report in zip(poses, found.poses, strict=True) if report.used]
    residuals = found.adjustment.residuals_px
    rms = float(np.sqrt(np.nanmean((residuals**2).sum(axis=-1))))
    enlarged = 0.04 * max(sizes[0]) / max(rms, 1e-6)
    figure = Figure(figsize=(13, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, width_ratios=(1, 1, 0.8))
    for side, (ax, size) in enumerate(zip(axes[:2], sizes, strict=True)):
        name = ("left", "right")[side]
        px = np.concatenate([np.asarray((p.left_px, p.right_px)[side]) for p in used])
        d = residuals[:, side].reshape(-1, 2)
        ax.plot(*px.T, ".", ms=2, color=PALE)
        ax.quiver(*px.T, *(enlarged * d.T), angles="xy", scale_units="xy", scale=1, width=0.0022, color=ACCENT)
        ax.set(xlim=(0, size[0]), ylim=(size[1], 0), aspect="equal", xlabel="u px", ylabel="v px")
        share = (found.coverage_ratio, found.right_coverage_ratio)[side]
        own = (found.left_rms_px, found.right_rms_px)[side]
        ax.set_title(f"{name}: RMS {own:.3f} px, covers {100 * share:.0f} %", color=INK, fontsize=10)
    axes[0].text(
        0.02, 0.02, f"vectors enlarged {enlarged:.0f} times", transform=axes[0].transAxes, color=ACCENT, fontsize=8
    )
    ax = axes[2]
    listed = [p for p in found.poses if p.used]
    ax.scatter([p.tilt_deg for p in listed], [p.distance_mm for p in listed], s=22, color=INK, zorder=3)
    for p in listed:
        ax.annotate(
            p.name, (p.tilt_deg, p.distance_mm), xytext=(4, 3), textcoords="offset points", fontsize=7, color=PALE
        )
    ax.axhspan(*found.depth_range_mm, color=PALE, alpha=0.15, lw=0)
    ax.set(xlabel="tilt of the board, degrees", ylabel="distance of its centre, mm")
    ax.set_title("poses; grey: depth that corners cover", color=INK, fontsize=10)
    for ax in axes:
        ax.grid(color="#e4e8ec", lw=0.6)
        ax.set_axisbelow(True)
    try:
        figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be written: {error}") from error
