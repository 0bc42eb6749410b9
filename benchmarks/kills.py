"""`python -m benchmarks.kills`: runs killed at random moments, each followed by a resume, and the warehouse that comes of it.

A kill is SIGKILL to the whole process group, driver and workers; every third to the driver alone, and then the workers must
end by themselves. After each, what is visible is verified against its
recorded hashes; then the same command runs again, with the next kill at a random moment of it. When a campaign is done, its
warehouse must equal that of a run that nobody disturbed (equal data files, equal lineage without times, durations and run
identifiers), and a new campaign begins, until so many kills have been made.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import fleet_inbox
from benchmarks.processes import ROOT, environment

PER_RUN = ("run_id", "produced_at", "seconds", "superseded_at")
"""Columns of the lineage that carry the run, not the result."""


@dataclass
class Tally:
    """What happened so far."""

    kills: int = 0
    campaigns: int = 0
    undisturbed_seconds: float = 0.0
    wrong: list[str] = field(default_factory=list)


def options(arguments: list[str] | None) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="kills in all [default: 200]")
    parser.add_argument("--scans", type=int, default=12, help="production scans of the campaign [default: 12]")
    parser.add_argument("--days", type=int, default=3, help="days of the campaign [default: 3]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments [default: 0]")
    parser.add_argument("--plain", action="store_true", help="without Dagster: starts in a third of the time")
    parser.add_argument("--data", type=Path, help="folder that keeps the templates [default: the temporary folder]")
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    return parser.parse_args(arguments)


def content(warehouse: Path) -> tuple[set[str], list[str]]:
    """What two warehouses must agree in: data files by name, which is their hash, and the rows of the lineage."""
    import duckdb

    with duckdb.connect(str(warehouse / "warehouse.duckdb"), read_only=True) as connection:
        rows = connection.execute(f"SELECT * EXCLUDE ({', '.join(PER_RUN)}) FROM lineage").fetchall()
        files = connection.execute("SELECT DISTINCT path FROM lineage WHERE path <> ''").fetchall()
    return {path for (path,) in files}, sorted(map(repr, rows))


def differences(left: Path, right: Path) -> list[str]:
    """Why two warehouses are not equal, in words; nothing if they are."""
    (files, rows), (other_files, other_rows) = content(left), content(right)
    found = [f"data file in one only: {path}" for path in sorted(files ^ other_files)]
    return found + [f"lineage in one only: {row[:300]}" for row in sorted(set(rows) ^ set(other_rows))]


def start(inbox: Path, warehouse: Path, recorded: Path, plain: bool) -> subprocess.Popen:
    """One run, in a process group of its own."""
    place = [str(inbox), str(warehouse), "2", str(recorded), *(["plain"] if plain else [])]
    command = [sys.executable, "-m", "benchmarks.fleet_drive", *place]
    return subprocess.Popen(
        command, env=environment(), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )


def finish(process: subprocess.Popen) -> None:
    """Wait for a run that nobody kills."""
    _, errors = process.communicate()
    if process.returncode != 0:
        raise RuntimeError(f"the run ended with {process.returncode}:\n{errors.decode(errors='replace')[-3000:]}")


ORPHANS_END_SECONDS = 60.0


def killed(process: subprocess.Popen, after_seconds: float, alone: bool) -> bool:
    """Kill a run after a time, its driver alone or all its workers too; False if it was done before."""
    try:
        process.wait(after_seconds)
    except subprocess.TimeoutExpired:
        (os.kill if alone else os.killpg)(process.pid, signal.SIGKILL)
        process.communicate(timeout=ORPHANS_END_SECONDS)  # until nobody holds the pipe any more
        return True
    finish(process)
    return False


def campaign(chosen: argparse.Namespace, places: dict[str, Path], moments: random.Random, tally: Tally) -> None:
    """One campaign, killed until it is done or until there have been enough kills."""
    from warehouse.check import verify

    shutil.rmtree(places["disturbed"], ignore_errors=True)
    while True:
        process = start(places["inbox"], places["disturbed"], places["recorded"], chosen.plain)
        if tally.kills < chosen.kills:
            after_seconds = moments.uniform(0.0, 1.1 * tally.undisturbed_seconds)
            if not killed(process, after_seconds, alone=tally.kills % 3 == 2):
                break
            tally.kills += 1
            if (places["disturbed"] / "_ledger").is_dir():
                tally.wrong += [f"after kill {tally.kills}: {b}" for b in verify(places["disturbed"], None)["broken"]]
        else:
            finish(process)
            break
    tally.campaigns += 1
    tally.wrong += differences(places["undisturbed"], places["disturbed"])


def main(arguments: list[str] | None = None) -> int:
    """Kill, resume, compare; exit code 1 if anything differs."""
    chosen = options(arguments)
    root = (chosen.data or Path(tempfile.gettempdir()) / "wheelset-benchmark").resolve()
    root.mkdir(parents=True, exist_ok=True)
    source = fleet_inbox.templates(root, 2, 1)
    work = Path(tempfile.mkdtemp(prefix="kills-", dir=root))
    places = {name: work / name for name in ("inbox", "undisturbed", "disturbed")} | {
        "recorded": root / "recorded-kills"
    }
    tally, moments = Tally(), random.Random(chosen.seed)
    shutil.rmtree(places["recorded"], ignore_errors=True)  # by another version of the program, perhaps
    try:
        fleet_inbox.build(source, places["inbox"], chosen.scans, chosen.days)
        for _ in range(2):  # the first also records the computations
            shutil.rmtree(places["undisturbed"], ignore_errors=True)
            begun = time.perf_counter()
            finish(start(places["inbox"], places["undisturbed"], places["recorded"], chosen.plain))
            tally.undisturbed_seconds = time.perf_counter() - begun
        while tally.kills < chosen.kills:
            campaign(chosen, places, moments, tally)
            print(
                f"{tally.kills} kills, {tally.campaigns} campaigns, {len(tally.wrong)} wrong",
                file=sys.stderr,
                flush=True,
            )
    finally:
        shutil.rmtree(work, ignore_errors=True)
    document: dict[str, Any] = dict(vars(tally))
    print(json.dumps(document, indent=2) if chosen.json else _in_words(tally))
    return 1 if tally.wrong else 0


def _in_words(tally: Tally) -> str:
    verdict = "all equal to the undisturbed one" if not tally.wrong else "\n".join(tally.wrong[:20])
    return f"{tally.kills} kills, {tally.campaigns} campaigns resumed to their end: {verdict}"


if __name__ == "__main__":
    sys.exit(main())
