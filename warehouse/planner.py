"""What a run would do, without doing it: shared by `status`, `run --dry-run`, the nightly schedule and the inbox sensor."""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from warehouse import reviews
from warehouse.execute import STAGE_BY_NAME, stage_config
from warehouse.inbox import Entry, Inbox, read_json_text
from warehouse.lineage import UNDATED, Ledger
from warehouse.state import State
from wheelset_assets.config import Config
from wheelset_assets.quality import ScanUnusable
from wheelset_assets.stages import SCAN_STAGES, STAGES


@dataclass
class DayPlan:
    """Work on one day: new or changed scans, and known ones by the first stale stage with why it is stale."""

    day: str
    new: list[str] = field(default_factory=list)
    stale: dict[str, list[str]] = field(default_factory=dict)
    why: Counter = field(default_factory=Counter)

    def add(self, day: str, stage: str, unit: str, why: str) -> None:
        """File a unit under its first stale stage."""
        self.day = day
        self.stale.setdefault(stage, []).append(unit)
        self.why[why] += 1

    @property
    def n_scans(self) -> int:
        """Scans with work."""
        return len(self.new) + sum(len(v) for v in self.stale.values())


@dataclass
class Plan:
    """Everything that the next run would do."""

    days: list[DayPlan]
    calibrations: list[str]
    n_scans: int
    estimated_seconds: float | None
    reviews_changed: bool = False
    fingerprint: str = ""
    """Changes with what is to be done: also if the same bundle came anew, in other bytes, or the same stage is stale for another reason."""

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return not self.calibrations and not self.reviews_changed and not any(day.n_scans for day in self.days)

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        days = [{"day": d.day, "new": d.new, "stale": d.stale, "why": dict(d.why)} for d in self.days if d.n_scans]
        return {
            "idle": self.idle,
            "scans_in_inbox": self.n_scans,
            "scans_with_work": sum(day.n_scans for day in self.days),
            "calibrations": self.calibrations,
            "reviews_changed": self.reviews_changed,
            "days": days,
            "estimated_seconds": self.estimated_seconds,
        }


def plan(root: Path, inbox: Path, config: Config, only: frozenset[str] = frozenset()) -> Plan:
    """Compare inbox, ledger and configuration. Reads no bundle but the headers of new ones, and takes no lock."""
    state = State(Inbox(inbox), Ledger(root), config)
    days: dict[str, DayPlan] = defaultdict(lambda: DayPlan(""))
    calibrations = set()
    asked: list[str] = []
    for kind, entry in state.unknown_bundles():
        asked.append(f"{kind} {entry.identifier} {entry.signature}")
        if kind == "calibration":
            calibrations.add(entry.identifier)
        elif not only or entry.identifier in only:
            day = _day_of(entry)
            days[day].day = day
            days[day].new.append(entry.identifier)
    for name, wanted, _ in state.stale_calibrations():
        calibrations.add(name)
        asked.append(f"calibration {name} {wanted}")
    state.keep_former(state.former)  # what a changed reference brings is known once it is verified
    state.arrange()
    for day in state.days():
        units = [u for u in state.units(day) if not only or u.scan.scan_id in only]
        for stage, found in state.stale_units(units).items():
            for unit in found:
                days[day].add(day, stage, unit.key, _why(state, stage, unit))
                need, wanted_print = state.stale(STAGE_BY_NAME[stage], unit)
                asked.append(f"{stage} {unit.key} {wanted_print or need.failed}")
        state.ledger.release()
        listed = {key for keys in days[day].stale.values() for key in keys}
        for unit in units:
            if unit.calibration_id in calibrations and unit.key not in listed:
                why = f"calibration {unit.calibration_id} is new or stale"
                days[day].add(day, SCAN_STAGES[0].name, unit.key, why)
    reviewed = reviews.reviews_fingerprint(state.inbox.reviews())
    asked.append(f"reviews {reviewed}")
    result = Plan(
        sorted((d for d in days.values() if d.n_scans), key=lambda d: d.day),
        sorted(calibrations),
        len(state.present),
        None,
        reviewed != reviews.known_fingerprint(root),
        hashlib.sha256("\n".join(sorted(asked)).encode()).hexdigest()[:16],
    )
    result.estimated_seconds = _estimate(state, result)
    return result


def _day_of(entry: Entry) -> str:
    """Acquisition day of a bundle that has not been verified, or `undated`."""
    try:
        text, _ = read_json_text(entry.folder / "scan.json", entry.identifier)
        return datetime.fromisoformat(json.loads(text)["captured_at"]).date().isoformat()
    except (ScanUnusable, OSError, ValueError, KeyError, TypeError):
        return UNDATED


def _why(state: State, stage_name: str, unit: Any) -> str:
    stage = STAGE_BY_NAME[stage_name]
    record = state.ledger.day(unit.day).get(unit.key, stage_name)
    if record is None:
        return f"{stage_name}: not made yet"
    if record.code_version != stage.code_version:
        return f"{stage_name}: code version {record.code_version} is now {stage.code_version}"
    if record.config_fingerprint != stage_config(state.config, stage).fingerprint():
        return f"{stage_name}: configuration changed"
    need = state.need(stage, unit)
    if need.failed:
        return f"{stage_name}: {need.failed.splitlines()[0]}"
    if not record.ok and not record.inputs:
        return f"{stage_name}: could not start before: {(record.reason or '').splitlines()[0]}"
    before = dict(record.inputs)
    changed = [name for name, version in need.inputs if before.get(name) != version]
    return f"{stage_name}: {', '.join(changed) or 'inputs'} changed"


def _estimate(state: State, plan_: Plan) -> float | None:
    """Seconds of computation, from what each stage took a scan on the ten last days on record."""
    spent: dict[str, list[float]] = defaultdict(list)
    for day in state.ledger.days()[-10:]:
        for (_, stage), record in state.ledger.day(day).current.items():
            if record.ok and record.seconds:
                spent[stage].append(record.seconds)
        state.ledger.release()
    mean = {stage: sum(values) / len(values) for stage, values in spent.items()}
    if not mean:
        return None
    names = [s.name for s in STAGES if s.scope == "scan"]
    total = 0.0
    for planned in plan_.days:
        total += len(planned.new) * sum(mean.get(n, 0.0) for n in names)
        for stage, units in planned.stale.items():
            total += len(units) * sum(mean.get(n, 0.0) for n in names[names.index(stage) :])
    return round(total, 1)
