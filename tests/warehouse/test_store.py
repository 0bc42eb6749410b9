"""Files are named by their content, appear whole or not at all, and hold nothing of the run that wrote them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from warehouse import store
from wheelset_assets.declare import Column, Table

POINTS = Table(
    "points",
    1,
    "Points",
    key=("row",),
    layout="scan",
    columns=(
        Column("row", "int16", "Row"),
        Column("x_mm", "float32", "Place", unit="mm"),
        Column("sensor_id", "category", "Sensor"),
        Column("quality_flags", "strings", "Flags"),
    ),
)


def points(n: int = 1000, shift: float = 0.0) -> pa.Table:
    return POINTS.from_columns(
        {
            "row": list(range(n)),
            "x_mm": [shift + i / 7 for i in range(n)],
            "sensor_id": ["a"] * n,
            "quality_flags": [["outliers"], []] * (n // 2),
        }
    )


def test_a_file_is_named_by_its_bytes_and_reads_back_the_same(tmp_path: Path) -> None:
    data = points()
    path, version, size = store.write_table(tmp_path, POINTS, data, "2025-04-05", "s-1")
    assert path == f"points/day=2025-04-05/scan_id=s-1/{version}.parquet"
    assert store.sha256_file(tmp_path / path).startswith(version)
    assert (tmp_path / path).stat().st_size == size
    assert store.read_table(tmp_path, path).equals(data)
    assert store.read_table(tmp_path, path, ["x_mm"]).column_names == ["x_mm"]


@pytest.mark.parametrize(
    ("layout", "expected"),
    [
        ("scan", "points/day=d/scan_id=k"),
        ("day", "points/day=d"),
        ("calibration", "points/calibration_id=k"),
        ("fleet", "points"),
    ],
)
def test_layouts(tmp_path: Path, layout: str, expected: str) -> None:
    from dataclasses import replace

    table = replace(POINTS, layout=layout)  # type: ignore[arg-type]
    assert store.folder(tmp_path, table, "d", "k") == tmp_path / expected


def test_equal_data_give_equal_bytes_wherever_and_however_chunked(tmp_path: Path) -> None:
    data = points()
    pieces = pa.concat_tables([data.slice(0, 10), data.slice(10)])
    first = store.write_table(tmp_path / "a", POINTS, data, "2025-04-05", "s-1")
    assert store.write_table(tmp_path / "b", POINTS, data, "2025-04-05", "s-1") == first
    assert store.table_hash(pieces) == store.table_hash(data)
    assert store.write_table(tmp_path, POINTS, points(shift=1e-3), "2025-04-05", "s-1")[1] != first[1]
    assert store.table_hash(points(shift=1e-3)) != store.table_hash(data)


def test_the_hash_of_content_does_not_see_how_it_lies_in_memory(tmp_path: Path) -> None:
    table = Table("t", 1, "T", key=(), layout="day", columns=(
        Column("name", "string", "Name"), Column("n", "float64", "N", nullable=True), Column("flags", "strings", "Flags"),
        Column("list", "float64s", "List", nullable=True),
    ))  # fmt: skip
    rows = [
        {"name": f"r{i}", "n": None if i % 2 else float(i), "flags": ["a"] * i, "list": None if i == 1 else [i]}
        for i in range(4)
    ]
    whole = table.from_rows(rows)
    path, *_ = store.write_table(tmp_path, table, whole, "2025-04-05", None)
    for found in (whole.slice(1, 2), store.read_table(tmp_path, path).slice(1, 2)):
        assert store.table_hash(found) == store.table_hash(table.from_rows(rows[1:3]))
    assert store.table_hash(whole.slice(1, 2)) != store.table_hash(whole.slice(2, 2))
    assert store.table_hash(whole.rename_columns(["name", "m", "flags", "list"])) != store.table_hash(whole)


def test_writing_again_changes_nothing(tmp_path: Path) -> None:
    path, *_ = store.write_table(tmp_path, POINTS, points(), "2025-04-05", "s-1")
    assert store.write_table(tmp_path, POINTS, points(), "2025-04-05", "s-1")[0] == path
    assert [p.name for p in (tmp_path / path).parent.iterdir()] == [Path(path).name]


def test_nothing_of_the_run_is_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, *_ = store.write_table(tmp_path, POINTS, points(), "2025-04-05", "s-1")
    metadata = pq.read_metadata(tmp_path / path)
    assert str(os.getpid()) not in str(metadata.metadata)
    assert str(tmp_path) not in str(metadata.metadata)


@pytest.mark.parametrize("where", ["os.fsync", "os.replace"])
def test_a_kill_while_writing_leaves_no_file_under_a_final_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    class Killed(BaseException):
        pass

    def kill(*_: object) -> None:
        raise Killed

    store.folder(tmp_path, POINTS, "2025-04-05", "s-1").mkdir(parents=True)  # or making it would be killed first
    with monkeypatch.context() as patch:
        patch.setattr(f"warehouse.store.{where}", kill)
        with pytest.raises(Killed):
            store.write_table(tmp_path, POINTS, points(), "2025-04-05", "s-1")
        with pytest.raises(Killed):
            store.write_bytes(tmp_path / "small.json", b"{}")
    left = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert len(left) == 2
    assert all(p.name.startswith(".tmp-") for p in left)
    assert store.sweep_temporary(tmp_path) == 2
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


def test_a_small_file_is_replaced_whole(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b.json"
    store.write_bytes(target, b"one")
    store.write_bytes(target, b"two")
    assert target.read_bytes() == b"two"
    assert [p.name for p in target.parent.iterdir()] == ["b.json"]


def test_a_published_name_is_flushed_with_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rename that is not flushed may be undone by a power cut, after the ledger has named the file."""
    flushed: list[Path] = []
    monkeypatch.setattr(store, "sync_folder", flushed.append)
    store.write_bytes(tmp_path / "a.json", b"{}")
    assert flushed == [tmp_path]


