"""The command line `wheelset`: options, progress, exit codes. The work is done elsewhere; heavy imports wait until needed."""

from __future__ import annotations

import os
import sys
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.experiments import experiment_app
from pipelines.options import (
    ConfigOption,
    InboxOption,
    JsonOption,
    ScanArgument,
    WarehouseOption,
    did_you_mean,
    print_json,
)
from pipelines.settings import settings
from pipelines.tools import tool_app
from pipelines.upkeep import add_to, check_warehouse
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
        bool, typer.Option("--retry-failed", help="Try failed scans again though nothing of them has changed")
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
    now = datetime.now().astimezone()
    moment = now.replace(hour=clock.hour, minute=clock.minute, second=0, microsecond=0)
    return moment if moment > now else moment + timedelta(days=1)


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


@app.command()
def report(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="fleet (which wheelsets must be turned), wheelset (one of them), accuracy, stability, calibration, msa, or all",
        ),
    ],
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
    format_: Annotated[str, typer.Option("--format", help="table, json, md, html, csv, xlsx or parquet")] = "table",
    out: Annotated[
        Path | None,
        typer.Option("--out", help="File (or folder for csv, parquet, all) to write instead of standard output"),
    ] = None,
    wheelset: Annotated[str | None, typer.Option("--wheelset", help="Only this wheelset")] = None,
    rig: Annotated[str | None, typer.Option("--rig", help="Only this rig")] = None,
    scan: Annotated[str | None, typer.Option("--scan", help="Scan that the page of a wheelset is about")] = None,
    since: Annotated[str | None, typer.Option("--since", metavar="YYYY-MM-DD", help="From this day on")] = None,
    until: Annotated[
        str | None, typer.Option("--until", metavar="YYYY-MM-DD", help="Up to this day; the fleet as of it")
    ] = None,
    block: Annotated[
        str | None,
        typer.Option("--block", help="Table of the report that csv or parquet holds, instead of its main one"),
    ] = None,
    as_of: Annotated[
        str | None,
        typer.Option(
            "--as-of",
            metavar="MOMENT",
            help="With the measurements as they were then, before later reprocessing: a day (its end) or an ISO time",
        ),
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(
            "--pairs",
            help="CSV with quantity, side, measured_mm, reference_mm, expanded_uncertainty_mm: the same statistics for values from elsewhere (accuracy)",
        ),
    ] = None,
) -> int:
    """Reports: every number is made by a SQL file that the report names.

    `report fleet`: which wheelsets must be turned this week, and how sure that is. `report wheelset --wheelset ID`: the
    page for the lathe. `report all --out FOLDER`: everything as a small site.
    """
    from pipelines.show import write_report

    given = {"wheelset_id": wheelset, "rig_id": rig, "scan_id": scan, "since": since, "until": until}
    s = settings(inbox, warehouse, config)
    return write_report(s, name, "json" if as_json else format_, out, pairs, given, block, _past_moment(as_of))


