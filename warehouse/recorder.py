"""What puts outcomes on record: a task's receipt into its day's ledger, its light rows into the day's tables."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from warehouse import store
from warehouse.bounds import as_disk_full
from warehouse.execute import Outcome, stage_config
from warehouse.light import LightTables
from warehouse.lineage import CALIBRATION_DAY, FLEET_DAY, Ledger, Record, git_commit, now, package_versions
from warehouse.state import Unit, reason_fingerprint
from warehouse.summary import StageSummary
from wheelset_assets.config import Config
from wheelset_assets.declare import Stage
from wheelset_assets.stages import SCAN_STAGES
from wheelset_assets.tables import MEASUREMENTS

PASSING = "passing"
"""Fingerprint of a failure that says nothing of the scan: no computation has it, so the next run tries again."""
CHECKPOINT_SECONDS = 120.0
"""What a run that is killed loses at most: light rows and receipts are saved so often while a stage works."""


class Recorder:
    """Ledger and light tables of the days that a run touches, and what it counts."""

    def __init__(self, root: Path, ledger: Ledger, config: Config, run_id: str, flushes: bool = False) -> None:
        self.root, self.ledger, self.config, self.run_id = root, ledger, config, run_id
        self.flushes = flushes
        """Whether the workers leave it to this process to flush what they wrote, all at once."""
        self.touched: set[str] = set()
        self.warnings: list[str] = []
        self.points = 0
        self.compute_seconds = 0.0
        self.stages: dict[str, StageSummary] = {}
        self._light: dict[str, LightTables] = {}
        self._saved_at = time.monotonic()

    def light(self, day: str) -> LightTables:
        """Light tables of a day."""
        return self._light.setdefault(day, LightTables(self.root, self.ledger, day))

    def save(self, day: str) -> None:
        """Make what a day has visible: its tables and the names of its folders first, then the ledger that names them."""
        try:
            if day not in (CALIBRATION_DAY, FLEET_DAY):
                self.light(day).flush(flushed=not self.flushes)
            if self.ledger.day(day).dirty:
                if self.flushes:
                    store.flush_all(self.root)
                else:
                    store.flush_names(self.root, day)
            self.ledger.save(day)
        except OSError as error:
            if full := as_disk_full(error, self.root):
                raise full from error
            raise
        self._saved_at = time.monotonic()

    def checkpoint(self, day: str) -> bool:
        """Save a day if the last time is long ago; whether it was."""
        due = self.is_due()
        if due:
            self.save(day)
        return due

    def is_due(self) -> bool:
        """Whether the last time that something was saved is long ago."""
        return time.monotonic() - self._saved_at > CHECKPOINT_SECONDS

    def release(self) -> None:
        """Let go of what is saved, so that memory does not grow with the number of days."""
        self._light.clear()
        self.ledger.release()

    def count(self, outcome: Outcome, summary: StageSummary) -> None:
        """Count what became of a task."""
        summary.count(outcome)
        self.stages.setdefault(outcome.stage, StageSummary()).count(outcome)
        self.warnings += [f"{outcome.unit}: {warning}" for warning in outcome.warnings]
        self.compute_seconds += outcome.compute_seconds
        if outcome.state == "ok":
            self.points += outcome.points

    def put(
        self,
        day: str,
        unit: str,
        scan_id: str,
        stage: Stage,
        outcome: Outcome,
        print_: str,
        inputs: tuple[tuple[str, str], ...],
    ) -> None:
        """File what became of a task; what is downstream of a failure is given up."""
        record = Record(
            unit,
            scan_id,
            stage.name,
            outcome.state,
            outcome.reason,
            PASSING if outcome.passing else print_,
            stage.code_version,
            stage_config(self.config, stage).fingerprint(),
            inputs,
            outcome.outputs,
            git_commit(),
            self.run_id,
            now(),
            outcome.seconds,
            outcome.points,
            package_versions(),
            compute_seconds=outcome.compute_seconds,
        )
        self.ledger.day(day).put(record)
        if day in (CALIBRATION_DAY, FLEET_DAY):
            return
        if "@" not in unit:
            self.touched.add(unit)
        self.light(day).drop(unit, stage.outputs)
        for name, rows in outcome.light.items():
            if "@" not in unit or name != MEASUREMENTS.name:
                self.light(day).put(name, unit, rows)
        if not record.ok:
            for later in SCAN_STAGES[SCAN_STAGES.index(stage) + 1 :]:
                self._remove(day, unit, later, record)

    def drop(self, day: str, unit: Unit, stage: Stage) -> None:
        """Give up a stage's record of a unit that an earlier stage stopped."""
        ledger = self.ledger.day(day)
        causes = [ledger.get(unit.key, s.name) for s in SCAN_STAGES[: SCAN_STAGES.index(stage)]]
        because = next((c for c in causes if c is not None and not c.ok), None)
        if because is not None:
            self._remove(day, unit.key, stage, because)

    def _remove(self, day: str, unit: str, stage: Stage, because: Record) -> None:
        """Supersede a stage's record of a unit whose inputs are gone."""
        ledger = self.ledger.day(day)
        old = ledger.current.pop((unit, stage.name), None)
        if old is not None:
            if old.ok:
                ledger.history.append(replace(old, superseded_at=because.produced_at, superseded_by=because.version))
            ledger.dirty = True
            self.light(day).drop(unit, stage.outputs)

    def fail(self, day: str, unit: Unit, stage: Stage, reason: str, summary: StageSummary) -> None:
        """Put a scan on record that a stage cannot even start with."""
        summary.reasons[reason.split("\n")[0]] += 1
        print_ = reason_fingerprint(reason)
        record = self.ledger.day(day).get(unit.key, stage.name)
        if record is None or record.fingerprint != print_:
            summary.failed += 1
            outcome = Outcome(unit.key, stage.name, "failed", reason)
            self.put(day, unit.key, unit.scan.scan_id, stage, outcome, print_, ())
