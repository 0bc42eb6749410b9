"""The pool over a real Dask cluster behaves as over local processes: a killer is isolated, a lost machine is made good."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from dask_cluster import Cluster, cluster, free_port
from pool_tasks import leave_mark, slow, work

from warehouse import pool_dask
from warehouse.bounds import Bounds
from warehouse.pool import InfrastructureError, Pool, WorkerDied
from wheelset_assets.quality import ConfigError

pytest.importorskip("distributed", reason="the extra cluster is not installed")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Two workers, with Dask's own patience for a task whose worker dies."""
    with cluster(tmp_path_factory.mktemp("cluster"), 2) as made:
        yield made


def test_results_errors_and_only_the_killer_is_blamed(two: Cluster) -> None:
    with Pool(0, two.address) as pool:
        assert list(pool.run(work, [])) == []
        results = dict(pool.run(work, [*range(6), "die", "raise", *range(6, 12)]))
        assert isinstance(results.pop("die"), WorkerDied)
        assert isinstance(results.pop("raise"), ValueError)
        assert results == {i: 2 * i for i in range(12)}
        assert dict(pool.run(work, [1])) == {1: 2}, "and the cluster is as good as before"


def test_a_machine_lost_on_the_way_costs_nothing(tmp_path: Path) -> None:
    """One of two workers is killed while it works, nanny and all: every task gives its result, once."""
    with cluster(tmp_path / "cluster", 1) as made:
        lost = made.worker()
        marks = tmp_path / "marks"
        marks.mkdir()
        with Pool(0, made.address) as pool:
            _until(lambda: pool._start() and pool._executor.workers == 2)  # type: ignore[union-attr]
            seen = []
            for task, result in pool.run(leave_mark, [(marks, 0.2)] * 12):
                assert isinstance(result, int), result
                seen.append((task, result))
                if len({pid for _, pid in seen}) == 2 and lost.poll() is None:
                    made.kill(lost)
        assert lost.poll() is not None
        assert len(seen) == 12


def test_an_endless_task_dies_at_its_limit_and_alone(tmp_path: Path) -> None:
    with (
        cluster(tmp_path, 2, {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}) as made,
        Pool(0, made.address, bounds=Bounds(task_seconds=2.0)) as pool,
    ):
        results = dict(pool.run(slow, [0.1, 300.0, 0.2]))
        assert isinstance(died := results.pop(300.0), WorkerDied)
        assert "longer than 2 s" in str(died)
        assert results == {0.1: 0.1, 0.2: 0.2}
        assert dict(pool.run(slow, [0.3] * 8)) == {0.3: 0.3}, "the limit is a task's, not a worker's"


def test_no_task_is_begun_once_told_to_stop(two: Cluster) -> None:
    seen: list[object] = []
    with Pool(0, two.address) as pool:
        for task, _ in pool.run(work, list(range(50)), lambda: len(seen) >= 2):
            seen.append(task)
    assert 2 <= len(seen) <= 8


def test_a_worker_must_see_the_warehouse(two: Cluster, tmp_path: Path) -> None:
    (tmp_path / "_lock").touch()
    with Pool(0, two.address, sees=(tmp_path / "_lock",)) as pool:
        assert dict(pool.run(work, [1])) == {1: 2}
    with (
        Pool(0, two.address, sees=(tmp_path / "elsewhere",)) as pool,
        pytest.raises(InfrastructureError, match=r"elsewhere.*mount the folder"),
    ):
        list(pool.run(work, [1]))


def test_a_worker_with_other_versions_is_turned_away(two: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    newer = pool_dask.versions().replace(f"Python {sys.version_info.major}.", "Python 9.")
    monkeypatch.setattr(pool_dask, "versions", lambda: newer)
    with (
        Pool(0, two.address) as pool,
        pytest.raises(
            InfrastructureError, match=rf"other versions than the driver: Python {sys.version_info.major}\.\d+$"
        ),
    ):
        list(pool.run(work, [1]))


def test_threads_and_absence_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool_dask, "CONNECT_SECONDS", 1)
    with pytest.raises(InfrastructureError, match="no scheduler answers"):
        list(Pool(0, f"tcp://127.0.0.1:{free_port()}").run(work, [1]))
    monkeypatch.setattr(pool_dask, "CONNECT_SECONDS", 30)
    monkeypatch.setattr(pool_dask, "WORKERS_SECONDS", 1)
    with cluster(tmp_path, 0) as made:
        with pytest.raises(InfrastructureError, match=r"no worker within 1 s; start some: dask worker tcp"):
            list(Pool(0, made.address).run(work, [1]))
        monkeypatch.setattr(pool_dask, "WORKERS_SECONDS", 60)
        made.worker(threads=3)
        with pytest.raises(InfrastructureError, match=r"has 3 threads; start workers with --nthreads 1"):
            list(Pool(0, made.address).run(work, [1]))


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"wheelset\[cluster\]"):
        list(Pool(0, "tcp://127.0.0.1:1").run(work, [1]))


def test_a_scheduler_that_dies_is_nobodys_fault(tmp_path: Path) -> None:
    with cluster(tmp_path, 1) as made, Pool(0, made.address) as pool:
        runs = pool.run(leave_mark, [(tmp_path, 0.1)] * 200)
        assert isinstance(next(runs)[1], int)
        made.kill(made.scheduler)
        with pytest.raises(InfrastructureError, match="the scheduler is gone"):
            _raise_first(runs)


def _raise_first(runs: Iterator[tuple[object, object]]) -> None:
    for _, result in runs:
        if isinstance(result, Exception):
            raise result


def _until(true: object, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not true():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.1)
