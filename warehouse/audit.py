"""The audit of a table before it is published: what its declaration says must hold of every row.

A check is SQL that selects the failing rows. Those that follow from the columns (limits, values, key), and a table's own
that have a screen, are first screened in Arrow, which takes microseconds; only where the screen finds something does their
SQL run, and names the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from wheelset_assets.declare import Check, Column, Table

if TYPE_CHECKING:
    import duckdb

LARGE = 100_000
"""From so many rows on, a key is checked by the order of the rows, which is how it is written."""


def audit(table: Table, data: pa.Table) -> list[str]:
    """Check data against its declaration before it is published; RuntimeError for a failed check, warnings returned."""
    if not data.schema.equals(table.schema):
        raise RuntimeError(
            f"table {table.name}: schema differs from its declaration:\n{data.schema}\nexpected\n{table.schema}"
        )
    columns = list(zip(table.columns, data.columns, strict=True))
    for column, values in columns:
        if not column.nullable and values.null_count:
            raise RuntimeError(f"table {table.name}: column {column.name} has {values.null_count} nulls")
    if data.num_rows == 0:
        return []
    large = data.num_rows > LARGE
    if large and not _key_ascends(table, data):
        raise RuntimeError(
            f"table {table.name}: check key_unique: rows are not in strictly ascending order of {', '.join(table.key)}"
        )
    suspicious = not all(_within(column, values) for column, values in columns)
    suspicious = suspicious or not (large or key_is_unique(table, data))
    checks = table.generated_checks() if suspicious else _unscreened(table, data)
    return _run_checks(table, data, [c for c in checks if not (large and c.name == "key_unique")])


def _unscreened(table: Table, data: pa.Table) -> tuple[Check, ...]:
    """The table's own checks, without those whose screens find nothing."""
    return tuple(check for check in table.checks if check.screen is None or not check.screen(data))


def _run_checks(table: Table, data: pa.Table, checks: Sequence[Check]) -> list[str]:
    """Warnings of the checks that select a row; RuntimeError for the first that is an error."""
    if not checks:
        return []
    connection = _auditor()
    connection.register("audited", data)
    warnings = []
    for check in checks:
        failing = connection.execute(f"SELECT * FROM ({check.sql.format(table='audited')}) LIMIT 3").fetchall()
        if failing:
            message = f"table {table.name}: check {check.name} ({check.meaning}): {failing}"
            if check.severity == "error":
                raise RuntimeError(message)
            warnings.append(message)
    connection.unregister("audited")
    return warnings


@cache
def _auditor() -> duckdb.DuckDBPyConnection:
    """One connection a process: opening one costs as much as checking a small table."""
    import duckdb

    connection = duckdb.connect()
    connection.execute("SET threads = 1")
    return connection


def _within(column: Column, values: pa.ChunkedArray) -> bool:
    """Whether a column keeps its limits, has no NaN or infinity, and only declared values; nulls pass."""
    if column.values and not set(values.unique().drop_null().to_pylist()) <= set(column.values):
        return False
    if column.minimum is None and column.maximum is None and column.type not in ("float32", "float64"):
        return True
    numbers = (values.drop_null() if values.null_count else values).to_numpy()
    if not len(numbers):
        return True
    low, high = numbers.min(), numbers.max()  # NaN if there is one
    good = bool(np.isfinite(low) and np.isfinite(high))
    return (
        good
        and (column.minimum is None or low >= column.minimum)
        and (column.maximum is None or high <= column.maximum)
    )


def _codes(column: pa.ChunkedArray) -> np.ndarray | None:
    """A key column as whole numbers that are equal where its values are; None if it cannot be had so."""
    if column.null_count:
        return None
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):  # no row at all
        return None
    if pa.types.is_string(array.type):
        array = array.dictionary_encode()
    if pa.types.is_dictionary(array.type):
        return np.asarray(array.indices.to_numpy(), np.int64)
    if pa.types.is_integer(array.type):
        return np.asarray(array.to_numpy(), np.int64)
    if pa.types.is_date32(array.type):
        return np.asarray(array.cast(pa.int32()).to_numpy(), np.int64)
    if pa.types.is_float64(array.type):
        return (array.to_numpy() + 0.0).view(np.int64)  # -0.0 is 0.0
    return None


def key_is_unique(table: Table, data: pa.Table) -> bool:
    """Whether the key names every row once; False also where this cannot be said quickly."""
    if not table.key:
        return True
    columns = [_codes(data[name]) for name in table.key]
    known = [c for c in columns if c is not None]
    if len(known) < len(columns):
        return False
    if _ascends(known):
        return True
    keys = np.zeros(data.num_rows, np.int64)
    room = 1
    for codes in known:
        span = int(codes.max()) - int(codes.min()) + 1
        room *= span
        if room > 2**62:
            return len(np.unique(np.stack(known, axis=1), axis=0)) == data.num_rows
        keys = keys * span + (codes - codes.min())
    return len(np.unique(keys)) == data.num_rows


def _key_ascends(table: Table, data: pa.Table) -> bool:
    """Whether the key's columns rise strictly from row to row, taken together; categories by their order of appearance."""
    columns = [_codes(data[name]) for name in table.key]
    known = [c for c in columns if c is not None]
    return len(known) == len(columns) and _ascends(known)


def _ascends(columns: list[np.ndarray]) -> bool:
    """Whether whole numbers, compared column by column, rise strictly from row to row."""
    greater = np.zeros(len(columns[0]) - 1, bool)
    equal = np.ones(len(columns[0]) - 1, bool)
    for values in columns:
        step = np.diff(values)
        greater |= equal & (step > 0)
        equal &= step == 0
    return bool(greater.all())
