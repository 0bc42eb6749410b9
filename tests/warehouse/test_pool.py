"""The worker pool: results as they come, errors as results, and a dead worker blamed on the task that killed it."""

from __future__ import annotations

import os
import time

import pytest
from pool_tasks import slow, work

from warehouse import pool as module
from warehouse.pool import InfrastructureError, Pool, WorkerDied, canary, one_thread


def _leave(_: object) -> None:
    os._exit(3)


@pytest.mark.parametrize("workers", [0, 2])
def test_results_and_errors_of_all_tasks(workers: int) -> None:
    with Pool(workers) as pool:
        found = list(pool.run(work, [1, "raise", 2, 3]))
        assert list(pool.run(work, [])) == []
        assert dict(pool.run(work, [7])) == {7: 14}
    assert {t: r for t, r in found if t != "raise"} == {1: 2, 2: 4, 3: 6}
    (error,) = [r for t, r in found if t == "raise"]
    assert isinstance(error, ValueError)


def test_only_the_killer_of_a_worker_is_blamed() -> None:
    with Pool(2) as pool:
        found = list(pool.run(work, [*range(6), "die", *range(6, 12)]))
        assert len(found) == 13
        results = dict(found)
        assert isinstance(results.pop("die"), WorkerDied)
        assert results == {i: 2 * i for i in range(12)}
        assert dict(pool.run(work, [1])) == {1: 2}


def test_two_killers_and_a_bug_among_the_suspects() -> None:
    with Pool(1) as pool:
        results = dict(pool.run(work, ["die", "raise", 1]))
        assert [type(results[k]) for k in ("die", "raise", 1)] == [WorkerDied, ValueError, int]
        again = [r for _, r in pool.run(work, ["die", "die"])]
        assert [type(r) for r in again] == [WorkerDied, WorkerDied]


def test_workers_that_do_not_start_are_nobodys_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    pool = Pool(1)
    with monkeypatch.context() as patch:
        patch.setattr(module, "_prepare", _leave)
        with pytest.raises(InfrastructureError, match="the workers do not start"):
            list(pool.run(work, [1]))
    with pool:  # and when they start again, so does the pool
        assert dict(pool.run(work, [1])) == {1: 2}


@pytest.mark.parametrize("workers", [0, 1])
def test_no_task_is_begun_once_told_to_stop(workers: int) -> None:
    seen: list[object] = []
    with Pool(workers) as pool:
        for task, _ in pool.run(work, list(range(50)), lambda: len(seen) >= 2):
            seen.append(task)
    assert 2 <= len(seen) <= 2 + 2 * workers


def test_leaving_does_not_wait_for_the_queue() -> None:
    started = time.perf_counter()
    with Pool(1) as pool:
        for _ in pool.run(slow, [0.01] + [0.5] * 20):
            break
    assert time.perf_counter() - started < 8


def test_workers_use_one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    one_thread()
    assert os.environ["OMP_NUM_THREADS"] == "1"
    assert canary() == os.getpid()


def environment_of_worker(name: str) -> str | None:
    """What a worker sees."""
    return os.environ.get(name)


def test_workers_see_the_environment_of_now(monkeypatch: pytest.MonkeyPatch) -> None:
    with Pool(1) as pool:
        assert dict(pool.run(environment_of_worker, ["WHEELSET_LATE"])) == {"WHEELSET_LATE": None}
    monkeypatch.setenv("WHEELSET_LATE", "yes")
    with Pool(1) as pool:
        assert dict(pool.run(environment_of_worker, ["WHEELSET_LATE"])) == {"WHEELSET_LATE": "yes"}
