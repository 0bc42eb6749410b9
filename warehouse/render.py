"""Showing a computed report: JSON, Markdown, CSV and Parquet here; elsewhere HTML (`render_page`), text (`render_terminal`)
and Excel (`render_xlsx`).

Nothing is computed: what is shown is in the report's tables. The same report gives the same bytes.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq

from warehouse.render_cells import label, plain, text
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    from warehouse.report import Block, Report

Format = Literal["table", "json", "md", "html", "csv", "xlsx", "parquet"]


def render(
    report: Report, format: Format, out: Path | None = None, *, width: int | None = None, block: str | None = None
) -> str | bytes:
    """The report in one of the formats; also written to `out`, if given.

    CSV and Parquet hold one block: `block`, or the report's main one. Where `out` is a folder, or has no suffix, they
    become a folder with a file for every block instead, and the list of these files is returned.
    """
    if block is not None and block not in report.blocks:
        raise ConfigError(f"report {report.spec.name} has no block {block!r}; it has: {', '.join(report.blocks)}")
    if format in ("csv", "parquet"):
        write = csv_of if format == "csv" else _parquet
        if out is not None and block is None and (out.is_dir() or not out.suffix):
            return _folder(report, out, format, write)
        content = write(report.blocks[block or report.spec.main].table)
    elif format == "table":
        from warehouse.render_terminal import terminal

        content = terminal(report, width)
    elif format == "json":
        content = json.dumps(document(report), ensure_ascii=False, allow_nan=False, indent=1) + "\n"
    elif format == "md":
        content = _markdown(report)
    elif format == "html":
        from warehouse.render_page import page

        content = page(report)
    elif format == "xlsx":
        from warehouse.render_xlsx import workbook

        content = workbook(report)
    else:
        raise ConfigError(f"unknown format {format!r}; expected table, json, md, html, csv, xlsx or parquet")
    if out is not None:
        _write(out, content)
    return content


def document(report: Report) -> dict[str, Any]:
    """The report as one JSON document, of plain types."""
    return {
        "report": report.spec.name,
        "title": report.title,
        "parameters": dict(report.parameters),
        "notes": lead(report),
        "blocks": {
            name: {
                "title": block.spec.title,
                "sql": block.query.file,
                "columns": [{"name": c, "meaning": block.query.meanings.get(c, "")} for c in block.table.column_names],
                "rows": [{c: plain(v) for c, v in row.items()} for row in block.table.to_pylist()],
            }
            for name, block in report.blocks.items()
        },
    }


def lead(report: Report) -> list[str]:
    """What must be said before the numbers."""
    return ([report.spec.nothing] if report.is_empty else []) + list(report.notes)


def parameter_lines(report: Report) -> list[str]:
    """The parameters, one a line."""
    return [f"{name.replace('_', ' ')}: {value}" for name, value in report.parameters.items()]


def shown_rows(block: Block, limit: int | None = None) -> tuple[list[str], list[dict[str, Any]], int]:
    """Columns and rows that people see: of a long table the first and the last; and how many rows are left out."""
    columns = list(block.spec.shown or block.table.column_names)
    table, limit = block.table.select(columns), limit or block.spec.limit
    if table.num_rows <= limit:
        return columns, table.to_pylist(), 0
    half = limit // 2
    ends = pa.concat_tables([table.slice(0, half), table.slice(table.num_rows - half)])
    return columns, ends.to_pylist(), table.num_rows - 2 * half


def is_numeric(block: Block, column: str) -> bool:
    """Whether a column holds numbers, to be set to the right."""
    kind = block.table.schema.field(column).type
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))


def omission(block: Block, left_out: int) -> str:
    """The sentence on rows and columns that only the data formats hold; empty if none."""
    if left_out:
        return f"First and last rows; {left_out} rows between them are in the JSON, CSV, Excel and Parquet forms."
    if block.spec.shown and len(block.spec.shown) < block.table.num_columns and block.table.num_rows:
        return "More columns are in the JSON, CSV, Excel and Parquet forms."
    return ""


def _write(out: Path, content: str | bytes) -> None:
    """Whole or not at all: a reader never sees half a file."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        staged = out.with_name(f".{out.name}.{os.getpid()}")
        staged.write_bytes(content.encode() if isinstance(content, str) else content)
        staged.replace(out)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}") from None


def _folder(report: Report, out: Path, format: str, write: Callable[[pa.Table], str | bytes]) -> str:
    paths = []
    for name, block in report.blocks.items():
        path = out / f"{report.spec.name}_{name}.{format}"
        _write(path, write(block.table))
        paths.append(f"{path}\n")
    return "".join(paths)


def csv_of(table: pa.Table) -> str:
    """A table as CSV text, times in UTC."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(table.column_names)
    for row in table.to_pylist():
        writer.writerow(plain(value) for value in row.values())
    return buffer.getvalue()


def _parquet(table: pa.Table) -> bytes:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _markdown(report: Report) -> str:
    lines = [f"# {_escaped(report.title)}", "", report.spec.about, ""]
    lines += [f"- {_escaped(line)}" for line in parameter_lines(report)]
    lines += [""] * bool(report.parameters)
    lines += [part for note in lead(report) for part in (f"**{_escaped(note)}**", "")]
    for block in report.blocks.values():
        columns, rows, left_out = shown_rows(block)
        lines += [f"## {block.spec.title}", "", block.query.answers, ""]
        lines += [block.spec.says, ""] if block.spec.says else []
        if rows:
            lines.append("| " + " | ".join(_escaped(_head(c)) for c in columns) + " |")
            lines.append("|" + "|".join("---:" if is_numeric(block, c) else "---" for c in columns) + "|")
            lines += ["| " + " | ".join(_escaped(text(c, row[c])) for c in columns) + " |" for row in rows]
        else:
            lines.append(block.spec.empty)
        note = omission(block, left_out)
        lines += ["", *([note, ""] if note else []), f"Query: `{block.query.file}`", ""]
    return "\n".join(lines)


def _head(name: str) -> str:
    words, symbol = label(name)
    return f"{words} ({symbol})" if symbol else words


def _escaped(shown: str) -> str:
    """Text inert in Markdown: no HTML, no cell or line breaks, no emphasis or links."""
    shown = " ".join(shown.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    for mark in "\\`*[]|":
        shown = shown.replace(mark, f"\\{mark}")
    return shown
