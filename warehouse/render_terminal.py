"""The report as text for a terminal: tables that fit its width, cut into several side by side rather than folded."""

from __future__ import annotations

import io
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from warehouse.render import is_numeric, lead, omission, parameter_lines, shown_rows
from warehouse.render_cells import LONG, label, text

if TYPE_CHECKING:
    from rich.table import Table

    from warehouse.report import Block, Report

MOST_ROWS, WIDEST_TEXT, NARROWEST_KEY, GAP = 24, 28, 8, 2


def terminal(report: Report, width: int | None = None) -> str:
    """The report's tables as text, for `width` columns or as many as the terminal has."""
    from rich.console import Console
    from rich.text import Text

    width = max(width or shutil.get_terminal_size((100, 24)).columns, 40)
    buffer = io.StringIO()
    console = Console(file=buffer, width=width, color_system=None, force_terminal=False, legacy_windows=False)

    def say(words: str) -> None:
        console.print(Text(words))

    say(report.title)
    say("=" * min(width, len(report.title)))
    for line in (report.spec.about, *parameter_lines(report), *lead(report)):
        say(line)
    for block in report.blocks.values():
        columns, rows, left_out = shown_rows(block, min(block.spec.limit, MOST_ROWS))
        head = f"{block.spec.title}  [{block.query.file}]"
        say(f"\n{head}\n{'-' * min(width, len(head))}")
        if not rows:
            say(block.spec.empty)
            continue
        for number, part in enumerate(_parts(columns, rows, block.spec.n_keys, width)):
            if number:
                say("")
            console.print(_table(block, part, rows, len(rows) // 2 if left_out else -1))
        for line in filter(None, (block.spec.says, omission(block, left_out))):
            say(line)
    return "\n".join(line.rstrip() for line in buffer.getvalue().splitlines()) + "\n"


def _wanted(name: str, rows: Sequence[Mapping[str, Any]]) -> int:
    """Width that a column wants: its longest cell, and no less than the longest word of its head."""
    words, symbol = label(name)
    return max(*(len(word) for word in (*words.split(), symbol)), *(len(text(name, row[name])) for row in rows))


def _parts(columns: Sequence[str], rows: Sequence[Mapping[str, Any]], n_keys: int, width: int) -> list[dict[str, int]]:
    """Columns with their widths, cut into tables that each fit in `width` and begin with the keys."""
    wanted = {name: _wanted(name, rows) for name in columns}
    keys = {name: min(wanted[name], WIDEST_TEXT) for name in columns[:n_keys]}
    while sum(keys.values()) + GAP * len(keys) > width * 3 // 5 and max(keys.values()) > NARROWEST_KEY:
        keys[max(keys, key=lambda name: keys[name])] -= 1
    free = width - sum(keys.values()) - GAP * len(keys)
    parts, left = [dict(keys)], free
    for name in columns[n_keys:]:
        needed = min(wanted[name], free, WIDEST_TEXT)
        if needed > left and len(parts[-1]) > len(keys):
            parts.append(dict(keys))
            left = free
        if name in LONG:
            needed = min(wanted[name], max(needed, left))
        parts[-1][name] = needed
        left -= needed + GAP
    return parts


def _table(block: Block, part: Mapping[str, int], rows: Sequence[Mapping[str, Any]], cut: int) -> Table:
    from rich.table import Table
    from rich.text import Text

    heads = {}
    for name, width in part.items():
        words, symbol = label(name)
        heads[name] = [*textwrap.wrap(words, width), *([symbol] if symbol else [])]
    height = max(len(lines) for lines in heads.values())
    table = Table(box=None, padding=(0, GAP, 0, 0), pad_edge=False)
    for name, width in part.items():
        head = "\n".join([""] * (height - len(heads[name])) + heads[name])
        right = is_numeric(block, name)
        table.add_column(Text(head), justify="right" if right else "left", width=width, overflow="fold")
    for index, row in enumerate(rows):
        if index == cut:
            table.add_row(*(Text("⋮") for _ in part))
        table.add_row(*(Text(text(name, row[name])) for name in part))
    return table
