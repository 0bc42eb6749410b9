"""What a run did: counts by stage for the orchestrator, counts in scans for people and scripts."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from warehouse.execute import Outcome
from warehouse.lineage import BUNDLE, Record
from wheelset_assets.stages import SCAN_STAGES

if TYPE_CHECKING:
    from warehouse.night import Night


@dataclass
class StageSummary:
    """What one stage did on one day. `compute_seconds`: of `seconds`, those in the stage's own function."""

    computed: int = 0
    unchanged: int = 0
    refused: int = 0
    failed: int = 0
    blocked: int = 0
    points: int = 0
    seconds: float = 0.0
    compute_seconds: float = 0.0
    bytes: int = 0
    reasons: Counter = field(default_factory=Counter)
    data_version: str = ""

    def count(self, outcome: Outcome) -> None:
        """Add what became of one task."""
        self.seconds += outcome.seconds
        self.compute_seconds += outcome.compute_seconds
        self.points += outcome.points
        self.bytes += sum(o.bytes for o in outcome.outputs)
        if outcome.state == "ok":
            self.computed += 1
        else:
            self.refused += outcome.state == "refused"
            self.failed += outcome.state == "failed"
            self.reasons[outcome.reason] += 1

    def include(self, before: StageSummary) -> None:
        """Add what the stage did on the same day a while ago; what it made then counts as unchanged here."""
        for name in ("computed", "refused", "failed", "points", "seconds", "compute_seconds", "bytes"):
            setattr(self, name, getattr(self, name) + getattr(before, name))
        self.unchanged = max(0, self.unchanged - before.computed)


@dataclass
class Summary:
    """What a run did, in scans. `pending` has work that this run did not reach; `warnings` concern no single scan."""

    measured: int = 0
    refused: int = 0
    failed: int = 0
    unchanged: int = 0
    pending: int = 0
    points: int = 0
    seconds: float = 0.0
    compute_seconds: float = 0.0
    troubles: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        return asdict(self)


def summarise(night: Night) -> Summary:
    """Counts of a run, in scans."""
    kept = night.record
    result = Summary(points=kept.points, warnings=list(dict.fromkeys(kept.warnings)))
    result.compute_seconds = round(kept.compute_seconds, 3)
    behind = _not_reached(night)
    states = _states(night, [name for name in night.state.present if name in kept.touched])
    for name in night.state.present:
        state, record = states.get(name, ("", None))
        if name in behind or name in night.unread or state == "pending":
            result.pending += 1
        elif name not in kept.touched:
            result.unchanged += 1
        elif state == "measured":
            result.measured += 1
        elif record is not None:
            setattr(result, state, getattr(result, state) + 1)
            reason, _, details = (record.reason or "").partition("\n")
            trouble = {"scan_id": name, "state": state, "stage": record.stage, "reason": reason}
            result.troubles.append(trouble | ({"details": details} if details else {}))
    result.seconds = round(time.perf_counter() - night.started, 3)
    return result


def _by_day(night: Night, names: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
    """Names of usable scans by the day that they lie on; a day leaves memory before the next one is looked at."""
    days: dict[str, list[str]] = defaultdict(list)
    for name in names:
        days[night.state.scans[name].day].append(name)
    for day, found in sorted(days.items()):
        yield day, found
        night.ledger.release()


def _not_reached(night: Night) -> set[str]:
    """Scans that still have work, because time ran out or because only others were asked for."""
    if not night.interrupted and not night.only:
        return set()
    names = [n for n, u in night.state.scans.items() if u.key not in night.record.touched or night.interrupted]
    behind: set[str] = set()
    for _, found in _by_day(night, names):
        stale = night.state.stale_units(night.state.scans[name] for name in found)
        behind |= {unit.key for units in stale.values() for unit in units}
    return behind


def _states(night: Night, names: list[str]) -> dict[str, tuple[str, Record | None]]:
    """State of scans that the run touched, each with the record that decided it."""
    usable = [name for name in names if name in night.state.scans]
    states: dict[str, tuple[str, Record | None]] = {}
    for day, found in _by_day(night, usable):
        ledger = night.ledger.day(day)
        for name in found:
            states[name] = _state_of([ledger.get(night.state.scans[name].key, s.name) for s in SCAN_STAGES])
    if others := set(names) - set(usable):
        states |= dict.fromkeys(others, ("pending", None))
        states |= {r.unit: (r.state, r) for _, r in night.ledger.records_of(BUNDLE) if r.unit in others}
    return states


def _state_of(records: list[Record | None]) -> tuple[str, Record | None]:
    """What the records of a scan's stages, in their order, say of it."""
    for record in records:
        if record is None:
            return "pending", None
        if not record.ok:
            return record.state, record
    return "measured", None
