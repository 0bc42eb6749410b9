"""How small tables travel between driver and workers: as Arrow streams, which hold their own rows and nothing else.

Pickled as it is, a table brings the whole of the buffers that it is a slice of, a day's rows for those of one scan; and
costs ten times as much even where it has them for itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pyarrow as pa


class Tables(dict[str, pa.Table]):
    """Tables by name, to be sent with a task or an outcome."""

    def __reduce__(self) -> tuple[Callable[[dict[str, bytes]], Tables], tuple[Any, ...]]:
        return _unpacked, ({name: _packed(table) for name, table in self.items()},)


def _packed(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    packed: bytes = sink.getvalue().to_pybytes()
    return packed


def _unpacked(packed: Mapping[str, bytes]) -> Tables:
    return Tables({name: _table(stream) for name, stream in packed.items()})


def _table(stream: bytes) -> pa.Table:
    with pa.ipc.open_stream(pa.BufferReader(stream)) as reader:
        table = reader.read_all()
    return table if table.num_rows else table.schema.empty_table()  # columns without a chunk are an odd thing to get
