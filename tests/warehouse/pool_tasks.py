"""What the workers of the tests do: they import it by name, as they import the stages."""

from __future__ import annotations

import os
import time
from pathlib import Path


def work(task: object) -> object:
    """Double a number; or raise, or die."""
    if task == "raise":
        raise ValueError("a bug")
    if task == "die":
        os._exit(1)
    return 2 * task if isinstance(task, int) else task  # type: ignore[operator]


def slow(task: float) -> float:
    """Sleep."""
    time.sleep(task)
    return task


def leave_mark(task: tuple[Path, float]) -> int:
    """Leave a file named by this process, sleep, and say who it was."""
    folder, seconds = task
    (folder / str(os.getpid())).touch()
    time.sleep(seconds)
    return os.getpid()


def poison(task: str) -> str:
    """Loop for ever, crash, or take all the memory there is; or give the task back."""
    if task == "endless":
        while True:
            pass
    if task == "segfault":
        os.kill(os.getpid(), 11)
    if task == "memory":
        return str(len(bytearray(8 * 10**9)))
    return task
