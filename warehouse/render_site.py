"""All reports as a small site: a page each, a page for every wheelset, and an index that answers the first question."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warehouse.render import render
from warehouse.render_page import environment, tables_of

if TYPE_CHECKING:
    import duckdb

Progress = Callable[[int, int, str], None]


def site(
    connection: duckdb.DuckDBPyConnection,
    out: Path,
    parameters: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write every report and a page for each wheelset into a folder; the files written, the index first.

    Files of an earlier site with the same names are replaced, others left alone.
    """
    from warehouse.report import REPORTS, build

    given = dict(parameters or {})
    fleet = build(connection, "fleet", given)
    wheelsets = fleet.blocks["turning"].table.column("wheelset_id").to_pylist()
    names = [name for name in REPORTS if name != "wheelset"]
    total = len(names) + len(wheelsets)
    written, entries = [], []
    for done, name in enumerate(names):
        report = fleet if name == "fleet" else build(connection, name, given)
        path = out / f"{name}.html"
        render(report, "html", path)
        written.append(path)
        entries.append({"file": path.name, "title": report.title, "about": report.spec.about})
        if progress:
            progress(done + 1, total, name)
    links: dict[str, str] = {}
    for done, wheelset in enumerate(wheelsets, start=len(names)):
        path = out / f"wheelset-{_safe(wheelset, links.values())}.html"
        render(build(connection, "wheelset", given | {"wheelset_id": wheelset}), "html", path)
        links[wheelset] = path.name
        written.append(path)
        if progress:
            progress(done + 1, total, wheelset)
    index = out / "index.html"
    page = environment().get_template("index.html.j2")
    rows = fleet.blocks["turning"]
    index.write_text(
        page.render(entries=entries, links=links, turning=tables_of(rows), fleet=fleet) + "\n", encoding="utf-8"
    )
    return [index, *written]


def _safe(wheelset: str, taken: Any) -> str:
    """A file name for a wheelset: letters, digits, dots and dashes; numbered if two would be the same."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", wheelset)[:80] or "_"
    number, free = 1, name
    while f"wheelset-{free}.html" in taken:
        number += 1
        free = f"{name}-{number}"
    return free
