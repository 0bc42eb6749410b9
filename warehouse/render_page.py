"""The page: one HTML file that needs nothing else. It fills the template; words and numbers come from the report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from warehouse.render import is_numeric, lead, omission, parameter_lines, shown_rows
from warehouse.render_cells import LONG, label, text
from warehouse.render_figures import draw

if TYPE_CHECKING:
    from jinja2 import Environment

    from warehouse.report import Block, Report

VERDICTS = ("agrees", "unbiased", "biased", "disagrees", "conform", "not_conform", "undecided")


def page(report: Report) -> str:
    """The report as one self-contained HTML document."""
    from markupsafe import Markup

    templates = environment()
    figures: dict[str, list[dict[str, Any]]] = {}
    for spec in report.spec.figures:
        drawing = draw(report, spec)
        if drawing.groups:
            figures.setdefault(spec.after, []).append({"spec": spec, "drawing": drawing})
    return (
        templates.get_template("report.html.j2").render(
            report=report,
            parameters=parameter_lines(report),
            lead=lead(report),
            blocks=[tables_of(block) | {"figures": figures.get(name, [])} for name, block in report.blocks.items()],
            trusted=Markup,  # for the figures alone: drawn by this package, free of text from data
        )
        + "\n"
    )


def environment() -> Environment:
    """Templates, which escape what they are given."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("warehouse"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def tables_of(block: Block) -> dict[str, Any]:
    """A block as the templates want it: heads, cells with their kinds, and what was left out."""
    columns, rows, left_out = shown_rows(block)
    numeric = {name: is_numeric(block, name) for name in columns}
    return {
        "spec": block.spec,
        "query": block.query,
        "heads": [
            {"label": label(name), "meaning": block.query.meanings.get(name, ""), "numeric": numeric[name]}
            for name in columns
        ],
        "rows": [[_cell(name, row[name], numeric[name]) for name in columns] for row in rows],
        "cut": len(rows) // 2 if left_out else None,
        "left_out": left_out,
        "note": omission(block, left_out),
    }


def _cell(name: str, value: Any, numeric: bool) -> dict[str, Any]:
    shown = text(name, value)
    if numeric:
        shown = shown.replace("-", "−")
    verdict = _verdict(name, value)
    kind = "number" if numeric else f"verdict {verdict}" if verdict else "long" if name in LONG else ""
    return {"text": shown, "kind": kind}


def _verdict(name: str, value: Any) -> str:
    """Class of a cell that judges; its words say the same, so that colour is never alone."""
    if name == "verdict" and value in VERDICTS:
        return str(value)
    if name == "action" and isinstance(value, str):
        ends = {
            "now": "now",
            "this week": "week",
            "at next visit": "next",
            "measure again": "next",
            "none": "none-to-do",
        }
        return next((kind for words, kind in ends.items() if value.endswith(words)), "")
    return ""
