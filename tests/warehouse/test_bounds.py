"""Limits of a run, and what is tried again: poison is killed and blamed, trouble that passes is waited out."""

from __future__ import annotations

import errno
import time
from pathlib import Path
from types import SimpleNamespace

import pool_tasks
import pytest
from fake_inbox import FakeStages, counts, inbox_of, run_night, seal

from warehouse import bounds, execute, night, store
from warehouse.bounds import Bounds, DiskFull, with_retries
from warehouse.execute import Outcome, Task
from warehouse.lineage import Ledger
from warehouse.planner import plan
from warehouse.pool import Pool, WorkerDied
from wheelset_assets.config import Config
from wheelset_assets.quality import ConfigError

DAY = "2025-04-05"


def test_endless_loop_and_crash_are_killed_and_named_and_the_others_done() -> None:
    started = time.monotonic()
    with Pool(2, bounds=Bounds(task_seconds=2.0)) as pool:
        done = dict(pool.run(pool_tasks.poison, ["good", "endless", "segfault", "fine"]))
    assert (done["good"], done["fine"]) == ("good", "fine")
    assert isinstance(done["endless"], WorkerDied)
    assert "longer than 2 s, the limit of a task" in str(done["endless"])
    assert isinstance(done["segfault"], WorkerDied)
    assert "SIGSEGV" in str(done["segfault"])
    assert time.monotonic() - started < 120


def test_a_worker_cannot_take_more_memory_than_its_share() -> None:
    with Pool(1, bounds=Bounds(memory_gb=1.5)) as pool:
        (found,) = pool.run(pool_tasks.poison, ["memory"])
        (after,) = pool.run(pool_tasks.poison, ["good"])
    assert isinstance(found[1], MemoryError)
    assert after == ("good", "good")


def test_fewer_workers_where_memory_is_small() -> None:
    assert Bounds(memory_gb=1.6).workers(8) == 2
    assert Bounds(memory_gb=0.1).workers(8) == 1
    assert Bounds(memory_gb=0.1).workers(0) == 0
    assert Bounds().workers(8) == 8
    with pytest.raises(ConfigError, match="disk_floor_gb: expected a number"):
        Bounds(disk_floor_gb=-1.0)


def test_what_passes_is_tried_again_and_nothing_else() -> None:
    waits: list[float] = []
    errors = [OSError(errno.EIO, "a moment"), OSError(errno.ESTALE, "a moment"), None]

    def action() -> str:
        if error := errors.pop(0):
            raise error
        return "done"

    assert with_retries(action, waits.append) == "done"
    assert waits == [0.5, 2.0]
    errors[:] = [OSError(errno.EACCES, "never"), None]
    with pytest.raises(OSError, match="never"):
        with_retries(action, waits.append)
    errors[:] = [OSError(errno.EIO, "always")] * 3
    with pytest.raises(OSError, match="always"):
        with_retries(action, waits.append)
    assert len(waits) == 4


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """No waiting between tries."""
    monkeypatch.setattr(bounds, "FIRST_WAIT_SECONDS", 0.0)


