"""A real Dask cluster on the loopback: a scheduler and workers, each a process of its own under a nanny."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PATH = os.pathsep.join(str(p) for p in (Path(__file__).parents[1], *Path(__file__).parent.glob("*/")))


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_for_port(port: int, process: subprocess.Popen, seconds: float = 60.0) -> None:
    """Until something listens there; fails with the process."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        assert process.poll() is None, f"{process.args} ended with {process.returncode}"
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise AssertionError(f"nothing listens on port {port}")


class Cluster:
    """Address of the scheduler, and its processes."""

    def __init__(self, folder: Path, environment: dict[str, str] | None = None) -> None:
        self.folder = folder
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.processes: list[subprocess.Popen] = []
        inherited = [p for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
        self.environment = os.environ | {"PYTHONPATH": os.pathsep.join([PATH, *inherited])} | (environment or {})
        self.scheduler = self._dask("scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        wait_for_port(self.port, self.scheduler)

    def _dask(self, what: str, *arguments: str) -> subprocess.Popen:
        """A Dask command in a folder of its own: its relative paths are not ours."""
        home = self.folder / f"{what}-{len(self.processes)}"
        home.mkdir(parents=True)
        with (home / "log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", what, *arguments],
                cwd=home,
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self.processes.append(process)
        return process

    def worker(self, *arguments: str, threads: int = 1) -> subprocess.Popen:
        """One more worker: a nanny and the process that it watches over."""
        common = ("--nthreads", str(threads), "--no-dashboard", "--host", "127.0.0.1", "--local-directory", ".")
        return self._dask("worker", self.address, *common, *arguments)

    def kill(self, process: subprocess.Popen) -> None:
        """A machine that is gone: nanny and worker die at once."""
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def close(self) -> None:
        """End what was started here."""
        for process in self.processes:
            if process.poll() is None:
                self.kill(process)


@contextmanager
def cluster(folder: Path, workers: int = 2, environment: dict[str, str] | None = None) -> Iterator[Cluster]:
    """A cluster with so many workers."""
    made = Cluster(folder, environment)
    try:
        for _ in range(workers):
            made.worker()
        yield made
    finally:
        made.close()
