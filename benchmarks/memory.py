"""Resident memory: of a process tree while it runs (sampled), and of this process between two moments (exact).

Only Linux tells; elsewhere the figures are None. No process is started here.
"""

from __future__ import annotations

import os
import threading
from pathlib import Path
from types import TracebackType

PERIOD_S = 0.05
PROC = Path("/proc")


def reset_peak() -> bool:
    """Let this process' peak begin again at what it holds now; False where the system cannot."""
    try:
        (PROC / "self" / "clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True


def peak_mb() -> float | None:
    """Largest resident memory of this process since `reset_peak`, in MB of 10^6 bytes."""
    kib = _status_kib(os.getpid(), "VmHWM:")
    return None if kib is None else kib * 1024 / 1e6


def _status_kib(pid: int, field: str) -> int | None:
    try:
        with open(PROC / str(pid) / "status", encoding="ascii", errors="replace") as file:
            for line in file:
                if line.startswith(field):
                    return int(line.split()[1])
    except (OSError, ValueError):
        return None
    return None


def descendants(pid: int) -> list[int]:
    """The process and all processes below it."""
    found, queue = [], [pid]
    while queue:
        one = queue.pop()
        found.append(one)
        try:
            for task in (PROC / str(one) / "task").iterdir():
                queue += [int(child) for child in (task / "children").read_text(encoding="ascii").split()]
        except OSError:
            continue
    return found


class TreeMemory:
    """Peaks over a process and all below it, while the context lasts: sampled sum of VmRSS, and largest single process.

    Pages that processes share are counted in each of them, so the sum is an upper bound.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._sum_kib = 0
        self._largest_kib = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    @property
    def peak_mb(self) -> float | None:
        """Peak of the sum in MB of 10^6 bytes, or None if nothing could be sampled."""
        return self._sum_kib * 1024 / 1e6 if self._sum_kib else None

    @property
    def largest_mb(self) -> float | None:
        """Largest peak that the kernel counted for one of the processes, in MB of 10^6 bytes."""
        return self._largest_kib * 1024 / 1e6 if self._largest_kib else None

    def _watch(self) -> None:
        while not self._stop.is_set():
            self.sample()
            self._stop.wait(PERIOD_S)

    def sample(self) -> None:
        """Look at the tree once."""
        tree = descendants(self.pid)
        self._sum_kib = max(self._sum_kib, sum(_status_kib(pid, "VmRSS:") or 0 for pid in tree))
        self._largest_kib = max([self._largest_kib, *(_status_kib(pid, "VmHWM:") or 0 for pid in tree)])

    def __enter__(self) -> TreeMemory:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
