"""The vocabulary checks itself: columns, tables and stages that contradict themselves are refused, by name."""

from __future__ import annotations

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wheelset_assets.declare import ARROW_TYPES, UNITS, Check, Column, Stage, Table, as_arrow

ID = Column("scan_id", "string", "Scan")
DEPTH = Column("depth_mm", "float64", "Depth", unit="mm", minimum=0, maximum=10)
COUNT = Column("n_points", "int32", "Points", minimum=1)
SIDE = Column("side", "string", "Side", values=("left", "right"))
MAYBE = Column("u_mm", "float32", "Uncertainty", unit="mm", minimum=0, nullable=True)


def table(**changes) -> Table:
    known = {
        "name": "things", "version": 1, "meaning": "Things", "layout": "scan", "key": ("scan_id",),
        "columns": (ID, DEPTH, COUNT, SIDE, MAYBE),
    }  # fmt: skip
    return Table(**(known | changes))


ROW = {"scan_id": "a", "depth_mm": 5.0, "n_points": 3, "side": "left", "u_mm": 0.1}


# --- columns


@pytest.mark.parametrize("name", ["Depth_mm", "1depth", "depth-mm", "", "depth mm", "tiefe_ä", 'x"; DROP TABLE y'])
def test_column_names_are_plain_sql(name):
    with pytest.raises(ValueError, match="column name"):
        Column(name, "float64", "Meaning")


def test_unknown_types_and_units_are_refused_with_those_that_are_known():
    with pytest.raises(ValueError, match=r"unknown type 'float'.*float64"):
        Column("x", "float", "Meaning")
    with pytest.raises(ValueError, match=r"unknown unit 'inch'.*mm"):
        Column("x", "float64", "Meaning", unit="inch")


@pytest.mark.parametrize("unit", ["mm", "um", "px", "deg", "c"])
def test_a_name_carries_its_unit(unit):
    with pytest.raises(ValueError, match=f"carry its unit _{unit}"):
        Column("depth", "float64", "Meaning", unit=unit)
    assert Column(f"depth_{unit}", "float64", "Meaning", unit=unit).comment == f"Meaning [{unit}]"


def test_comment_and_arrow_field_follow_the_declaration():
    assert ID.comment == "Scan"
    assert pa.field("u_mm", pa.float32(), nullable=True) == MAYBE.arrow
    assert not DEPTH.arrow.nullable


@pytest.mark.parametrize("type_", list(ARROW_TYPES))
def test_every_type_makes_an_empty_column_that_duckdb_reads(type_):
    made = table(columns=(ID, Column("x", type_, "Meaning", nullable=True)))
    empty = made.empty()
    assert empty.schema.field("x").type == ARROW_TYPES[type_]
    con = duckdb.connect()
    con.register("t", made.from_columns({"scan_id": ["a"], "x": [None]}))
    assert con.sql("SELECT x FROM t").fetchall() == [(None,)]


def test_units_are_listed_once():
    assert len(set(UNITS)) == len(UNITS)


# --- tables


def test_a_column_twice_and_an_unknown_key_are_refused():
    with pytest.raises(ValueError, match="things: a column is declared twice"):
        table(columns=(ID, DEPTH, DEPTH))
    with pytest.raises(ValueError, match=r"things: key columns \['frame'\]"):
        table(key=("scan_id", "frame"))


def test_schema_keeps_order_types_and_nullability():
    schema = table().schema
    assert schema.names == ["scan_id", "depth_mm", "n_points", "side", "u_mm"]
    assert schema.field("depth_mm").type == pa.float64()
    assert [schema.field(n).nullable for n in schema.names] == [False, False, False, False, True]
    assert table().empty().schema == schema


def test_a_column_is_found_by_name():
    assert table().column("side") is SIDE
    with pytest.raises(KeyError, match="things has no column nope"):
        table().column("nope")


def test_rows_and_columns_make_the_declared_table():
    made = table().from_rows([ROW, ROW | {"scan_id": "b", "u_mm": None}])
    assert made.schema == table().schema
    assert made.to_pylist()[1]["u_mm"] is None
    again = table().from_columns({name: made[name] for name in made.column_names})
    assert again.equals(made)


@pytest.mark.parametrize("change", [{"extra": [1]}, {"side": None}])
def test_a_name_too_few_or_too_many_is_named(change):
    columns = {k: [v] for k, v in ROW.items()}
    columns = {k: v for k, v in (columns | change).items() if v is not None}
    with pytest.raises(ValueError, match=f"things: columns do not match its declaration: {next(iter(change))}"):
        table().from_columns(columns)


def test_a_row_without_a_column_is_an_error():
    with pytest.raises(KeyError):
        table().from_rows([{"scan_id": "a"}])


