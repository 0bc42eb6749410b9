"""A run over the inbox: verify what is new, compute what is stale, stage by stage and day by day, and leave a summary.

The orchestrator calls `prepare`, then `run_calibrations`, `run_stage` for each day and stage, `run_fleet` and `finish`; this
module knows nothing of it. Every method may be called again: what is done is not done twice.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from warehouse import fleet, place, store
from warehouse.bounds import DEFAULT, Bounds, DiskFull, is_passing, with_retries
from warehouse.execute import Outcome, Task, execute, stage_config
from warehouse.inbox import Entry, Inbox
from warehouse.light import LIGHT
from warehouse.lineage import CALIBRATION_DAY, FLEET_DAY, UNDATED, Ledger
from warehouse.lock import WarehouseLock
from warehouse.pool import Pool, WorkerDied
from warehouse.recorder import Recorder
from warehouse.state import State, Unit
from warehouse.summary import StageSummary, Summary, summarise
from warehouse.travel import Tables
from wheelset_assets.config import Config
from wheelset_assets.declare import Stage
from wheelset_assets.quality import ConfigError, ScanUnusable
from wheelset_assets.stages import CALIBRATION, MEASUREMENT, REPEATABILITY, SCAN_STAGES

Progress = Callable[[str, str, int, int], None]
"""Called as progress(what, unit, done, total)."""


def _verify(job: tuple[Path, str, Entry]) -> Any:
    root, kind, entry = job
    inbox = Inbox(root)
    verify = inbox.verify_calibration if kind == "calibration" else inbox.verify_scan
    return with_retries(lambda: verify(entry))


def no_progress(what: str, unit: str, done: int, total: int) -> None:
    """Say nothing."""


class Night:
    """One run over an inbox into a warehouse, holding the warehouse's lock."""

    def __init__(
        self,
        root: Path,
        inbox: Path,
        config: Config,
        *,
        workers: int = 2,
        cluster: str | None = None,
        only: frozenset[str] = frozenset(),
        until: datetime | None = None,
        progress: Progress = no_progress,
        wait_seconds: float = 2.0,
        bounds: Bounds = DEFAULT,
        retry_failed: bool = False,
    ) -> None:
        self.root, self.config, self.only, self.until, self.progress = root, config, only, until, progress
        self.inbox_root = inbox
        self.run_id = uuid.uuid4().hex[:12]
        self.started = time.perf_counter()
        self.lock = WarehouseLock(root)
        self.pool = Pool(workers, cluster, sees=(self.lock.path, inbox), bounds=bounds)
        self.bounds = bounds
        self.ledger = Ledger(root)
        self.state = State(Inbox(inbox), self.ledger, config, retry_before=self.run_id if retry_failed else None)
        flushes = cluster is None and store.can_flush_all(root)  # other machines must flush their own
        self.record = Recorder(root, self.ledger, config, self.run_id, flushes)
        self.interrupted = False
        self.references_only = False
        """Whether the day that was given last is to be gone through for its references alone."""
        self._begun: dict[str, dict[str, StageSummary]] = {}
        """Days whose references were worked on ahead of their scans, with what each stage did."""
        self.unread: set[str] = set()
        """Scans whose bundles could not be read now, or were not reached, though nothing speaks against them."""
        self.error: BaseException | None = None
        """What stopped a part of the run, if something did: an orchestrator may end it in good order all the same."""
        self._wait = wait_seconds
        self._swept = False

    def __enter__(self) -> Night:
        try:
            place.make_folder(self.root)
            self.lock.acquire(self._wait)
        except OSError as error:
            raise ConfigError(f"{self.root}: cannot hold a warehouse: {error.strerror}") from error
        return self

    def __exit__(self, *_: object) -> None:
        self.pool.__exit__()
        self.lock.release()

    # --- bundles and calibrations --------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Take up the inbox: verify new and changed bundles, and put what they are on record."""
        self.bounds.check_disk(self.root)
        self._keep_rigs()
        changed = self.state.unknown_bundles()
        jobs = [(self.inbox_root, kind, entry) for kind, entry in changed]
        self.unread = {entry.identifier for kind, entry in changed if kind == "scan"}
        try:
            for n, (job, result) in enumerate(self.pool.run(_verify, jobs, self.out_of_time), start=1):
                self.progress("verify", job[2].identifier, n, len(jobs))
                if isinstance(result, OSError) and (is_passing(result) or not job[2].folder.exists()):
                    self.record.warnings.append(
                        f"{job[1]} {job[2].identifier} could not be read: {result}; left for the next run"
                    )
                    continue
                if isinstance(result, Exception) and not isinstance(result, ScanUnusable):
                    if not isinstance(result, OSError | WorkerDied):
                        raise result
                    refused = ScanUnusable(f"{job[1]}s/{job[2].identifier}: {result}")
                    refused.may_pass = isinstance(result, OSError)
                    result = refused
                self._take_up(job[1], job[2], result)
                if self.record.is_due():
                    self._save_bundles()
        finally:
            self._save_bundles()
        self.interrupted = self.interrupted or self.out_of_time()
        self.state.keep_former(self.unread)
        self.state.arrange()
        for rig_id in sorted(self.state.inbox.unread_rigs):
            why = self.state.inbox.rigs[rig_id][2]
            self.record.warnings.append(f"{why}; what hangs on this rig is left for the next run")
        self.unread |= self.state.waiting

    def _save_bundles(self) -> None:
        for day in self.ledger.dirty_days():
            self.record.light(day).prune()
            self.record.save(day)
        self.record.save(UNDATED)
        self.record.save(CALIBRATION_DAY)

    def _take_up(self, kind: str, entry: Entry, result: Any) -> None:
        """Put a verified bundle on record; a good one whose content is what it was does not count as touched."""
        self.unread.discard(entry.identifier)
        before = self.ledger.bundle(entry.identifier) if kind == "scan" else None
        record = self.state.record_bundle(kind, entry, result, self.run_id)
        if kind == "calibration":
            if not record.ok:
                self.record.warnings.append(f"calibration {entry.identifier} was refused: {record.reason}")
        elif not record.ok or before is None or before[1].fingerprint != record.fingerprint:
            self.record.touched.add(record.unit)

    def _sweep(self) -> None:
        """Remove what a killed run left half written, before the first task: a run with nothing to do need not look."""
        if not self._swept:
            store.sweep_temporary(self.root)
            self._swept = True

    def _keep_rigs(self) -> None:
        """Copy the rigs' files, so that recordings and reports need no inbox: `_rigs/<sha256>.json`."""
        for rig, sha, _ in self.state.inbox.rigs.values():
            if rig is not None and not (target := self.root / "_rigs" / f"{sha}.json").exists():
                store.write_bytes(target, (self.state.inbox.root / "rigs" / f"{rig.rig_id}.json").read_bytes())

    def run_calibrations(self) -> StageSummary:
        """Stage 1 over every calibration bundle that is new or stale."""
        summary = StageSummary()
        tasks, wanted = [], {}
        for name, print_, inputs in self.state.stale_calibrations():
            header, entry, bundle = self.state.calibrations[name]
            rig, _, why = self.state.inbox.rigs.get(
                header.rig_id, (None, "", f"rig {header.rig_id} is not in the inbox")
            )
            wanted[name] = (print_, inputs)
            if rig is None:
                self.record.put(
                    CALIBRATION_DAY,
                    name,
                    name,
                    CALIBRATION,
                    Outcome(name, CALIBRATION.name, "failed", why),
                    print_,
                    inputs,
                )
                summary.failed += 1
                continue
            files = {n: sha for n, sha in bundle.inputs if n != "calibration.json"}
            tasks.append(
                Task(
                    self.root,
                    CALIBRATION.name,
                    name,
                    CALIBRATION_DAY,
                    stage_config(self.config, CALIBRATION),
                    bundle_folder=entry.folder,
                    bundle_files=files,
                    calibration=header,
                    rig=rig,
                    flushed=not self.record.flushes,
                )
            )
        self._run(tasks, CALIBRATION, CALIBRATION_DAY, wanted, summary)
        self.record.save(CALIBRATION_DAY)
        summary.data_version = self._data_version(CALIBRATION_DAY, CALIBRATION)
        return summary

    # --- scan stages ---------------------------------------------------------------------------------------------

    def units(self, day: str) -> list[Unit]:
        """Units of a day that this run may touch."""
        found = self.state.units(day)
        if self.references_only:
            found = [u for u in found if u.scan.purpose == "reference"]
        if not self.only:
            return found
        wanted = self._wanted_keys()
        return [u for u in found if u.key in wanted]

    def _wanted_keys(self) -> set[str]:
        """Units that `only` asks for, and the references behind them, each zeroed by the one before it."""
        wanted: set[str] = set()
        chain = [unit for name, unit in self.state.scans.items() if name in self.only]
        while chain:
            unit = chain.pop()
            if unit.key not in wanted:
                wanted.add(unit.key)
                at = self.state.reference(unit)[1]
                chain += [at] if at is not None else []
        return wanted

    def stale_units(self, day: str) -> dict[str, list[Unit]]:
        """For each unit of a day with work, filed under its first stale stage."""
        return self.state.stale_units(self.units(day))

    def days_with_work(self) -> Iterator[str]:
        """Days to be worked on, as long as there is time: the newest first, but references before all scans.

        A reference is zeroed by the one before it, and a scan by the newest: so if several days have work, the references
        of all of them come first, in order of time, and then the days from the newest back. A day comes again if the work
        itself makes more: a reference that turns out to be unusable gives its scans another one.

        With `references_only` set, only the references of the day are meant; the day itself is then still to come, even if
        nothing more is to be done on it, and its summaries tell of both.
        """
        asked: dict[tuple[str, bool], dict[str, list[Unit]]] = {}
        more = True
        while more:
            more = False
            for day, references in self._order():
                self.record.release()
                self.references_only = references
                stale = self.stale_units(day)
                nothing_new = not stale or stale == asked.get((day, references))
                if nothing_new and (references or day not in self._begun):
                    continue
                if self.out_of_time():
                    self.interrupted = True
                    break
                asked[day, references], more = stale, True
                yield day
                if not references:
                    self._begun.pop(day, None)
            self.references_only = False
            if self.interrupted:
                for day in sorted(self._begun):  # nothing is begun any more, but what was done on them is told
                    self.record.release()
                    yield day
                return

    def _order(self) -> list[tuple[str, bool]]:
        """Days with work, each with whether only its references are meant."""
        days = []
        for day in self.state.days():
            if self.stale_units(day):
                days.append(day)
            self.record.release()
        first = [(day, True) for day in days] if len(days) > 1 else []
        return first + [(day, False) for day in reversed(days)]

    def run_stage(self, stage: Stage, day: str) -> StageSummary:
        """One stage over the stale units of a day; the references first where the others need them."""
        summary = StageSummary()
        units = self.units(day)
        if stage is MEASUREMENT:  # each reference is zeroed by the one before it
            batches: list[list[Unit]] = [
                [u for u in units if u.derived],
                *([u] for u in units if u.scan.purpose == "reference" and not u.derived),
                [u for u in units if u.scan.purpose == "production"],
            ]
        else:
            batches = [units]
        for batch in batches:
            self._batch(stage, day, batch, summary)
        self.record.save(day)
        if self.references_only:
            self._begun.setdefault(day, {})[stage.name] = summary
        elif (before := self._begun.get(day, {}).pop(stage.name, None)) is not None:
            summary.include(before)
        summary.data_version = self._data_version(day, stage)
        return summary

    def _batch(self, stage: Stage, day: str, units: Iterable[Unit], summary: StageSummary) -> None:
        tasks, wanted = [], {}
        self.bounds.check_disk(self.root)
        for unit in units:
            if self.out_of_time():
                self.interrupted = True
                break
            need, print_ = self.state.stale(stage, unit)
            if need.blocked:
                summary.blocked += 1
                self.record.drop(day, unit, stage)
            elif need.failed:
                self.record.fail(day, unit, stage, need.failed, summary)
            elif print_ is None:
                record = self.ledger.day(day).get(unit.key, stage.name)
                if record is not None and record.ok:
                    summary.unchanged += 1
                elif record is not None:
                    summary.reasons[record.reason] += 1
            else:
                wanted[unit.key] = (print_, need.inputs)
                tasks.append(self._task(stage, unit))
        self._run(tasks, stage, day, wanted, summary)
        self.interrupted = self.interrupted or self.out_of_time()

    def out_of_time(self) -> bool:
        """Whether the time window has closed."""
        return self.until is not None and datetime.now(UTC) >= self.until

    def _task(self, stage: Stage, unit: Unit) -> Task:
        ledger = self.ledger.day(unit.day)
        paths: dict[str, str] = {}
        tables = Tables()
        for name in stage.inputs:
            if name == "calibrations":
                record = self.ledger.day(CALIBRATION_DAY).current[unit.calibration_id, CALIBRATION.name]
                paths[name] = record.output(name).path
            elif name in LIGHT:
                tables[name] = self.record.light(unit.day).get(name, unit.key)
            else:
                producer = next(s for s in SCAN_STAGES if any(t.name == name for t in s.outputs))
                paths[name] = ledger.current[unit.key, producer.name].output(name).path
        reference = None
        if "reference" in stage.raw_inputs:
            reference, at, _ = self.state.reference(unit)
            if at is not None:
                for name in stage.optional_inputs:
                    tables[name] = self.record.light(at.day).get(name.removeprefix("reference_"), at.key)
        return Task(
            self.root,
            stage.name,
            unit.key,
            unit.day,
            stage_config(self.config, stage),
            paths,
            tables,
            unit.folder,
            dict(unit.files),
            unit.scan,
            None,
            self.state.rig(unit),
            reference,
            not self.record.flushes,
        )

    def _run(self, tasks: list[Task], stage: Stage, day: str, wanted: dict, summary: StageSummary) -> None:
        if tasks:
            self._sweep()
        try:
            for n, (task, result) in enumerate(self.pool.run(execute, tasks, self.out_of_time), start=1):
                if isinstance(result, WorkerDied):
                    result = Outcome(task.unit, stage.name, "failed", str(result))
                elif isinstance(result, Exception):
                    result.add_note(f"while {stage.name} worked on {task.unit}")
                    raise result
                print_, inputs = wanted[task.unit]
                scan_id = task.scan.scan_id if task.scan else task.unit
                self.record.put(day, task.unit, scan_id, stage, result, print_, inputs)
                self.record.count(result, summary)
                if self.record.checkpoint(day):
                    self.bounds.check_disk(self.root)
                self.progress(stage.name, task.unit, n, len(tasks))
        except BaseException:  # a bug, a full disk, or an interrupt: what was finished is kept
            with contextlib.suppress(OSError, DiskFull):
                self.record.save(day)
            raise

    # --- fleet and end -------------------------------------------------------------------------------------------

    def fleet_stale(self) -> tuple[str, tuple[tuple[str, str], ...]] | None:
        """Fingerprint and inputs of the repeatability statistics, if they are stale."""
        return fleet.stale(self.ledger, self.config)

    def run_fleet(self) -> StageSummary:
        """Stage 8 over all measurements."""
        summary = StageSummary()
        wanted = self.fleet_stale()
        if wanted is None:
            summary.unchanged = 1
        else:
            self._sweep()
            outcome = fleet.run(self.root, self.ledger, self.config, execute)
            self.record.put(FLEET_DAY, "fleet", "fleet", REPEATABILITY, outcome, *wanted)
            self.record.count(outcome, summary)
            self.record.save(FLEET_DAY)
        summary.data_version = self._data_version(FLEET_DAY, REPEATABILITY)
        return summary

    def _data_version(self, day: str, stage: Stage) -> str:
        """Hash over the current output versions of a stage on a day."""
        current = self.ledger.day(day).current
        lines = [
            f"{unit} {record.version if record.ok else record.state}"
            for (unit, name), record in sorted(current.items())
            if name == stage.name
        ]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]

    def summary(self) -> Summary:
        """Counts of this run, in scans."""
        return summarise(self)