def _past_moment(text: str | None) -> datetime | None:
    """A moment in local time unless it says its own; a day alone means its end."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(
            f"--as-of {text!r}: expected a day or a time, such as 2026-03-01 or 2026-03-01T06:00+01:00"
        ) from error
    if len(text) == len("2026-03-01"):
        moment += timedelta(days=1, microseconds=-1)
    return moment.astimezone()


@app.command()
def export(
    what: Annotated[str, typer.Argument(metavar="WHAT", help="cloud, profile or measurements")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="File; its suffix is the format: cloud .ply .pcd .xyz .e57; profile .whl (MiniProf) .prw (SIMPACK) .csv; measurements .dfq (Q-DAS) .csv .xlsx",
        ),
    ],
    scan: Annotated[str | None, typer.Option("--scan", help="Scan; for measurements: only this one")] = None,
    cloud: Annotated[
        str, typer.Option("--cloud", help="triangulated_clouds, filtered_clouds or fused_clouds")
    ] = "filtered_clouds",
    sensor: Annotated[str | None, typer.Option("--sensor", help="Sensor (station, for fused_clouds)")] = None,
    side: Annotated[str | None, typer.Option("--side", help="left or right, for a profile")] = None,
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """Write stored clouds, wheel profiles and measurements in formats that others read."""
    from pipelines.export import export as write

    n = write(settings(inbox, warehouse, config).warehouse, what, scan, out, cloud, sensor, side)
    if as_json:
        print_json({"out": str(out), "n": n})
    else:
        print(out)
    return 0


@app.command()
def diff(
    version_a: Annotated[
        str,
        typer.Argument(metavar="VERSION_A", help="Code version, configuration fingerprint or commit (its beginning)"),
    ],
    version_b: Annotated[
        str, typer.Argument(metavar="VERSION_B", help="The other; `current` for what holds now")
    ] = "current",
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
    format_: Annotated[str, typer.Option("--format", help="table, json, md, html, csv, xlsx or parquet")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="File to write instead of standard output")] = None,
) -> int:
    """Two code versions or configurations over the same scans: which values changed, and by how much against U.

    `wheelset sql "FROM diff_versions"` lists the versions that the warehouse holds values of.
    """
    from pipelines.show import write_diff

    s = settings(inbox, warehouse, config)
    return write_diff(s, version_a, version_b, "json" if as_json else format_, out)


@app.command()
def sql(
    query: Annotated[
        str | None, typer.Argument(metavar="QUERY", help="SQL over the views; `wheelset describe` lists them")
    ] = None,
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
    file: Annotated[Path | None, typer.Option("--file", help="Read the query from a file")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Filter of the reports' views; repeatable")
    ] = None,
    format_: Annotated[str, typer.Option("--format", help="table, csv, json or parquet")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="Write there instead of standard output")] = None,
) -> int:
    """Ask the warehouse: one read-only query; without one, on a terminal, a shell with history and completion.

    A query may also come through a pipe. `.tables` and `.schema VIEW` tell what there is.
    `--set since=2025-04-01` narrows the reports' views (since, until, rig_id, wheelset_id).
    """
    from pipelines.ask import ask

    if query is not None and file is not None:
        raise ConfigError("sql: expected either a query or --file FILE, not both")
    if query is None and file is None:
        if sys.stdin.isatty():
            from pipelines.shell import interactive

            return interactive(settings(inbox, warehouse, config).warehouse)
        query = sys.stdin.read()
        if not query.strip():
            raise ConfigError("sql: no query; give one as an argument, by --file FILE, or through a pipe")
    if file is not None:
        try:
            query = file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"--file {file}: cannot be read: {error}") from error
    assert query is not None
    root = settings(inbox, warehouse, config).warehouse
    if query.lstrip().startswith("."):
        from pipelines.shell import Shell

        Shell(root).command(query.split())
        return 0
    return ask(root, query, "json" if as_json else format_, out, _variables(set_ or []))


def _variables(given: list[str]) -> dict[str, str]:
    from pipelines.shell import VARIABLES

    pairs = dict(text.partition("=")[::2] for text in given)
    if unknown := sorted(set(pairs) - set(VARIABLES)):
        raise ConfigError(f"--set {unknown[0]!r}: expected NAME=VALUE with one of {', '.join(VARIABLES)}")
    return pairs


@app.command()
def replay(
    scan: ScanArgument,
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Recording to write [default: recordings/SCAN.rrd in the warehouse]", show_default=False
        ),
    ] = None,
    open_: Annotated[bool, typer.Option("--open", help="Open it in the rerun viewer")] = False,
) -> int:
    """Rebuild a scan's rerun recording from the stored tables."""
    from pipelines.replay import open_recording, write_recording

    s = settings(inbox, warehouse, config)
    check_warehouse(s.warehouse)
    path = write_recording(
        s.warehouse, scan, out or s.warehouse / "recordings" / f"{scan}.rrd", s.inbox if s.inbox.is_dir() else None
    )
    if as_json:
        print_json({"scan_id": scan, "recording": str(path)})
    else:
        print(path)
    if open_:
        open_recording(path)
    return 0


@app.command()
def lineage(
    scan: Annotated[str | None, typer.Argument(metavar="SCAN", help="Identifier of a scan")] = None,
    measurement: Annotated[
        str | None,
        typer.Option("--measurement", metavar="SCAN/QUANTITY/SIDE", help="One value instead of all of a scan"),
    ] = None,
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """From a scan's results down to the sha256 of every raw file: what was made from what, by which code."""
    from pipelines.trace import trace

    s = settings(inbox, warehouse, config)
    check_warehouse(s.warehouse)
    if (scan is None) == (measurement is None):
        raise ConfigError("lineage: expected either SCAN or --measurement SCAN/QUANTITY/SIDE")
    tree = trace(s.warehouse, scan, measurement)
    if as_json:
        print_json(tree)
    else:
        from pipelines.show import show_lineage

        show_lineage(tree)
    return 0


@app.command()
def budget(
    scan: ScanArgument,
    quantity: Annotated[str, typer.Option("--quantity", help="Quantity, such as wheel_diameter")],
    side: Annotated[
        str | None, typer.Option("--side", help="left, right or both [default: all that there are]", show_default=False)
    ] = None,
    monte_carlo: Annotated[
        int | None,
        typer.Option(
            "--monte-carlo",
            metavar="DRAWS",
            help="Check U by this many draws of all sources (JCGM 101), such as 1000000; JSON: {budget, monte_carlo}",
        ),
    ] = None,
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """Uncertainty budget of a value: source, standard uncertainty, sensitivity, contribution, share."""
    from pipelines.ask import budget_rows, monte_carlo_rows
    from pipelines.show import show_budget, show_monte_carlo

    root = settings(inbox, warehouse, config).warehouse
    rows = budget_rows(root, scan, quantity, side)
    drawn = monte_carlo_rows(root, rows, monte_carlo) if monte_carlo is not None else None
    if as_json:
        print_json(rows if drawn is None else {"budget": rows, "monte_carlo": drawn})
    else:
        show_budget(rows)
        show_monte_carlo(drawn or [])
    return 0


@app.command()
def describe(
    what: Annotated[
        str | None,
        typer.Argument(metavar="[TOPIC]", help="tables, quantities, config, flags, stages, or a table's name"),
    ] = None,
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """Tables, columns with units, quantities, quality flags, and every knob with its default."""
    from pipelines.describe import describe as tell

    document = tell(what, settings(inbox, warehouse, config).config)
    if as_json:
        print_json(document)
    else:
        from pipelines.show import show_description

        show_description(document)
    return 0


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for the demonstration")] = Path("demo"),
    as_json: JsonOption = False,
) -> int:
    """The newcomer's tour: simulate a small campaign, process it, print the accuracy report, say where everything lies."""
    from pipelines.demo import tour

    return tour(out, as_json)


add_to(app)
