"""The SQL functions of the reports against scipy."""

from __future__ import annotations

import duckdb
import pytest
from scipy import stats

from warehouse.report import functions


@pytest.fixture(scope="module")
def connection() -> duckdb.DuckDBPyConnection:
    connection = duckdb.connect(":memory:")
    connection.execute(functions())
    return connection


@pytest.mark.parametrize("df", [*range(1, 41), 60, 100, 999, 10_000, 1_000_000])
def test_the_quantile_of_t_is_scipys(connection: duckdb.DuckDBPyConnection, df: int) -> None:
    (found,) = connection.execute("SELECT student_t_95($1)", [df]).fetchone() or ()
    assert found == pytest.approx(stats.t.ppf(0.975, df), abs=1e-7)


@pytest.mark.parametrize("df", [1, 2, 3, 4, 5, 10, 11, 30, 101, 1000, 5001])
@pytest.mark.parametrize("t", [0.0, 0.1, -1.0, 2.0, -5.0, 30.0])
def test_the_p_value_of_t_is_scipys(connection: duckdb.DuckDBPyConnection, t: float, df: int) -> None:
    (found,) = connection.execute("SELECT student_t_p($1::DOUBLE, $2::BIGINT)", [t, df]).fetchone() or ()
    assert found == pytest.approx(2 * stats.t.sf(abs(t), df), abs=1e-10)


@pytest.mark.parametrize(("k", "n"), [(0, 3), (1, 1), (1, 6), (2, 6), (6, 6), (30, 400), (2, 100_000)])
def test_the_binomial_tail_is_scipys(connection: duckdb.DuckDBPyConnection, k: int, n: int) -> None:
    (found,) = connection.execute("SELECT binomial_tail($1::BIGINT, $2::BIGINT, 0.05)", [k, n]).fetchone() or ()
    assert found == pytest.approx(stats.binom.sf(k - 1, n, 0.05), abs=1e-8)


def test_nothing_comes_of_nothing(connection: duckdb.DuckDBPyConnection) -> None:
    asked = ("student_t_95(0)", "student_t_95(NULL)", "student_t_p(NULL, 3)", "student_t_p(1.0, 0)")
    for each in (*asked, "student_t_p('nan'::DOUBLE, 4)"):
        assert connection.execute(f"SELECT {each}").fetchone() == (None,)
