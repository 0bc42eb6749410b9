"""`gc` takes what the rule lets go, and never a current file; dry unless told otherwise; safe if it is cut short."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from fake_inbox import FakeStages, run_night, seal

from warehouse import catalog, collect
from warehouse.check import verify
from warehouse.collect import Retention
from warehouse.lineage import Ledger
from warehouse.lock import WarehouseLock
from wheelset_assets.config import Config
from wheelset_assets.quality import ConfigError

DAY = "2025-04-05"
LATER = datetime.now(UTC) + timedelta(days=100)


@pytest.fixture
def warehouse(inbox: Path, tmp_path: Path, stages: FakeStages) -> Path:
    """Three generations: the second and third by other knobs."""
    for window in (5, 7, 9):
        config = Config.model_validate({"filtering": {"window_rows": window}})
        run_night(inbox, tmp_path / "w", config)
    catalog.build(tmp_path / "w", Ledger(tmp_path / "w"))
    return tmp_path / "w"


def data_files(warehouse: Path) -> set[str]:
    return {
        p.relative_to(warehouse).as_posix() for p in warehouse.rglob("*.parquet") if not p.parts[-2].startswith("_")
    }


def current(warehouse: Path) -> set[str]:
    records = [r for day in ("calibrations", DAY, "fleet") for r in Ledger(warehouse).day(day).current.values()]
    return {o.path for r in records for o in r.outputs}


def test_dry_by_default_and_what_it_says_is_what_goes(warehouse: Path) -> None:
    before = data_files(warehouse)
    dry = collect.collect(warehouse, Retention(), delete=False, now=LATER)
    assert data_files(warehouse) == before
    assert dry.versions > 0
    done = collect.collect(warehouse, Retention(), delete=True, now=LATER)
    assert (done.versions, done.files, done.bytes) == (dry.versions, dry.files, dry.bytes)
    assert before - data_files(warehouse) == set(done.paths)
    assert done.paths
    assert not set(done.paths) & current(warehouse)
    assert verify(warehouse, None) == {"files": len(data_files(warehouse)), "broken": [], "unnamed": 0}
    assert collect.collect(warehouse, Retention(), delete=True, now=LATER).files == 0


def test_the_rule(warehouse: Path) -> None:
    n = len([r for r in Ledger(warehouse).day(DAY).history if r.stage == "filtered_clouds"])
    assert n == 6, "three scans, two generations superseded"
    assert collect.collect(warehouse, Retention(keep_days=90), delete=False).versions == 0
    collect.collect(warehouse, Retention(keep_days=0, keep_versions=1), delete=True, now=LATER)
    assert len([r for r in Ledger(warehouse).day(DAY).history if r.stage == "filtered_clouds"]) == 3
    collect.collect(warehouse, Retention(keep_days=0, keep_versions=0), delete=True, now=LATER)
    assert Ledger(warehouse).day(DAY).history == []
    assert data_files(warehouse) == current(warehouse)
    with pytest.raises(ConfigError, match="--keep-days: expected"):
        Retention(keep_days=-1)


def test_strays_and_recordings_that_nobody_names(warehouse: Path) -> None:
    (warehouse / "recordings").mkdir()
    (warehouse / "recordings" / "old.rrd").write_bytes(b"recording")
    (warehouse / "features" / "0123456789abcdef.parquet").write_bytes(b"stray")
    found = collect.collect(warehouse, Retention(keep_days=1000), delete=True)
    assert {"recordings/old.rrd", "features/0123456789abcdef.parquet"} <= set(found.paths)
    assert found.by_table["recordings"] == {"files": 1, "bytes": 9}
    assert not set(found.paths) & current(warehouse)


def test_cut_short_after_the_ledger_the_next_one_ends_it(warehouse: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(catalog, "build", killed)
    with pytest.raises(KeyboardInterrupt):
        collect.collect(warehouse, Retention(), delete=True, now=LATER)
    monkeypatch.undo()
    assert verify(warehouse, None)["broken"] == []
    assert collect.collect(warehouse, Retention(), delete=True, now=LATER).files > 0
    assert verify(warehouse, None)["unnamed"] == 0


def test_not_while_a_run_writes(warehouse: Path) -> None:
    lock = WarehouseLock(warehouse)
    lock.acquire()
    with pytest.raises(ConfigError, match="another run"):
        collect.collect(warehouse, Retention(), delete=False)
    lock.release()


def test_a_run_after_it_finds_nothing_to_do(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    config = Config.model_validate({"filtering": {"window_rows": 9}})
    stages.take()
    collect.collect(warehouse, Retention(keep_days=0, keep_versions=0), delete=True, now=LATER)
    assert run_night(inbox, warehouse, config).unchanged == 3
    assert stages.take() == []
    seal(inbox / "scans" / f"scan-{DAY}-0", comment="mended")
    assert run_night(inbox, warehouse, config).measured == 1
