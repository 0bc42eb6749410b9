"""Options that several commands share, and the one way to print JSON."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from warehouse.place import place


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Words with the names that are near one that is not known; nothing if none is."""
    close = difflib.get_close_matches(name, sorted(known), n=3, cutoff=0.4)
    return f"; did you mean {', '.join(close)}?" if close else ""


InboxOption = Annotated[
    Path | None,
    typer.Option(
        "--inbox",
        metavar="DIR",
        parser=place,
        help="Folder or s3:// prefix with scan bundles [env: WHEELSET_INBOX; default: inbox]",
        show_default=False,
    ),
]
WarehouseOption = Annotated[
    Path | None,
    typer.Option(
        "--warehouse",
        metavar="DIR",
        parser=place,
        help="Folder or s3:// prefix of results [env: WHEELSET_WAREHOUSE; default: warehouse-data]",
        show_default=False,
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="TOML file over the defaults; `wheelset describe config` lists the keys [env: WHEELSET_CONFIG]",
        show_default=False,
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on standard output, nothing else there")]
ScanArgument = Annotated[str, typer.Argument(metavar="SCAN", help="Identifier of a scan")]


def print_json(document: Any) -> None:
    """One JSON document on standard output; not-a-number is a bug and raises."""
    print(json.dumps(document, indent=2, default=str, allow_nan=False))
