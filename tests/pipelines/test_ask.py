"""Answers in plain types, and what counts as a question."""

from __future__ import annotations

import json
from pathlib import Path

import duckdb
import pyarrow as pa
import pytest

from pipelines.ask import FORMATS, _distinct, _flat, _refuse_writing, ask, plain_rows
from wheelset_assets.quality import ConfigError

EVERYTHING = """
    SELECT sum(a) AS whole, 1.5 AS decimal, INTERVAL 1 DAY AS span, TIME '10:00' AS time, uuid() AS uuid,
        DATE '2020-01-02' AS day, TIMESTAMPTZ '2020-01-02 03:04:05+00' AS moment, {'a': [1, 2]} AS struct,
        [1.5, NULL] AS list, 'x'::ENUM('x') AS enum, MAP {'k': 1} AS map, 'inf'::DOUBLE AS inf, true AS yes,
        NULL AS nothing, 'text' AS text
    FROM (VALUES (1), (2)) v(a)"""


@pytest.fixture
def answer() -> pa.Table:
    with duckdb.connect() as connection:
        connection.execute("SET TimeZone = 'UTC'")
        return connection.sql(EVERYTHING).to_arrow_table()


def test_rows_are_plain_json(answer: pa.Table) -> None:
    (row,) = json.loads(json.dumps(plain_rows(answer), allow_nan=False))
    assert (row["whole"], row["decimal"], row["day"], row["time"]) == (3, 1.5, "2020-01-02", "10:00:00")
    assert (row["moment"], row["struct"], row["list"]) == ("2020-01-02T03:04:05+00:00", {"a": [1, 2]}, [1.5, None])
    assert (row["enum"], row["inf"], row["yes"], row["nothing"]) == ("x", None, True, None)


def test_csv_can_hold_everything(answer: pa.Table) -> None:
    flat = _flat(answer)
    assert flat.column_names == answer.column_names
    assert {str(f.type) for f in flat.schema} <= {"string", "double", "bool"}
    row = flat.to_pylist()[0]
    assert (row["whole"], row["struct"], row["list"], row["nothing"]) == ("3", '{"a": [1, 2]}', "[1.5, null]", None)


def test_names_that_occur_again_get_a_number() -> None:
    assert _distinct(["a", "b", "a", "a_2", "a"]) == ["a", "b", "a_2", "a_2_2", "a_3"]


@pytest.mark.parametrize(
    ("text", "good"),
    [
        ("SELECT 1", True),
        ("  -- why\n FROM range(3)", True),
        ("VALUES (1)", True),
        ("EXPLAIN SELECT 1", True),
        ("explain analyze select 1", True),
        ("EXPLAIN (FORMAT json) SELECT 1", True),
        ("EXPLAIN (SELECT 1)", True),
        ("DESCRIBE SELECT 1", True),
        ("SUMMARIZE SELECT 1 AS a", True),
        ("EXPLAIN/**/ANALYZE COPY (SELECT 1) TO 'x'", False),
        ("/* a */ EXPLAIN -- b\n ANALYZE CREATE TABLE x (a INT)", False),
        ("EXPLAIN (ANALYZE) COPY (SELECT 1) TO 'x'", False),
        ("COPY (SELECT 1) TO 'x'", False),
        ("CHECKPOINT", False),
        ("USE memory", False),
        ("CALL pragma_version()", False),
        ("", False),
        ("-- nothing", False),
    ],
)
def test_what_is_a_question(text: str, good: bool) -> None:
    with duckdb.connect() as connection:
        if good:
            _refuse_writing(connection, text)
        else:
            with pytest.raises(ConfigError, match="sql: "):
                _refuse_writing(connection, text)


def test_unknown_formats_are_named_before_anything_is_asked(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--format 'xlsx': expected one of table, csv, json, parquet"):
        ask(tmp_path, "SELECT 1", "xlsx", None)
    assert FORMATS == ("table", "csv", "json", "parquet")