def test_a_scan_whose_disk_did_not_answer_is_tried_by_the_next_run(
    inbox: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages.failing["features", f"scan-{DAY}-0"] = "input or output: [Errno 5]"
    passing = lambda task: _as_passing(stages(task))  # noqa: E731
    monkeypatch.setattr(night, "execute", passing)
    assert counts(run_night(inbox, tmp_path / "w")) == (2, 0, 1, 0)
    (day,) = plan(tmp_path / "w", inbox, Config()).days
    assert day.stale == {"features": [f"scan-{DAY}-0"]}
    stages.failing.clear()
    assert counts(run_night(inbox, tmp_path / "w")) == (1, 0, 0, 2)


def _as_passing(outcome: Outcome) -> Outcome:
    return outcome if outcome.state == "ok" else Outcome(outcome.unit, outcome.stage, "failed", "i/o", passing=True)


def test_a_failure_is_not_tried_again_unless_asked_for(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    stages.failing["features", f"scan-{DAY}-0"] = "the worker process died"
    run_night(inbox, tmp_path / "w")
    stages.take()
    assert counts(run_night(inbox, tmp_path / "w")) == (0, 0, 0, 3)
    assert stages.take() == []
    assert counts(run_night(inbox, tmp_path / "w", retry_failed=True)) == (0, 0, 1, 2)
    assert stages.take() == [("features", f"scan-{DAY}-0")], "once, though it failed again"
    stages.failing.clear()
    assert counts(run_night(inbox, tmp_path / "w", retry_failed=True)) == (1, 0, 0, 2)


def test_a_bundle_that_cannot_be_read_now_is_pending_and_not_refused(
    inbox: Path, tmp_path: Path, stages: FakeStages, hasty: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, troubled = store.sha256_file, f"scan-{DAY}-0"

    def sometimes(path: Path) -> str:
        if troubled in path.parts:
            raise OSError(errno.EIO, "Input/output error", str(path))
        return real(path)

    from warehouse import inbox as module

    monkeypatch.setattr(module, "sha256_file", sometimes)
    summary = run_night(inbox, tmp_path / "w")
    assert (counts(summary), summary.pending) == ((2, 0, 0, 0), 1)
    assert "could not be read" in summary.warnings[0]
    monkeypatch.setattr(module, "sha256_file", real)
    assert counts(run_night(inbox, tmp_path / "w")) == (1, 0, 0, 2)


def task_over(folder: Path, root: Path) -> Task:
    return Task(root, "triangulated_clouds", "s", DAY, Config().triangulation, bundle_folder=folder)


@pytest.mark.parametrize(
    ("error", "words", "passing"),
    [
        (OSError(errno.EIO, "Input/output error"), "input or output", True),
        (FileNotFoundError(errno.ENOENT, "gone", "/bundle/frames.parquet"), "vanished while it was read", True),
        (MemoryError(), "out of memory", False),
    ],
)
def test_trouble_of_a_task_becomes_an_outcome(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hasty: None, error: Exception, words: str, passing: bool
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(execute, "_get", fails)
    outcome = execute.execute(task_over(Path("/bundle"), tmp_path))
    assert (outcome.state, outcome.passing) == ("failed", passing)
    assert words in str(outcome.reason)


def test_a_full_disk_stops_the_run_in_words_and_the_next_goes_on(
    tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, warehouse = inbox_of(tmp_path / "inbox", scans=4), tmp_path / "w"
    real, room = store.write_table, [20]

    def until_full(*arguments: object, **options: object) -> object:
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(store, "write_table", until_full)
    with pytest.raises((DiskFull, OSError), match=r"(?i)no (room|space)"):
        run_night(place, warehouse)
    room[0] = 10**6
    assert counts(run_night(place, warehouse))[0] == 5
    from warehouse.check import verify

    assert verify(warehouse, place)["broken"] == []


def test_too_little_free_disk_stops_before_anything_is_computed(
    inbox: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounds.shutil, "disk_usage", lambda _: SimpleNamespace(free=4e8))
    with pytest.raises(DiskFull, match=r"0\.40 GB are free, less than the floor of 1 GB"):
        run_night(inbox, tmp_path / "w")
    assert stages.take() == []
    assert counts(run_night(inbox, tmp_path / "w", bounds=Bounds(disk_floor_gb=0.1)))[0] == 3


def test_a_changed_bundle_is_tried_again(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    stages.failing["features", f"scan-{DAY}-0"] = "the worker process died"
    run_night(inbox, tmp_path / "w")
    stages.failing.clear()
    seal(inbox / "scans" / f"scan-{DAY}-0", comment="mended")
    frames = inbox / "scans" / f"scan-{DAY}-0" / "frames.parquet"
    assert frames.exists()
    run_night(inbox, tmp_path / "w")
    record = Ledger(tmp_path / "w").day(DAY).get(f"scan-{DAY}-0", "features")
    assert record is not None
    assert record.state == "ok"
