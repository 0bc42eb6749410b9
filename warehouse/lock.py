"""One writer at a time: an exclusive lock on the warehouse. On a disk, the operating system releases it when its holder dies."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import IO

from warehouse.lock_object import ObjectLock
from warehouse.place import is_remote
from wheelset_assets.quality import ConfigError


class WarehouseLock:
    """The lock of a warehouse, `_lock` in it: a locked file, or in object storage an object that its holder renews."""

    def __init__(self, root: Path) -> None:
        self.path = root / "_lock"
        self._lock: ObjectLock | FileLock = ObjectLock(self.path) if is_remote(root) else FileLock(self.path)

    def acquire(self, wait_seconds: float = 0.0) -> None:
        """Take the lock, waiting so long for it; ConfigError names the holder if another run keeps it."""
        self._lock.acquire(wait_seconds)

    def taken(self) -> bool:
        """Whether a run holds the lock at this moment."""
        return self._lock.taken()

    def release(self) -> None:
        """Give the lock back."""
        self._lock.release()


class FileLock:
    """Advisory lock on a file, which holds the writer's process number for people."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: IO[str] | None = None

    def acquire(self, wait_seconds: float = 0.0) -> None:
        """Take the lock, waiting so long for it; ConfigError names the holder if another run keeps it."""
        deadline = time.monotonic() + wait_seconds
        file = self.path.open("a+", encoding="utf-8")
        while not _locked(file):
            if time.monotonic() >= deadline:
                file.seek(0)
                holder = file.read().strip() or "unknown"
                file.close()
                raise ConfigError(
                    f"{self.path.parent}: another run (process {holder}) is writing to this warehouse; wait for it to end"
                )
            time.sleep(0.1)
        file.seek(0)
        file.truncate()
        file.write(str(os.getpid()))
        file.flush()
        self._file = file

    def taken(self) -> bool:
        """Whether a run holds the lock at this moment."""
        if not self.path.exists():
            return False
        with self.path.open("a+", encoding="utf-8") as file:
            return not _locked(file)  # closing gives it back

    def release(self) -> None:
        """Give the lock back."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _locked(file: IO[str]) -> bool:
    """Try once to lock an open file."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0x7FFF0000)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