def test_the_names_of_scans_folders_are_flushed_by_the_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed: list[Path] = []
    monkeypatch.setattr(store, "sync_folder", flushed.append)
    monkeypatch.setattr(store, "TABLES", {POINTS.name: POINTS})
    for unit in ("s-1", "s-2"):
        store.write_table(tmp_path, POINTS, points(), "2025-04-05", unit)
    day = tmp_path / POINTS.name / "day=2025-04-05"
    assert [f for f in flushed if f.name[:8] != "scan_id="] == [tmp_path, day.parent]
    store.flush_names(tmp_path, "2025-04-05")
    assert flushed[-1] == day
    store.flush_names(tmp_path, "2025-04-06")  # nothing was written on it
    assert flushed[-1] == day


def test_small_and_large_tables_are_written_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = store.write_table(tmp_path / "small", POINTS, points(), "2025-04-05", "s-1")
    monkeypatch.setattr(store, "SMALL_BYTES", 0)
    large = store.write_table(tmp_path / "large", POINTS, points(), "2025-04-05", "s-1")
    assert small == large
    assert (tmp_path / "small" / small[0]).read_bytes() == (tmp_path / "large" / large[0]).read_bytes()


def test_some_columns_come_in_the_order_asked_for(tmp_path: Path) -> None:
    path, *_ = store.write_table(tmp_path, POINTS, points(), "2025-04-05", "s-1")
    names = list(reversed(points().column_names))
    assert store.read_table(tmp_path, path, names).equals(points().select(names))


def test_files_may_be_flushed_all_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr("warehouse.store.os.fsync", calls.append)
    path, version, _ = store.write_table(tmp_path, POINTS, points(), "2025-04-05", "s-1", flushed=False)
    assert calls == []
    assert store.write_table(tmp_path, POINTS, points(), "2025-04-05", "s-1")[:2] == (path, version)
    assert calls


@pytest.mark.skipif(sys.platform != "linux", reason="syncfs is Linux's")
def test_a_file_system_is_flushed_by_one_call(tmp_path: Path) -> None:
    assert store.can_flush_all(tmp_path)
    store.flush_all(tmp_path)
    with pytest.raises(FileNotFoundError):
        store.flush_all(tmp_path / "gone")
