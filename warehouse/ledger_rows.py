"""Records of the ledger as rows of an Arrow table, and back; column by column, because a night has tens of thousands.

Names that many records share (stages, versions, packages, runs) become one object each, so that a ledger in memory costs
little more than what is peculiar to its records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from itertools import pairwise, repeat
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

if TYPE_CHECKING:
    from warehouse.lineage import Output, Record

OUTPUT = pa.struct(
    [
        ("table", pa.string()),
        ("path", pa.string()),
        ("version", pa.string()),
        ("rows", pa.int64()),
        ("bytes", pa.int64()),
    ]
)
INPUT = pa.struct([("name", pa.string()), ("version", pa.string())])
RECORD = pa.schema(
    [
        ("unit", pa.string()),
        ("scan_id", pa.string()),
        ("stage", pa.string()),
        ("state", pa.string()),
        ("reason", pa.string()),
        ("fingerprint", pa.string()),
        ("code_version", pa.string()),
        ("config_fingerprint", pa.string()),
        ("git_commit", pa.string()),
        ("run_id", pa.string()),
        ("produced_at", pa.timestamp("us", tz="UTC")),
        ("seconds", pa.float64()),
        ("compute_seconds", pa.float64()),
        ("points", pa.int64()),
        ("inputs", pa.list_(INPUT)),
        ("outputs", pa.list_(OUTPUT)),
        ("packages", pa.string()),
        ("superseded_at", pa.timestamp("us", tz="UTC")),
        ("superseded_by", pa.string()),
        ("signature", pa.string()),
        ("header", pa.string()),
        ("recording", pa.string()),
        ("valid_from", pa.timestamp("us", tz="UTC")),
    ]
)
NESTED = ("inputs", "outputs")
OWN = ("unit", "scan_id", "fingerprint", "signature", "header", "version", "path")
"""Columns whose values are peculiar to a record: nothing is gained by sharing them."""


def to_table(records: Sequence[Record]) -> pa.Table:
    """One row a record."""
    columns = [
        _lists(records, field.name)
        if field.name in NESTED
        else pa.array([getattr(r, field.name) for r in records], field.type)
        for field in RECORD
    ]
    return pa.Table.from_arrays(columns, schema=RECORD)


def _lists(records: Sequence[Record], name: str) -> pa.Array:
    """The inputs, which are pairs, or the outputs of records as lists of structs."""
    kind = RECORD.field(name).type.value_type
    groups = [getattr(record, name) for record in records]
    flat = [item for group in groups for item in group]
    offsets = np.concatenate([[0], np.cumsum([len(group) for group in groups])]).astype(np.int32)
    if name == "inputs":
        parts = [pa.array([pair[i] for pair in flat], pa.string()) for i in range(2)]
    else:
        parts = [pa.array([getattr(item, field.name) for item in flat], field.type) for field in kind]
    return pa.ListArray.from_arrays(pa.array(offsets), pa.StructArray.from_arrays(parts, fields=list(kind)))


def from_table(table: pa.Table, record: type[Record], output: Callable[..., Output]) -> Iterable[Record]:
    """The records of a table; columns that an older program did not write take their defaults."""
    values: list[Iterable[Any]] = []
    for one in fields(record):
        if one.name not in table.column_names:
            values.append(repeat(one.default, table.num_rows))
        elif one.name in NESTED:
            values.append(_groups(table[one.name], output if one.name == "outputs" else None))
        else:
            values.append(_shared(table[one.name], share=one.name not in OWN))
    yield from map(record, *values)


def _groups(column: pa.ChunkedArray, make: Callable[..., Any] | None) -> list[tuple]:
    """Lists of structs as tuples of what `make` makes of their fields, or of tuples of these."""
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        return []
    flat = array.flatten()
    parts = [
        _shared(pa.chunked_array([flat.field(i)]), share=flat.type.field(i).name not in OWN)
        for i in range(flat.type.num_fields)
    ]
    items = list(zip(*parts, strict=True)) if make is None else list(map(make, *parts))
    ends = np.cumsum([0, *array.value_lengths().to_pylist()]).tolist()
    return [tuple(items[a:b]) for a, b in pairwise(ends)]


def _shared(column: pa.ChunkedArray, share: bool) -> list[Any]:
    """Python values of a column; equal texts are one object if `share`."""
    if not share or not pa.types.is_string(column.type) or column.num_chunks == 0:
        return column.to_pylist()
    encoded = column.combine_chunks().dictionary_encode()
    texts = [*encoded.dictionary.to_pylist(), None]
    return [texts[i] for i in encoded.indices.fill_null(len(texts) - 1).to_pylist()]
