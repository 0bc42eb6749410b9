"""`wheelset experiment rotation`: the paper's Fig. 3, rotations of a profile recovered over both of its ranges."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipelines.experiments import experiment_app
from pipelines.experiments.output import NOISE_MM, FigureOption, OutOption, ScanOption, StationOption
from pipelines.options import JsonOption, WarehouseOption

PAPER = {"0-360 by 5": (-1.09, 1.09), "0-90 by 1": (-1.114, 0.829)}
LIMIT_DEG = 0.01


@experiment_app.command()
def rotation(
    scan: ScanOption = None,
    warehouse: WarehouseOption = None,
    station: StationOption = None,
    noise_um: Annotated[float, typer.Option("--noise-um", min=0, help="Noise added across both profiles")] = NOISE_MM
    * 1e3,
    every: Annotated[int, typer.Option("--every", min=1, max=45, help="Only every so many-th angle: quicker")] = 1,
    seed: Annotated[int, typer.Option("--seed", help="Seed of that noise")] = 1,
    out: OutOption = None,
    figure: FigureOption = "png",
    as_json: JsonOption = False,
) -> int:
    """Fig. 3: a profile is turned by 0-360° in steps of 5° and by 0-90° in steps of 1°, and the angle recovered.

    By the magnitude of its spectrum on a polar grid; ours must be within 0.01°. Each turn comes with a shift of some mm.
    Without --scan on the nominal S1002 profile with noise.
    """
    import numpy as np

    from pipelines.experiments.output import new_figure, simulated_profile, stored_profile, tell, write
    from pipelines.settings import settings
    from wheelset_assets.metrology.frequency import rotation_and_shift, turn

    if scan:
        curve, of = stored_profile(settings(None, warehouse).warehouse, scan, station)
    else:
        curve, of = simulated_profile(), "nominal S1002"
    random = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for name, angles in (("0-360 by 5", np.arange(0.0, 361, 5)), ("0-90 by 1", np.arange(0.0, 91, 1))):
        for angle in angles[::every]:
            moved, fixed = (curve + noise_um * 1e-3 * random.standard_normal(curve.shape) for _ in range(2))
            shift = random.uniform(-3, 3, 2)
            found = rotation_and_shift(turn(moved, angle) + shift, fixed)
            rows.append(
                {
                    "range": name,
                    "angle_deg": float(angle),
                    "found_deg": found.rotation_deg,
                    "error_deg": float((found.rotation_deg - angle + 180) % 360 - 180),
                    "shift_error_um": float(np.abs(found.shift_mm - shift).max() * 1e3),
                    "peak": found.peak,
                }
            )
    drawing, axes = new_figure(9, 3.6, 1, 2)
    lines, summary = [], []
    for ax, (name, paper) in zip(axes[0], PAPER.items(), strict=True):
        of_range = [r for r in rows if r["range"] == name]
        error = np.array([r["error_deg"] for r in of_range])
        ax.plot([r["angle_deg"] for r in of_range], error * 1e3, ".-", color="#2a6f97", lw=0.8, ms=4)
        ax.axhspan(-LIMIT_DEG * 1e3, LIMIT_DEG * 1e3, color="#2a6f97", alpha=0.1, lw=0)
        ax.set_xlabel("rotation, °")
        ax.set_ylabel("error, 0.001°")
        ax.set_title(f"{name}°; paper: {paper[0]}° to {paper[1]}°", fontsize=9)
        within = bool(np.abs(error).max() <= LIMIT_DEG)
        summary.append({"range": name, "n": len(error), "min_deg": float(error.min()), "max_deg": float(error.max())})
        summary[-1] |= {
            "rms_deg": float(np.sqrt((error**2).mean())),
            "paper_min_deg": paper[0],
            "paper_max_deg": paper[1],
        }
        summary[-1] |= {"within": within}
        yes = "yes" if within else "NO"
        lines.append(
            [
                name + "°",
                str(len(error)),
                f"{error.min():+.5f} … {error.max():+.5f}",
                f"{paper[0]:+g} … {paper[1]:+g}",
                yes,
            ]
        )
    places = write(rows, drawing, out, "rotation", figure)
    tell(
        f"Fig. 3: rotation in the frequency domain ({of}, noise {noise_um:g} µm)",
        ["range", "n", "our error (°)", "the paper's error (°)", f"within {LIMIT_DEG}°"],
        lines,
        [f"Largest error of the shift found with it: {max(r['shift_error_um'] for r in rows):.1f} µm."],
        places,
        {"experiment": "rotation", "data": of, "summary": summary, "rows": rows},
        as_json,
    )
    return 0
