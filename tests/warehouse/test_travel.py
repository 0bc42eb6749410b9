"""Small tables on their way to a worker and back: the same rows, and no more than them."""

from __future__ import annotations

import pickle

import pyarrow as pa
import pytest

from warehouse.travel import Tables
from wheelset_assets.tables import TABLES

SCHEMA = pa.schema(
    [
        pa.field("scan_id", pa.string(), nullable=False),
        pa.field("sensor_id", pa.dictionary(pa.int32(), pa.string())),
        pa.field("flags", pa.list_(pa.string())),
        pa.field("value", pa.float64()),
    ]
)


def whole(n: int) -> pa.Table:
    rows = [{"scan_id": f"s-{i}", "sensor_id": "ab"[i % 2], "flags": ["x"] * (i % 3), "value": None} for i in range(n)]
    return pa.Table.from_pylist(rows, schema=SCHEMA)


def sent(table: pa.Table) -> pa.Table:
    return pickle.loads(pickle.dumps(Tables(rows=table)))["rows"]


@pytest.mark.parametrize("n", [0, 1, 7])
def test_a_table_comes_back_as_it_was(n: int) -> None:
    came = sent(whole(n))
    assert came.equals(whole(n))
    assert came.schema.equals(SCHEMA, check_metadata=True)
    assert all(column.num_chunks == 1 for column in came.columns)


def test_a_slice_travels_without_the_rest() -> None:
    part = whole(100_000).slice(500, 3)
    assert sent(part).equals(part)
    assert len(pickle.dumps(Tables(rows=part))) < 10_000 < len(pickle.dumps(part))


def test_parts_with_dictionaries_of_their_own() -> None:
    other = whole(4).set_column(1, SCHEMA.field(1), pa.array(["c", "a", None, "c"]).dictionary_encode())
    both = pa.concat_tables([whole(3), other])
    assert sent(both).to_pylist() == both.to_pylist()


def test_every_declared_table_can_travel() -> None:
    for table in TABLES.values():
        assert sent(table.empty()).equals(table.empty())
