"""`wheelset experiment ablation`: what each filter and each registration does to the final measurements."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipelines.experiments import experiment_app
from pipelines.experiments.output import FigureOption, OutOption
from pipelines.options import JsonOption

SHOWN = ("wheel_diameter", "journal_diameter", "inner_distance", "flange_height", "flange_thickness", "qr")
DEFAULTS = {"filter": "quadratic", "registration": "point to curve, with prior"}


@experiment_app.command()
def ablation(
    draws: Annotated[int, typer.Option("--draws", min=2, help="Simulated wheelsets")] = 60,
    frames: Annotated[int, typer.Option("--frames", min=16, help="Frames a turn")] = 60,
    rows: Annotated[int, typer.Option("--rows", min=128, help="Image rows of the tallest sensor")] = 512,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes")] = 2,
    seed: Annotated[int, typer.Option("--seed", help="Seed; the draws' numbers decide the rest")] = 20252,
    out: OutOption = None,
    figure: FigureOption = "png",
    as_json: JsonOption = False,
) -> int:
    """Bias and spread of the final values under each filter and each registration, all else at its default.

    Every way works on the same scans, with a reference scan that was processed the same way, certificates and
    thermometers exact: what differs between two lines is the way alone. Spread: standard deviation of the errors against
    the truth; 95 %: of |error|.
    """
    from pipelines.experiments.output import tell, write

    summary = summarised(_errors(draws, frames, rows, workers, seed))
    places = write(summary, _drawn(summary), out, "ablation", figure)
    tell(
        f"Ablation: errors against the truth, {draws} wheelsets: bias ± spread (µm)",
        ["varied", "way", *(name.replace("_", " ") for name in SHOWN)],
        _lines(summary),
        ["*: the default. All quantities are in the Parquet file, with refusals and 95 % of |error|."],
        places,
        {"experiment": "ablation", "draws": draws, "defaults": DEFAULTS, "rows": summary},
        as_json,
    )
    return 0


def _lines(summary: list[dict[str, Any]]) -> list[list[str]]:
    """A line for each way, a cell for each of SHOWN."""
    found = {(r["varied"], r["way"], r["quantity"]): r for r in summary}
    lines = []
    for varied, way in dict.fromkeys((r["varied"], r["way"]) for r in summary):
        cells = []
        for quantity in SHOWN:
            r = found.get((varied, way, quantity))
            refused = f" ({r['refused']} refused)" if r and r["refused"] else ""
            cells.append(f"{r['bias_um']:+.2f} ± {r['spread_um']:.2f}{refused}" if r else "")
        lines.append([varied, way + (" *" if way == DEFAULTS[varied] else ""), *cells])
    return lines


def run_ways(job: Any) -> list[dict[str, Any]]:
    """Errors of one draw under every way; `varied` and `way` name it."""
    from pipelines.experiments.virtual import drawn
    from pipelines.experiments.ways import filters, registrations
    from wheelset_assets.config import Config
    from wheelset_assets.stages.pose import register_by_icp

    draw = drawn(job)
    seen = draw.see()
    ways: list[tuple[str, str, Config, Any]] = [
        *(("filter", name, config, register_by_icp) for name, config in filters().items()),
        *(("registration", name, Config(), register) for name, register in registrations().items()),
    ]
    found = []
    for varied, name, config, register in ways:
        key = (varied, name)
        if key not in draw.world.references:
            draw.world.references[key] = draw.world.process(draw.world.master, None, config, register)
        tables = draw.world.process(seen, draw.world.references[key], config, register)
        found += [{"varied": varied, "way": name} | row for row in draw.errors(tables["measurements"])]
    return found


def _errors(draws: int, frames: int, rows: int, workers: int, seed: int) -> list[dict[str, Any]]:
    from pipelines.experiments.output import computed
    from pipelines.experiments.virtual import Job

    return computed(run_ways, [Job("exact", index, seed, rows, frames) for index in range(draws)], workers)


def summarised(errors: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each way and quantity, sides and draws together, with 95 % of |error| over the default way's."""
    import numpy as np

    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in errors:
        if row["truth"] is not None and "not_detected" not in (row["flags"] or []):
            groups.setdefault((row["varied"], row["way"], row["quantity"]), []).append(row)
    summary: list[dict[str, Any]] = []
    for (varied, way, quantity), own in groups.items():
        known = [r for r in own if r["value"] is not None]
        if len(known) < 2:
            continue
        error = np.array([r["value"] - r["truth"] for r in known]) * 1e3
        summary.append(
            {
                "varied": varied,
                "way": way,
                "quantity": quantity,
                "n": len(known),
                "refused": len(own) - len(known),
                "bias_um": float(error.mean()),
                "spread_um": float(error.std(ddof=1)),
                "p95_um": float(np.quantile(np.abs(error), 0.95)),
                "median_expanded_um": float(2e3 * np.median([r["u"] for r in known])),
            }
        )
    default = {(r["varied"], r["quantity"]): r["p95_um"] for r in summary if r["way"] == DEFAULTS[r["varied"]]}
    for row in summary:
        base = default.get((row["varied"], row["quantity"]), 0.0)
        row["p95_ratio"] = row["p95_um"] / base if base > 0 else float("nan")
    return summary


def _drawn(summary: list[dict[str, Any]]) -> Any:
    """Bias as a point and spread as a bar, a panel for each quantity and for what was varied."""
    from pipelines.experiments.output import new_figure

    drawing, axes = new_figure(13.0, 6.4, 2, len(SHOWN))
    for row_of_axes, varied in zip(axes, DEFAULTS, strict=True):
        ways = list(dict.fromkeys(r["way"] for r in summary if r["varied"] == varied))
        for column, (ax, quantity) in enumerate(zip(row_of_axes, SHOWN, strict=True)):
            for place, way in enumerate(ways):
                own = [r for r in summary if (r["varied"], r["way"], r["quantity"]) == (varied, way, quantity)]
                for r in own:
                    colour = "#c1121f" if way == DEFAULTS[varied] else "#2a6f97"
                    ax.errorbar(r["bias_um"], place, xerr=r["spread_um"], fmt="o", ms=4, color=colour, elinewidth=1.4)
            ax.axvline(0.0, color="0.6", lw=0.7)
            ax.set_ylim(len(ways) - 0.5, -0.5)
            ax.set_yticks(range(len(ways)), ways if column == 0 else [], fontsize=8)
            ax.set_title(quantity.replace("_", " "), fontsize=9)
            if varied == list(DEFAULTS)[-1]:
                ax.set_xscale("symlog", linthresh=5.0)
            ax.tick_params(labelsize=7)
            ax.set_xlabel("bias ± spread, µm", fontsize=8)
    return drawing
