"""`wheelset experiment depth`: the paper's Fig. 5, depth along one lateral position, before and after filtering."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipelines.experiments import experiment_app
from pipelines.experiments.output import FigureOption, OutOption, ScanOption, SensorOption
from pipelines.options import ConfigOption, JsonOption, WarehouseOption

PAPER_RANGE_MM, PAPER_MEAN_MM = 0.03187, 71.6318


@experiment_app.command()
def depth(
    scan: ScanOption = None,
    warehouse: WarehouseOption = None,
    sensor: SensorOption = None,
    at_mm: Annotated[
        float | None, typer.Option("--at-mm", help="Place along the stripe, sensor frame [default: its middle]")
    ] = None,
    config: ConfigOption = None,
    out: OutOption = None,
    figure: FigureOption = "png",
    as_json: JsonOption = False,
) -> int:
    """Fig. 5: the depth at one lateral position over the turn, its range and scatter, for each filter.

    A range holds run-out as well as noise, so the scatter about the course over the turn stands beside it. Without
    --scan a scan is simulated.
    """
    import numpy as np

    from pipelines.experiments.grids import FILTERS, depth_grid, noise_um, scan_source
    from pipelines.experiments.output import new_figure, tell, write
    from wheelset_assets.config import load_config
    from wheelset_assets.stages.cloud import smooth

    knobs = load_config(config).filtering
    with scan_source(scan, warehouse) as source:
        grid = depth_grid(source, sensor)
    seen = np.isfinite(grid.depth_mm).mean(axis=0) > 0.8
    wanted = at_mm if at_mm is not None else float(np.median(grid.across_mm[seen]))
    row = int(np.where(seen, np.abs(grid.across_mm - wanted), np.inf).argmin())
    rows: list[dict[str, Any]] = []
    drawing, axes = new_figure(9, 3.8)
    for kind in FILTERS:
        made = smooth(grid.depth_mm, knobs, grid.noise_mm, grid.correlation, kind).depth_mm[:, row]
        known = made[np.isfinite(made)]
        rows.append(
            {
                "filter": kind,
                "at_mm": float(grid.across_mm[row]),
                "n": len(known),
                "mean_mm": float(known.mean()),
                "range_mm": float(np.ptp(known)),
                "standard_deviation_um": float(known.std(ddof=1) * 1e3),
                "noise_um": noise_um(made[:, None]),
            }
        )
        if kind in ("none", knobs.smoothing):
            axes[0, 0].plot((made - known.mean()) * 1e3, ".-", lw=0.6, ms=3, label=kind)
    axes[0, 0].set_xlabel("frame")
    axes[0, 0].set_ylabel("depth less its mean, µm")
    axes[0, 0].set_title(f"{grid.of}: row at {grid.across_mm[row]:.1f} mm", fontsize=10)
    axes[0, 0].legend(frameon=False, fontsize=8)
    places = write(rows, drawing, out, "depth", figure)
    lines = [
        [
            r["filter"],
            f"{r['mean_mm']:.4f}",
            f"{r['range_mm']:.5f}",
            f"{r['standard_deviation_um']:.2f}",
            f"{r['noise_um']:.2f}",
        ]
        for r in rows
    ]
    lines.append(["paper", f"{PAPER_MEAN_MM}", f"{PAPER_RANGE_MM}", "", ""])
    tell(
        f"Fig. 5: depth at one lateral position ({grid.of}, {rows[0]['n']} frames)",
        ["filter", "mean (mm)", "range (mm)", "st. dev. (µm)", "of it noise (µm)"],
        lines,
        [],
        places,
        {"experiment": "depth", "data": grid.of, "paper_range_mm": PAPER_RANGE_MM, "rows": rows},
        as_json,
    )
    return 0
