"""Screens of checks: yes only where the check's SQL selects nothing, and yes for what a stage makes when all is well."""

from __future__ import annotations

import duckdb
import numpy as np
import pyarrow as pa
import pytest

from wheelset_assets.declare import Check, Table
from wheelset_assets.tables import BUDGETS, MEASUREMENTS, TABLES

SCREENED = [(table, check) for table in TABLES.values() for check in table.checks if check.screen is not None]


def selects(check: Check, data: pa.Table) -> bool:
    with duckdb.connect() as connection:
        connection.register("audited", data)
        return bool(connection.execute(check.sql.format(table="audited")).fetchall())


def random_rows(table: Table, rng: np.random.Generator, n: int) -> pa.Table:
    """Rows whose values come from few, so that every check is met and broken now and then."""
    few = {
        "value": [1.0, None],
        "reason": ["because", None],
        "expanded_uncertainty": [0.1, 0.2, 0.1, 0.0, None],
        "scan_id": ["s-1", "s-2"],
        "quantity": ["d", "q"],
        "side": ["left", "right"],
        "share": [0.5, 0.5, 1.0, 0.25, 1e-7],
    }
    made = {}
    for column in table.columns:
        chosen = few.get(column.name, [None])
        made[column.name] = pa.array([chosen[i] for i in rng.integers(0, len(chosen), n)], column.arrow.type)
    return pa.table(made)


@pytest.mark.parametrize(("table", "check"), SCREENED, ids=[check.name for _, check in SCREENED])
def test_a_screen_never_hides_what_its_check_selects(table: Table, check: Check) -> None:
    assert check.screen is not None
    rng = np.random.default_rng(5)
    seen = set()
    for _ in range(300):
        data = random_rows(table, rng, int(rng.integers(1, 4)))
        passed, found = check.screen(data), selects(check, data)
        seen.add((passed, found))
        assert not (passed and found), data.to_pylist()
    assert seen == {(True, False), (False, True)}


def rows(table: Table, **columns: list) -> pa.Table:
    n = len(next(iter(columns.values())))
    return pa.table(
        {c.name: pa.array(columns.get(c.name, [None] * n), c.arrow.type) for c in table.columns},
    )


def test_values_that_are_no_number_go_to_the_sql() -> None:
    nan = rows(MEASUREMENTS, value=[1.0], expanded_uncertainty=[float("nan")])
    screen = {check.name: check.screen for check in MEASUREMENTS.checks}["value_with_uncertainty"]
    assert screen is not None
    assert not screen(nan)


def test_a_group_that_lies_apart_is_summed_as_one() -> None:
    [check] = BUDGETS.checks
    assert check.screen is not None
    names = {"scan_id": ["s", "t", "s"], "quantity": ["d"] * 3, "side": ["left"] * 3}
    assert check.screen(rows(BUDGETS, **names, share=[0.4, 1.0, 0.6]))
    assert not check.screen(rows(BUDGETS, **names, share=[1.0, 1.0, 1.0]))
    unknown = rows(BUDGETS, **(names | {"scan_id": ["s", None, "s"]}), share=[0.4, 1.0, 0.6])
    assert not check.screen(unknown)
    assert not check.screen(rows(BUDGETS, **names, share=[0.4, None, 0.6]))
    assert not check.screen(rows(BUDGETS, **names, share=[0.4, float("nan"), 0.6]))
