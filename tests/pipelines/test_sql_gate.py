"""Ad-hoc SQL reads the warehouse's folder and nothing else, and writes nothing at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.ask import query
from warehouse import catalog
from warehouse.lineage import Ledger
from wheelset_assets.quality import ConfigError


@pytest.fixture
def warehouse(tmp_path: Path) -> Path:
    root = tmp_path / "warehouse"
    root.mkdir()
    catalog.build(root, Ledger(root))
    (root / "inside.csv").write_text("a\n1\n")
    (tmp_path / "secret.csv").write_text("a\n1\n")
    return root


def test_the_warehouse_itself_is_readable(warehouse: Path) -> None:
    assert query(warehouse, f"SELECT a FROM read_csv('{warehouse}/inside.csv')").to_pylist() == [{"a": 1}]
    assert query(warehouse, "SELECT count(*) AS n FROM measurements").to_pylist() == [{"n": 0}]


@pytest.mark.parametrize(
    "text",
    [
        "SELECT * FROM read_text('{outside}/secret.csv')",
        "SELECT * FROM read_csv('{outside}/warehouse/../secret.csv')",
        "SELECT * FROM '{outside}/secret.csv'",
        "SELECT * FROM glob('{outside}/*')",
        "SELECT * FROM read_blob('/etc/hostname')",
        "FROM sniff_csv('{outside}/secret.csv')",
        "SELECT * FROM duckdb_secrets() s, read_text('{outside}/secret.csv')",
    ],
)
def test_nothing_outside_is_read(warehouse: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"sql: .*(Permission|disabled)"):
        query(warehouse, text.format(outside=warehouse.parent))


@pytest.mark.parametrize(
    "text",
    [
        "COPY (SELECT 1) TO '{inside}/x.csv'",
        "COPY measurements TO '{outside}/x.parquet'",
        "EXPORT DATABASE '{inside}/x'",
        "ATTACH '{inside}/x.duckdb'",
        "CREATE TABLE x AS SELECT 1",
        "CREATE OR REPLACE VIEW measurements AS SELECT 1",
        "DROP VIEW measurements",
        "SET enable_external_access = true",
        "RESET lock_configuration",
        "INSTALL httpfs",
        "LOAD httpfs",
        "PRAGMA enable_profiling = 'json'",
        "SELECT 1; DROP VIEW measurements",
        "CALL pragma_version()",
    ],
)
def test_nothing_is_written_or_changed(warehouse: Path, text: str) -> None:
    before = sorted(p.name for p in warehouse.iterdir())
    with pytest.raises(ConfigError, match=r"sql: (only queries are allowed|expected one statement|.*Error)"):
        query(warehouse, text.format(inside=warehouse, outside=warehouse.parent))
    assert sorted(p.name for p in warehouse.iterdir()) == before
    assert query(warehouse, "SELECT count(*) AS n FROM measurements").to_pylist() == [{"n": 0}]
