"""What the commands print for people, by rich. Numbers are made elsewhere."""

from __future__ import annotations

import contextlib
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.tree import Tree

from pipelines.settings import Settings
from warehouse.collect import Collected
from warehouse.planner import Plan
from warehouse.summary import Summary
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    from warehouse.render import Format


def _console() -> Console:
    return Console(width=None if sys.stdout.isatty() else 160, highlight=False)


def _table(*columns: str, right: tuple[str, ...] = ()) -> Table:
    table = Table(show_edge=False, header_style="bold")
    for name in columns:
        table.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return table


def show_summary(summary: Summary, warehouse: Path) -> None:
    """The table that ends a run, and what went wrong in it."""
    console = _console()
    names = ("measured", "refused", "failed", "unchanged", *(("pending",) if summary.pending else ()))
    table = _table(*names, "points", "seconds", right=(*names, "points", "seconds"))
    table.add_row(*(str(getattr(summary, n)) for n in names), f"{summary.points:,}", f"{summary.seconds:.1f}")
    console.print(table)
    if summary.troubles:
        troubles = _table("scan", "state", "stage", "reason", "recording")
        for t in summary.troubles[:50]:
            troubles.add_row(
                t["scan_id"],
                t["state"],
                t["stage"] or "",
                ": ".join(part for part in (t["reason"], t.get("details")) if part),
                t.get("recording") or "",
            )
        console.print(troubles)
        if len(summary.troubles) > 50:
            console.print(
                f"… {len(summary.troubles) - 50} more: wheelset sql \"SELECT * FROM scan_status WHERE state IN ('refused', 'failed')\""
            )
    for warning in summary.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)
    console.print(f"warehouse: {warehouse}", markup=False)


def show_night(found: dict[str, Any], out: Path | None) -> None:
    """The summary of a night, as its document has it."""
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(out.open("w", encoding="utf-8")) if out else None
        console = Console(width=None if file is None and sys.stdout.isatty() else 160, highlight=False, file=file)
        console.print(
            f"run {found['run_id']}, {found['started_at'][:19]} to {found['ended_at'][:19]} UTC: {found['outcome']}"
        )
        if found["error"]:
            console.print(found["error"], style="red", markup=False)
        names = ("measured", "refused", "failed", "pending", "unchanged")
        table = _table(*names, "points", "seconds", right=(*names, "points", "seconds"))
        table.add_row(*(str(found[n]) for n in names), f"{found['points']:,}", f"{found['seconds']:.1f}")
        console.print(table)
        if found["reasons"]:
            table = _table("scans", "state", "stage", "reason", "among them", right=("scans",))
            for row in found["reasons"]:
                table.add_row(
                    str(row["n_scans"]), row["state"], row["stage"], escape(row["reason"]), ", ".join(row["scans"])
                )
            console.print(table)
        for warning in found["warnings"]:
            console.print(f"warning: {warning}", style="yellow", markup=False)
        table = _table(
            "stage", "computed", "seconds", "of it computing", right=("computed", "seconds", "of it computing")
        )
        for row in found["stages"]:
            table.add_row(row["stage"], str(row["computed"]), f"{row['seconds']:.1f}", f"{row['compute_seconds']:.1f}")
        if found["stages"]:
            console.print(table)


def show_plan(plan: Plan) -> None:
    """What a run would do."""
    console = _console()
    if plan.idle:
        console.print(f"nothing to do: {plan.n_scans} scans in the inbox, all up to date")
        return
    if plan.calibrations:
        console.print(f"calibrations: {', '.join(plan.calibrations)}")
    if plan.reviews_changed:
        console.print("reviews: files in cmm/ are new or changed")
    table = _table("day", "new", "stale", "from stage", "why", right=("new", "stale"))
    for day in plan.days:
        if day.n_scans:
            stages = ", ".join(f"{stage} ({len(units)})" for stage, units in day.stale.items())
            why = "; ".join(f"{reason} ({n})" for reason, n in day.why.most_common(4))
            table.add_row(day.day, str(len(day.new)), str(sum(len(u) for u in day.stale.values())), stages, why)
    console.print(table)
    if plan.estimated_seconds:
        console.print(f"computation: about {plan.estimated_seconds:.0f} s on one core")


