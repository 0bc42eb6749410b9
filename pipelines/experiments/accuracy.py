"""`wheelset experiment accuracy`: errors of every quantity against simulated truth, and whether U covers them."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipelines.experiments import experiment_app
from pipelines.experiments.output import FigureOption, OutOption
from pipelines.options import JsonOption
from wheelset_assets.quality import ConfigError

TARGETS_MM = {
    "journal_diameter": 0.001,
    "wheel_diameter": 0.003,
    "inner_distance": 0.004,
    "shoulder_distance": 0.004,
    "flange_height": 0.010,
    "flange_thickness": 0.010,
    "qr": 0.030,
}
"""Of the series with exact inputs: 95 % of the errors lie within."""
FLATS = ("flat_depth", "flat_length")
REFUTED = 1e-3
LEVEL = 0.9545
"""Coverage that k = 2 claims for a normal distribution."""


@experiment_app.command()
def accuracy(
    draws: Annotated[int, typer.Option("--draws", min=2, help="Simulated wheelsets a series")] = 300,
    series: Annotated[
        str,
        typer.Option(
            "--series",
            help="exact: certificate, thermometers and expansion known; realistic: each draw its own rig, calibration, "
            "certificate error, thermometer error, expansion; both",
        ),
    ] = "both",
    frames: Annotated[int, typer.Option("--frames", min=16, help="Frames a turn")] = 120,
    reference_frames: Annotated[
        int, typer.Option("--reference-frames", min=16, help="Frames of each rig's reference scan")
    ] = 240,
    rows: Annotated[int, typer.Option("--rows", min=128, help="Image rows of the tallest sensor")] = 1024,
    axis_um: Annotated[
        float,
        typer.Option(
            "--axis-um", min=0.0, help="The axis of rotation lies within this of the rig's, scan by scan (µm)"
        ),
    ] = 0.5,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes")] = 2,
    seed: Annotated[int, typer.Option("--seed", help="Seed; the draws' numbers decide the rest")] = 20251,
    out: OutOption = None,
    figure: FigureOption = "png",
    as_json: JsonOption = False,
) -> int:
    """Every quantity against the truth: bias, spread, 95 % of the errors, and coverage of U (k = 2: 95.45 %).

    Draws vary profile, wear, diameter within 20 mm of the master, temperatures, place and turn; one in ten has a sector
    of 40 degrees unseen, one in ten grease on the datum circle, one a flat, one five times the outliers. The p-value is
    two-sided, of the binomial distribution: below 0.001 the claimed uncertainty is refuted, as too small or as too large.
    Spread / bound: against the Cramér-Rao bound of the stripes' noise, the axis and the thermometers (exact series); of
    quantities that no master zeroes, of noise, calibration, sensing plane and registration. A one-sided sensor cannot see
    the axis: half a micrometre of it is as much as the target of the journals; `--axis-um 0` shows what the rest does.
    """
    from pipelines.experiments.output import computed, tell, write
    from pipelines.experiments.virtual import SERIES, Job, run_draw

    names = list(SERIES) if series == "both" else [series]
    if unknown := [n for n in names if n not in SERIES]:
        raise ConfigError(f"--series {unknown[0]}: known are {', '.join(SERIES)} and both")
    jobs = [Job(name, index, seed, rows, frames, reference_frames, axis_um) for name in names for index in range(draws)]
    errors = computed(run_draw, jobs, workers)
    given = {
        "frames": frames,
        "reference_frames": reference_frames,
        "image_rows": rows,
        "axis_um": axis_um,
        "seed": seed,
    }
    summary = [row | given for row in summarised(errors)]
    places = write(summary, _drawn(errors, names), out, "accuracy", figure)
    places |= {"errors": write(errors, None, out, "accuracy-errors", figure)["parquet"]}
    lines: list[list[str]] = []
    for name in names:
        lines.append([f"{name} inputs"])
        lines += [_line(r) for r in summary if r["series"] == name]
    refuted = [r for r in summary if r["p_value"] <= REFUTED]
    missed = [r for r in summary if r["met"] is False]
    tell(
        f"Errors against the truth (µm), {draws} draws a series",
        ["quantity", "n", "none", "bias", "spread", "95 %", "/ bound", "target", "U", "in U %", "p"],
        lines,
        [
            f"{len(refuted)} of {len(summary)} claimed uncertainties are refuted at p <= {REFUTED:g}; "
            f"{len(missed)} of {sum(r['met'] is not None for r in summary)} targets are missed.",
            "95 %: of the errors' sizes; / bound: spread over the Cramér-Rao bound; none: values refused; U: the median one.",
            "Of flats, zeros that say `not_detected` are left out: their U is what could have escaped.",
        ],
        places,
        {"experiment": "accuracy", "draws": draws, **given, "rows": summary},
        as_json,
    )
    return 0


def _line(r: dict[str, Any]) -> list[str]:
    return [
        r["quantity"],
        f"{r['n']}",
        f"{r['refused'] or ''}",
        *(f"{r[name]:.3g}" for name in ("bias_um", "spread_um", "p95_um")),
        "" if r["efficiency"] is None else f"{r['efficiency']:.2f}",
        _target(r),
        f"{r['median_expanded_um']:.3g}",
        f"{100 * r['coverage']:.1f}",
        f"{r['p_value']:.2g}" + ("" if r["p_value"] > REFUTED else " REFUTED"),
    ]


def _target(r: dict[str, Any]) -> str:
    """A target that is missed, beside what the bound alone would leave of errors at 95 %."""
    if r["target_um"] is None:
        return ""
    if r["met"]:
        return f"{r['target_um']:g} met"
    least = f", bound {1.96 * r['bound_um']:.2g}" if r["bound_um"] else ""
    return f"{r['target_um']:g} MISSED{least}"


def summarised(errors: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a series and quantity: sides and draws together."""
    import numpy as np
    from scipy.stats import binomtest

    from wheelset_assets.quantities import QUANTITIES

    summary = []
    for series in dict.fromkeys(row["series"] for row in errors):
        for quantity in (q.name for q in QUANTITIES):
            own = [r for r in errors if r["series"] == series and r["quantity"] == quantity and r["truth"] is not None]
            known = [r for r in own if r["value"] is not None]
            if quantity in FLATS:
                # A zero that stands for "nothing found" claims what could have escaped, not a spread.
                known = [r for r in known if "not_detected" not in (r["flags"] or [])]
            refused = sum(r["value"] is None for r in own)
            if not known:
                continue
            error = np.array([r["value"] - r["truth"] for r in known])
            u = np.array([r["u"] for r in known])
            covered = int((np.abs(error) <= 2 * u).sum())
            target = TARGETS_MM.get(quantity) if series == "exact" else None
            bounds = np.array([r["bound"] for r in known if r["bound"] is not None])
            bound = float(np.sqrt((bounds**2).mean())) if len(bounds) == len(known) else None
            spread = float(error.std(ddof=1)) if len(error) > 1 else 0.0
            p95 = float(np.quantile(np.abs(error), 0.95))
            # Both sides of a draw share rig, certificate and thermometers: half as many are independent.
            sides = len({r["side"] for r in known})
            n, hit = round(len(known) / sides), round(covered / sides)
            summary.append(
                {
                    "series": series,
                    "quantity": quantity,
                    "n": len(known),
                    "refused": refused,
                    "bias_um": float(1e3 * error.mean()),
                    "spread_um": 1e3 * spread,
                    "bound_um": 1e3 * bound if bound else None,
                    "efficiency": spread / bound if bound else None,
                    "p95_um": 1e3 * p95,
                    "target_um": 1e3 * target if target else None,
                    "met": bool(p95 <= target) if target else None,
                    "median_expanded_um": float(2e3 * np.median(u)),
                    "rms_pull": float(np.sqrt(np.mean((error / u) ** 2))),
                    "coverage": covered / len(known),
                    "p_value": float(binomtest(hit, n, LEVEL).pvalue),
                }
            )
    return summary


def _drawn(errors: list[dict[str, Any]], names: list[str]) -> Any:
    import numpy as np

    from pipelines.experiments.output import new_figure

    drawing, axes = new_figure(9.0, 3.6)
    ax = axes[0, 0]
    quantities = list(TARGETS_MM)
    for offset, (name, colour) in enumerate(zip(names, ("#2a6f97", "#c1121f"), strict=False)):
        for k, quantity in enumerate(quantities):
            own = [r for r in errors if r["series"] == name and r["quantity"] == quantity and r["value"] is not None]
            pulls = np.array([(r["value"] - r["truth"]) / r["u"] for r in own])
            place = k + 0.3 * (offset - 0.5)
            ax.scatter(np.full(len(pulls), place), pulls, s=4, alpha=0.35, color=colour, label=name if k == 0 else None)
    for level in (-2, 2):
        ax.axhline(level, color="0.4", lw=0.8, ls="--")
    ax.set_xticks(range(len(quantities)), [q.replace("_", "\n") for q in quantities], fontsize=8)
    ax.set_ylabel("error / u")
    ax.legend(frameon=False, fontsize=8)
    return drawing
