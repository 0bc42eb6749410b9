"""One worker pool a run, behind one class: a canary first, and isolation of the task that kills its worker."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from pathlib import Path
from typing import Any

from warehouse.bounds import DEFAULT, Bounded, Bounds, limit_memory, why_died
from wheelset_assets.quality import WheelsetError


class InfrastructureError(WheelsetError):
    """The workers themselves do not work: no scan is to blame."""


class WorkerDied(WheelsetError):
    """The worker that ran a task alone died with it: segmentation fault, out of memory, or killed."""


def one_thread() -> None:
    """Let linear algebra use one thread in this process's children, and in itself if numpy is not loaded yet.

    The workers share the cores already, and the order of summation must not depend on how many there are.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def canary(_: None = None) -> int:
    """What a healthy worker can do: import the stages, and say who it is."""
    import warehouse.execute  # noqa: F401

    return os.getpid()


def _prepare(environment: dict[str, str], memory_bytes: int | None = None) -> None:
    os.environ.update(environment)  # a fork server keeps that of when it started: credentials may have come since
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver decides what an interrupt means
    import cv2

    cv2.setNumThreads(1)
    limit_memory(memory_bytes)
    if (driver := multiprocessing.parent_process()) is not None:
        threading.Thread(target=_end_with, args=(driver,), name="wheelset-driver", daemon=True).start()


def _end_with(driver: Any) -> None:
    """End this worker when its driver has ended: one that was killed alone can tell nobody, and nobody waits for results."""
    connection.wait([driver.sentinel])
    os._exit(1)


def local_executor(workers: int, memory_bytes: int | None = None) -> ProcessPoolExecutor:
    """Worker processes on this machine."""
    one_thread()
    method = "spawn" if sys.platform in ("win32", "darwin") else "forkserver"
    context = multiprocessing.get_context(method)
    if method == "forkserver":
        context.set_forkserver_preload(["warehouse.execute", "scipy.spatial", "cv2", "duckdb"])
    given = (dict(os.environ), memory_bytes)
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare, initargs=given)


class Pool:
    """Workers for one run. `workers` 0 runs every task in this process, which is for debugging and small tests.

    With `cluster`, the address of a Dask scheduler, its workers do the tasks, however many there are; each must find the
    files `sees`.
    """

    def __init__(
        self, workers: int, cluster: str | None = None, sees: tuple[Path, ...] = (), bounds: Bounds = DEFAULT
    ) -> None:
        self.bounds = bounds
        workers = workers if cluster is not None else bounds.workers(workers)
        self.workers, self.cluster, self.sees = workers if cluster is None else max(workers, 1), cluster, sees
        self._executor: Executor | None = None

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._executor = None

    def _start(self) -> Executor:
        if self._executor is None:
            executor = (
                local_executor(self.workers, self.bounds.worker_bytes(self.workers))
                if self.cluster is None
                else self._dask(self.cluster)
            )
            try:
                executor.submit(canary, None).result(timeout=120)
            except Exception as error:
                executor.shutdown(wait=False, cancel_futures=True)
                if isinstance(error, WheelsetError):
                    raise
                raise InfrastructureError(f"the workers do not start: {error!r}") from error
            self._executor = executor
        return self._executor

    def _dask(self, address: str) -> Executor:
        from warehouse.pool_dask import DaskExecutor

        executor = DaskExecutor(address, self.sees, self.bounds.task_seconds)
        self.workers = executor.workers
        return executor

    def _drop(self) -> None:
        """Give a broken executor up; the next task starts a fresh one."""
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)
            self._executor = None

    def run(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], stop: Callable[[], bool] = lambda: False
    ) -> Iterator[tuple[Any, Any]]:
        """Results of function over tasks as (task, result or exception), as they come.

        If a worker dies, the tasks that were under way run again one at a time, each alone in a fresh worker, so that
        only the culprit is blamed. Once `stop` says so, no further task is begun. A task that takes longer than its limit
        dies with its worker.
        """
        if self.workers == 0:
            for task in tasks:
                if stop():
                    return
                try:
                    result = function(task)
                except Exception as error:  # a bug in one task must not take the others with it
                    result = error
                yield task, result
            return
        if self.cluster is None:  # the workers of a cluster see to it themselves
            function = Bounded(function, self.bounds.task_seconds)
        queue = list(tasks)[::-1]
        suspects: list[Any] = []
        pending: dict[Future, Any] = {}
        while queue or pending or suspects:
            if stop():
                queue.clear()
                suspects.clear()
            if suspects and not pending:
                task = suspects.pop()
                yield task, self._alone(function, task)
                continue
            if not suspects:
                self._submit(function, queue, pending)
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            broken = False
            for future in done:
                task = pending.pop(future)
                raised = future.exception()
                if isinstance(raised, BrokenProcessPool):
                    broken = True
                    suspects.append(task)
                else:
                    yield task, raised if raised is not None else future.result()
            if broken:
                wait(pending)  # all of them fail at once, but for those that had just ended
                self._drop()

    def _submit(self, function: Callable[[Any], Any], queue: list[Any], pending: dict[Future, Any]) -> None:
        while queue and len(pending) < 2 * self.workers:
            try:
                pending[self._start().submit(function, queue[-1])] = queue[-1]
            except BrokenProcessPool:  # a worker died since the last result; the pending tasks tell
                if not pending:
                    self._drop()
                    continue
                return
            queue.pop()

    def _alone(self, function: Callable[[Any], Any], task: Any) -> Any:
        """Result of a task that has a worker pool for itself."""
        executor = self._start()
        processes = dict(getattr(executor, "_processes", None) or {})
        try:
            return executor.submit(function, task).result()
        except BrokenProcessPool:
            processes |= getattr(executor, "_processes", None) or {}
            self._drop()
            why = why_died([processes[n].exitcode for n in processes], self.bounds)
            return WorkerDied(f"the worker process died while it worked on this scan: {why}")
        except InfrastructureError:
            raise
        except Exception as error:
            return error