def show_collected(found: Collected) -> None:
    """What retention lets go."""
    console = _console()
    table = _table("what", "files", "MB", right=("files", "MB"))
    for kind, entry in sorted(found.by_table.items()):
        table.add_row(kind, str(entry["files"]), f"{entry['bytes'] / 1e6:.1f}")
    if found.files:
        console.print(table)
    verb = "removed" if found.deleted else "would remove"
    runs = f", {found.runs} runs of Dagster" if found.runs else ""
    console.print(f"{verb} {found.files} files, {found.bytes / 1e6:.1f} MB, {found.versions} superseded versions{runs}")
    if not found.deleted and (found.files or found.versions or found.runs):
        console.print("nothing was changed; add --delete to do it")


def show_lineage(tree: dict[str, Any]) -> None:
    """A lineage tree."""

    def label(node: dict[str, Any]) -> str:
        text = f"{node['name']}  {node.get('version') or ''}"
        if node.get("kind") == "measurement":
            value = (
                node["reason"]
                if node["value"] is None
                else f"{node['value']:.4f} {node['unit']} ± {node['expanded_uncertainty']:.4f}"
            )
            return f"{node['name']}  {value}"
        if node.get("kind") == "stage":
            commit = (node["git_commit"] or "no commit")[:12]
            text += f"  code {node['code_version']}, configuration {node['config_fingerprint']}, commit {commit}"
        if node.get("reason"):
            text += f"  {node['state']}: {node['reason']}"
        return text

    def grow(branch: Tree, node: dict[str, Any]) -> None:
        for child in node["inputs"]:
            grow(branch.add(label(child)), child)

    root = Tree(label(tree))
    grow(root, tree)
    Console(width=None if sys.stdout.isatty() else 240, highlight=False, markup=False, soft_wrap=True).print(root)


def show_budget(rows: list[dict[str, Any]]) -> None:
    """An uncertainty budget for each side."""
    console = _console()
    for side in dict.fromkeys(row["side"] for row in rows):
        own = [row for row in rows if row["side"] == side]
        table = _table(
            "source",
            "standard uncertainty",
            "sensitivity",
            "contribution",
            "share",
            right=("standard uncertainty", "sensitivity", "contribution", "share"),
        )
        for row in own:
            table.add_row(
                row["source"],
                f"{row['standard_uncertainty']:.4g} {row['source_unit']}",
                f"{row['sensitivity']:.4g}",
                f"{row['contribution'] * 1e3:.3f} µm",
                f"{100 * row['share']:.1f} %",
            )
        total = sum(row["contribution"] ** 2 for row in own) ** 0.5
        console.print(
            f"{own[0]['scan_id']} {own[0]['quantity']} {side}: u = {total * 1e3:.2f} µm, U = {2e3 * total:.2f} µm (k = 2)"
        )
        console.print(table)


def show_monte_carlo(rows: list[dict[str, Any]]) -> None:
    """Intervals of the draws beside value ± U, and whether they agree."""
    if not rows:
        return
    console = _console()
    table = _table("side", "u (µm)", "value ± U", "95.45 % of the draws", "tolerance (µm)", "agree")
    for row in rows:
        low, high = row["gum_interval"]
        drawn_low, drawn_high = row["interval"]
        table.add_row(
            row["side"],
            f"{row['standard_uncertainty'] * 1e3:.3f}",
            f"{low:.5f} to {high:.5f}",
            f"{drawn_low:.5f} to {drawn_high:.5f}",
            f"{row['tolerance'] * 1e3:g}",
            "yes" if row["agrees"] else "no: the distribution is not normal; trust the draws",
        )
    console.print(f"{rows[0]['draws']:,} draws (JCGM 101):")
    console.print(table)


def show_description(document: dict[str, Any]) -> None:
    """A piece of the data dictionary."""
    console = _console()
    for name, value in document.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            table = _table(*value[0])
            for row in value:
                table.add_row(*(", ".join(map(str, v)) if isinstance(v, list) else str(v) for v in row.values()))
            console.print(f"\n{name}", style="bold")
            console.print(table)
        else:
            console.print(f"{name}: {', '.join(map(str, value)) if isinstance(value, list) else value}", markup=False)


