"""What a night works on first: references in order of time, then the newest day; and what it keeps in memory meanwhile."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from fake_inbox import FakeStages, inbox_of, run_night

from warehouse import store
from warehouse.lineage import Ledger
from warehouse.night import Night
from wheelset_assets.config import Config
from wheelset_assets.stages import SCAN_STAGES

DAYS = ("2025-04-05", "2025-04-06", "2025-04-07")


def test_references_first_then_the_newest_scans(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=DAYS, scans=1), tmp_path / "w"
    summary = run_night(inbox, warehouse)
    assert summary.measured == 6
    measured = [unit for stage, unit in stages.take() if stage == "measurements"]
    assert measured == [*(f"ref-{day}" for day in DAYS), *(f"scan-{day}-0" for day in reversed(DAYS))]
    assert run_night(inbox, warehouse).unchanged == 6
    assert stages.take() == []


def test_one_day_is_one_piece_of_work(tmp_path: Path, stages: FakeStages) -> None:
    inbox = inbox_of(tmp_path / "inbox", days=DAYS[:1], scans=1)
    with Night(tmp_path / "w", inbox, Config(), workers=0, wait_seconds=0) as night:
        night.prepare()
        night.run_calibrations()
        found = []
        for day in night.days_with_work():
            found.append(day)
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
    assert found == [DAYS[0]]


@pytest.mark.parametrize("scans", [0, 1])
def test_the_figures_of_a_day_tell_of_its_references_too(tmp_path: Path, stages: FakeStages, scans: int) -> None:
    inbox = inbox_of(tmp_path / "inbox", days=DAYS, scans=scans)
    found = []
    with Night(tmp_path / "w", inbox, Config(), workers=0, wait_seconds=0) as night:
        night.prepare()
        night.run_calibrations()
        for day in night.days_with_work():
            last = [night.run_stage(stage, day) for stage in SCAN_STAGES][-1]
            found.append((day, night.references_only, last.computed, last.unchanged))
    ahead = [(day, True, 1, 0) for day in DAYS]
    assert found == ahead + [(day, False, 1 + scans, 0) for day in reversed(DAYS)]


def test_the_window_closes_between_days_and_the_next_run_goes_on(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=DAYS, scans=1), tmp_path / "w"
    shut = run_night(inbox, warehouse, until=datetime(2020, 1, 1, tzinfo=UTC))
    assert (shut.measured, shut.pending) == (0, 6)
    assert run_night(inbox, warehouse).measured == 6


def test_days_that_are_done_leave_memory(tmp_path: Path, stages: FakeStages) -> None:
    inbox = inbox_of(tmp_path / "inbox", days=DAYS, scans=1)
    most = 0
    with Night(tmp_path / "w", inbox, Config(), workers=0, wait_seconds=0) as night:
        night.prepare()
        night.run_calibrations()
        for day in night.days_with_work():
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
            most = max(most, len([d for d in night.ledger._days if d[:2] == "20"]))
    assert most <= 2, "the day itself, and that of a reference before it"


@pytest.mark.parametrize("at_once", [True, False])
def test_data_are_on_disk_before_the_ledger_names_them(
    tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch, at_once: bool
) -> None:
    """By one call for all files where the system has it, else file by file and the folders' names by the day."""
    done: list[str] = []
    write = Ledger._write
    monkeypatch.setattr(store, "can_flush_all", lambda root: at_once)
    monkeypatch.setattr(store, "flush_all", lambda root: done.append("flushed"))
    monkeypatch.setattr(store, "flush_names", lambda root, day: done.append("flushed"))
    monkeypatch.setattr(Ledger, "_write", lambda s, path, table: (done.append(path.stem), write(s, path, table))[1])
    run_night(inbox_of(tmp_path / "inbox", days=DAYS, scans=1), tmp_path / "w")
    assert {*done[::2]} == {"flushed"}
    assert "flushed" not in done[1::2]
    assert len([name for name in done if name.startswith("day=2025")]) >= 2 * len(DAYS)


def test_what_cannot_be_flushed_is_not_put_on_record(
    tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(root: Path) -> None:
        raise OSError(5, "Input/output error", str(root))

    inbox = inbox_of(tmp_path / "inbox", days=DAYS, scans=1)
    monkeypatch.setattr(store, "can_flush_all", lambda root: True)
    with monkeypatch.context() as patch:
        patch.setattr(store, "flush_all", lost)
        with pytest.raises(OSError, match="Input/output"):
            run_night(inbox, tmp_path / "w")
    assert not list((tmp_path / "w" / "_ledger").glob("day=2025*"))
    assert run_night(inbox, tmp_path / "w").measured == 2 * len(DAYS)
