"""Records of the ledger as rows of an Arrow table, and back; column by column, because a night has tens of thousands.

Names that many records share (stages, versions, packages, runs) become one object each, so that a ledger in memory costs
little more than what is peculiar to its records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
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


def from_table(table: pa.Table, record: Callable[..., Record], output: Callable[..., Output]) -> Iterable[Record]:
    """The records of a table; columns that an older program did not write take their defaults."""
    names = [name for name in RECORD.names if name in table.column_names]
    values = [
        _groups(table[name], output if name == "outputs" else _pair)
        if name in NESTED
        else _shared(table[name], share=name not in OWN)
        for name in names
    ]
    for row in zip(*values, strict=True):
        yield record(**dict(zip(names, row, strict=True)))


def _pair(name: str, version: str) -> tuple[str, str]:
    return name, version


def _groups(column: pa.ChunkedArray, make: Callable[..., Any]) -> list[tuple]:
    """Lists of structs as tuples of what `make` makes of their fields."""
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        return []
    flat = array.flatten()
    fields = [
        _shared(pa.chunked_array([flat.field(i)]), share=flat.type.field(i).name not in OWN)
        for i in range(flat.type.num_fields)
    ]
    items = [make(*row) for row in zip(*fields, strict=True)]
    ends = np.cumsum([0, *array.value_lengths().to_pylist()]).tolist()
    return [tuple(items[a:b]) for a, b in pairwise(ends)]


def _shared(column: pa.ChunkedArray, share: bool) -> list[Any]:
    """Python values of a column; equal texts are one object if `share`."""
    if not share or not pa.types.is_string(column.type) or column.num_chunks == 0:
        return column.to_pylist()
    encoded = column.combine_chunks().dictionary_encode()
    texts = [*encoded.dictionary.to_pylist(), None]
    return [texts[i] for i in encoded.indices.fill_null(len(texts) - 1).to_pylist()]
