"""Reports over many measurements: `python -m benchmarks.reports --rows 1000000 --scans 5000`.

Writes a warehouse of made-up measurements (as many scans as the rows need, over five months), with clouds of `--scans`
scans beside them, builds its catalog, and times what a reader waits for: the catalog opened and asked, every report
computed. The clouds' files are hard links to one another: a catalog knows paths, not contents.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from warehouse import catalog, report, store
from warehouse.lineage import Ledger, Output, Record
from wheelset_assets.quantities import QUANTITIES
from wheelset_assets.stages import SCAN_STAGES
from wheelset_assets.tables import MEASUREMENTS, TABLES

DAYS = 150
FIRST = date(2025, 4, 1)
SIZES_MM = {"wheel_diameter": 920.0, "journal_diameter": 130.0, "inner_distance": 1353.0, "shoulder_distance": 2180.0}
CLOUDS = ("triangulated_clouds", "filtered_clouds", "features")


def make(root: Path, rows: int, n_clouds: int, seed: int = 1) -> int:
    """The warehouse; returns how many scans it holds."""
    keys = [
        (q.name, side)
        for q in QUANTITIES
        for side in (("both",) if q.name.startswith(("inner", "shoulder_dist")) else ("left", "right"))
    ]
    a_day = max(1, round(rows / len(keys) / DAYS))
    rng, ledger = np.random.default_rng(seed), Ledger(root)
    links: dict[str, Path] = {}
    clouds = 0
    for k in range(DAYS):
        day = FIRST + timedelta(days=k)
        names = [f"scan-{k:03d}-{i:04d}" for i in range(a_day)]
        path, version, size = store.write_table(root, MEASUREMENTS, _day(names, keys, day, rng), day.isoformat(), None)
        for name in names:
            outputs = [Output("measurements", path, version, len(keys), size // a_day)]
            records = [_record(name, SCAN_STAGES[-1].name, outputs)]
            if clouds < n_clouds:
                clouds += 1
                for table in CLOUDS:
                    output = _linked(root, table, day.isoformat(), name, links)
                    stage = next(s for s in SCAN_STAGES if any(t.name == table for t in s.outputs))
                    records.append(_record(name, stage.name, [output]))
            for record in records:
                ledger.day(day.isoformat()).put(record)
        ledger.save(day.isoformat())
    catalog.build(root, ledger)
    return a_day * DAYS


def _day(names: list[str], keys: list[tuple[str, str]], day: date, rng: np.random.Generator) -> pa.Table:
    n, m = len(names), len(keys)
    wheelset = rng.integers(0, 400, n)
    warm = 20 + 6 * np.sin((day - FIRST).days / 48) + rng.normal(0, 1, n)
    sizes = np.array([SIZES_MM.get(q, 1.0) for q, _ in keys])
    value = sizes[None, :] + 0.1 * (wheelset[:, None] % 7) + 0.002 * rng.standard_normal((n, m))
    start = datetime(day.year, day.month, day.day, 6, tzinfo=UTC)
    moments = [start + timedelta(minutes=5 * i) for i in range(n)]
    columns: dict[str, Any] = {c.name: [None] * (n * m) for c in MEASUREMENTS.columns}
    columns |= {
        "scan_id": np.repeat(names, m).tolist(),
        "wheelset_id": np.repeat([f"WS-{w:03d}" for w in wheelset], m).tolist(),
        "rig_id": np.repeat([f"rig-{w % 3}" for w in wheelset], m).tolist(),
        "purpose": ["production"] * (n * m),
        "captured_at": [moment for moment in moments for _ in range(m)],
        "acquired_on": [day] * (n * m),
        "quantity": [q for q, _ in keys] * n,
        "side": [s for _, s in keys] * n,
        "value": value.ravel(),
        "unit": ["mm"] * (n * m),
        "expanded_uncertainty": np.full(n * m, 0.005),
        "coverage_factor": np.full(n * m, 2.0),
        "value_uncompensated": (value - 0.005 * (warm[:, None] - 20)).ravel(),
        "quality_flags": [[]] * (n * m),
        "calibration_id": ["cal-1"] * (n * m),
        "reference_scan_id": ["ref-1"] * (n * m),
        "wheelset_temperature_c": np.repeat(warm, m),
        "rig_temperature_c": np.repeat(warm + 0.3, m),
        "wheelset_type": ["CRH3"] * (n * m),
    }
    return MEASUREMENTS.from_columns(columns)


def _record(name: str, stage: str, outputs: list[Output]) -> Record:
    return Record(name, name, stage, "ok", None, "f" * 16, "1", "c" * 16, (), tuple(outputs))


def _linked(root: Path, table: str, day: str, name: str, links: dict[str, Path]) -> Output:
    if table not in links:
        path, _, _ = store.write_table(root, TABLES[table], TABLES[table].empty(), day, name)
        links[table] = root / path
    place = store.folder(root, TABLES[table], day, name)
    place.mkdir(parents=True, exist_ok=True)
    target = place / links[table].name
    if not target.exists():
        os.link(links[table], target)
    return Output(table, target.relative_to(root).as_posix(), target.stem, 0, target.stat().st_size)


def main() -> int:
    """The command."""
    import duckdb

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--scans", type=int, default=5000, help="scans with clouds")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="wheelset-reports-") as name:
        root = Path(name)
        scans = make(root, options.rows, options.scans)
        found: dict[str, Any] = {"scans": scans, "clouds": options.scans, "seconds": {}}

        def timed(what: str, work: Any) -> Any:
            seconds = []
            for _ in range(options.repeats):
                started = time.perf_counter()
                result = work()
                seconds.append(time.perf_counter() - started)
            found["seconds"][what] = sorted(seconds)[len(seconds) // 2]
            return result

        def opened() -> int:
            with duckdb.connect(str(root / catalog.NAME), read_only=True) as connection:
                return len(connection.execute("SELECT view_name FROM duckdb_views() WHERE NOT internal").fetchall())

        def counted(view: str) -> Any:
            with duckdb.connect(str(root / catalog.NAME), read_only=True) as connection:
                return connection.execute(f"SELECT count(*) FROM {view}").fetchone()

        found["views"] = timed("catalog opened, views listed", opened)
        found["rows"] = timed("count(*) of measurements", lambda: counted("measurements"))[0]
        timed("count(*) of triangulated_clouds", lambda: counted("triangulated_clouds"))
        timed("catalog built anew", lambda: catalog.build(root, Ledger(root)))
        with catalog.connect(root) as connection:
            for kind in ("stability", "accuracy", "msa", "fleet"):
                timed(f"report {kind}", lambda kind=kind: report.build(connection, kind))
    if options.json:
        print(json.dumps(found, indent=1))
        return 0
    print(f"{found['rows']:,} measurements of {scans:,} scans; clouds of {options.scans:,}; {found['views']} views")
    for what, seconds in found["seconds"].items():
        print(f"{what:<32} {seconds:6.2f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
