"""Starts the processes that are measured, and says how long they took and how much memory they and theirs held.

Commands of the program are run as a user runs them; what runs inside them is none of this module's business.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.memory import TreeMemory, descendants

ROOT = Path(__file__).resolve().parent.parent
WHEELSET = [sys.executable, "-c", "from pipelines.cli import main; main()"]
MEMORY_NOTE = "sum of VmRSS over the process and its children, sampled; shared pages count in each"


@dataclass(frozen=True)
class Ran:
    """A process that ended: its standard output, wall-clock seconds, and peak memory in MB of 10^6 bytes."""

    output: str
    seconds: float
    peak_tree_mb: float | None
    peak_process_mb: float | None
    """The largest of its processes."""
    cpu_seconds: float = 0.0
    """Processor time of the process and all below it, if it was watched."""


def environment(**more: str) -> dict[str, str]:
    """This process' environment without the user's wheelset settings, with the checkout importable."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("WHEELSET_", "DAGSTER_"))}
    path = os.pathsep.join(p for p in (str(ROOT), kept.get("PYTHONPATH", "")) if p)
    return kept | {"PYTHONPATH": path, "DAGSTER_DISABLE_TELEMETRY": "yes"} | more


class TreeCpu(TreeMemory):
    """Processor seconds of a process and all below it, beside their memory; sampled, so the last moment is missing."""

    def __init__(self, pid: int) -> None:
        super().__init__(pid)
        self._ticks: dict[int, int] = {}

    @property
    def cpu_seconds(self) -> float:
        """User and system time of all processes that were seen."""
        return sum(self._ticks.values()) / os.sysconf("SC_CLK_TCK")

    def sample(self) -> None:
        """Look at the tree once."""
        super().sample()
        for pid in descendants(self.pid):
            try:
                fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
                self._ticks[pid] = int(fields[11]) + int(fields[12])
            except (OSError, ValueError, IndexError):
                continue


def run(command: list[str], env: dict[str, str] | None = None, watch: type[TreeMemory] = TreeMemory) -> Ran:
    """Run a command to its end; RuntimeError with the end of its standard error if it fails."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        started = time.perf_counter()
        process = subprocess.Popen(command, env=env or environment(), stdout=out, stderr=errors, cwd=ROOT)
        with watch(process.pid) as memory:
            process.wait()
        seconds = time.perf_counter() - started
        out.seek(0)
        errors.seek(0)
        output = out.read().decode(errors="replace")
        if process.returncode != 0:
            tail = errors.read().decode(errors="replace").strip()[-3000:]
            raise RuntimeError(f"{' '.join(command[1:4])} … ended with {process.returncode}:\n{output[-1000:]}\n{tail}")
    return Ran(output, seconds, memory.peak_mb, memory.largest_mb, getattr(memory, "cpu_seconds", 0.0))


def python(module: str, job: dict[str, Any], folder: Path, **env: str) -> Ran:
    """Run a module of the benchmark over a job file."""
    path = folder / f"{module.rpartition('.')[2]}.json"
    path.write_text(json.dumps(job), encoding="utf-8")
    return run([sys.executable, "-m", module, str(path)], environment(**env))


def wheelset_run(inbox: Path, warehouse: Path, workers: int) -> tuple[Ran, dict[str, Any]]:
    """`wheelset run` as a user starts it, and its own summary."""
    options = ["--inbox", str(inbox), "--warehouse", str(warehouse), "--workers", str(workers), "--json"]
    ran = run([*WHEELSET, "run", *options])
    return ran, json.loads(ran.output)
