"""Mutated bundles against the pipeline: `python -m benchmarks.fuzz --examples 10000 --workers 2`.

For each example a good scan is spoilt in one or two ways (`mutations`), put beside a good rig, calibration and reference
scan, and a night is run over them. It must not crash or hang, must write nothing outside the warehouse, and must leave a
row for the scan. If the mutation kept the hashes valid, each value must be within its uncertainty of the good scan's or
of the truth (frames in another order bring noise of their own), or carry a flag that the good one lacks, or be refused.
Every twenty-fifth example also builds the catalog and opens it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from benchmarks.mutations import MUTATIONS, seal
from warehouse import catalog
from warehouse.inbox import printable
from warehouse.light import LightTables
from warehouse.lineage import Ledger
from warehouse.night import Night, Summary
from warehouse.pool import Pool, WorkerDied
from wheelset_assets.config import Config
from wheelset_assets.stages import SCAN_STAGES
from wheelset_assets.tables import MEASUREMENTS

SECONDS_AT_MOST = 120
"""An example that takes longer hangs; a good one takes about a second."""
CONFIG = Config.model_validate({"features": {"spacing_mm": 2.0}})
"""Coarser features: they decide nothing on a rim, and take half of an example's time."""
Values = dict[tuple[str, str], tuple[float | None, float | None, frozenset[str]]]
"""Value, expanded uncertainty and flags by quantity and side."""
Truth = dict[tuple[str, str], float]
"""True value in mm by quantity and side."""


@dataclass(frozen=True)
class Base:
    """A good inbox without the production scan, a warehouse that has processed it, the scan apart, and its values."""

    folder: Path
    scan_id: str
    values: Values
    truth: Truth

    @property
    def inbox(self) -> Path:
        """Rig, calibration and reference scan."""
        return self.folder / "inbox"

    @property
    def warehouse(self) -> Path:
        """Warehouse that has processed the inbox."""
        return self.folder / "warehouse"

    @property
    def good(self) -> Path:
        """The good production scan's folder."""
        return self.folder / "good"


@dataclass(frozen=True)
class Verdict:
    """What became of an example; `problem` is None if all that must hold did."""

    seed: int
    what: tuple[str, ...]
    outcome: str
    problem: str | None
    seconds: float


def make_base(folder: Path, frames: int = 32, rows: int = 512) -> Base:
    """Simulate, process and set apart; what a good scan gives is the yardstick."""
    from wheelset_assets.simulation import SimulationPlan, simulate

    simulate(SimulationPlan(out=folder / "inbox", wheelsets=1, repeats=1, seed=5, frames=frames, rows=rows))
    (scan,) = [p for p in sorted((folder / "inbox" / "scans").iterdir()) if p.name.startswith("WS-")]
    scan.rename(folder / "good")
    truth = pq.read_table(folder / "inbox.truth.parquet", filters=[("scan_id", "=", scan.name)]).to_pylist()
    base = Base(folder, scan.name, {}, {(row["quantity"], row["side"]): row["truth_mm"] for row in truth})
    run(base.inbox, base.warehouse)
    with _place(base) as place:
        shutil.copytree(base.good, place / "inbox" / "scans" / base.scan_id)
        run(place / "inbox", place / "warehouse")
        return replace(base, values=values(place / "warehouse", base.scan_id))


def run(inbox: Path, warehouse: Path, catalogued: bool = True, workers: int = 0) -> Summary:
    """A night, by default in this process, without an orchestrator; its catalog costs more than an example, and is left
    out of most.
    """
    with Night(warehouse, inbox, CONFIG, workers=workers, wait_seconds=0) as night:
        night.prepare()
        night.run_calibrations()
        for day in night.days_with_work():
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
        night.run_fleet()
        if catalogued:
            catalog.build(warehouse, night.ledger, night.state.inbox.reviews())
        return night.summary()


def values(warehouse: Path, scan_id: str) -> Values:
    """What the measurements say of a scan."""
    ledger = Ledger(warehouse)
    found: Values = {}
    for day in ledger.days():
        for row in LightTables(warehouse, ledger, day).get(MEASUREMENTS.name, scan_id).to_pylist():
            flags = frozenset(row["quality_flags"])
            found[row["quantity"], row["side"]] = (row["value"], row["expanded_uncertainty"], flags)
    return found


