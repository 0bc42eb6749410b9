"""Reading pairs of measured and reference values from a CSV file. Their statistics are SQL's, as everyone's."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from wheelset_assets.quality import ConfigError

REQUIRED = ("quantity", "side", "measured_mm", "reference_mm", "expanded_uncertainty_mm")
OPTIONAL = ("reference_expanded_uncertainty_mm", "wheelset_id", "scan_id")
SIDES = ("left", "right", "both")
SCHEMA = pa.schema(
    [
        ("line", pa.int64()),
        ("scan_id", pa.string()),
        ("wheelset_id", pa.string()),
        ("quantity", pa.string()),
        ("side", pa.string()),
        ("measured_mm", pa.float64()),
        ("reference_mm", pa.float64()),
        ("expanded_uncertainty_mm", pa.float64()),
        ("reference_expanded_uncertainty_mm", pa.float64()),
    ]
)


def read_pairs(path: Path) -> tuple[pa.Table, tuple[str, ...]]:
    """The pairs of a file, and what its reader should know of how it was read.

    Columns quantity, side, measured_mm, reference_mm, expanded_uncertainty_mm (of the measured value; may be empty),
    optionally reference_expanded_uncertainty_mm, wheelset_id, scan_id. A malformed file raises ConfigError.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start} is no UTF-8; expected a CSV file in UTF-8") from None
    lines = _lines(path, text)
    _, header = next(lines, (1, []))
    names = [name.strip() for name in header]
    _check_header(path, names)
    rows = [_row(path, line, names, cells) for line, cells in lines]
    notes = []
    if ignored := [name for name in names if name not in REQUIRED and name not in OPTIONAL]:
        notes.append(f"Columns that this report does not use: {', '.join(ignored)}.")
    if not any(row["reference_expanded_uncertainty_mm"] for row in rows):
        notes.append(
            "The file states no uncertainty of its references (reference_expanded_uncertainty_mm): taken as exact."
        )
    return pa.Table.from_pylist(rows, schema=SCHEMA), tuple(notes)


def _lines(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of every line that is not blank."""
    reader = csv.reader(text.splitlines(), strict=True)
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                yield reader.line_num, cells
    except csv.Error as error:
        raise ConfigError(f"{path}, line {reader.line_num}: no CSV: {error}") from None


def _check_header(path: Path, names: list[str]) -> None:
    expected = f"expected the columns {', '.join(REQUIRED)}, separated by commas"
    if not names:
        raise ConfigError(f"{path}, line 1: the file is empty; {expected}")
    for name in REQUIRED:
        if name not in names:
            raise ConfigError(f"{path}, line 1: no column {name}; {expected}; found {', '.join(names)}")
    for name in (*REQUIRED, *OPTIONAL):
        if names.count(name) > 1:
            raise ConfigError(f"{path}, line 1, column {name}: stands there {names.count(name)} times; expected once")


def _row(path: Path, line: int, names: list[str], cells: list[str]) -> dict[str, object]:
    if len(cells) != len(names):
        raise ConfigError(
            f"{path}, line {line}: {len(cells)} cells; expected {len(names)}, as many as columns "
            "(decimal point, not comma)"
        )
    given = {name: cell.strip() for name, cell in zip(names, cells, strict=True)}

    def wrong(column: str, expectation: str) -> ConfigError:
        return ConfigError(f"{path}, line {line}, column {column}: {given[column]!r}; expected {expectation}")

    def number(column: str, expectation: str, may_be_empty: bool = False) -> float | None:
        if may_be_empty and not given.get(column):
            return None
        try:
            value = float(given[column])
        except ValueError:
            raise wrong(column, expectation) from None
        if not math.isfinite(value) or (may_be_empty and value < 0):
            raise wrong(column, expectation)
        return value

    if not given["quantity"]:
        raise wrong("quantity", "the name of a quantity, such as wheel_diameter")
    if given["side"] not in SIDES:
        raise wrong("side", f"one of {', '.join(SIDES)}")
    length, uncertainty = "a number in mm", "a number in mm, zero or more, or nothing"
    return {
        "line": line,
        "scan_id": given.get("scan_id") or None,
        "wheelset_id": given.get("wheelset_id") or None,
        "quantity": given["quantity"],
        "side": given["side"],
        "measured_mm": number("measured_mm", length),
        "reference_mm": number("reference_mm", length),
        "expanded_uncertainty_mm": number("expanded_uncertainty_mm", uncertainty, may_be_empty=True),
        "reference_expanded_uncertainty_mm": number(
            "reference_expanded_uncertainty_mm", uncertainty, may_be_empty=True
        ),
    }