def show_verification(found: dict[str, Any]) -> None:
    """What `verify` found."""
    console = _console()
    console.print(
        f"{found['files']} files checked, {len(found['broken'])} broken, {found['unnamed']} not named by the ledger"
    )
    for line in found["broken"]:
        console.print(f"broken: {line}", markup=False)


def write_report(
    s: Settings,
    name: str,
    format_: str,
    out: Path | None,
    pairs: Path | None,
    parameters: dict[str, str | None] | None = None,
    block: str | None = None,
    moment: datetime | None = None,
) -> int:
    """Compute a report, of the measurements of a moment if one is given, and write it in a format; `all` writes a site."""
    from pipelines.ask import open_read_only
    from warehouse import report

    parameters = dict(parameters or {}) | ({} if moment is None else {"as_of": moment.isoformat()})

    if pairs is not None:
        if name != "accuracy":
            raise ConfigError(f"--pairs: goes with report accuracy; found {name!r}")
        made = report.accuracy_from_pairs(pairs)
    elif name == "all":
        return _write_site(s, format_, out, parameters, moment)
    else:
        if name not in report.REPORTS:
            raise ConfigError(f"report {name!r}: expected one of {', '.join(report.REPORTS)}, or all")
        connection = open_read_only(s.warehouse, moment)
        _check_known(connection, parameters)
        made = report.build(connection, name, parameters)
    return _deliver(made, format_, out, block)


def write_diff(s: Settings, version_a: str, version_b: str, format_: str, out: Path | None) -> int:
    """What changed between two versions, in a format."""
    from pipelines.ask import open_read_only
    from warehouse.report import diff

    return _deliver(diff(open_read_only(s.warehouse), version_a, version_b), format_, out, None)


def _deliver(made: Any, format_: str, out: Path | None, block: str | None) -> int:
    from warehouse.render import render

    if format_ in ("xlsx", "parquet") and out is None and sys.stdout.isatty():
        raise ConfigError(f"--format {format_}: name a file by --out, or redirect standard output")
    rendered = render(made, cast("Format", format_), out, block=block)
    if out is None:
        data = rendered if isinstance(rendered, bytes) else rendered.encode()
        sys.stdout.buffer.write(data if data.endswith(b"\n") else data + b"\n")
        sys.stdout.buffer.flush()
    else:
        print(out)
    return 0


def _check_known(connection: Any, parameters: dict[str, str | None]) -> None:
    """A name that the warehouse does not know is an error of usage, with those that are near."""
    import difflib

    options = {"wheelset_id": "--wheelset", "rig_id": "--rig", "scan_id": "--scan"}
    for column, option in options.items():
        if (given := parameters.get(column)) is not None:
            found = connection.execute(f"SELECT DISTINCT {column} FROM scan_status WHERE {column} IS NOT NULL")
            known = sorted(name for (name,) in found.fetchall())
            if given not in known:
                near = difflib.get_close_matches(given, known, n=3, cutoff=0.4) or known[:5]
                raise ConfigError(
                    f"{option} {given!r}: not in this warehouse; did you mean {', '.join(near) or 'none'}?"
                )


def _write_site(
    s: Settings, format_: str, out: Path | None, parameters: dict[str, str | None], moment: datetime | None
) -> int:
    """The reports as a folder of pages, or of files in another format."""
    from pipelines.ask import open_read_only
    from pipelines.progress import Bars
    from warehouse import report
    from warehouse.render import render
    from warehouse.render_site import site

    if out is None:
        raise ConfigError("report all: name the folder to write by --out")
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: expected a folder")
    connection = open_read_only(s.warehouse, moment)
    _check_known(connection, parameters)
    if format_ not in ("table", "html"):
        for name in report.REPORTS:
            made = report.build(connection, name, parameters)
            target = out / name if format_ in ("csv", "parquet") else out / f"{name}.{format_}"
            render(made, cast("Format", format_), target)
        print(out)
        return 0
    with Bars() as bars:
        written = site(connection, out, parameters, lambda done, total, what: bars("report", what, done, total))
    print(written[0])
    return 0
