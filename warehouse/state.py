"""What is known before a run: bundles of the inbox against the ledger, references, and what each stage needs of each unit.

Shared by the planner and the run, so that what `status` shows is what `run` does.
"""

from __future__ import annotations

import hashlib
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from warehouse import nominal
from warehouse.execute import fingerprint, fingerprint_of, method, stage_config
from warehouse.inbox import BundleRefused, Entry, Inbox, Verified
from warehouse.lineage import BUNDLE, CALIBRATION_DAY, UNDATED, Ledger, Record, git_commit, now, package_versions
from wheelset_assets.bundle import CalibrationHeader, Rig, ScanHeader
from wheelset_assets.config import Config
from wheelset_assets.declare import Stage
from wheelset_assets.quality import ScanUnusable
from wheelset_assets.stages import CALIBRATION, MEASUREMENT, SCAN_STAGES
from wheelset_assets.stages.raw import Reference

NO_REFERENCE = "no reference"
NO_EARLIER_REFERENCE = "no earlier reference"
PRODUCER = {table.name: stage for stage in (CALIBRATION, *SCAN_STAGES) for table in stage.outputs}


@dataclass(frozen=True)
class Unit:
    """One scan under one calibration. `key` is the scan_id, or scan_id@calibration_id for a recalibrated reference."""

    key: str
    scan: ScanHeader
    calibration_id: str
    day: str
    folder: Path
    files: tuple[tuple[str, str], ...]
    bundle_version: str
    header_sha256: str

    @property
    def derived(self) -> bool:
        """Whether this is a reference scan triangulated again under another calibration."""
        return "@" in self.key


def _unit(record: Record, folder: Path) -> Unit:
    """The unit of a verified scan bundle."""
    assert record.header is not None
    scan = ScanHeader.model_validate_json(record.header)
    files = tuple((n, v) for n, v in record.inputs if n != "scan.json")
    header_sha = dict(record.inputs)["scan.json"]
    scan = scan.model_copy(update={"files": {}})  # they are in the unit once already
    day = scan.acquired_on.isoformat()
    return Unit(record.unit, scan, scan.calibration_id, day, folder, files, record.fingerprint, header_sha)


_LONG_AGO = datetime.min.replace(tzinfo=UTC)


def _by_time(unit: Unit) -> tuple[datetime, str]:
    return unit.scan.captured_at, unit.key


@dataclass(frozen=True)
class Need:
    """Inputs of a stage over a unit by name and version; or why it cannot run, sorted by whose fault it is."""

    inputs: tuple[tuple[str, str], ...] = ()
    blocked: str | None = None
    failed: str | None = None


def reason_fingerprint(reason: str) -> str:
    """Identity of a failure before computation: the same reason again is nothing new."""
    return hashlib.sha256(reason.encode()).hexdigest()[:16]


