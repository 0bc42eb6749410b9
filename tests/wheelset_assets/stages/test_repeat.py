"""Repeatability by wheelset, quantity, side and period, against the same by hand."""

from __future__ import annotations

import statistics
from datetime import date

import pyarrow as pa

from wheelset_assets.config import RepeatabilityConfig
from wheelset_assets.stages.repeat import run_repeatability


def rows(*given):
    names = ("wheelset_id", "quantity", "side", "acquired_on", "value", "purpose")
    table = [dict(zip(names, one, strict=True)) for one in given]
    more = {"unit": "mm", "expanded_uncertainty": 0.01}
    return pa.Table.from_pylist(
        [r | more | {"value_uncompensated": None if r["value"] is None else 2 * r["value"]} for r in table],
        schema=pa.schema(
            [
                ("wheelset_id", pa.string()),
                ("quantity", pa.string()),
                ("side", pa.string()),
                ("unit", pa.string()),
                ("acquired_on", pa.date32()),
                ("purpose", pa.string()),
                ("value", pa.float64()),
                ("value_uncompensated", pa.float64()),
                ("expanded_uncertainty", pa.float64()),
            ]
        ),
    )


MAY, LATER, JUNE = date(2025, 5, 3), date(2025, 5, 9), date(2025, 6, 1)
GIVEN = rows(
    ("b", "qr", "left", MAY, 11.0, "production"),
    ("a", "qr", "left", JUNE, 10.5, "production"),
    ("a", "qr", "left", MAY, 10.1, "production"),
    ("a", "qr", "left", MAY, 10.3, "production"),
    ("a", "qr", "left", LATER, 10.2, "production"),
    ("a", "qr", "right", MAY, 9.0, "production"),
    ("a", "qr", "left", MAY, 99.0, "reference"),
    ("a", "qr", "left", MAY, None, "production"),
)


def run(table=GIVEN, **settings):
    found = run_repeatability(measurements=table, config=RepeatabilityConfig(**settings))["repeatability"].to_pylist()
    return {(r["wheelset_id"], r["side"], r["period"], r["period_start"]): r for r in found}


def test_every_period_has_its_own_values_and_no_others():
    found = run()
    expected = {
        ("a", "left", "day", MAY): [10.1, 10.3],
        ("a", "left", "day", LATER): [10.2],
        ("a", "left", "day", JUNE): [10.5],
        ("a", "left", "month", date(2025, 5, 1)): [10.1, 10.3, 10.2],
        ("a", "left", "month", date(2025, 6, 1)): [10.5],
        ("a", "left", "all", MAY): [10.1, 10.3, 10.2, 10.5],
        ("a", "right", "day", MAY): [9.0],
        ("a", "right", "month", date(2025, 5, 1)): [9.0],
        ("a", "right", "all", MAY): [9.0],
        ("b", "left", "day", MAY): [11.0],
        ("b", "left", "month", date(2025, 5, 1)): [11.0],
        ("b", "left", "all", MAY): [11.0],
    }
    assert set(found) == set(expected)
    for key, values in expected.items():
        row = found[key]
        assert row["n"] == len(values)
        assert abs(row["mean"] - statistics.mean(values)) < 1e-12
        assert abs(row["range"] - (max(values) - min(values))) < 1e-12
        assert abs(row["range_uncompensated"] - 2 * row["range"]) < 1e-12
        assert (row["minimum"], row["maximum"], row["unit"]) == (min(values), max(values), "mm")
        if len(values) == 1:
            assert row["standard_deviation"] is None
        else:
            assert abs(row["standard_deviation"] - statistics.stdev(values)) < 1e-12
        assert abs(row["mean_expanded_uncertainty"] - 0.01) < 1e-15


def test_rows_are_sorted_and_do_not_depend_on_the_order_of_the_values():
    keys = list(run())
    assert keys == sorted(keys)
    backwards = GIVEN.take(list(range(GIVEN.num_rows))[::-1])
    assert run(backwards) == run()


def test_texts_may_come_as_dictionaries():
    encoded = GIVEN
    for i, name in enumerate(GIVEN.column_names):
        if pa.types.is_string(GIVEN[name].type):
            encoded = encoded.set_column(i, name, GIVEN[name].dictionary_encode())
    assert run(pa.concat_tables([encoded.slice(0, 3), encoded.slice(3)])) == run()


def test_periods_with_few_values_are_left_out():
    assert set(run(min_values=3)) == {("a", "left", "month", date(2025, 5, 1)), ("a", "left", "all", MAY)}


def test_nothing_measured_gives_no_row():
    assert run(GIVEN.slice(0, 0)) == {}
