"""The command line `wheelset`: options, progress, exit codes. The work is done elsewhere; heavy imports wait until needed."""

from __future__ import annotations

import os
import sys
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines import questions, upkeep
from pipelines.experiments import experiment_app
from pipelines.options import (
    ConfigOption,
    InboxOption,
    JsonOption,
    WarehouseOption,
    did_you_mean,
    print_json,
)
from pipelines.settings import settings
from pipelines.tools import tool_app
from warehouse.pool import one_thread
from wheelset_assets.quality import ConfigError, WheelsetError

INTERRUPTED = 130
"""Exit code after Ctrl-C, by the shells' convention."""
UsageProblem: Any = typer.BadParameter.__mro__[2]
"""Base of all errors in how a command was called, whichever module the option parser keeps it in."""

app = typer.Typer(
    name="wheelset",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="Optical metrology of railway wheelsets: scan bundles in, measurements with uncertainty and provenance out.\n\n"
    "Start with `wheelset demo`. Exit codes: 0 all well; 1 a bug or a broken warehouse; 2 wrong usage, configuration or inbox; "
    "3 ran to its end, but some scans were refused or failed in this run.",
)
app.add_typer(tool_app, name="tool")
app.add_typer(experiment_app, name="experiment")


def main() -> None:
    """Entry point: errors for people become one message and an exit code; bugs keep their traceback and exit with 1."""
    one_thread()  # before numpy is loaded: sums must not depend on how many cores there are
    try:
        code = app(standalone_mode=False, prog_name="wheelset")
        sys.stdout.flush()
    except ConfigError as error:
        _complain(str(error))
        code = 2
    except WheelsetError as error:
        _complain(str(error))
        code = 1
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except UsageProblem as error:
        error.show()
        code = 2
    except (SystemExit, BrokenPipeError) as leave:
        if not isinstance(leave, BrokenPipeError) and not isinstance(leave.__context__, BrokenPipeError):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the reader has seen enough; nothing is left to be said
        code = 0
    if code == INTERRUPTED:
        _complain("interrupted; what was finished is kept, and the next run goes on from there")
    sys.exit(code if isinstance(code, int) else 0)


def _complain(message: str) -> None:
    print(f"wheelset: {message}", file=sys.stderr)


@app.command()
def run(
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would be done and why, and do nothing")] = False,
    scan: Annotated[
        list[str] | None, typer.Option("--scan", help="Only this scan (and the reference it needs); repeatable")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=0,
            help="Worker processes; 0 computes in this process [env: WHEELSET_WORKERS; default: the cores, at most 8]",
            show_default=False,
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            "--cluster",
            metavar="tcp://HOST:PORT",
            help="Dask scheduler whose workers compute instead; docs/scale.md [env: WHEELSET_CLUSTER]",
            show_default=False,
        ),
    ] = None,
    log_json: Annotated[
        Path | None,
        typer.Option(
            "--log-json", metavar="FILE", help="Append what happens as JSON lines; WHEELSET_LOG=json for standard error"
        ),
    ] = None,
    until: Annotated[
        str | None,
        typer.Option("--until", metavar="HH:MM", help="Stop cleanly at this local time; the next run goes on"),
    ] = None,
    retry_failed: Annotated[
        bool,
        typer.Option("--retry-failed", help="Try refused and failed scans again though nothing of them has changed"),
    ] = False,
    task_seconds: Annotated[
        float | None,
        typer.Option(
            "--task-seconds",
            help="A stage of a scan that takes longer is killed, and the scan has failed; 0: no limit [env: WHEELSET_TASK_SECONDS; default: 3600]",
            show_default=False,
        ),
    ] = None,
    memory_gb: Annotated[
        float | None,
        typer.Option(
            "--memory-gb",
            help="Memory of all workers together; fewer workers if it is small [env: WHEELSET_MEMORY_GB; default: no limit]",
            show_default=False,
        ),
    ] = None,
    disk_floor_gb: Annotated[
        float | None,
        typer.Option(
            "--disk-floor-gb",
            help="Stop when less is free where the warehouse lies [env: WHEELSET_DISK_FLOOR_GB; default: 1]",
            show_default=False,
        ),
    ] = None,
    notify: Annotated[
        str | None,
        typer.Option(
            "--notify",
            metavar="COMMAND",
            help="Command that reads the summary, JSON, on its standard input [env: WHEELSET_NOTIFY]",
            show_default=False,
        ),
    ] = None,
) -> int:
    """Process what is new or stale in the inbox, and nothing else.

    Ends with a table: measured, refused, failed, unchanged. A scan that failed gets a recording (`wheelset replay`).
    """
    limits = {"task_seconds": task_seconds, "memory_gb": memory_gb, "disk_floor_gb": disk_floor_gb}
    s = settings(inbox, warehouse, config, workers, cluster, limits, notify)
    only = frozenset(scan or [])
    if only:
        _check_scans(s.inbox, only)
    end = _moment(until)
    if dry_run:
        return _status(s, as_json, only)
    from pipelines import logs
    from pipelines.progress import Bars
    from pipelines.runner import run as run_night

    logs.configure(log_json)
    with Bars(quiet=logs.to_standard_error() or (as_json and not sys.stderr.isatty())) as bars:
        summary = run_night(s, only=only, until=end, progress=bars, retry_failed=retry_failed)
    if as_json:
        print_json(summary.as_json())
    else:
        from pipelines.show import show_summary

        show_summary(summary, s.warehouse)
    return 3 if summary.refused or summary.failed else 0