@contextmanager
def _place(base: Base) -> Iterator[Path]:
    """A scratch folder with the good inbox (hard links) and a copy of its warehouse."""
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=base.folder) as name:
        place = Path(name)
        shutil.copytree(base.inbox, place / "inbox", copy_function=os.link)
        shutil.copytree(base.warehouse, place / "warehouse")
        (place / "canary").write_text("untouched")
        yield place


def example(base: Base, seed: int, kinds: tuple[str, ...] = (), workers: int = 0) -> Verdict:
    """Spoil the good scan as the seed says (or in the kinds given), run a night, and judge."""
    random = np.random.default_rng(seed)
    names = sorted(MUTATIONS)
    chosen = kinds or tuple(names[int(random.integers(len(names)))] for _ in range(1 if random.random() < 0.8 else 2))
    started = time.perf_counter()
    with _place(base) as place:
        folder = place / "inbox" / "scans" / base.scan_id
        shutil.copytree(base.good, folder, copy_function=os.link)
        done: list[str] = []
        payload = True
        for kind in chosen:
            mutation = MUTATIONS[kind]
            try:
                done.append(f"{kind}: {mutation.strike(folder, random)}")
                if mutation.sealed:
                    seal(folder)
            except (OSError, ValueError, LookupError, AttributeError, TypeError, RecursionError) as error:
                done.append(f"{kind}: not possible after the first ({type(error).__name__})")
            payload = payload and mutation.payload
        before = _tree(place)
        try:
            with _time_limit():
                summary = run(place / "inbox", place / "warehouse", seed % 25 == 0, workers)
                outcome, problem = _judge(base, place, summary, payload)
                if seed % 25 == 0:
                    scans = place / "inbox" / "scans"
                    complete = sum(_listed(p) for p in scans.iterdir())
                    problem = problem or _readable(place, complete)
            if (after := _tree(place)) != before:
                problem = f"written outside the warehouse: {sorted(set(before.items()) ^ set(after.items()))[:3]}"
        except Exception as error:
            outcome, problem = "crash", f"{type(error).__name__}: {error}"
    return Verdict(seed, tuple(done), outcome, problem, time.perf_counter() - started)


def _tree(place: Path) -> dict[str, tuple[int, int]]:
    """Sizes and times of everything but the warehouse."""
    found: dict[str, tuple[int, int]] = {}
    for top, folders, files in os.walk(place):
        if Path(top) == place:
            folders.remove("warehouse")
        for name in (*folders, *files):
            status = os.lstat(os.path.join(top, name))
            found[printable(os.path.join(top, name))] = (status.st_size, status.st_mtime_ns)
    return found


@contextmanager
def _time_limit() -> Iterator[None]:
    def hang(*_: object) -> None:
        raise TimeoutError(f"hangs: more than {SECONDS_AT_MOST} s")

    before = signal.signal(signal.SIGALRM, hang)
    signal.alarm(SECONDS_AT_MOST)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _judge(base: Base, place: Path, summary: Summary, payload: bool) -> tuple[str, str | None]:
    folders = [p for p in (place / "inbox" / "scans").iterdir() if _listed(p)]
    names = {printable(p.name) for p in folders} - {p.name for p in (base.inbox / "scans").iterdir()}
    if not names:
        return "not complete", None
    (name,) = names
    found = [t for t in summary.troubles if t["scan_id"] == name]
    if found:
        state = str(found[0]["state"])
        return state, None if found[0]["reason"] else f"{state} without a reason"
    if summary.measured != 1:
        return "lost", f"the summary does not know it: {summary}"
    return ("measured", None) if not payload else _compare(base, values(place / "warehouse", name))


def _listed(folder: Path) -> bool:
    """Whether the inbox lists it: a folder whose name begins with a dot is one that a transfer has not yet renamed."""
    return not folder.name.startswith(".") and os.path.lexists(folder / "scan.json")


def _readable(place: Path, names: int) -> str | None:
    """Whether any client can open the catalog and finds a row for every scan."""
    with catalog.connect(place / "warehouse") as connection:
        rows = connection.execute("SELECT scan_id, state, reason FROM scan_status").fetchall()
        connection.execute("SELECT count(*) FROM lineage").fetchall()
    return None if len(rows) == names else f"{len(rows)} rows in scan_status for {names} scans"