@dataclass
class State:
    """Inbox and ledger together."""

    inbox: Inbox
    ledger: Ledger
    config: Config
    scans: dict[str, Unit] = field(default_factory=dict)
    calibrations: dict[str, tuple[CalibrationHeader, Entry, Record]] = field(default_factory=dict)
    references: dict[str, list[Unit]] = field(default_factory=dict)
    kept: dict[str, Unit] = field(default_factory=dict)
    """Reference scans on record whose bundles have left the inbox, or cannot be read now: their results still set the zero."""
    former: dict[str, Unit] = field(default_factory=dict)
    """Reference scans whose bundles changed, as they were: until their verification says otherwise, nothing speaks against them."""
    waiting: set[str] = field(default_factory=set)
    """Scans of a rig whose file cannot be read now."""
    present: list[str] = field(default_factory=list)
    """Names of the inbox's scan bundles, usable or not."""
    by_day: dict[str, list[Unit]] = field(default_factory=dict)
    retry_before: str | None = None
    """If given: what was refused or failed in other runs than this one is to be tried again."""
    _profiles: dict[str | None, str] = field(default_factory=dict)
    _methods: dict[str, tuple[str, str, str]] = field(default_factory=dict)

    # --- bundles -------------------------------------------------------------------------------------------------

    def unknown_bundles(self) -> list[tuple[str, Entry]]:
        """Bundles that are new or changed, as (kind, entry); those known are taken from the ledger."""
        changed: list[tuple[str, Entry]] = []
        for entry in self.inbox.calibrations():
            seen = self.ledger.day(CALIBRATION_DAY).get(entry.identifier, BUNDLE)
            if seen is None or seen.signature != entry.signature or self._to_retry(seen):
                changed.append(("calibration", entry))
            elif seen.ok and seen.header:
                self.calibrations[entry.identifier] = (
                    CalibrationHeader.model_validate_json(seen.header),
                    entry,
                    seen,
                )
        present = {entry.identifier: entry for entry in self.inbox.scans()}
        self.present = list(present)
        filed: set[str] = set()
        twice: set[str] = set()
        known: set[str] = set()
        for _, last in self.ledger.records_of(BUNDLE):
            if last.unit in filed:
                twice.add(last.unit)
            elif self._take_known(last, present.get(last.unit)):
                known.add(last.unit)
            filed.add(last.unit)
        for name in sorted(twice):
            known.discard(name)
            if self._take_known(self._filed_once(name, present.get(name)), present.get(name)):
                known.add(name)
        changed += [("scan", entry) for name, entry in present.items() if name not in known]
        return changed

    def _take_known(self, last: Record, there: Entry | None) -> bool:
        """Take a bundle on record into the state; whether the inbox still has it as it was."""
        known = there is not None and last.signature == there.signature and not self._to_retry(last)
        if not last.ok or not last.header:
            return known
        if known and there is not None:
            self.scans[last.unit] = _unit(last, there.folder)
        elif '"reference"' in last.header:
            was = _unit(last, there.folder if there is not None else self.inbox.root / "scans" / last.unit)
            if was.scan.purpose == "reference":
                (self.kept if there is None else self.former)[last.unit] = was
        return known

    def _filed_once(self, name: str, there: Entry | None) -> Record:
        """The record of a bundle that is on record under several days: a run that filed it under another day was killed
        between the two files. The one that knows the bundle as it is stays, else the newest; the others are given up.
        """
        for found in (self.scans, self.kept, self.former):
            found.pop(name, None)
        records = [(day, r) for day, r in self.ledger.records_of(BUNDLE) if r.unit == name]
        is_current = [there is not None and r.signature == there.signature for _, r in records]
        best = max(range(len(records)), key=lambda n: (is_current[n], records[n][1].produced_at or _LONG_AGO))
        for n, (day, _) in enumerate(records):
            if n != best:
                self._forget(day, name, records[best][1])
        return records[best][1]

    def keep_former(self, unread: Iterable[str]) -> None:
        """Let references whose bundles could not be looked at set the zero as they did: only their scans' time has come."""
        self.kept |= {name: self.former[name] for name in unread if name in self.former}

    def record_bundle(self, kind: str, entry: Entry, verified: Verified | Exception, run_id: str) -> Record:
        """Put the verification of a bundle on record and take it into the state if it is usable.

        What was made from it before is given up if it is refused, or filed under another day now.
        """
        ok = isinstance(verified, Verified)
        header = verified.header_json if isinstance(verified, Verified | BundleRefused) else None
        day = CALIBRATION_DAY
        if kind == "scan":
            day = ScanHeader.model_validate_json(header).acquired_on.isoformat() if header else UNDATED
            before = self.ledger.bundle(entry.identifier)
            if before is not None and not header:
                day = before[0]
        record = Record(
            entry.identifier,
            entry.identifier,
            BUNDLE,
            "ok" if ok else "refused",
            None if ok else str(verified),
            verified.version if isinstance(verified, Verified) else reason_fingerprint(str(verified)),
            "1",
            "",
            (*sorted(verified.files.items()), (f"{kind}.json", verified.header_sha256))
            if isinstance(verified, Verified)
            else (),
            git_commit=git_commit(),
            run_id=run_id,
            produced_at=now(),
            packages=package_versions(),
            signature="" if isinstance(verified, ScanUnusable) and verified.may_pass else entry.signature,
            header=header,
        )
        if kind == "scan" and before is not None and before[0] != day:
            self._forget(before[0], entry.identifier, record)
        if not ok:
            self._forget(day, entry.identifier, record)
        self.ledger.day(day).put(record)
        if ok and kind == "calibration":
            assert header is not None
            self.calibrations[entry.identifier] = (CalibrationHeader.model_validate_json(header), entry, record)
        elif ok:
            self.scans[entry.identifier] = _unit(record, entry.folder)
        return record

    def _forget(self, day: str, unit: str, because: Record) -> None:
        """Move every current record of a unit on a day to the history."""
        ledger = self.ledger.day(day)
        for key in [k for k in ledger.current if k[0] == unit]:
            old = ledger.current.pop(key)
            if old.ok and key[1] != BUNDLE:
                ledger.history.append(
                    replace(old, superseded_at=because.produced_at, superseded_by=because.version, header=None)
                )
            ledger.dirty = True

    def arrange(self) -> None:
        """Sort the scans by day, and the references of each rig by time; call once all bundles are known."""
        self.references, self.by_day = {}, {}
        self.waiting = {n for n, unit in self.scans.items() if unit.scan.rig_id in self.inbox.unread_rigs}
        self.scans = {n: unit for n, unit in self.scans.items() if n not in self.waiting}
        for unit in self.scans.values():
            self.by_day.setdefault(unit.day, []).append(unit)
        for unit in sorted([*self.scans.values(), *self.kept.values()], key=_by_time):
            if unit.scan.purpose == "reference":
                self.references.setdefault(unit.scan.rig_id, []).append(unit)

    def stale_calibrations(self) -> list[tuple[str, str, tuple[tuple[str, str], ...]]]:
        """Calibrations to be made, as (calibration_id, fingerprint, inputs)."""
        stale: list[tuple[str, str, tuple[tuple[str, str], ...]]] = []
        for name, (header, _, bundle) in sorted(self.calibrations.items()):
            if header.rig_id in self.inbox.unread_rigs:
                continue
            rig, sha, _why = self.inbox.rigs.get(header.rig_id, (None, "missing", None))
            inputs = (("bundle", bundle.fingerprint), ("rig", sha if rig else "missing"))
            wanted = fingerprint(CALIBRATION, stage_config(self.config, CALIBRATION), inputs)
            record = self.ledger.day(CALIBRATION_DAY).get(name, CALIBRATION.name)
            if record is None or record.fingerprint != wanted:
                stale.append((name, wanted, inputs))
        return stale

    # --- units ---------------------------------------------------------------------------------------------------

    def days(self) -> list[str]:
        """Days with scans, so ordered that a day comes after those that hold its references."""
        wanted: dict[str, set[str]] = {}
        for unit in self.scans.values():
            wanted.setdefault(unit.day, set())
            found = self._likely_reference(unit)
            if found is not None and found.day != unit.day:
                wanted[unit.day].add(found.day)
        ordered: list[str] = []
        while wanted:
            ready = sorted(day for day, before in wanted.items() if not before & set(wanted)) or sorted(wanted)[:1]
            ordered += ready
            for day in ready:
                del wanted[day]
        return ordered

    def units(self, day: str) -> list[Unit]:
        """Units of a day: recalibrated references that its scans need, its references by time, then the others."""
        own = self.by_day.get(day, [])
        derived: dict[str, Unit] = {}
        for unit in own:
            found = self.candidate_reference(unit)
            if found is not None and found.calibration_id != unit.calibration_id:
                key = f"{found.key}@{unit.calibration_id}"
                if found.key in self.scans:
                    derived[key] = replace(found, key=key, calibration_id=unit.calibration_id, day=day)
        rank: Callable[[Unit], tuple] = lambda u: (u.scan.purpose != "reference", u.scan.captured_at, u.key)  # noqa: E731
        return sorted(derived.values(), key=rank) + sorted(own, key=rank)

    def candidate_reference(self, unit: Unit) -> Unit | None:
        """The reference that a scan names, or else the newest usable one of its rig that is not newer than the scan."""
        if unit.derived:
            return None
        candidates = self.references.get(unit.scan.rig_id, [])
        if unit.scan.purpose == "reference":  # strictly before it, or two that name each other would wait for ever
            candidates = [u for u in candidates if _by_time(u) < _by_time(unit)]
        if named := unit.scan.reference_scan_id:
            return next((u for u in candidates if u.key == named), None)
        for found in reversed(candidates):
            if found.scan.captured_at <= unit.scan.captured_at and self.usable_reference(found):
                return found
        return None

    def _likely_reference(self, unit: Unit) -> Unit | None:
        """The reference that a scan has if none before it is unusable: told without a look into any ledger."""
        candidates = self.references.get(unit.scan.rig_id, [])
        if named := unit.scan.reference_scan_id:
            return next((u for u in candidates if u.key == named), None)
        before = bisect_right(candidates, (unit.scan.captured_at, unit.key), key=_by_time)
        if before and candidates[before - 1].key == unit.key:
            before -= 1
        return candidates[before - 1] if before else None

    def usable_reference(self, unit: Unit) -> bool:
        """Whether nothing on record speaks against a reference: no stage of it has been refused or failed.

        One whose bundle is gone must have been measured before.
        """
        records = [self.ledger.day(unit.day).get(unit.key, s.name) for s in SCAN_STAGES]
        if unit.key in self.kept and None in records:
            return False
        return all(record is None or record.ok for record in records)

    def reference(self, unit: Unit) -> tuple[Reference, Unit | None, str | None]:
        """Reference for the measurement stage, its unit (under the scan's calibration), and details if there is none."""
        if unit.derived:
            return Reference(None, "not compared"), None, None
        found = self.candidate_reference(unit)
        if found is None or not self.usable_reference(found):
            if unit.scan.reference_scan_id:
                return (
                    Reference(None, NO_REFERENCE),
                    None,
                    f"the named reference {unit.scan.reference_scan_id} cannot be used",
                )
            reason = NO_EARLIER_REFERENCE if unit.scan.purpose == "reference" else NO_REFERENCE
            return Reference(None, reason), None, f"rig {unit.scan.rig_id} has no usable reference scan before this one"
        if found.calibration_id == unit.calibration_id:
            return Reference(found.scan), found, None
        key = f"{found.key}@{unit.calibration_id}"
        at = replace(found, key=key, calibration_id=unit.calibration_id, day=unit.day)
        if unit.scan.purpose == "reference" and (why := self._unusable(at)):
            return Reference(None, NO_EARLIER_REFERENCE), None, why  # it is the first one under its calibration
        return Reference(found.scan, recalibrated=True), at, None

    def _unusable(self, at: Unit) -> str | None:
        """Why a reference scan, under the calibration of the scan that needs it, cannot set a zero; None if it may."""
        records = [self.ledger.day(at.day).get(at.key, s.name) for s in SCAN_STAGES]
        if stopped := next((r for r in records if r is not None and not r.ok), None):
            return f"reference {at.key}: {stopped.reason}"
        if None in records and at.scan.scan_id in self.kept:
            return f"reference {at.key}: its bundle is no longer in the inbox"
        return None

    # --- needs ---------------------------------------------------------------------------------------------------

    def need(self, stage: Stage, unit: Unit) -> Need:
        """Inputs of a scan stage over a unit as things stand on record."""
        inputs: list[tuple[str, str]] = []
        ledger = self.ledger.day(unit.day)
        for name in stage.inputs:
            if name == "calibrations":
                record = self.ledger.day(CALIBRATION_DAY).get(unit.calibration_id, CALIBRATION.name)
                if record is None or not record.ok:
                    return Need(failed=self._calibration_reason(unit.calibration_id, record))
            else:
                record = ledger.get(unit.key, PRODUCER[name].name)
                if record is None or not record.ok:
                    return Need(blocked=PRODUCER[name].name)
            inputs.append((name, record.output(name).version))
        for name in stage.raw_inputs:
            if name == "stripes":
                inputs.append(("bundle", unit.bundle_version))
            elif name == "scan":
                inputs.append(("scan.json", unit.header_sha256))
            elif name == "frames":
                inputs.append(("frames.parquet", dict(unit.files)["frames.parquet"]))
            elif name == "nominal":
                inputs.append(("nominal profile", self._profile(unit.scan.wheelset.profile)))
        rig, sha, why = self.inbox.rigs.get(
            unit.scan.rig_id, (None, "", f"rig {unit.scan.rig_id} is not in the inbox (rigs/{unit.scan.rig_id}.json)")
        )
        if rig is None:
            return Need(failed=why)
        inputs.append(("rig", sha))
        if stage is MEASUREMENT:
            reference, at, details = self.reference(unit)
            if at is None and unit.scan.purpose == "production":
                return Need(failed=f"{reference.reason}\n{details}")
            inputs.append(("reference", reference.scan.scan_id if reference.scan else reference.reason or "none"))
            if at is not None:
                base = self.ledger.day(at.day)
                inputs.append(("reference scan.json", at.header_sha256))
                if why := self._unusable(at):
                    return Need(failed=f"{NO_REFERENCE}\n{why}")
                for name in MEASUREMENT.optional_inputs:
                    table = name.removeprefix("reference_")
                    record = base.get(at.key, PRODUCER[table].name)
                    if record is None:
                        return Need(blocked=f"reference {at.key}")
                    inputs.append((name, record.output(table).version))
        return Need(tuple(inputs))

    def _profile(self, name: str | None) -> str:
        """Version of a nominal profile, looked up once: every scan asks, and an answer may be two requests away."""
        if name not in self._profiles:
            self._profiles[name] = nominal.version(self.ledger.root, name)
        return self._profiles[name]

    def _calibration_reason(self, calibration_id: str, record: Record | None) -> str:
        bundle = self.ledger.day(CALIBRATION_DAY).get(calibration_id, BUNDLE)
        if record is not None and record.reason:
            return f"calibration {calibration_id}: {record.reason}"
        if bundle is not None and not bundle.ok:
            return f"calibration {calibration_id} was refused: {bundle.reason}"
        return f"calibration {calibration_id} is not in the inbox"

    def stale(self, stage: Stage, unit: Unit) -> tuple[Need, str | None]:
        """What a stage needs of a unit, and its fingerprint if that differs from the one on record."""
        need = self.need(stage, unit)
        if need.blocked or need.failed:
            return need, None
        if stage.name not in self._methods:
            self._methods[stage.name] = method(stage, stage_config(self.config, stage))
        wanted = fingerprint_of(self._methods[stage.name], need.inputs)
        record = self.ledger.day(unit.day).get(unit.key, stage.name)
        known = record is not None and record.fingerprint == wanted and not self._to_retry(record)
        return need, None if known else wanted

    def _to_retry(self, record: Record) -> bool:
        return not record.ok and self.retry_before not in (None, record.run_id)

    def stale_units(self, units: Iterable[Unit]) -> dict[str, list[Unit]]:
        """Units with work, filed under their first stale stage; what is downstream of it may follow or not."""
        found: dict[str, list[Unit]] = {}
        for unit in units:
            for stage in SCAN_STAGES:
                need, wanted = self.stale(stage, unit)
                record = self.ledger.day(unit.day).get(unit.key, stage.name)
                if need.blocked:
                    break
                if wanted is not None or (
                    need.failed and (record is None or record.fingerprint != reason_fingerprint(need.failed))
                ):
                    found.setdefault(stage.name, []).append(unit)
                    break
        return found

    def rig(self, unit: Unit) -> Rig | None:
        """The unit's rig, if it can be used."""
        return self.inbox.rigs.get(unit.scan.rig_id, (None, "", None))[0]
