"""Every declared table: consistent with the others, readable by DuckDB, and guarded by checks that catch what they say."""

from __future__ import annotations

import datetime as dt
import re

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wheelset_assets import tables
from wheelset_assets.declare import Column, Table
from wheelset_assets.quality import Flag, flag_names
from wheelset_assets.stages import STAGES

ALL = tables.ALL_TABLES
NOON = dt.datetime(2025, 4, 5, 12, tzinfo=dt.UTC)


def good(column: Column):
    """A value that the declaration allows."""
    if column.values:
        return column.values[0]
    low = column.minimum if column.minimum is not None else 0
    values = {
        "bool": True, "string": "text", "category": "text", "date": NOON.date(), "timestamp": NOON,
        "strings": ["text"], "float64s": [1.0, 2.0], "float32x33": [1.0] * 33,
    }  # fmt: skip
    if column.type in values:
        return values[column.type]
    number = min(low + 1, column.maximum) if column.maximum is not None else low + 1
    return float(number) if column.type.startswith("float") else int(number)


def row(table: Table) -> dict:
    """A row that passes every check of its table."""
    made = {c.name: good(c) for c in table.columns}
    if table is tables.MEASUREMENTS:
        made["reason"] = None
    if table is tables.BUDGETS:
        made["share"] = 1.0
    return made


CON = duckdb.connect()


def failing(table: Table, rows: list[dict], only: str | None = None) -> set[str]:
    """Names of the checks, or of the one that is asked for, that select a row."""
    CON.register("t", table.from_rows(rows))
    checks = [c for c in table.generated_checks() if only in (None, c.name)]
    assert checks
    return {c.name for c in checks if CON.sql(c.sql.format(table="t")).fetchall()}


@pytest.mark.parametrize("table", ALL, ids=lambda t: t.name)
def test_checks_run_in_duckdb_on_a_good_and_on_bad_tables(table):
    """Each limit and each list of values, one violation at a time: its own check answers."""
    fine = row(table)
    assert failing(table, [fine]) == set()
    assert failing(table, [fine, fine]) >= {"key_unique"}
    for column in table.columns:
        broken = []
        if column.minimum is not None:
            broken.append((f"{column.name}_limits", column.minimum - 1))
        if column.maximum is not None:
            broken.append((f"{column.name}_limits", column.maximum + 1))
        if column.type in ("float32", "float64"):
            broken += [(f"{column.name}_limits", float("nan")), (f"{column.name}_limits", float("inf"))]
        if column.values:
            broken.append((f"{column.name}_values", "nothing of the kind"))
        for check, value in broken:
            assert failing(table, [fine | {column.name: value}], check) == {check}, (column.name, value)


@pytest.mark.parametrize("table", ALL, ids=lambda t: t.name)
def test_tables_survive_parquet_with_their_schema(table, tmp_path):
    """Also that a null where none is declared cannot be written."""
    path = tmp_path / "t.parquet"
    made = table.from_rows([row(table)])
    pq.write_table(made, path)
    back = pq.read_table(path, schema=table.schema)
    assert back.equals(made)
    required = next(c for c in table.columns if not c.nullable)
    with pytest.raises(pa.ArrowInvalid):
        pq.write_table(table.from_rows([row(table) | {required.name: None}]), path)


@pytest.mark.parametrize("table", ALL, ids=lambda t: t.name)
def test_names_units_and_meanings(table):
    assert re.fullmatch(r"[a-z][a-z0-9_]*", table.name)
    assert table.meaning
    assert table.version >= 1
    assert table.key
    for name in table.key:
        assert not table.column(name).nullable
    lowered = [c.name.lower() for c in table.columns]
    assert len(set(lowered)) == len(lowered)  # DuckDB's names ignore case
    for column in table.columns:
        assert len(column.meaning) > 3
        assert not column.meaning.endswith(".")
        ends = re.search(r"_(mm|um|px|deg|c|ratio)$", column.name)
        if ends and column.type.startswith("float") and column.name != "plane_c":  # C of A X + B Y + C Z = D
            unit = {"ratio": "1"}.get(ends[1], ends[1])
            assert column.unit == unit, column.name


def test_a_column_of_one_name_has_one_unit_and_one_kind_of_type_everywhere():
    kinds: dict[str, set] = {}
    for table in ALL:
        for column in table.columns:
            kind = re.sub(r"\d+", "", column.type).replace("category", "string")
            kinds.setdefault(column.name, set()).add((column.unit, kind))
    # What is measured carries its unit beside it.
    assert {name: k for name, k in kinds.items() if len(k) > 1} == {}


def test_every_table_is_made_by_one_stage():
    made = [output.name for stage in STAGES for output in stage.outputs]
    assert sorted(made) == sorted(t.name for t in ALL)
    assert dict(tables.TABLES) == {t.name: t for t in ALL}


def test_uncertainties_stand_beside_their_values():
    names = {c.name for c in tables.MEASUREMENTS.columns}
    assert {"value", "expanded_uncertainty", "coverage_factor", "value_uncompensated", "reason"} <= names


@pytest.mark.parametrize(
    ("change", "check"),
    [
        ({"value": None}, "value_or_reason"),
        ({"reason": "unseen"}, "value_or_reason"),
        ({"expanded_uncertainty": None}, "value_with_uncertainty"),
        ({"expanded_uncertainty": 0.0}, "value_with_uncertainty"),
    ],
)
def test_a_measurement_has_a_value_or_a_reason_and_no_value_is_without_uncertainty(change, check):
    assert check in failing(tables.MEASUREMENTS, [row(tables.MEASUREMENTS) | change])


def test_a_refused_measurement_is_a_good_row():
    refused = {"value": None, "expanded_uncertainty": None, "value_uncompensated": None, "reason": "unseen"}
    assert failing(tables.MEASUREMENTS, [row(tables.MEASUREMENTS) | refused]) == set()


def test_shares_of_a_budget_sum_to_one():
    first = row(tables.BUDGETS) | {"source": "a", "share": 0.7}
    assert failing(tables.BUDGETS, [first, first | {"source": "b", "share": 0.3}]) == set()
    assert failing(tables.BUDGETS, [first, first | {"source": "b", "share": 0.2}]) == {"shares_sum_to_one"}


def test_flags_are_one_registry():
    assert len(flag_names()) == len(set(flag_names())) == len(Flag)
    both = Flag.COVERAGE_GAP | Flag.CALIBRATION_OLD
    assert both.names() == ["calibration_old", "coverage_gap"]
    assert Flag.NONE.names() == []
    for name in flag_names():
        assert name in tables.FLAGS.meaning
        assert Flag[name.upper()].names() == [name]
