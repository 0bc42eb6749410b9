"""A day's light tables: merged by unit, written once, and without the rows of units that are gone."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa

from warehouse import store
from warehouse.light import LIGHT, LightTables
from warehouse.lineage import Ledger, Output, Record
from wheelset_assets.declare import Table

TABLE: Table = LIGHT["stripe_statistics"]
DAY = "2025-04-05"


def rows(unit: str, n_points: int) -> pa.Table:
    numbers = {"n_frames": 1, "n_centres_left": 2, "n_centres_right": 3, "n_points": n_points}
    empty = {column.name: None if column.nullable else 0 for column in TABLE.columns}
    return TABLE.from_rows([empty | {"scan_id": unit, "sensor_id": s, "line": 0} | numbers for s in "ab"])


def put(root: Path, ledger: Ledger, units: dict[str, int]) -> LightTables:
    light = LightTables(root, ledger, DAY)
    for unit, n_points in units.items():
        data = rows(unit, n_points)
        output = Output(TABLE.name, "", store.table_hash(data), data.num_rows, data.nbytes)
        record = Record(unit, unit, "triangulated_clouds", "ok", None, "f", "1", "c", (), (output,))
        ledger.day(DAY).put(record)
        light.put(TABLE.name, unit, data)
    light.flush()
    ledger.save(DAY)
    return light


def stored(root: Path, ledger: Ledger) -> dict[str, list[int]]:
    paths = {r.output(TABLE.name).path for r in ledger.day(DAY).current.values()}
    assert len(paths) == 1, "all records of a day name the same file"
    found: dict[str, list[int]] = {}
    for row in store.read_table(root, paths.pop()).to_pylist():
        found.setdefault(row["scan_id"], []).append(row["n_points"])
    return found


def test_units_merge_into_one_file_a_day(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    put(tmp_path, ledger, {"s-2": 2, "s-1": 1})
    assert stored(tmp_path, ledger) == {"s-1": [1, 1], "s-2": [2, 2]}
    again = Ledger(tmp_path)
    put(tmp_path, again, {"s-3": 3, "s-1": 9})
    assert stored(tmp_path, again) == {"s-1": [9, 9], "s-2": [2, 2], "s-3": [3, 3]}
    light = LightTables(tmp_path, again, DAY)
    assert light.get(TABLE.name, "s-3").equals(rows("s-3", 3))
    assert light.get(TABLE.name, "s-4").num_rows == 0


def test_the_order_of_arrival_does_not_show(tmp_path: Path) -> None:
    names = [f"s-{i}" for i in range(5)]
    one, two = Ledger(tmp_path / "1"), Ledger(tmp_path / "2")
    put(tmp_path / "1", one, {n: i for i, n in enumerate(names)})
    for i, n in reversed(list(enumerate(names))):
        put(tmp_path / "2", two, {n: i})
    assert {r.output(TABLE.name) for r in one.day(DAY).current.values()} == {
        r.output(TABLE.name) for r in two.day(DAY).current.values()
    }


def test_a_dropped_unit_leaves_the_file(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    put(tmp_path, ledger, {"s-1": 1, "s-2": 2})
    light = LightTables(tmp_path, ledger, DAY)
    del ledger.day(DAY).current["s-1", "triangulated_clouds"]
    light.drop("s-1", (TABLE,))
    light.flush()
    assert stored(tmp_path, ledger) == {"s-2": [2, 2]}


def test_rows_that_no_record_accounts_for_are_pruned(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    put(tmp_path, ledger, {"s-1": 1, "s-2": 2})
    del ledger.day(DAY).current["s-1", "triangulated_clouds"]
    light = LightTables(tmp_path, ledger, DAY)
    light.prune()
    light.flush()
    assert stored(tmp_path, ledger) == {"s-2": [2, 2]}


def test_nothing_changed_nothing_written(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    put(tmp_path, ledger, {"s-1": 1})
    files = set(tmp_path.rglob("*.parquet"))
    light = LightTables(tmp_path, ledger, DAY)
    light.prune()
    light.flush()
    light.drop("s-7", (TABLE,))
    light.flush()
    assert set(tmp_path.rglob("*.parquet")) == files
    assert not ledger.day(DAY).dirty


def test_the_last_unit_gone_leaves_no_file_behind_that_somebody_names(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    put(tmp_path, ledger, {"s-1": 1})
    ledger.day(DAY).current.clear()
    light = LightTables(tmp_path, ledger, DAY)
    light.prune()
    light.flush()
    assert light.get(TABLE.name, "s-1").num_rows == 0
