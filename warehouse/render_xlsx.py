"""The report as an Excel workbook: a sheet for each block, all rows and columns, and one that says what they mean."""

from __future__ import annotations

import datetime
import io
import re
import zipfile
from typing import TYPE_CHECKING, Any

from warehouse.render import lead, parameter_lines
from warehouse.render_cells import plain, unit

if TYPE_CHECKING:
    import pyarrow as pa
    from openpyxl.worksheet.worksheet import Worksheet

    from warehouse.report import Report

MOST_ROWS = 1_048_575
_EPOCH = (1980, 1, 1, 0, 0, 0)
_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f]")


def workbook(report: Report) -> bytes:
    """The workbook's bytes; the same report gives the same ones. Text is text: nothing from data becomes a formula."""
    from openpyxl import Workbook

    book = Workbook()
    about: Worksheet = book.active
    about.title = "about"
    lines = [report.title, report.spec.about, *parameter_lines(report), *lead(report)]
    for block in report.blocks.values():
        lines += ["", f"{block.spec.name}: {block.spec.title} ({block.query.file})", block.query.answers]
        lines += [f"    {name}: {meaning}" for name, meaning in block.query.meanings.items()]
    for number, line in enumerate(lines, start=1):
        _set(about, number, 1, line)
    about.column_dimensions["A"].width = 110
    for name, block in report.blocks.items():
        sheet = book.create_sheet(name[:31])
        _fill(sheet, block.table.column_names, block.table.slice(0, MOST_ROWS).to_pylist())
    buffer = io.BytesIO()
    book.save(buffer)
    return _timeless(buffer.getvalue())


def table_book(name: str, table: pa.Table) -> bytes:
    """A workbook of one table."""
    from openpyxl import Workbook

    book = Workbook()
    sheet: Worksheet = book.active
    sheet.title = name[:31]
    _fill(sheet, table.column_names, table.slice(0, MOST_ROWS).to_pylist())
    buffer = io.BytesIO()
    book.save(buffer)
    return _timeless(buffer.getvalue())


def _fill(sheet: Worksheet, names: list[str], rows: list[dict[str, Any]]) -> None:
    from openpyxl.styles import Font
    from openpyxl.utils import get_column_letter

    for number, name in enumerate(names, start=1):
        _set(sheet, 1, number, name)
        sheet.cell(1, number).font = Font(bold=True)
        sheet.column_dimensions[get_column_letter(number)].width = max(10, min(40, len(name) + 2))
    for line, row in enumerate(rows, start=2):
        for number, (name, value) in enumerate(row.items(), start=1):
            _set(sheet, line, number, value, name)
    sheet.freeze_panes = "A2"
    if rows:
        sheet.auto_filter.ref = sheet.dimensions


def _set(sheet: Worksheet, row: int, column: int, value: Any, name: str = "") -> None:
    """Put a value into a cell by its type; Excel knows no time zones, so that times become UTC without one."""
    if isinstance(value, datetime.datetime):
        value = value.astimezone(datetime.UTC).replace(tzinfo=None) if value.tzinfo else value
    elif not isinstance(value, datetime.date | int):
        value = plain(value)
    if value is None:
        return
    cell = sheet.cell(row, column)
    if isinstance(value, str | list):
        text = value if isinstance(value, str) else ", ".join(map(str, value))
        cell.value = _UNPRINTABLE.sub(" ", text)[:32767]
        cell.data_type = "s"
    else:
        cell.value = value
        if isinstance(value, float) and name:
            cell.number_format = "0." + "0" * unit(name)[1] if unit(name)[1] else "0"


def _timeless(content: bytes) -> bytes:
    """The same archive without the moment of its making."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "docProps/core.xml":
                data = re.sub(rb"(<dcterms:\w+[^>]*>)[^<]*", rb"\g<1>1980-01-01T00:00:00Z", data)
            target.writestr(zipfile.ZipInfo(name, _EPOCH), data, zipfile.ZIP_DEFLATED)
    return out.getvalue()
