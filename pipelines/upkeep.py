"""Commands that look after a warehouse: verify, gc, summary."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.options import ConfigOption, InboxOption, JsonOption, WarehouseOption, print_json
from pipelines.settings import settings
from wheelset_assets.quality import ConfigError


def add_to(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(verify)
    app.command()(gc)
    app.command()(summary)


def check_warehouse(root: Path) -> None:
    """ConfigError if there is no warehouse."""
    if not (root / "_ledger").is_dir():
        raise ConfigError(
            f"{root}: no warehouse there; run `wheelset run` first, or name it by --warehouse or WHEELSET_WAREHOUSE"
        )


def verify(
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """Check every visible file against its recorded version, every row against its record, and the catalog.

    With --inbox, the bundles are hashed again too.
    """
    from pipelines.show import show_verification
    from warehouse.check import verify as check

    s = settings(inbox, warehouse, config)
    check_warehouse(s.warehouse)
    found = check(s.warehouse, None if inbox is None else s.inbox)
    if as_json:
        print_json(found)
    else:
        show_verification(found)
    return 1 if found["broken"] else 0


def gc(
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
    keep_days: Annotated[float, typer.Option("--keep-days", help="Keep what was superseded within so many days")] = 90,
    keep_versions: Annotated[
        int, typer.Option("--keep-versions", help="Keep so many superseded versions of each output, however old")
    ] = 1,
    delete: Annotated[
        bool, typer.Option("--delete", "--yes", help="Remove it; without this, only show what would go")
    ] = False,
) -> int:
    """Retention: remove superseded versions, files and recordings that nothing names, and old Dagster runs; dry by default.

    Current files are never touched. `measurements_as_of` reaches as far back as superseded versions are kept.
    """
    from pipelines.collect import collect

    s = settings(inbox, warehouse, config)
    check_warehouse(s.warehouse)
    found = collect(s.warehouse, keep_days, keep_versions, delete)
    if as_json:
        print_json(found.as_json())
    else:
        from pipelines.show import show_collected

        show_collected(found)
    return 0


def summary(
    inbox: InboxOption = None,
    warehouse: WarehouseOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
    run: Annotated[str | None, typer.Option("--run", help="Run (the beginning of its id) instead of the last")] = None,
    format_: Annotated[str, typer.Option("--format", help="table, json or html")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="File to write instead of standard output")] = None,
) -> int:
    """What the last night did: measured, refused and failed scans, the reasons, and where the time went."""
    import json

    from pipelines.show import show_night
    from warehouse import morning

    if format_ not in ("table", "json", "html"):
        raise ConfigError(f"--format {format_!r}: expected table, json or html")
    s = settings(inbox, warehouse, config)
    check_warehouse(s.warehouse)
    found = morning.load(s.warehouse, run)
    format_ = "json" if as_json else format_
    if format_ == "table":
        show_night(found, out)
        return 0
    text = morning.page(found) if format_ == "html" else json.dumps(found, indent=2) + "\n"
    if out is None:
        print(text, end="")
    else:
        out.write_text(text, encoding="utf-8")
    return 0