def _check_scans(inbox: Path, wanted: frozenset[str]) -> None:
    from warehouse.inbox import Inbox

    known = {entry.identifier for entry in Inbox(inbox).scans()}
    if missing := sorted(wanted - known):
        raise ConfigError(f"--scan {missing[0]}: no such scan in {inbox / 'scans'}{did_you_mean(missing[0], known)}")


def _moment(text: str | None) -> datetime | None:
    if text is None:
        return None
    try:
        clock = datetime.strptime(text, "%H:%M").time()
    except ValueError as error:
        raise ConfigError(f"--until {text!r}: expected a local time such as 05:30") from error
    now = datetime.now()
    moment = datetime.combine(now, clock)
    # The clock on the wall counts: between now and then it may be put forward or back.
    return (moment if moment > now else moment + timedelta(days=1)).astimezone()


@app.command()
def status(
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """What is new or stale and why, how many scans, and how long the next run may take."""
    return _status(settings(inbox, warehouse, config), as_json, frozenset())


def _status(s: Any, as_json: bool, only: frozenset[str]) -> int:
    from warehouse.planner import plan

    found = plan(s.warehouse, s.inbox, s.config, only)
    if as_json:
        print_json(found.as_json())
    else:
        from pipelines.show import show_plan

        show_plan(found)
    return 0


@app.command()
def simulate(
    out: Annotated[Path, typer.Option("--out", help="Folder of the inbox to write; its truth is written beside it")],
    wheelsets: Annotated[int, typer.Option(min=1, help="Wheelsets")] = 2,
    days: Annotated[int, typer.Option(min=1, help="Days, each with a reference scan first")] = 1,
    repeats: Annotated[int, typer.Option(min=1, help="Scans of each wheelset on each day")] = 2,
    seed: Annotated[int, typer.Option(help="The same seed writes the same bytes")] = 0,
    images: Annotated[
        bool, typer.Option("--images", help="Deliver raw camera frames instead of stripe centres")
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", help="Spoil one further scan in this way; repeatable; `--fault list` names them"),
    ] = None,
    rig: Annotated[str, typer.Option(help="Preset of the rig: bench, compact or wide")] = "bench",
    profile: Annotated[
        list[str] | None,
        typer.Option(help="Nominal profile (S1002, LMA, CONE20, CONE40); repeatable, cycled over the wheelsets"),
    ] = None,
    frames: Annotated[int, typer.Option(min=8, help="Frames a turn")] = 120,
    rows: Annotated[int, typer.Option(min=128, help="Image rows")] = 1024,
    first_day: Annotated[str, typer.Option(metavar="YYYY-MM-DD", help="First day")] = "2025-04-05",
    span_days: Annotated[
        int | None, typer.Option(min=1, help="Spread the days over this many (150: the paper's five months)")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Simulate a measuring campaign: rig, calibration, master wheelset, scans with noise, reviews, and the truth apart."""
    from wheelset_assets.simulation import FAULTS, PRESETS, SimulationPlan
    from wheelset_assets.simulation import simulate as write_campaign

    if fault and "list" in fault:
        if as_json:
            print_json({kind: what.what for kind, what in sorted(FAULTS.items())})
            return 0
        for kind, what in sorted(FAULTS.items()):
            print(f"{kind:20} {what.what}")
        return 0
    if rig not in PRESETS:
        raise ConfigError(f"--rig {rig!r}: expected one of {', '.join(sorted(PRESETS))}")
    if unknown := sorted(set(fault or []) - set(FAULTS)):
        raise ConfigError(f"--fault {unknown[0]!r}: expected one of {', '.join(sorted(FAULTS))}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"--out {out}: not an empty folder; name a new one")
    try:
        start = date.fromisoformat(first_day)
    except ValueError as error:
        raise ConfigError(f"--first-day {first_day!r}: expected YYYY-MM-DD") from error
    from pipelines.progress import Bars

    with Bars(quiet=as_json and not sys.stderr.isatty()) as bars:
        try:
            made = write_campaign(
                SimulationPlan(
                    out=out,
                    wheelsets=wheelsets,
                    days=days,
                    repeats=repeats,
                    seed=seed,
                    images=images,
                    faults=tuple(fault or ()),
                    rig=rig,
                    profile=tuple(profile or ("S1002",)),
                    frames=frames,
                    rows=rows,
                    first_day=start,
                    span_days=span_days,
                ),
                lambda done, total, what: bars("simulate", what, done, total),
            )
        except ValueError as error:
            raise ConfigError(f"simulate: {error}") from error
    facts = {"inbox": str(made.inbox), "scans": made.n_scans, "truth": str(made.truth_path), "faults": made.faults}
    if as_json:
        print_json(facts)
    else:
        print(f"{made.n_scans} scans in {made.inbox}; the truth in {made.truth_path}")
    return 0


questions.add_to(app)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for the demonstration")] = Path("demo"),
    as_json: JsonOption = False,
) -> int:
    """The newcomer's tour: simulate a small campaign, process it, print the accuracy report, say where everything lies."""
    from pipelines.demo import tour

    return tour(out, as_json)


upkeep.add_to(app)
