"""What a killed run, an error that passes, or a bundle that came anew leaves behind, and how the next run gets over it."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from fake_inbox import FakeStages, counts, inbox_of, rows, run_night, seal, states, write_scan

from warehouse import bounds, catalog, morning, night, reviews
from warehouse import inbox as inbox_module
from warehouse.check import verify
from warehouse.collect import Retention, collect
from warehouse.inbox import Inbox
from warehouse.lineage import UNDATED, Ledger
from warehouse.planner import plan
from warehouse.pool import WorkerDied
from warehouse.recorder import Recorder
from wheelset_assets.config import Config
from wheelset_assets.stages import SCAN_STAGES

DAYS = ("2025-04-05", "2025-04-06")
VALUES = "SELECT scan_id, acquired_on, value FROM measurements ORDER BY 1, 2"


class Killed(BaseException):
    """Stands in for SIGKILL: nothing of the program goes on."""


def killed_after_saving(monkeypatch: pytest.MonkeyPatch, last: str, run: Any) -> None:
    """A run that is dead once the ledger of this day is saved."""
    save = Recorder.save

    def once(self: Recorder, day: str) -> None:
        save(self, day)
        if day == last:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "save", once)
        with pytest.raises(Killed):
            run()


@pytest.mark.parametrize("first_saved", DAYS)
def test_a_kill_between_both_days_of_a_scan_dated_anew(
    tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch, first_saved: str
) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=DAYS, scans=1), tmp_path / "w"
    run_night(inbox, warehouse)
    moved = f"scan-{DAYS[1]}-0"
    order = Ledger.dirty_days
    if first_saved == DAYS[1]:
        monkeypatch.setattr(Ledger, "dirty_days", lambda self: order(self)[::-1])
    seal(inbox / "scans" / moved, captured_at=f"{DAYS[0]}T20:00:00+08:00")
    killed_after_saving(monkeypatch, first_saved, lambda: run_night(inbox, warehouse))
    if first_saved == DAYS[0]:
        assert f"scan {moved}: on record under {DAYS[0]} and {DAYS[1]}" in verify(warehouse, None)["broken"]
    assert plan(warehouse, inbox, Config()).as_json()["scans_with_work"] == 1
    assert counts(run_night(inbox, warehouse)) == (1, 0, 0, 3)
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 4)
    assert rows(warehouse, f"SELECT acquired_on::VARCHAR, state FROM scan_status WHERE scan_id = '{moved}'") == [
        (DAYS[0], "measured")
    ]
    run_night(inbox, tmp_path / "undisturbed")
    assert rows(warehouse, VALUES) == rows(tmp_path / "undisturbed", VALUES)
    assert verify(warehouse, inbox)["broken"] == []


def test_a_kill_before_a_mended_bundle_has_left_the_undated(
    inbox: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    warehouse, name = tmp_path / "w", "scan-2025-04-05-0"
    good = (inbox / "scans" / name / "scan.json").read_text()
    (inbox / "scans" / name / "scan.json").write_text("{")
    assert counts(run_night(inbox, warehouse)) == (2, 1, 0, 0)
    (inbox / "scans" / name / "scan.json").write_text(good)
    killed_after_saving(monkeypatch, DAYS[0], lambda: run_night(inbox, warehouse))
    assert counts(run_night(inbox, warehouse)) == (1, 0, 0, 2)
    assert states(warehouse)[name] == ("measured", None)
    assert Ledger(warehouse).day(UNDATED).current == {}


@pytest.fixture
def unanswered(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Parts of paths whose files do not answer, for as long as they stand in the list."""
    names: list[str] = []
    monkeypatch.setattr(bounds, "FIRST_WAIT_SECONDS", 0.0)
    for function in ("sha256_file", "read_json_text"):
        real = getattr(inbox_module, function)

        def read(path: Path, *more: Any, real: Any = real) -> Any:
            if any(name in str(path) for name in names):
                raise OSError(errno.EIO, "Input/output error", str(path))
            return real(path, *more)

        monkeypatch.setattr(inbox_module, function, read)
    return names


def test_a_reference_that_does_not_answer_sets_the_zero_as_before(
    tmp_path: Path, stages: FakeStages, unanswered: list[str]
) -> None:
    """Its file was touched, so it is looked at again; that it cannot be says nothing against what hangs on it."""
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=DAYS), tmp_path / "w"
    run_night(inbox, warehouse)
    before = rows(warehouse, VALUES)
    for day in DAYS:
        os.utime(inbox / "scans" / f"ref-{day}" / "frames.parquet")
    found = plan(warehouse, inbox, Config()).as_json()["days"]
    assert [(day["new"], day["stale"]) for day in found] == [([f"ref-{day}"], {}) for day in DAYS]
    unanswered.append("ref-")
    stages.take()
    summary = run_night(inbox, warehouse)
    assert (counts(summary), summary.pending) == ((0, 0, 0, 4), 2)
    assert stages.take() == []
    assert rows(warehouse, VALUES) == before
    unanswered.clear()
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 6)
    assert stages.take() == []


