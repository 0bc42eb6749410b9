"""The newcomer's tour: simulate, run, report, and say where everything lies."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

from pipelines.progress import Bars
from pipelines.settings import settings
from wheelset_assets.quality import ConfigError

MARK = ".wheelset-demo"


def tour(out: Path, as_json: bool) -> int:
    """Two wheelsets on two days, three scans each, one of them spoiled so that there is a recording to look at."""
    from pipelines.runner import run
    from pipelines.show import show_summary, write_report
    from wheelset_assets.simulation import SimulationPlan, simulate

    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: expected a folder, or a name for a new one")
    if out.exists() and any(out.iterdir()):
        if not (out / MARK).exists():
            raise ConfigError(f"--out {out}: the folder is not empty and not a former demonstration; name a new one")
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARK).write_text("Made by `wheelset demo`, which replaces this folder.\n", encoding="utf-8")
    inbox, warehouse = out / "inbox", out / "warehouse"
    plan = SimulationPlan(
        out=inbox, wheelsets=2, days=2, repeats=3, seed=1, frames=96, rows=512, faults=("empty-stripes",), span_days=31
    )
    with Bars() as bars:
        simulate(plan, lambda done, total, what: bars("simulate", what, done, total))
    s = settings(inbox, warehouse)
    with Bars() as bars:
        summary = run(s, progress=bars)
    html = out / "accuracy.html"
    if as_json:
        print(
            json.dumps(
                {"inbox": str(inbox), "warehouse": str(warehouse), "report": str(html), "summary": summary.as_json()},
                indent=2,
            )
        )
        sys.stdout.flush()
    else:
        show_summary(summary, warehouse)
        print()
        write_report(s, "accuracy", "table", None, None)
    _quietly(s, "accuracy", html)
    _quietly(s, "stability", out / "stability.html")
    if not as_json:
        print(_epilogue(out, inbox, warehouse))
    return 0


def _quietly(s: object, name: str, out: Path) -> None:
    from pipelines.ask import open_read_only
    from warehouse import report
    from warehouse.render import render

    made = report.build(open_read_only(s.warehouse), name, {})  # type: ignore[attr-defined]
    render(made, "html", out)


def _epilogue(out: Path, inbox: Path, warehouse: Path) -> str:
    recordings = sorted((warehouse / "recordings").glob("*.rrd"))
    lines = [
        "",
        f"simulated inbox      {inbox}   (its truth: {inbox}.truth.parquet)",
        f"warehouse            {warehouse}",
        f"accuracy report      {out / 'accuracy.html'}",
        f"stability report     {out / 'stability.html'}",
        *(
            f"recording            {path}   (a scan that failed; wheelset replay {path.stem} --open --warehouse {warehouse})"
            for path in recordings
        ),
        "",
        f"ask it anything      wheelset sql --warehouse {warehouse} "
        '"SELECT quantity, side, count(*), avg(value) FROM measurements GROUP BY ALL"',
        f"where from           wheelset lineage --warehouse {warehouse} WS-000-20250405-00",
    ]
    return "\n".join(lines)
