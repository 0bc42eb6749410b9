"""`wheelset experiment translation`: the paper's Table 2, shifts recovered by phase correlation, beside what it prints."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipelines.experiments import experiment_app
from pipelines.experiments.output import NOISE_MM, FigureOption, OutOption, ScanOption, StationOption
from pipelines.options import JsonOption, WarehouseOption

TABLE_2 = (
    (-0.03, 0.05, 100.0, 30.0, 50.0, "misprint: 30, 50 belongs to ρ = 1000"),
    (-0.3, 0.5, 10.0, 3.0, 5.0, "sign of x lost"),
    (-0.3, 0.5, 10.0, 3.0, 5.0, "sign of x lost"),
    (-0.03, 0.05, 100.0, 3.0, 5.0, "sign of x lost"),
    (-0.05, 0.07, 100.0, 0.0, 0.0, "misprint: −5, 7"),
)
"""Shift in x and z (mm), amplification, the paper's result (pixels), and what is wrong with it (paper-notes, item 11)."""


@experiment_app.command()
def translation(
    scan: ScanOption = None,
    warehouse: WarehouseOption = None,
    station: StationOption = None,
    noise_um: Annotated[float, typer.Option("--noise-um", min=0, help="Noise added across both profiles")] = NOISE_MM
    * 1e3,
    seed: Annotated[int, typer.Option("--seed", help="Seed of that noise")] = 1,
    out: OutOption = None,
    figure: FigureOption = "png",
    as_json: JsonOption = False,
) -> int:
    """Table 2: a profile is shifted, and the shift recovered in the frequency domain at amplification ρ.

    Ours must be within 0.1/ρ mm of the truth in every row. Without --scan on the nominal S1002 profile with noise.
    """
    import numpy as np

    from pipelines.experiments.output import new_figure, simulated_profile, stored_profile, tell, write
    from pipelines.settings import settings
    from wheelset_assets.metrology.frequency import phase_correlation

    if scan:
        curve, of = stored_profile(settings(None, warehouse).warehouse, scan, station)
    else:
        curve, of = simulated_profile(), "nominal S1002"
    random = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for x, z, rho, paper_x, paper_z, remark in TABLE_2:
        moved, fixed = (curve + noise_um * 1e-3 * random.standard_normal(curve.shape) for _ in range(2))
        found = phase_correlation(moved + np.array([x, z]), fixed, rho)
        error = np.abs(found.shift_mm - [x, z]).max()
        rows.append(
            {
                "shift_x_mm": x,
                "shift_z_mm": z,
                "rho": rho,
                "x_px": float(found.pixels[0]),
                "z_px": float(found.pixels[1]),
                "paper_x_px": paper_x,
                "paper_z_px": paper_z,
                "error_um": float(error * 1e3),
                "limit_um": 100.0 / rho,
                "within": bool(error <= 0.1 / rho),
                "peak": found.peak,
                "remark": remark,
            }
        )
    drawing, axes = new_figure(7.5, 3.6)
    ax = axes[0, 0]
    place = np.arange(len(rows))
    ax.bar(place, [r["error_um"] for r in rows], color="#2a6f97", label="error")
    ax.scatter(place, [r["limit_um"] for r in rows], marker="_", s=400, color="#c1121f", label="0.1/ρ")
    ax.set_yscale("log")
    ax.set_xticks(place, [f"({r['shift_x_mm']:g}, {r['shift_z_mm']:g})\nρ = {r['rho']:g}" for r in rows], fontsize=8)
    ax.set_ylabel("largest error, µm")
    ax.set_title(f"Translation by phase correlation, {of}", fontsize=10)
    ax.legend(frameon=False, fontsize=8)
    places = write(rows, drawing, out, "translation", figure)
    lines = [
        [
            f"{r['shift_x_mm']:g}, {r['shift_z_mm']:g}",
            f"{r['rho']:g}",
            f"{r['x_px']:.3f}, {r['z_px']:.3f}",
            f"{r['paper_x_px']:g}, {r['paper_z_px']:g}",
            f"{r['error_um']:.3f}",
            f"{r['limit_um']:g}",
            "yes" if r["within"] else "NO",
        ]
        for r in rows
    ]
    tell(
        f"Table 2: translation in the frequency domain ({of}, noise {noise_um:g} µm)",
        ["x, z (mm)", "ρ", "ours (px)", "paper (px)", "error (µm)", "0.1/ρ", "within"],
        lines,
        [f"{sum(r['within'] for r in rows)} of {len(rows)} rows within 0.1/ρ. The paper's values:"]
        + [f"  row {n}: {r['remark']}" for n, r in enumerate(rows, start=1)],
        places,
        {"experiment": "translation", "data": of, "rows": rows},
        as_json,
    )
    return 0
