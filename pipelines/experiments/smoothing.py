"""`wheelset experiment smoothing`: the paper's Fig. 4 with figures: a profile before and after each filter."""

from __future__ import annotations

from typing import Any

from pipelines.experiments import experiment_app
from pipelines.experiments.output import FigureOption, OutOption, ScanOption, SensorOption
from pipelines.options import ConfigOption, JsonOption, WarehouseOption


@experiment_app.command()
def smoothing(
    scan: ScanOption = None,
    warehouse: WarehouseOption = None,
    sensor: SensorOption = None,
    config: ConfigOption = None,
    out: OutOption = None,
    figure: FigureOption = "png",
    as_json: JsonOption = False,
) -> int:
    """Fig. 4: noise before and after each filter, what the filter claims, and the bias that it leaves on the profile.

    Noise: scatter over the frames about each row's course. Bias: change of a row's mean over all frames, which the noise
    hardly reaches; largest where the profile is curved or ends. Without --scan a scan is simulated.
    """
    import numpy as np

    from pipelines.experiments.grids import FILTERS, depth_grid, noise_um, scan_source
    from pipelines.experiments.output import new_figure, tell, write
    from wheelset_assets.config import load_config
    from wheelset_assets.stages.cloud import smooth

    knobs = load_config(config).filtering
    with scan_source(scan, warehouse) as source:
        grid = depth_grid(source, sensor)
    rows: list[dict[str, Any]] = []
    z = grid.depth_mm
    drawing, axes = new_figure(9, 6, 2, 1)
    frame = int(np.isfinite(z).sum(axis=1).argmax())
    for kind in FILTERS:
        made = smooth(z, knobs, grid.noise_mm, grid.correlation, kind)
        bias = _mean(made.depth_mm) - _mean(z)
        bias = bias[np.isfinite(bias)]
        noise = noise_um(made.depth_mm)
        before = noise_um(z)
        rows.append(
            {
                "filter": kind,
                "noise_before_um": before,
                "noise_um": noise,
                "noise_factor": noise / before,
                "claimed_factor": float(np.nanmedian(made.noise_factor)),
                "bias_rms_um": float(np.sqrt((bias**2).mean()) * 1e3),
                "bias_max_um": float(np.abs(bias).max() * 1e3),
                "points_lost": int(np.isfinite(z).sum() - np.isfinite(made.depth_mm).sum()),
            }
        )
        axes[1, 0].plot(grid.across_mm, (made.depth_mm[frame] - _mean(z)) * 1e3, lw=0.8, label=kind)
    axes[0, 0].plot(grid.across_mm, z[frame], color="#2a6f97", lw=0.8)
    axes[0, 0].set_ylabel("depth, mm")
    axes[0, 0].set_title(f"{grid.of}: frame {frame}, before smoothing", fontsize=10)
    axes[1, 0].set_ylabel("departure from the turn's mean, µm")
    axes[1, 0].set_xlabel("along the stripe, mm")
    axes[1, 0].set_ylim(-5 * rows[0]["noise_um"], 5 * rows[0]["noise_um"])
    axes[1, 0].legend(frameon=False, fontsize=8, ncols=5)
    places = write(rows, drawing, out, "smoothing", figure)
    lines = [
        [
            r["filter"],
            f"{r['noise_um']:.2f}",
            f"{r['noise_factor']:.3f}",
            f"{r['claimed_factor']:.3f}",
            f"{r['bias_rms_um']:.2f}",
            f"{r['bias_max_um']:.1f}",
            str(r["points_lost"]),
        ]
        for r in rows
    ]
    tell(
        f"Fig. 4: smoothing ({grid.of})",
        ["filter", "noise (µm)", "factor", "claimed", "bias RMS (µm)", "bias max (µm)", "points lost"],
        lines,
        [
            "The paper shows a picture without figures. Factor: noise after over before; claimed: carried to the points' u."
        ],
        places,
        {"experiment": "smoothing", "data": grid.of, "rows": rows},
        as_json,
    )
    return 0


def _mean(z: Any) -> Any:
    from wheelset_assets.metrology.grids import nan_mean

    return nan_mean(z, axis=0)[0]
