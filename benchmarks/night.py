"""Times `wheelset run` from outside, through the command line and Dagster: calibration, a night, one scan.

Each run begins in a warehouse that holds what came before, so that only the work in its name is new to it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.data import Data
from benchmarks.processes import Ran, wheelset_run

WORKERS = 2


def measure(
    data: Data, referenced: Path, work: Path, repeats: int, say: Callable[[str], None], *, quick: bool
) -> dict[str, Any]:
    """Wall-clock seconds and memory of the runs: the calibration once, then night (unless quick) and scan, repeated.

    `referenced`: a warehouse that holds the calibration and the reference scan; it is copied, never written.
    """
    calibrated = work / "calibrated"
    say("wheelset run: calibration")
    found = {"calibration": _facts([_run(data.calibration_inbox, calibrated, 0)])}
    night = ("night", "reference and wheelset scan", calibrated, 2)
    scan = ("scan", "wheelset scan", referenced, 1)
    for name, what, start, expected in (scan,) if quick else (night, scan):
        runs = []
        for k in range(repeats):
            say(f"wheelset run: {what} ({k + 1} of {repeats})")
            runs.append(_run(data.inbox, _copy(start, work / name), expected))
        found[name] = _facts(runs)
    return found


def _copy(source: Path, target: Path) -> Path:
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)
    return target


def _run(inbox: Path, warehouse: Path, expected: int) -> tuple[Ran, dict[str, Any]]:
    ran, summary = wheelset_run(inbox, warehouse, WORKERS)
    if summary["measured"] != expected or summary["failed"] or summary["refused"]:
        raise RuntimeError(f"wheelset run: expected {expected} measured scans; found {summary}")
    return ran, summary


def _facts(runs: list[tuple[Ran, dict[str, Any]]]) -> dict[str, Any]:
    trees = [ran.peak_tree_mb for ran, _ in runs if ran.peak_tree_mb]
    largest = [ran.peak_process_mb for ran, _ in runs if ran.peak_process_mb]
    return {
        "workers": WORKERS,
        "points": runs[-1][1]["points"],
        "seconds": [ran.seconds for ran, _ in runs],
        "seconds_inside": [summary["seconds"] for _, summary in runs],
        "peak_tree_mb": max(trees, default=None),
        "peak_process_mb": max(largest, default=None),
    }