def _compare(base: Base, found: Values) -> tuple[str, str | None]:
    """As U is a statement of probability: of the values one in twenty may be off by more than U, none by 1.5 times U.

    Off from the good scan's value or from the truth, whichever is nearer: two scans of other noise may lie on either side.
    """
    outcome, off = "unchanged", []
    for key, (value, u, flags) in base.values.items():
        new, new_u, new_flags = found.get(key, (None, None, frozenset()))
        if new is None:
            outcome = "values refused" if value is not None else outcome
        elif new_flags - flags:
            outcome = "flagged" if outcome != "values refused" else outcome
        elif value is not None and u is not None and new_u is not None:
            change = abs(new - value) / max(u, new_u, 1e-12)
            ratio = min(change, abs(new - base.truth.get(key, np.inf)) / max(new_u, 1e-12))
            if change > 1 >= ratio:
                outcome = "U holds the truth" if outcome in ("unchanged", "within U") else outcome
            elif ratio > 1:
                off.append((ratio, f"{' '.join(key)}: {value:.4f} became {new:.4f}, U = {new_u:.4f}, without a flag"))
            outcome = "within U" if new != value and outcome == "unchanged" else outcome
    if off and (max(off)[0] > 1.5 or len(off) > max(1, len(base.values) // 20)):
        return "wrong", f"{len(off)} of {len(base.values)} values; {max(off)[1]}"
    return outcome, None


@cache
def _open(folder: Path) -> Base:
    return restored(json.loads((folder / "base.json").read_text()), folder)


def kept(base: Base) -> dict[str, Any]:
    """What a process needs to judge by, as JSON can hold it."""
    values = [[q, s, v, u, sorted(f)] for (q, s), (v, u, f) in base.values.items()]
    return {"scan_id": base.scan_id, "values": values, "truth": [[*key, value] for key, value in base.truth.items()]}


def restored(found: dict[str, Any], folder: Path) -> Base:
    """The inverse of `kept`."""
    values = {(q, s): (v, u, frozenset(f)) for q, s, v, u, f in found["values"]}
    return Base(folder, found["scan_id"], values, {(q, s): value for q, s, value in found["truth"]})


def _work(job: tuple[Path, int, tuple[str, ...]]) -> Verdict:
    folder, seed, kinds = job
    return example(_open(folder), seed, kinds)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first example; the others follow")
    parser.add_argument("--kind", action="append", default=[], choices=sorted(MUTATIONS), help="only this; repeatable")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    outcomes: dict[str, Counter[str]] = {}
    problems: list[Verdict] = []
    seconds: list[float] = []
    with tempfile.TemporaryDirectory(prefix="wheelset-fuzz-") as name, Pool(options.workers) as pool:
        folder = Path(name)
        print("simulating and processing the good scan …", file=sys.stderr)
        base = make_base(folder)
        (folder / "base.json").write_text(json.dumps(kept(base)))
        jobs = [
            (folder, options.seed + k, (options.kind[k % len(options.kind)],) if options.kind else ())
            for k in range(options.examples)
        ]
        for n, (job, result) in enumerate(pool.run(_work, jobs), start=1):
            if isinstance(result, WorkerDied):
                # A library ended the process, as on damaged files it may: a night has workers to lose, so it is tried there.
                result = example(base, job[1], job[2], workers=1)
            elif isinstance(result, Exception):
                raise result
            for kind in {text.split(":")[0] for text in result.what}:
                outcomes.setdefault(kind, Counter())[result.outcome] += 1
            seconds.append(result.seconds)
            if result.problem:
                problems.append(result)
                print(f"seed {result.seed}: {'; '.join(result.what)}\n    {result.problem}", file=sys.stderr)
            if n % 100 == 0:
                print(f"{n} of {len(jobs)}, {len(problems)} problems", file=sys.stderr)
    found = {
        "examples": options.examples,
        "problems": [asdict(p) for p in problems],
        "outcomes": {kind: dict(counts) for kind, counts in sorted(outcomes.items())},
        "seconds_median": float(np.median(seconds)),
        "seconds_max": max(seconds),
    }
    if options.json:
        print(json.dumps(found, indent=1))
    else:
        for kind, counts in found["outcomes"].items():
            print(f"{kind:20} {', '.join(f'{n} {what}' for what, n in sorted(counts.items()))}")
        print(
            f"{options.examples} examples, {len(problems)} problems; {found['seconds_median']:.2f} s each at the median,"
        )
        print(f"{found['seconds_max']:.1f} s at most")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