def test_a_rig_that_does_not_answer_lets_its_scans_wait(
    tmp_path: Path, stages: FakeStages, unanswered: list[str]
) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=DAYS), tmp_path / "w"
    run_night(inbox, warehouse)
    before = rows(warehouse, VALUES)
    unanswered.append("rigs/")
    stages.take()
    summary = run_night(inbox, warehouse)
    assert (counts(summary), summary.pending) == ((0, 0, 0, 0), 6)
    assert [w for w in summary.warnings if "what hangs on this rig is left for the next run" in w] == summary.warnings
    assert plan(warehouse, inbox, Config()).idle
    unanswered.clear()
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 6)
    assert stages.take() == []
    assert rows(warehouse, VALUES) == before


def test_a_file_that_may_not_be_read_is_looked_at_every_night(
    inbox: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change of permissions changes neither size nor time."""
    real = inbox_module.sha256_file

    def forbidden(path: Path) -> str:
        if "scan-2025-04-05-0" in str(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path)

    with monkeypatch.context() as patch:
        patch.setattr(inbox_module, "sha256_file", forbidden)
        for measured in (2, 0):
            assert counts(run_night(inbox, tmp_path / "w")) == (measured, 1, 0, 2 - measured)
        assert "Permission denied" in str(states(tmp_path / "w")["scan-2025-04-05-0"][1])
    assert counts(run_night(inbox, tmp_path / "w")) == (1, 0, 0, 2)


def test_a_bundle_that_killed_its_worker_is_tried_again_when_asked_for(
    inbox: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(job: Any) -> Any:
        raise WorkerDied("it took longer than 1 s, the limit of a task")

    with monkeypatch.context() as patch:
        patch.setattr(night, "_verify", dies)
        assert counts(run_night(inbox, tmp_path / "w")) == (0, 3, 0, 0)
    assert counts(run_night(inbox, tmp_path / "w")) == (0, 0, 0, 3)
    assert counts(run_night(inbox, tmp_path / "w", retry_failed=True)) == (3, 0, 0, 0)


def test_the_window_closes_while_bundles_are_taken_up(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    from datetime import UTC, datetime, timedelta

    summary = run_night(inbox, tmp_path / "w", until=datetime.now(UTC) - timedelta(hours=1))
    assert (counts(summary), summary.pending) == ((0, 0, 0, 0), 3)
    assert counts(run_night(inbox, tmp_path / "w")) == (3, 0, 0, 0)


def test_bundles_that_were_taken_up_are_kept_every_two_minutes(
    inbox: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    from warehouse import recorder

    monkeypatch.setattr(recorder, "CHECKPOINT_SECONDS", 0.0)
    done: list[str] = []

    def progress(what: str, unit: str, n: int, total: int) -> None:
        done.append(unit)
        if n == total:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(night.Night, "_save_bundles", _not_after(Killed))
        with pytest.raises(Killed):
            run_night(inbox, tmp_path / "w", progress=progress)
    ledger = Ledger(tmp_path / "w")
    kept = {unit for day in ledger.all_days() for unit, _ in ledger.day(day).current}
    assert kept == set(done[:-1])
    assert kept


def _not_after(error: type[BaseException]) -> Any:
    real = night.Night._save_bundles

    def save(self: night.Night) -> None:
        if not isinstance(sys.exception() if hasattr(sys, "exception") else sys.exc_info()[1], error):
            real(self)

    return save


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
def test_reviews_are_plain_files_of_a_bounded_size(
    inbox: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = "wheelset_id,quantity,side,value_mm,expanded_uncertainty_mm,measured_at\n"
    row = "{},wheel_diameter,left,860.0,0.002,2025-04-05T10:00:00+08:00\n"
    folder = inbox / "cmm"
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    (tmp_path / "secret.csv").write_text(header + row.format("SECRET"))
    (folder / "link.csv").symlink_to(tmp_path / "secret.csv")
    os.mkfifo(folder / "pipe.csv")
    (folder / "long.csv").write_text(header + 50 * row.format("WS-1"))
    (folder / "short.csv").write_text(header + row.format("WS-1"))
    monkeypatch.setattr(reviews, "MAX_REVIEW_BYTES", 1000)
    files = Inbox(inbox).reviews()
    reviews.store_reviews(tmp_path, files)
    assert [r["wheelset_id"] for r in reviews.stored_reviews(tmp_path)] == ["WS-1"]
    told = reviews.review_troubles(tmp_path)
    assert [t.split(": ")[1] for t in told] == ["cmm/link.csv", "cmm/long.csv", "cmm/pipe.csv"]
    assert not any("SECRET" in t for t in told)
    before = reviews.reviews_fingerprint(files)
    (tmp_path / "secret.csv").write_text(header)
    assert reviews.reviews_fingerprint(files) == before
    assert plan(tmp_path / "w", inbox, Config()).reviews_changed


def test_collecting_after_a_run_that_was_killed_leaves_no_view_without_its_files(
    inbox: Path, tmp_path: Path, stages: FakeStages
) -> None:
    """The ledger is ahead of the catalog, which alone still names the files that go."""
    import duckdb

    warehouse = tmp_path / "w"
    run_night(inbox, warehouse)
    catalog.update(warehouse, Ledger(warehouse), [])
    write_scan(inbox, "scan-late", "2025-04-05T15:00:00+08:00")
    run_night(inbox, warehouse)
    assert collect(warehouse, Retention(), True).files > 0
    with duckdb.connect(str(warehouse / catalog.NAME), read_only=True) as connection:
        assert connection.execute("SELECT count(*) FROM measurements").fetchall() == [(4,)]
    assert verify(warehouse, None)["broken"] == []


def test_what_a_stopped_run_finished_is_seen_and_what_it_did_not_reach_waits(
    tmp_path: Path, stages: FakeStages
) -> None:
    from pipelines.finish import stopped

    inbox, warehouse = inbox_of(tmp_path / "inbox", days=DAYS), tmp_path / "w"
    stages.failing["features", f"scan-{DAYS[0]}-1"] = RuntimeError("a bug")
    with night.Night(warehouse, inbox, Config(), workers=0, wait_seconds=0) as run:
        run.prepare()
        run.run_calibrations()
        with pytest.raises(RuntimeError) as caught:  # the newest day is done, then the bug ends it
            _all_stages(run)
        stopped(run, caught.value, None)
    with catalog.connect(warehouse) as connection:
        found = dict(connection.execute("SELECT scan_id, state FROM scan_status").fetchall())
    assert {name for name, state in found.items() if state == "measured"} >= {f"scan-{DAYS[1]}-{n}" for n in (0, 1)}
    told = morning.load(warehouse)
    assert (told["outcome"], told["error"]) == ("stopped", "RuntimeError: a bug")
    assert told["pending"] == 2
    assert told["unchanged"] == 0
    assert told["measured"] == 4


def _all_stages(run: night.Night) -> None:
    for day in run.days_with_work():
        for stage in SCAN_STAGES:
            run.run_stage(stage, day)


@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
def test_workers_end_with_a_driver_that_was_killed_alone(tmp_path: Path) -> None:
    """Whoever reads the run's output through a pipe sees its end, and no memory stays taken."""
    (tmp_path / "orphans.py").write_text(
        "import os, signal, time\n"
        "from warehouse.pool import Pool\n"
        "def work(task):\n"
        "    time.sleep(0.1)\n"
        "    return os.getpid()\n"
        "if __name__ == '__main__':\n"
        "    for n, (_, worker) in enumerate(Pool(2).run(work, list(range(1000)))):\n"
        "        print(worker, flush=True)\n"
        "        if n == 3:\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = Path(__file__).resolve().parents[2]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(root), str(tmp_path)))}
    started = subprocess.run(
        [sys.executable, "orphans.py"], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, timeout=120, check=False
    )
    assert started.returncode == -signal.SIGKILL
    workers = {int(line) for line in started.stdout.split()}
    assert workers
    deadline = time.monotonic() + 20
    while alive := [pid for pid in workers if _runs(pid)]:
        assert time.monotonic() < deadline, alive
        time.sleep(0.1)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{pid}/stat")
    return not status.exists() or status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_lock_whose_renewal_was_answered_into_the_void_is_renewed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """The store took the beat, its answer was lost: the next one must not take its own mark for another run's."""
    from warehouse import lock_object

    held: dict[str, Any] = {"data": b"", "etag": 0, "lose": 0}

    def put(path: Path, data: bytes, replacing: Any = lock_object.place.ANY) -> str:
        if replacing is not lock_object.place.ANY and replacing != (str(held["etag"]) if held["etag"] else None):
            raise lock_object.place.Changed("another writer was there first")
        held["data"], held["etag"] = data, held["etag"] + 1
        if held["lose"]:
            held["lose"] -= 1
            raise OSError("connection reset")
        return str(held["etag"])

    def look(self: lock_object.ObjectLock) -> tuple[Any, str | None, float]:
        return (json.loads(held["data"]), str(held["etag"]), 0.0) if held["data"] else (None, None, 0.0)

    monkeypatch.setattr(lock_object.place, "put", put)
    monkeypatch.setattr(lock_object, "BEAT_SECONDS", 0.02)
    monkeypatch.setattr(lock_object.ObjectLock, "_look", look)
    lock = lock_object.ObjectLock(Path("x"))
    lock.acquire()
    time.sleep(0.1)
    held["lose"] = 1
    time.sleep(0.2)
    before = json.loads(held["data"])["beat"]
    deadline = time.monotonic() + 10
    while json.loads(held["data"])["beat"] == before:
        assert time.monotonic() < deadline, "nothing renews it"
        time.sleep(0.02)
    held["data"] = lock_object.place.as_json_bytes({"token": "another's"})
    held["etag"] += 1
    time.sleep(0.2)
    assert json.loads(held["data"]) == {"token": "another's"}
    assert lock._thread is not None
    assert not lock._thread.is_alive()
