"""The ledger: what was made from what, by which code, and what became of every scan. One Parquet file a day, atomically
replaced; receipts inside, versions of the data outside the data files.

A record is one stage over one unit. Units are scans, calibrations and the fleet; a reference scan that is needed under
another calibration is a unit of its own, `<scan_id>@<calibration_id>`, which no view shows.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from warehouse import ledger_rows, place
from warehouse.events import event
from warehouse.store import publish
from wheelset_assets.quality import WheelsetError

CALIBRATION_DAY = "calibrations"
FLEET_DAY = "fleet"
UNDATED = "undated"
"""Where bundles rest whose day cannot be read."""
BUNDLE = "bundle"
"""Stage name of a bundle's verification: the root of every scan's lineage."""


@dataclass(frozen=True, slots=True)
class Output:
    """One table that a stage wrote for a unit: where it rests, its version, rows and bytes."""

    table: str
    path: str
    version: str
    rows: int
    bytes: int


@dataclass(frozen=True, slots=True)
class Record:
    """One stage over one unit, done, refused or failed."""

    unit: str
    scan_id: str
    stage: str
    state: str
    reason: str | None
    fingerprint: str
    code_version: str
    config_fingerprint: str
    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[Output, ...] = ()
    git_commit: str | None = None
    run_id: str = ""
    produced_at: datetime | None = None
    seconds: float = 0.0
    points: int = 0
    packages: str = ""
    superseded_at: datetime | None = None
    superseded_by: str | None = None
    signature: str = ""
    header: str | None = None
    recording: str | None = None
    compute_seconds: float | None = None
    """Of `seconds`, those in the stage's own function; None in records of older programs."""
    valid_from: datetime | None = None
    """When these data became current, if that was before they were produced again with the same result."""

    @property
    def ok(self) -> bool:
        """Whether the stage made its outputs."""
        return self.state == "ok"

    @property
    def since(self) -> datetime | None:
        """When its data became current."""
        return self.valid_from or self.produced_at

    @property
    def version(self) -> str:
        """Version of all outputs together."""
        return "+".join(o.version for o in self.outputs) if self.outputs else self.fingerprint

    def output(self, table: str) -> Output:
        """The output of this table; KeyError if there is none."""
        for output in self.outputs:
            if output.table == table:
                return output
        raise KeyError(f"{self.stage} of {self.unit} wrote no {table}")


@dataclass
class DayLedger:
    """Records of one day: the current one of every (unit, stage), and those that they superseded."""

    day: str
    current: dict[tuple[str, str], Record] = field(default_factory=dict)
    history: list[Record] = field(default_factory=list)
    dirty: bool = False

    def get(self, unit: str, stage: str) -> Record | None:
        """Current record of a stage over a unit."""
        return self.current.get((unit, stage))

    def put(self, record: Record) -> None:
        """Make a record current; the one that it replaces goes to the history unless its data are the same."""
        key = (record.unit, record.stage)
        old = self.current.get(key)
        if old is not None and old.ok and (old.version != record.version or not record.ok):
            self.history.append(
                replace(old, superseded_at=record.produced_at, superseded_by=record.version, header=None)
            )
        elif old is not None and old.ok:
            record = replace(record, valid_from=old.since)
        self.current[key] = record
        self.dirty = True
        event(
            "stage",
            run_id=record.run_id,
            day=self.day,
            scan_id=record.scan_id,
            unit=record.unit,
            stage=record.stage,
            state=record.state,
            reason=record.reason,
            seconds=round(record.seconds, 4),
            points=record.points or None,
        )

    def records(self) -> list[Record]:
        """All records, current ones first, in a fixed order."""
        return [self.current[key] for key in sorted(self.current)] + self.history


