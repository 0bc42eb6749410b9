"""`python -m benchmarks.fleet_night`: a night of thousands of small scans, what it costs above computation, and the next.

    own cost of a scan = (wall-clock seconds x workers - seconds in the stages' own functions) / scans

so everything is charged that is not metrology: Dagster, verification, reading, checks, Parquet, ledger, catalog, idle
workers, start-up. It needs a machine that does nothing else; `own_cpu_ms` is the same in processor time, of all processes
less that of the stages' functions, and so without what workers and disk wait: it can be had on a busy machine too. By
default the stages' functions run once for each template (`--computation all` runs them for each scan).
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

from benchmarks import fleet_inbox, machine
from benchmarks.processes import WHEELSET, TreeCpu, environment, run

MAX_OWN_MS, MAX_AGAIN_SECONDS, MAX_GROWTH = 60.0, 5.0, 1.1


def options(arguments: list[str] | None) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet_night", description=__doc__)
    parser.add_argument("--scans", type=int, default=5000, help="production scans of the night [default: 5000]")
    parser.add_argument("--days", type=int, default=20, help="acquisition days that they lie on [default: 20]")
    parser.add_argument("--fewer", type=int, default=1000, help="the same with so many, for memory; 0: not [1000]")
    parser.add_argument("--workers", type=int, default=2, help="worker processes [default: 2]")
    parser.add_argument("--wheelsets", type=int, default=4, help="simulated wheelsets [default: 4]")
    parser.add_argument("--repeats", type=int, default=2, help="simulated scans of each [default: 2]")
    parser.add_argument("--computation", choices=("templates", "all"), default="templates", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help="folder that keeps the templates [default: the temporary folder]")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    return parser.parse_args(arguments)


def night(source: Path, work: Path, scans: int, days: int, chosen: argparse.Namespace, recorded: str) -> dict[str, Any]:
    """One night into an empty warehouse, then the same again with nothing changed."""
    shutil.rmtree(work, ignore_errors=True)
    inbox = fleet_inbox.build(source, work / "inbox", scans, days)
    warehouse = work / "warehouse"
    place = [str(inbox.inbox), str(warehouse), str(chosen.workers), recorded]
    first = run([sys.executable, "-m", "benchmarks.fleet_drive", *place], environment(), watch=TreeCpu)
    summary = json.loads(first.output.splitlines()[-1])
    wrong = _unaccounted(inbox, warehouse)
    options = ["--inbox", place[0], "--warehouse", place[1], "--workers", place[2], "--json"]
    again = run([*WHEELSET, "run", *options], environment())
    idle = json.loads(again.output)
    found = {
        "scans": inbox.n_scans,
        "days": days,
        "seconds": first.seconds,
        "compute_seconds": summary["compute_seconds"],
        "own_ms": 1e3 * (first.seconds * chosen.workers - summary["compute_seconds"]) / inbox.n_scans,
        "cpu_seconds": first.cpu_seconds,
        "own_cpu_ms": 1e3 * (first.cpu_seconds - summary["compute_cpu_seconds"]) / inbox.n_scans,
        "driver_peak_mb": summary["driver_peak_mb"],
        "counts": {k: summary[k] for k in ("measured", "refused", "failed", "unchanged", "pending")},
        "faults": len(inbox.faults),
        "unaccounted": wrong,
        "again_seconds": again.seconds,
        "again_unchanged": idle["unchanged"],
        "warehouse_mb": sum(p.stat().st_size for p in warehouse.rglob("*") if p.is_file()) / 1e6,
    }
    shutil.rmtree(work, ignore_errors=True)
    return found


def _unaccounted(inbox: fleet_inbox.FleetInbox, warehouse: Path) -> list[str]:
    """Scans that the catalog does not show as what they are."""
    import duckdb

    with duckdb.connect(str(warehouse / "warehouse.duckdb"), read_only=True) as connection:
        states = dict(connection.execute("SELECT scan_id, state FROM scan_status").fetchall())
    names = [entry.name for entry in (inbox.inbox / "scans").iterdir()]
    expected = {name: fleet_inbox.EXPECTED.get(inbox.faults.get(name, ""), "measured") for name in names}
    return [
        f"{n}: {states.get(n)}, expected {s} ({inbox.faults.get(n)})" for n, s in expected.items() if states.get(n) != s
    ]


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and say whether the targets are met (exit code 1 if not)."""
    chosen = options(arguments)
    root = (chosen.data or Path(tempfile.gettempdir()) / "wheelset-benchmark").resolve()
    root.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    source = fleet_inbox.templates(root, chosen.wheelsets, chosen.repeats)
    recorded = root / "recorded"
    shutil.rmtree(recorded, ignore_errors=True)
    nights = []
    for scans in [n for n in (chosen.fewer, chosen.scans) if n]:
        days = max(1, round(chosen.days * scans / chosen.scans))
        where = "-" if chosen.computation == "all" else str(recorded)
        nights.append(night(source, root / f"night-{os.getpid()}", scans, days, chosen, where))
        print(f"[{time.perf_counter() - started:.0f} s] {json.dumps(nights[-1])}", file=sys.stderr, flush=True)
    last = nights[-1]
    checks = {
        "own_ms": last["own_ms"] <= MAX_OWN_MS,
        "again_seconds": last["again_seconds"] <= MAX_AGAIN_SECONDS and last["again_unchanged"] == last["scans"],
        "faults_accounted_for": not any(n["unaccounted"] for n in nights),
    }
    if len(nights) > 1:
        checks["memory_is_flat"] = last["driver_peak_mb"] <= MAX_GROWTH * nights[0]["driver_peak_mb"]
    document = {"machine": machine.describe(), "workers": chosen.workers, "nights": nights, "met": checks}
    if chosen.json:
        print(json.dumps(document, indent=2, default=str))
    else:
        _show(document)
    return 0 if all(checks.values()) else 1


def _show(document: dict[str, Any]) -> None:
    names = ("scans", "days", "seconds", "own_ms", "own_cpu_ms", "driver_peak_mb", "again_seconds", "warehouse_mb")
    print("| " + " | ".join(names) + " |\n|" + "---:|" * len(names))
    for one in document["nights"]:
        print("| " + " | ".join(f"{one[n]:.1f}" if isinstance(one[n], float) else str(one[n]) for n in names) + " |")
    for name, met in document["met"].items():
        print(f"{name}: {'met' if met else 'NOT met'}")
    for wrong in [w for n in document["nights"] for w in n["unaccounted"]][:20]:
        print(wrong)


if __name__ == "__main__":
    sys.exit(main())
