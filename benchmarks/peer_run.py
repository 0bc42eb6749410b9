"""Drives the peer: one process, stopped if a step outlasts its limit, started again for the steps that remain.

What a step costs and what the peer found come home as plain facts; judging them against the truth is `compare`'s.
"""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from benchmarks.memory import TreeMemory
from benchmarks.processes import ROOT, environment

MODULE = "benchmarks.peer"
START_LIMIT_S = 180.0
END = "end"


def run_peer(job: dict[str, Any], folder: Path, limit_s: float, env: dict[str, str] | None = None) -> dict[str, Any]:
    """The peer's steps by name with seconds or what became of them, its results, or why there is no peer."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "job.json"
    path.write_text(json.dumps(job), encoding="utf-8")
    found: dict[str, Any] = {"steps": {}, "results": {}, "sizes": {}, "peak_tree_mb": None, "limit_seconds": limit_s}
    while "results" not in (last := _process(path, found, limit_s, env)):
        if "unavailable" in last:
            return {"available": False, "reason": last["unavailable"]}
        if last.get("step") is None:
            return {"available": False, "reason": last["reason"]}
        found["steps"][last["step"]] = {"state": last["state"], "reason": last["reason"]}
    return found | {"available": True, "results": last["results"], "sizes": last["sizes"]}


def _process(path: Path, found: dict[str, Any], limit_s: float, env: dict[str, str] | None) -> dict[str, Any]:
    """One process over the steps that remain; the facts it ended with, or the step at which it was stopped or died."""
    settled = [name for name, step in found["steps"].items() if step["state"] != "done"]
    with (path.parent / "peer-errors.txt").open("w+b") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", MODULE, str(path), *settled],
            env=env or environment(), cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True,
        )  # fmt: skip
        lines: queue.Queue[str] = queue.Queue()
        reader = threading.Thread(target=_pump, args=(process, lines), daemon=True)
        reader.start()
        try:
            with TreeMemory(process.pid) as memory:
                last = _follow(lines, found, limit_s)
        finally:
            process.kill()
            process.wait()
            reader.join()
        if memory.peak_mb:
            found["peak_tree_mb"] = max(found["peak_tree_mb"] or 0.0, memory.peak_mb)
        errors.seek(0)
        tail = errors.read().decode(errors="replace").strip().splitlines()[-1:]
    if last.get("state") == "died":
        last["reason"] = "the process ended: " + (tail[0] if tail else "no message")
    return last


def _pump(process: subprocess.Popen, lines: queue.Queue[str]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            lines.put(line)
    lines.put(END)


def _follow(lines: queue.Queue[str], found: dict[str, Any], limit_s: float) -> dict[str, Any]:
    """Read what the process tells until it is through, dead, or over the limit."""
    current: str | None = None
    until = time.monotonic() + START_LIMIT_S
    while True:
        try:
            line = lines.get(timeout=max(until - time.monotonic(), 0.0))
        except queue.Empty:
            return {"step": current, "state": "stopped", "reason": f"stopped after {limit_s:g} s"}
        if line == END:
            return {"step": current, "state": "died", "reason": ""}
        try:
            facts = json.loads(line)
        except ValueError:
            continue  # a library's own message
        if "unavailable" in facts or "results" in facts:
            return facts
        if "parameters" in facts:
            found |= facts
        elif facts.get("state") == "started":
            current, until = facts["step"], time.monotonic() + limit_s
        elif "step" in facts:
            found["steps"][facts.pop("step")] = facts
            current, until = None, time.monotonic() + START_LIMIT_S
