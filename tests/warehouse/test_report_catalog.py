"""The reports' queries as views of a database file: in any client, read-only, without this package."""

from __future__ import annotations

from pathlib import Path

import duckdb
import pytest
from report_data import campaign

from warehouse.report import REPORTS, build, catalog_statements


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("catalog") / "warehouse.duckdb"
    source, target = campaign(), duckdb.connect(path)
    tables = [name for (name,) in source.execute("SELECT view_name FROM duckdb_views() WHERE NOT internal").fetchall()]
    for name in tables:
        target.register("arriving", source.sql(f"FROM {name}").to_arrow_table())
        target.execute(f"CREATE TABLE {name} AS FROM arriving")
        target.unregister("arriving")
    for statement in catalog_statements():
        target.execute(statement)
    target.close()
    return path


def test_the_views_answer_as_the_reports_do(database: Path) -> None:
    connection = duckdb.connect(database, read_only=True)
    for name, spec in REPORTS.items():
        report = build(connection, name, {})
        for key, value in report.parameters.items():
            connection.execute(f"SET VARIABLE {key} = $1", [value])
        for block in spec.blocks:
            found = connection.sql(f"FROM {spec.view(block)}").to_arrow_table()
            assert found.to_pylist() == report.blocks[block.name].table.to_pylist()
        for key in report.parameters:
            connection.execute(f"RESET VARIABLE {key}")
    comments = dict(
        connection.execute(
            "SELECT column_name, comment FROM duckdb_columns() WHERE table_name = 'accuracy_summary'"
        ).fetchall()
    )
    assert comments["bias_um"].startswith("mean error")


def test_a_filter_of_one_report_does_not_touch_the_views(database: Path) -> None:
    connection = duckdb.connect(database, read_only=True)
    assert build(connection, "accuracy", {"wheelset_id": "nobody"}).is_empty
    assert connection.sql("SELECT count(*) FROM accuracy_pairs").fetchall() == [(480,)]


def test_a_reader_narrows_a_view_by_variables(database: Path) -> None:
    connection = duckdb.connect(database, read_only=True)
    connection.execute("SET VARIABLE wheelset_id = 'W2'")
    assert connection.sql("SELECT DISTINCT wheelset_id FROM stability_values").fetchall() == [("W2",)]
