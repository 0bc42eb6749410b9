"""`python -m benchmarks.catalog_scale WAREHOUSE`: what the catalog costs as scans become many.

Takes one measured scan of a small warehouse, puts it on record over and over (files linked, not copied) in days of
`--scans-a-day`, and builds the catalog over all of them.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path
from typing import Any

from warehouse.lineage import BUNDLE, CALIBRATION_DAY, Ledger, Record
from wheelset_assets.stages import SCAN_STAGES


def source(root: Path) -> tuple[str, list[Record]]:
    """Day and records of a scan that was measured."""
    ledger = Ledger(root)
    for day in ledger.days():
        current = ledger.day(day).current
        for unit, stage in current:
            if stage == SCAN_STAGES[-1].name and current[unit, stage].ok and "ref" not in unit:
                return day, [current[unit, name] for name in (BUNDLE, *(s.name for s in SCAN_STAGES))]
    raise SystemExit(f"{root}: no measured scan there")


def copies(root: Path, day: str, records: list[Record], target: Path, n_days: int, scans_a_day: int) -> None:
    """Put the scan on record n_days x scans_a_day times."""
    ledger = Ledger(target)
    for number in range(n_days):
        new_day = (date(2025, 1, 1) + timedelta(days=number)).isoformat()
        for n in range(scans_a_day):
            unit = f"S-{number:03d}-{n:05d}"
            for record in records:
                outputs = []
                for output in record.outputs:
                    path = output.path.replace(f"day={day}", f"day={new_day}").replace(
                        f"scan_id={record.unit}", f"scan_id={unit}"
                    )
                    if output.path and not (target / path).exists():
                        (target / path).parent.mkdir(parents=True, exist_ok=True)
                        os.link(root / output.path, target / path)
                    outputs.append(replace(output, path=path))
                ledger.day(new_day).put(replace(record, unit=unit, scan_id=unit, outputs=tuple(outputs)))
        ledger.save(new_day)
    calibrations = Ledger(root).day(CALIBRATION_DAY)
    for record in calibrations.current.values():
        for output in record.outputs:
            if output.path and not (target / output.path).exists():
                (target / output.path).parent.mkdir(parents=True, exist_ok=True)
                os.link(root / output.path, target / output.path)
        ledger.day(CALIBRATION_DAY).put(record)
    ledger.save(CALIBRATION_DAY)


def measure(root: Path, n_days: int, scans_a_day: int) -> dict[str, Any]:
    """Seconds and bytes of ledger and catalog."""
    from warehouse import catalog

    day, records = source(root)
    with tempfile.TemporaryDirectory(dir=root.parent) as temporary:  # links stay within a disk
        target = Path(temporary)
        copies(root, day, records, target, n_days, scans_a_day)
        started = time.perf_counter()
        ledger = Ledger(target)
        for name in ledger.days():
            ledger.day(name)
        read = time.perf_counter() - started
        started = time.perf_counter()
        catalog.build(target, ledger, [])
        built = time.perf_counter() - started
        connection = catalog.connect(target)
        started = time.perf_counter()
        connection.execute("SELECT quantity, side, avg(value) FROM measurements GROUP BY ALL").fetchall()
        asked = time.perf_counter() - started
        connection.close()
        return {
            "scans": n_days * scans_a_day,
            "days": n_days,
            "ledger_bytes": sum(p.stat().st_size for p in ledger.folder.iterdir()),
            "catalog_bytes": (target / catalog.NAME).stat().st_size,
            "read_ledgers_seconds": round(read, 2),
            "build_catalog_seconds": round(built, 2),
            "average_of_measurements_seconds": round(asked, 3),
        }


def main() -> None:
    """Measure sizes one after another and print one JSON document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("warehouse", type=Path, help="A warehouse with at least one measured scan")
    parser.add_argument("--scans-a-day", type=int, default=200)
    parser.add_argument("--days", type=int, nargs="+", default=[1, 5, 25])
    options = parser.parse_args()
    root = options.warehouse.resolve()
    print(json.dumps([measure(root, n, options.scans_a_day) for n in options.days], indent=1))


if __name__ == "__main__":
    main()
