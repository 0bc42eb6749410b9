"""What a run may use: time a task, memory a worker, and the disk that must stay free; and which errors pass by themselves.

The kernel holds the bounds, not this program: a task in an endless loop of native code hears nobody. A worker that is
killed at its limit looks like one that crashed, and the pool isolates the task in the same way.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from warehouse.place import is_remote
from wheelset_assets.quality import ConfigError, WheelsetError

T = TypeVar("T")
TRIES = 3
FIRST_WAIT_SECONDS = 0.5
_LOCAL = ("EIO", "EAGAIN", "EBUSY", "EINTR", "EMFILE", "ENFILE")
_REMOTE = ("ESTALE", "ETIMEDOUT", "ENETDOWN", "ENETUNREACH", "EHOSTDOWN", "EHOSTUNREACH", "ECONNRESET", "ECONNREFUSED")
PASSING = frozenset(getattr(errno, name) for name in (*_LOCAL, *_REMOTE) if hasattr(errno, name))
"""Errors of a disk or a network that may be gone a moment later."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LEAST_WORKER_GB = 0.75
"""What a worker needs with its libraries and a small scan."""


class DiskFull(WheelsetError):
    """There is no room to go on: the run stops, what was finished is kept."""


@dataclass(frozen=True)
class Bounds:
    """Limits of a run; None or 0 is no limit. `memory_gb` is for all workers together."""

    task_seconds: float | None = 3600.0
    memory_gb: float | None = None
    disk_floor_gb: float = 1.0

    def __post_init__(self) -> None:
        for name in ("task_seconds", "memory_gb", "disk_floor_gb"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < float("inf"):
                raise ConfigError(f"{name}: expected a number of at least 0; found {value!r}")

    def workers(self, wanted: int) -> int:
        """As many of the wanted workers as the memory allows, at least one."""
        if not self.memory_gb or wanted == 0:
            return wanted
        return max(1, min(wanted, int(self.memory_gb / LEAST_WORKER_GB)))

    def worker_bytes(self, workers: int) -> int | None:
        """Memory that each worker may take."""
        return int(self.memory_gb * 1e9 / max(workers, 1)) if self.memory_gb else None

    def check_disk(self, root: Path) -> None:
        """DiskFull if less than the floor is free where the warehouse lies."""
        if is_remote(root):
            return
        try:
            free = shutil.disk_usage(root).free
        except OSError:  # a place that cannot tell
            return
        if free < self.disk_floor_gb * 1e9:
            raise DiskFull(
                f"{root}: {free / 1e9:.2f} GB are free, less than the floor of {self.disk_floor_gb:g} GB; "
                "make room (`wheelset gc` shows what may go) or lower --disk-floor-gb; what was finished is kept"
            )


DEFAULT = Bounds()


def limit_memory(limit_bytes: int | None) -> None:
    """Let this process fail to allocate more; only where the kernel counts what is really its own (Linux)."""
    if limit_bytes is not None and sys.platform == "linux":
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (limit_bytes, hard))


@contextlib.contextmanager
def deadline(seconds: float | None) -> Iterator[None]:
    """Let the kernel kill this process by SIGALRM if the block takes longer. In the main thread of a worker only."""
    if not seconds or not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@dataclass(frozen=True)
class Bounded:
    """A task's function within its time; sent to a worker in its place."""

    function: Callable[[Any], Any]
    seconds: float | None

    def __call__(self, task: Any) -> Any:
        with deadline(self.seconds):
            return self.function(task)


def why_died(exit_codes: list[int | None], bounds: Bounds) -> str:
    """What killed a worker that ran a task alone, from the exit codes of its pool."""
    codes = [-code for code in exit_codes if code is not None and code < 0 and code != -signal.SIGTERM]
    if not exit_codes:  # workers on other machines
        limit = (
            f", or it took longer than {bounds.task_seconds:g} s, the limit of a task" if bounds.task_seconds else ""
        )
        return f"crash or out of memory{limit}"
    if not codes:
        ended = [code for code in exit_codes if code]
        return f"it ended with code {ended[0]}" if ended else "crash or out of memory"
    if hasattr(signal, "SIGALRM") and codes[0] == signal.SIGALRM:
        return f"it took longer than {bounds.task_seconds:g} s, the limit of a task"
    if codes[0] == signal.SIGKILL:
        return "it was killed, perhaps for want of memory"
    return f"{signal.Signals(codes[0]).name}, {signal.strsignal(codes[0])}"


def is_passing(error: BaseException) -> bool:
    """Whether an error may be gone at the next try."""
    return isinstance(error, OSError) and error.errno in PASSING


def with_retries(action: Callable[[], T], wait: Callable[[float], None] = time.sleep) -> T:
    """Result of an action that is tried again after errors that pass: three times, with a longer wait each time."""
    for attempt in range(TRIES - 1):
        try:
            return action()
        except OSError as error:
            if not is_passing(error):
                raise
            wait(FIRST_WAIT_SECONDS * 4**attempt)
    return action()


def as_disk_full(error: OSError, root: Path) -> DiskFull | None:
    """The error in words, if it says that there is no room."""
    if error.errno not in FULL:
        return None
    return DiskFull(
        f"{root}: no room to write ({os.strerror(error.errno or 0)}); make room (`wheelset gc` shows what may go); "
        "what was finished is kept, and the next run goes on from there"
    )