class Ledger:
    """All days of a warehouse; days are read when they are asked for."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folder = root / "_ledger"
        self._days: dict[str, DayLedger] = {}
        self._etags: dict[str, str | None] = {}
        self._bundle_days: dict[str, str] | None = None

    def days(self) -> list[str]:
        """Acquisition days with a ledger; calibrations, fleet and undated bundles are left out."""
        names = {p.stem.removeprefix("day=") for p in self.folder.glob("day=*.parquet")} | set(self._days)
        return sorted(names - {CALIBRATION_DAY, FLEET_DAY, UNDATED})

    def all_days(self) -> list[str]:
        """Every day file: calibrations first, acquisition days, undated bundles, fleet."""
        return [CALIBRATION_DAY, *self.days(), UNDATED, FLEET_DAY]

    def tables(self) -> Iterator[tuple[str, pa.Table]]:
        """Every day with its records as rows, one day after the other: nothing of it stays in memory."""
        for day in self.all_days():
            loaded = self._days.get(day)
            table = _to_table(loaded) if loaded is not None else self._read(self.folder / f"day={day}.parquet")
            if table is not None and table.num_rows:
                yield day, table

    def records_of(self, stage: str) -> Iterator[tuple[str, Record]]:
        """Day and current record of a stage over all scans. Of days that are not in memory, nothing else is read."""
        for day in [*self.days(), UNDATED]:
            loaded = self._days.get(day)
            found = loaded.current.values() if loaded is not None else self._read_stage(day, stage)
            for record in [r for r in found if r.stage == stage]:
                yield day, record

    def _read_stage(self, day: str, stage: str) -> Iterator[Record]:
        path = self.folder / f"day={day}.parquet"
        table = self._read(path, stage)
        if table is not None:
            yield from (r for r in ledger_rows.from_table(table, Record, Output) if r.superseded_at is None)

    def bundle(self, scan_id: str) -> tuple[str, Record] | None:
        """Day and record of a scan bundle's verification, if it was ever verified."""
        for day, ledger in self._days.items():
            record = ledger.get(scan_id, BUNDLE)
            if record is not None and day not in (CALIBRATION_DAY, FLEET_DAY):
                return day, record
        if self._bundle_days is None:
            self._bundle_days = {record.unit: day for day, record in self.records_of(BUNDLE)}
        found = self._bundle_days.get(scan_id)
        last = self.day(found).get(scan_id, BUNDLE) if found is not None else None
        return (found, last) if found is not None and last is not None else None

    def dirty_days(self) -> list[str]:
        """Acquisition days whose records changed since they were saved."""
        return sorted(d for d in set(self._days) - {CALIBRATION_DAY, FLEET_DAY, UNDATED} if self._days[d].dirty)

    def release(self) -> None:
        """Let go of the days that are saved: memory must not grow with the number of days that a run has looked at."""
        for day in [
            d for d, ledger in self._days.items() if not ledger.dirty and d not in (CALIBRATION_DAY, FLEET_DAY)
        ]:
            gone = self._days.pop(day)
            if self._bundle_days is not None:
                self._bundle_days |= {unit: day for unit, stage in gone.current if stage == BUNDLE}

    def day(self, day: str) -> DayLedger:
        """Ledger of a day, empty if it has none."""
        if day not in self._days:
            table = self._read(self.folder / f"day={day}.parquet")
            self._days[day] = DayLedger(day) if table is None else _from_table(day, table)
        return self._days[day]

    def save(self, day: str) -> None:
        """Write a day's ledger if it changed: from here on its outputs are visible."""
        ledger = self.day(day)
        if not ledger.dirty:
            return
        self._write(self.folder / f"day={day}.parquet", _to_table(ledger))
        ledger.dirty = False

    def _read(self, path: Path, stage: str | None = None) -> pa.Table | None:
        """A day's file, or its rows of a stage; None if there is none. Whoever reads a ledger's file reads it here."""
        source: Any = path
        if place.is_remote(path):
            data, self._etags[path.name] = place.get(path)
            source = None if data is None else pa.BufferReader(data)
        elif not path.exists():
            source = None
        if source is None:
            return None
        with pq.ParquetFile(source) as file:
            table = file.read()
        return table if stage is None else table.filter(pc.equal(table["stage"], stage))

    def _write(self, path: Path, table: pa.Table) -> None:
        """Replace a day's file. In object storage only if it is the one that was read: a run that lost its lock stops."""
        if place.is_remote(path):
            sink = pa.BufferOutputStream()
            pq.write_table(table, sink, compression="zstd")
            try:
                self._etags[path.name] = place.put(path, sink.getvalue().to_pybytes(), self._etags[path.name])
            except place.Changed as error:
                raise WheelsetError(
                    f"{path}: another run wrote it since this one read it, so this one's lock has lapsed; run again"
                ) from error
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".tmp-{path.name.removeprefix('day=')}")
        pq.write_table(table, temporary, compression="zstd")
        publish(temporary, path)

    def fingerprint(self) -> str:
        """Changes when any day's file is written."""
        if place.is_remote(self.folder):
            lines = [f"{name} {facts['ETag']}" for name, facts in sorted(place.objects(self.folder).items())]
        else:
            status = [(path.name, path.stat()) for path in sorted(self.folder.glob("day=*.parquet"))]
            lines = [f"{name} {s.st_size} {s.st_mtime_ns}" for name, s in status]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]

    def files(self) -> list[str]:
        """Paths of the saved ledger files."""
        return sorted(p.as_posix() for p in self.folder.glob("day=*.parquet"))


def _to_table(ledger: DayLedger) -> pa.Table:
    return ledger_rows.to_table(ledger.records())


def _from_table(day: str, table: pa.Table) -> DayLedger:
    ledger = DayLedger(day)
    for record in ledger_rows.from_table(table, Record, Output):
        if record.superseded_at is None:
            ledger.current[record.unit, record.stage] = record
        else:
            ledger.history.append(record)
    return ledger


@cache
def git_commit() -> str | None:
    """Commit of the source tree, with `+` if it has local changes; outside a checkout WHEELSET_COMMIT, or None."""
    if given := os.environ.get("WHEELSET_COMMIT"):
        return given
    here = Path(__file__).resolve().parent
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, timeout=10, check=True
        ).stdout.strip()
        changed = subprocess.run(
            ["git", "status", "--porcelain", "-uno"], cwd=here, capture_output=True, text=True, timeout=10, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
    return commit + ("+" if changed else "")


@cache
def package_versions() -> str:
    """Versions of the packages that numbers depend on, in one line."""
    found = []
    for name in (
        "wheelset",
        "numpy",
        "scipy",
        "opencv-python-headless",
        "open3d-cpu",
        "open3d",
        "pyarrow",
        "duckdb",
        "dagster",
    ):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def now() -> datetime:
    """The time for receipts; data files never carry it."""
    return datetime.now(UTC)


def as_json(record: Record) -> dict[str, Any]:
    """A record for people and scripts."""
    return {k: v for k, v in asdict(record).items() if k not in ("header", "signature")} | {
        "inputs": dict(record.inputs)
    }
