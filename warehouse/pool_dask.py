"""The workers of a Dask cluster as an executor for the pool. The only place that knows `distributed`.

A worker that dies shows as `BrokenProcessPool`, as it does on one machine, so that the pool isolates the culprit in the
same way. Tasks carry paths and small tables; clouds never travel. Every worker must have the versions of the driver and
see its files: a folder that is not shared would take outputs that nobody finds again.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from warehouse.lineage import package_versions
from warehouse.pool import InfrastructureError
from wheelset_assets.quality import ConfigError
from wheelset_assets.stages import STAGES

CONNECT_SECONDS = 30
WORKERS_SECONDS = 60
"""How long a run waits for the first worker: a nanny needs some seconds to restart one that died."""


@cache
def versions() -> str:
    """What must be the same everywhere, or a data version would depend on which worker made it."""
    stages = ", ".join(f"{stage.name} {stage.code_version}" for stage in STAGES)
    return f"Python {sys.version_info.major}.{sys.version_info.minor}, {package_versions()}; stages: {stages}"


def difference(ours: str, theirs: str) -> str:
    """The entries of a worker's versions that are not the driver's."""
    here, there = (dict.fromkeys(text.replace(";", ",").split(", ")) for text in (ours, theirs))
    return ", ".join(entry for entry in there if entry not in here) or theirs


@cache
def _prepare() -> None:
    import cv2

    cv2.setNumThreads(1)


@cache
def _sees(place: Path) -> None:
    """Remembered only if it is seen: an error is raised anew each time."""
    if not place.exists():
        raise FileNotFoundError(place)


@contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """Let the kernel end this process by SIGALRM if the block takes longer; its nanny starts another one.

    Dask runs tasks beside the main thread, where no handler can be set; the default action of the signal needs none.
    """
    if not seconds or not hasattr(signal, "setitimer") or signal.getsignal(signal.SIGALRM) != signal.SIG_DFL:
        yield
        return
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def on_worker(
    function: Callable[[Any], Any], task: Any, wanted: str, sees: tuple[Path, ...], seconds: float | None
) -> Any:
    """Run a task on a worker, also on one that joined late, once it is known to be fit for it; at most so many seconds."""
    if versions() != wanted:
        raise InfrastructureError(f"a worker has other versions than the driver: {difference(wanted, versions())}")
    for place in sees:
        try:
            _sees(place)
        except OSError as error:
            raise InfrastructureError(
                f"a worker does not see {place} ({error}): mount the folder there under the same path, or use s3://"
            ) from error
    _prepare()
    with _limited(seconds):
        return function(task)


class DaskExecutor(Executor):
    """Tasks on a running cluster, one thread a worker."""

    def __init__(self, address: str, sees: tuple[Path, ...] = (), task_seconds: float | None = None) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise ConfigError('--cluster needs the extra cluster: pip install "wheelset[cluster]"') from error
        try:
            self._client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InfrastructureError(f"--cluster {address}: no scheduler answers there: {error}") from error
        self.address, self._sees, self._task_seconds = address, sees, task_seconds
        try:
            self._check_workers()
        except BaseException:
            self._client.close()
            raise
        self._executor = self._client.get_executor(pure=False, retries=0)

    @property
    def workers(self) -> int:
        """How many there are at this moment: a cluster grows and shrinks."""
        return len(self._client.nthreads())

    def _check_workers(self) -> None:
        """At least one worker; InfrastructureError if tasks would share a process's libraries between threads."""
        try:
            self._client.wait_for_workers(1, timeout=WORKERS_SECONDS)
        except TimeoutError as error:
            raise InfrastructureError(
                f"--cluster {self.address}: no worker within {WORKERS_SECONDS} s; start some: dask worker {self.address} --nthreads 1"
            ) from error
        threads = self._client.nthreads()
        if many := sorted(name for name, number in threads.items() if number != 1):
            raise InfrastructureError(
                f"--cluster {self.address}: worker {many[0]} has {threads[many[0]]} threads; "
                "start workers with --nthreads 1, as many as there are cores (--nworkers)"
            )

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future:
        """A task on some worker; its future fails as that of a process pool does."""
        (task,) = arguments or (None,)
        inner = self._executor.submit(on_worker, function, task, versions(), self._sees, self._task_seconds)
        outer: Future = Future()
        outer.set_running_or_notify_cancel()
        inner.add_done_callback(lambda done: _pass_on(done, outer, self.address))
        return outer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; the workers live on. What is under way is cancelled, as closing a client does."""
        self._executor.shutdown(wait=wait and not cancel_futures)
        self._client.close()


def _pass_on(inner: Future, outer: Future, address: str) -> None:
    """Give a future's result or error on, in the terms of a process pool."""
    from distributed.scheduler import KilledWorker

    try:
        outer.set_result(inner.result())
    except KilledWorker as error:
        outer.set_exception(BrokenProcessPool(str(error)))
    except CancelledError:
        outer.set_exception(InfrastructureError(f"--cluster {address}: the scheduler is gone, or it gave the task up"))
    except BaseException as error:
        outer.set_exception(error)
