"""Retention: which superseded versions, stray files and recordings may go, and their removal.

A superseded version goes when it is older than `keep_days` and `keep_versions` newer ones of the same stage and unit have
been superseded after it. Current files are never touched. The ledger forgets first, then the catalog, then the files go:
a removal that is cut short leaves files that nobody names, and the next one takes them.
"""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from warehouse import catalog, store
from warehouse.lineage import DayLedger, Ledger, Record
from warehouse.lock import WarehouseLock
from warehouse.place import is_remote
from wheelset_assets.quality import ConfigError
from wheelset_assets.tables import MEASUREMENTS, TABLES


@dataclass(frozen=True)
class Retention:
    """What is kept: everything superseded within `keep_days`, and at least `keep_versions` superseded versions of each."""

    keep_days: float = 90.0
    keep_versions: int = 1

    def __post_init__(self) -> None:
        for name in ("keep_days", "keep_versions"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ConfigError(f"--{name.replace('_', '-')}: expected a number of at least 0")

    def outdated(self, ledger: DayLedger, now: datetime) -> list[Record]:
        """Superseded records of a day that need not be kept."""
        found = []
        versions: dict[tuple[str, str], list[Record]] = defaultdict(list)
        for record in ledger.history:
            versions[record.unit, record.stage].append(record)
        for records in versions.values():
            newest_first = sorted(records, key=lambda r: r.superseded_at or now, reverse=True)
            for record in newest_first[self.keep_versions :]:
                if now - (record.superseded_at or now) > timedelta(days=self.keep_days):
                    found.append(record)
        return found


@dataclass
class Collected:
    """What may go, or went: versions off the record, and files with their bytes by kind."""

    deleted: bool = False
    versions: int = 0
    files: int = 0
    bytes: int = 0
    by_table: dict[str, dict[str, int]] = field(default_factory=dict)
    paths: list[str] = field(default_factory=list)
    runs: int = 0
    """Runs in the orchestrator's own store."""

    def add(self, kind: str, path: Path, root: Path) -> None:
        """Count a file."""
        size = path.stat().st_size
        entry = self.by_table.setdefault(kind, {"files": 0, "bytes": 0})
        entry["files"] += 1
        entry["bytes"] += size
        self.files += 1
        self.bytes += size
        self.paths.append(path.relative_to(root).as_posix())

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        return asdict(self)


def collect(root: Path, retention: Retention, delete: bool, now: datetime | None = None) -> Collected:
    """Find what the rule lets go and, if asked, remove it; holds the warehouse's lock, so that no run writes meanwhile."""
    lock = WarehouseLock(root)
    lock.acquire(2.0)
    try:
        ledger = Ledger(root)
        found = Collected(deleted=delete)
        named: set[str] = set()
        for day in ledger.all_days():
            records = ledger.day(day)
            outdated_records = retention.outdated(records, now or datetime.now(UTC))
            outdated = {id(record) for record in outdated_records}
            records.history = [record for record in records.history if id(record) not in outdated]
            records.dirty = bool(outdated)
            found.versions += len(outdated)
            for record in records.records():
                named |= {o.path for o in record.outputs if o.path} | (
                    {record.recording} if record.recording else set()
                )
            if delete:
                _mark(root, outdated_records)
                ledger.save(day)
        going = _unnamed(root, named)
        for kind, path in going:
            found.add(kind, path, root)
        if delete:
            if going:  # also what a run that was killed left named by the catalog alone
                catalog.build(root, ledger)
            for _, path in going:
                path.unlink(missing_ok=True)
            _remove_empty_folders(root)
        return found
    finally:
        lock.release()


def _mark(root: Path, outdated: list[Record]) -> None:
    """Remember how far back the measurements no longer reach, before the ledger forgets them."""
    moments = [r.superseded_at for r in outdated if r.stage == MEASUREMENTS.name and r.superseded_at]
    if moments and (latest := max(moments)) > (catalog.collected_until(root) or latest - timedelta(1)):
        store.write_bytes(root / catalog.COLLECTED, json.dumps({"until": latest.isoformat()}).encode())


def _unnamed(root: Path, named: set[str]) -> list[tuple[str, Path]]:
    """Data files and recordings that no record names, each with its table or `recordings`."""
    found = [(name, path) for name in TABLES for path in sorted((root / name).rglob("*.parquet"))]
    found += [("recordings", path) for path in sorted((root / "recordings").glob("*.rrd"))]
    return [(kind, path) for kind, path in found if path.relative_to(root).as_posix() not in named]


def _remove_empty_folders(root: Path) -> None:
    if is_remote(root):
        return  # object storage has none
    for name in TABLES:
        for folder in sorted((p for p in (root / name).rglob("*") if p.is_dir()), reverse=True):
            if not any(folder.iterdir()):
                folder.rmdir()
