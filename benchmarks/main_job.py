"""`python -m benchmarks.main_job`: what calibration, a scan and a night cost, stage by stage and beside a peer.

Here: options, order of the parts, and where the results go. Each part is measured in processes of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks import compare, machine, night
from benchmarks.data import Data, prepared
from benchmarks.peer_run import run_peer
from benchmarks.processes import python
from benchmarks.report import markdown
from benchmarks.stages import BASE, ONE_THREAD

QUICK = {"frames": 60, "rows": 256, "repeats": 1}
BOARD_POSES, QUICK_BOARD_POSES = 12, 6
STARTED = time.perf_counter()
RESULTS = Path(__file__).resolve().parent / "RESULTS.md"


def options(arguments: list[str] | None) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.main_job", description=__doc__)
    parser.add_argument("--frames", type=int, default=1000, help="frames of each scan [default: 1000]")
    parser.add_argument("--rows", type=int, default=1024, help="image rows [default: 1024]")
    parser.add_argument("--repeats", type=int, default=3, help="repeats of every timing of ours [default: 3]")
    parser.add_argument(
        "--peer-limit",
        type=float,
        default=600.0,
        metavar="S",
        help="a longer step of the peer is stopped [default: 600]",
    )
    parser.add_argument("--no-peer", action="store_true", help="leave the peer out")
    parser.add_argument(
        "--data", type=Path, help="folder that keeps the simulated scans [default: in the temporary folder]"
    )
    parser.add_argument(
        "--quick", action="store_true", help="60 frames of 256 rows, once: for tests, says nothing of speed"
    )
    parser.add_argument("--write", action="store_true", help="write benchmarks/RESULTS.md")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output instead of tables")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        vars(chosen).update(QUICK)
    if chosen.repeats < 1:
        parser.error("--repeats: at least 1")
    return chosen


def say(text: str) -> None:
    """Progress, on standard error."""
    print(f"[{time.perf_counter() - STARTED:6.1f} s] {text}", file=sys.stderr, flush=True)


def command(chosen: argparse.Namespace) -> str:
    """The command as another machine would repeat it."""
    size = "--quick" if chosen.quick else f"--frames {chosen.frames} --rows {chosen.rows} --repeats {chosen.repeats}"
    peer = "--no-peer" if chosen.no_peer else f"--peer-limit {chosen.peer_limit:g}"
    return f"python -m benchmarks.main_job {size} {peer}"


def measure(chosen: argparse.Namespace) -> dict[str, Any]:
    """All parts in turn; what they leave on disk is removed, the simulated scans stay."""
    root = (chosen.data or Path(tempfile.gettempdir()) / "wheelset-benchmark").resolve()
    root.mkdir(parents=True, exist_ok=True)
    # Imports cost what they cost after a first run, whatever this environment says of bytecode.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(root / "bytecode")
    poses = QUICK_BOARD_POSES if chosen.quick else BOARD_POSES
    say(f"data: {chosen.frames} frames of {chosen.rows} rows")
    data = prepared(root, chosen.frames, chosen.rows, poses)
    work = Path(tempfile.mkdtemp(prefix="work-", dir=root))
    try:
        say(f"stages 1-8 in one process, {chosen.repeats} times")
        job = {"data": {k: str(v) for k, v in vars(data).items()}, "work": str(work), "repeats": chosen.repeats}
        ours = json.loads(python("benchmarks.stages", job, work, **ONE_THREAD).output)
        runs = night.measure(data, work / BASE, work, chosen.repeats, say, quick=chosen.quick)
        peer = _peer(chosen, data, ours["cameras"], work / "peer")
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return _results(chosen, data, poses, ours, runs, peer)


def _peer(chosen: argparse.Namespace, data: Data, cameras: dict[str, Any], folder: Path) -> dict[str, Any]:
    if chosen.no_peer:
        return {"available": False, "reason": "left out by --no-peer"}
    say("the peer: OpenCV and Open3D")
    job = {
        "bundle": str(data.bundle),
        "reference": str(data.inbox / "scans" / data.reference_id),
        "rig": str(data.inbox / "rigs" / f"{data.rig_id}.json"),
        "cameras": cameras,
    }
    peer = run_peer(job, folder, chosen.peer_limit)
    if not peer["available"]:
        say(f"no peer: {peer['reason']}")
    return peer


def _results(
    chosen: argparse.Namespace, data: Data, poses: int, ours: dict[str, Any], runs: dict[str, Any], peer: dict[str, Any]
) -> dict[str, Any]:
    seconds = ours["end_to_end_seconds"]
    return {
        "machine": machine.describe(),
        "command": command(chosen),
        "repeats": chosen.repeats,
        "data": {
            "frames": chosen.frames,
            "rows": chosen.rows,
            "board_poses": poses,
            "sensors": len(ours["centroids_mm"]),
            "points": ours["points"],
            "bundle_bytes": data.bundle_bytes(),
        },
        "stages": ours["timings"],
        "end_to_end": {"seconds": seconds, "points_per_second": compare.rates(ours["points"], seconds)},
        "command_line": runs,
        "bytes_per_point": compare.bytes_per_point(ours, data.bundle_bytes()),
        "rows": ours["rows"],
        "peer": peer,
        "accuracy": {
            "registration": compare.registration_errors(data, ours, peer),
            "wheel_diameter": compare.diameter_errors(data, ours, peer),
        },
    }


def main(arguments: list[str] | None = None) -> int:
    """Measure, then print, and write if asked to."""
    chosen = options(arguments)
    results = measure(chosen)
    text = markdown(results)
    if chosen.write:
        RESULTS.write_text(text, encoding="utf-8")
        say(f"written: {RESULTS.relative_to(RESULTS.parent.parent)}")
    print(json.dumps(results, indent=2, allow_nan=False) if chosen.json else text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
