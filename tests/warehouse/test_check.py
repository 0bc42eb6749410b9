"""`verify` finds every file that is not what its name says, and every bundle that is not what it was."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pytest
from fake_inbox import FakeStages, run_night, seal

from warehouse import catalog, store
from warehouse.check import verify
from warehouse.light import LIGHT
from warehouse.lineage import Ledger

DAY = "2025-04-05"


@pytest.fixture
def warehouse(inbox: Path, tmp_path: Path, stages: FakeStages) -> Path:
    run_night(inbox, tmp_path / "warehouse")
    return tmp_path / "warehouse"


def test_a_sound_warehouse(inbox: Path, warehouse: Path) -> None:
    found = verify(warehouse, inbox)
    assert found["files"] > 15
    assert found["broken"] == []
    assert found["unnamed"] == 0  # what a stage wrote is named, and nothing else lies about


def test_a_warehouse_that_was_moved_is_sound(inbox: Path, warehouse: Path, tmp_path: Path) -> None:
    catalog.build(warehouse, Ledger(warehouse))
    warehouse.rename(tmp_path / "moved")
    assert verify(tmp_path / "moved", inbox)["broken"] == []


def test_files_that_changed_or_are_gone(warehouse: Path) -> None:
    spoilt, gone, *_ = sorted(warehouse.glob("filtered_clouds/*/*/*.parquet"))
    spoilt.write_bytes(spoilt.read_bytes() + b"x")
    gone.unlink()
    stray = gone.with_name("0123456789abcdef.parquet")
    stray.write_bytes(b"stray")
    found = verify(warehouse, None)
    assert found["broken"] == [
        f"{spoilt.relative_to(warehouse).as_posix()}: its bytes do not hash to its name",
        f"{gone.relative_to(warehouse).as_posix()}: missing",
    ]
    assert found["unnamed"] == 1


def test_bundles_that_changed(inbox: Path, warehouse: Path) -> None:
    (inbox / "scans" / f"ref-{DAY}" / "frames.parquet").write_bytes(b"")
    seal(inbox / "scans" / f"scan-{DAY}-0", comment="another")
    shutil.rmtree(inbox / "scans" / f"scan-{DAY}-1")
    seal(inbox / "calibrations" / "cal-1", "calibration.json", temperature_c={"rig": 21})
    broken = verify(warehouse, inbox)["broken"]
    assert len(broken) == 3
    assert broken[0] == "calibrations/cal-1: its files changed since they were processed"
    assert broken[1].startswith(f"scans/ref-{DAY}/frames.parquet: sha256 is")
    assert broken[2] == f"scans/scan-{DAY}-0: its files changed since they were processed"


def test_bundles_that_are_new_or_were_refused_are_no_finding(inbox: Path, warehouse: Path) -> None:
    (inbox / "scans" / "new").mkdir()
    (inbox / "scans" / "new" / "scan.json").write_text("{")
    assert verify(warehouse, inbox)["broken"] == []


def rewrite_light(warehouse: Path, change: Callable[[pa.Table], pa.Table]) -> str:
    """Put another file of a day's measurements in place, under its proper name and named by every receipt."""
    ledger = Ledger(warehouse)
    day = ledger.day(DAY)
    path = next(o.path for r in day.current.values() for o in r.outputs if o.table == "measurements")
    changed = change(store.read_table(warehouse, path))
    new, _, _ = store.write_table(warehouse, LIGHT["measurements"], changed.combine_chunks(), DAY, None)
    for key, record in day.current.items():
        outputs = tuple(replace(o, path=new) if o.table == "measurements" else o for o in record.outputs)
        day.current[key] = replace(record, outputs=outputs)
    day.dirty = True
    ledger.save(DAY)
    return new


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (lambda t: t.slice(1), f"0 rows of ref-{DAY}, 1 on record"),
        (lambda t: pa.concat_tables([t, t.slice(0, 1)]), "occurs more than once"),
        (lambda t: renamed(t, "stranger"), "1 rows of stranger, which no record accounts for"),
        (
            lambda t: pa.concat_tables([other_value(t.slice(0, 1)), t.slice(1)]),
            f"rows of ref-{DAY} are not those on record",
        ),
    ],
)
def test_rows_are_held_against_their_receipts(
    warehouse: Path, change: Callable[[pa.Table], pa.Table], wrong: str
) -> None:
    rewrite_light(warehouse, change)
    broken = verify(warehouse, None)["broken"]
    assert any(wrong in line for line in broken), broken
    assert all(line.startswith(f"measurements of {DAY}: ") for line in broken)


def renamed(table: pa.Table, name: str) -> pa.Table:
    names = [*table["scan_id"].to_pylist()[:-1], name]
    return table.set_column(0, table.schema.field("scan_id"), pa.array(names))


def other_value(table: pa.Table) -> pa.Table:
    index = table.schema.get_field_index("value")
    return table.set_column(index, table.schema.field(index), pa.array([1.0] * table.num_rows))


def test_receipts_that_name_two_files(warehouse: Path) -> None:
    ledger = Ledger(warehouse)
    day = ledger.day(DAY)
    key = (f"scan-{DAY}-0", "measurements")
    outputs = tuple(replace(o, path=f"{o.table}/day={DAY}/other.parquet") for o in day.current[key].outputs)
    day.current[key] = replace(day.current[key], outputs=outputs)
    day.dirty = True
    ledger.save(DAY)
    assert any("its receipts name several files" in line for line in verify(warehouse, None)["broken"])


def test_a_catalog_that_cannot_be_read(warehouse: Path) -> None:
    catalog.build(warehouse, Ledger(warehouse))
    assert verify(warehouse, None)["broken"] == []
    next(warehouse.glob("features/*/*/*.parquet")).unlink()
    broken = verify(warehouse, None)["broken"]
    assert any(line.startswith("warehouse.duckdb: view features") for line in broken)
    (warehouse / "warehouse.duckdb").write_bytes(b"no database at all" * 1000)
    assert any("cannot be opened" in line for line in verify(warehouse, None)["broken"])
