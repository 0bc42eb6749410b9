"""Integrity: every visible file against the version that names it, every row of the light tables against the receipt that
accounts for it, the catalog, and, if asked, the inbox's files against the ledger.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from warehouse import catalog, store
from warehouse.audit import key_is_unique
from warehouse.inbox import Inbox
from warehouse.light import LIGHT, rows_by_unit
from warehouse.lineage import BUNDLE, CALIBRATION_DAY, DayLedger, Ledger, Output
from warehouse.store import VERSION_DIGITS, files_of, sha256_file
from wheelset_assets.declare import Table
from wheelset_assets.quality import ConfigError, ScanUnusable
from wheelset_assets.tables import ALL_TABLES, MEASUREMENTS, TABLES


def verify(root: Path, inbox: Path | None) -> dict[str, Any]:
    """Counts and the list of what is broken: files missing, files that do not hash to their name, changed bundles."""
    ledger = Ledger(root)
    named: set[str] = set()
    for day in ledger.all_days():
        for record in ledger.day(day).records():
            named |= {o.path for o in record.outputs if o.path}
    broken = []
    for path in sorted(named):
        file = root / path
        if not file.exists():
            broken.append(f"{path}: missing")
        elif sha256_file(file)[:VERSION_DIGITS] != file.stem:
            broken.append(f"{path}: its bytes do not hash to its name")
    for day in ledger.days():
        broken += _unaccounted_rows(root, ledger.day(day), set(broken))
    broken += _filed_twice(ledger)
    broken += _broken_views(root)
    present = {path for table in TABLES.values() for path in files_of(root, table)}
    if inbox is not None:
        broken += _changed_bundles(ledger, Inbox(inbox))
    return {"files": len(named), "broken": broken, "unnamed": len(present - named)}


def _unaccounted_rows(root: Path, ledger: DayLedger, known: set[str]) -> list[str]:
    """What is wrong with the rows of a day's light tables: rows without a receipt, receipts without rows, other rows than
    the receipt's, doubled keys, or receipts of one table that name several files.
    """
    receipts: dict[str, dict[str, Output]] = {}
    for (unit, _), record in ledger.current.items():
        for output in record.outputs if record.ok else ():
            if output.table in LIGHT and not (output.table == MEASUREMENTS.name and "@" in unit):
                receipts.setdefault(output.table, {})[unit] = output
    found = []
    for name, outputs in sorted(receipts.items()):
        where = f"{name} of {ledger.day}"
        paths = sorted({o.path for o in outputs.values()})
        if len(paths) > 1:
            found.append(f"{where}: its receipts name several files: {', '.join(paths)}")
        elif not any(wrong.startswith(f"{paths[0]}: ") for wrong in known):
            data = store.read_table(root, paths[0])
            found += [f"{where}: {wrong}" for wrong in _wrong_rows(LIGHT[name], data, outputs)]
    return found


def _wrong_rows(table: Table, data: pa.Table, outputs: dict[str, Output]) -> list[str]:
    found = []
    if data.num_rows and not key_is_unique(table, data):
        found.append(f"a key ({', '.join(table.key)}) occurs more than once")
    rows = rows_by_unit(data)
    for unit in sorted(set(rows) - set(outputs)):
        found.append(f"{rows[unit].num_rows} rows of {unit}, which no record accounts for")
    for unit, output in sorted(outputs.items()):
        there = rows.get(unit, table.empty())
        if there.num_rows != output.rows:
            found.append(f"{there.num_rows} rows of {unit}, {output.rows} on record")
        elif there.num_rows and store.table_hash(there) != output.version:
            found.append(f"rows of {unit} are not those on record")
    return found


def _filed_twice(ledger: Ledger) -> list[str]:
    """Scans that are on record under several days: a run that filed one anew was killed in between; the next run mends it."""
    days: dict[str, list[str]] = {}
    for day, record in ledger.records_of(BUNDLE):
        days.setdefault(record.unit, []).append(day)
    return [
        f"scan {name}: on record under {' and '.join(found)}" for name, found in sorted(days.items()) if len(found) > 1
    ]


def _broken_views(root: Path) -> list[str]:
    """Views of the catalog that cannot be read. An older catalog than the ledger is no fault: a run was cut short."""
    import duckdb

    if not (root / catalog.NAME).exists():
        return []
    try:
        connection = catalog.connect(root)  # after a move it is built again, as by any other command
    except (duckdb.Error, ConfigError) as error:
        return [f"{catalog.NAME}: cannot be opened: {str(error).splitlines()[0]}"]
    found = []
    with connection:
        for name in [table.name for table in (*ALL_TABLES, *catalog.DERIVED)]:
            try:
                connection.execute(f"SELECT * FROM {name} LIMIT 1").fetchall()
            except duckdb.Error as error:
                found.append(f"{catalog.NAME}: view {name}: {str(error).splitlines()[0]}")
    return found


def _changed_bundles(ledger: Ledger, inbox: Inbox) -> list[str]:
    """Bundles that were processed and are no longer what they were; those that have left the inbox are not missed."""
    calibrations = ledger.day(CALIBRATION_DAY)
    known = [("calibrations", entry, calibrations.get(entry.identifier, BUNDLE)) for entry in inbox.calibrations()]
    for entry in inbox.scans():
        seen = ledger.bundle(entry.identifier)
        known.append(("scans", entry, seen[1] if seen else None))
    found = []
    for kind, entry, record in known:
        if record is None or not record.ok:
            continue
        try:
            verify_one = inbox.verify_scan if kind == "scans" else inbox.verify_calibration
            if verify_one(entry).version != record.fingerprint:
                found.append(f"{kind}/{entry.identifier}: its files changed since they were processed")
        except ScanUnusable as error:
            found.append(str(error))
        except OSError as error:
            found.append(f"{kind}/{entry.identifier}: cannot be read: {error.strerror}")
    return found
