"""Commands that ask a warehouse and change nothing in it: reports, exports, SQL, replays, lineage, budgets."""

from __future__ import annotations

import sys
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer

from pipelines.options import (
    ConfigOption,
    InboxOption,
    JsonOption,
    ScanArgument,
    WarehouseOption,
    print_json,
)
from pipelines.settings import settings
from pipelines.upkeep import check_warehouse
from wheelset_assets.quality import ConfigError


def add_to(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    for command in (report, export, diff, sql, replay, lineage, budget, describe):
        app.command()(command)


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