@given(st.lists(st.floats(allow_nan=False, width=32), max_size=5))
def test_as_arrow_casts_arrays_lists_and_chunks_alike(values):
    wanted = pa.array(values, pa.float64())
    for given_ in (values, np.array(values, np.float32), pa.array(values, pa.float32())):
        assert as_arrow(given_, pa.float64()).equals(wanted)
    assert as_arrow(pa.chunked_array([wanted]), pa.float64()).equals(wanted)


def test_values_that_do_not_fit_their_type_are_errors():
    with pytest.raises((pa.ArrowInvalid, OverflowError)):
        as_arrow([2**40], pa.int32())
    with pytest.raises((pa.ArrowInvalid, pa.ArrowTypeError)):
        as_arrow(["many"], pa.int32())


# --- generated checks, as DuckDB runs them


def failing(rows, of=None) -> set[str]:
    """Names of the checks that select a row."""
    of = of or table()
    con = duckdb.connect()
    con.register("t", of.from_rows(rows))
    return {c.name for c in of.generated_checks() if con.sql(c.sql.format(table="t")).fetchall()}


def test_a_good_table_passes_and_the_checks_are_those_that_the_columns_declare():
    assert failing([ROW, ROW | {"scan_id": "b", "u_mm": None}]) == set()
    names = [c.name for c in table().generated_checks()]
    assert names == ["key_unique", "depth_mm_limits", "n_points_limits", "side_values", "u_mm_limits"]
    assert all(c.severity == "error" and c.meaning for c in table().generated_checks())


@pytest.mark.parametrize(
    ("change", "check"),
    [
        ({"depth_mm": -0.001}, "depth_mm_limits"),
        ({"depth_mm": 10.5}, "depth_mm_limits"),
        ({"depth_mm": float("nan")}, "depth_mm_limits"),
        ({"depth_mm": float("inf")}, "depth_mm_limits"),
        ({"u_mm": float("-inf")}, "u_mm_limits"),
        ({"u_mm": -1.0}, "u_mm_limits"),
        ({"n_points": 0}, "n_points_limits"),
        ({"side": "Left"}, "side_values"),
        ({"side": ""}, "side_values"),
        ({"scan_id": "a"}, "key_unique"),
    ],
)
def test_a_bad_row_fails_its_own_check_and_no_other(change, check):
    assert failing([ROW, ROW | {"scan_id": "b"} | change]) == {check}


def test_limits_themselves_are_allowed():
    assert failing([ROW | {"depth_mm": 0.0}, ROW | {"scan_id": "b", "depth_mm": 10.0, "n_points": 1}]) == set()


def test_a_tables_own_checks_come_with_the_generated_ones():
    deep = Check("not_deep", "SELECT * FROM {table} WHERE depth_mm > 4", "shallow", severity="warn")
    made = table(checks=(deep,))
    assert failing([ROW], made) == {"not_deep"}
    assert failing([ROW | {"depth_mm": 3.0}], made) == set()


def test_dictionary_columns_are_checked_like_strings():
    coded = Column("reason", "category", "Reason", values=("a", "b"))
    made = table(columns=(ID, coded))
    assert failing([{"scan_id": "1", "reason": "a"}], made) == set()
    assert failing([{"scan_id": "1", "reason": "c"}], made) == {"reason_values"}


# --- stages


def run_good(*, clouds, rig, config):
    """Nothing."""


def stage(**changes) -> Stage:
    known = {
        "version": 3, "meaning": "Makes things", "scope": "scan", "inputs": ("clouds",), "raw_inputs": ("rig",),
        "outputs": (table(), table(name="others", version=2)), "config_type": dict, "run": run_good,
    }  # fmt: skip
    return Stage(**(known | changes))


def test_a_stage_is_named_and_versioned_by_its_tables():
    assert stage().name == "things"
    assert stage().code_version == "3.1.2"


def test_arguments_are_checked_against_the_declaration_when_it_is_made():
    with pytest.raises(ValueError, match="stage things: run takes"):
        stage(inputs=("clouds", "features"))
    with pytest.raises(ValueError, match="stage things: run takes"):
        stage(run=lambda *, clouds, rig: None)
    with pytest.raises(ValueError, match="keyword-only"):
        stage(run=lambda clouds, *, rig, config: None)
    assert stage(run=lambda *, clouds, rig, config, extra: None, optional_inputs=("extra",)).name == "things"


def test_declarations_cannot_be_changed():
    for thing, name in ((ID, "type"), (table(), "name"), (stage(), "version")):
        with pytest.raises(AttributeError):
            setattr(thing, name, "other")
