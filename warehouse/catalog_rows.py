"""Rows of the catalog's own tables from the ledger, a day at a time and column by column.

A fleet's ledger as Python objects would take a hundred times its files, so no more than a day of it is ever looked at,
and what is kept of it are Arrow columns. Nothing is written here.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from warehouse import reviews
from warehouse.catalog_tables import LINEAGE, REFERENCE_VALUES, SCAN_STATUS, SINCE, STAGE_RUNS
from warehouse.ledger_rows import RECORD
from warehouse.lineage import BUNDLE, CALIBRATION_DAY, FLEET_DAY, Ledger
from wheelset_assets.bundle import ScanHeader
from wheelset_assets.declare import Table
from wheelset_assets.stages import SCAN_STAGES
from wheelset_assets.tables import ALL_TABLES, MEASUREMENTS

LINEAGE_RECORDS = 500
"""Records that are spread out into their inputs and outputs at once: each makes two dozen wide rows."""
SUPERSEDED = pa.schema(
    [
        ("path", pa.string()),
        ("scan_id", pa.string()),
        ("output_version", pa.string()),
        ("since", SINCE),
        ("superseded_at", SINCE),
        ("superseded_by", pa.string()),
        ("code_version", pa.string()),
        ("config_fingerprint", pa.string()),
    ]
)
CURRENT_SINCE = pa.schema([("scan_id", pa.string()), ("since", SINCE)])


@dataclass
class CatalogRows:
    """What the catalog holds of a ledger."""

    files: dict[str, list[str]] = field(default_factory=dict)
    """Current files of each table, relative to the warehouse."""
    superseded: pa.Table = field(default_factory=SUPERSEDED.empty_table)
    """Versions of scans' measurements that are no longer current."""
    current_since: pa.Table = field(default_factory=CURRENT_SINCE.empty_table)
    derived: dict[str, bytes] = field(default_factory=dict)
    """`scan_status`, `reference_values`, `lineage` and `stage_runs` as Parquet files: packed, they take little."""


def gather(root: Path, ledger: Ledger) -> CatalogRows:
    """Go through the ledger once."""
    files: dict[str, list[pa.Array]] = defaultdict(list)
    superseded, since, status = [SUPERSEDED.empty_table()], [CURRENT_SINCE.empty_table()], [SCAN_STATUS.empty()]
    with _Packed(REFERENCE_VALUES) as references, _Packed(LINEAGE) as lineage, _Packed(STAGE_RUNS) as runs:
        references.add(REFERENCE_VALUES.from_rows(reviews.stored_reviews(root)))
        for day, found in ledger.tables():
            records = _complete(found)
            current = records.filter(pc.is_null(records["superseded_at"]))
            for table, paths in _files(current).items():
                files[table].append(paths)
            superseded.append(_superseded(records))
            since.append(_since(current))
            for start in range(0, records.num_rows, LINEAGE_RECORDS):
                lineage.add(_lineage(records.slice(start, LINEAGE_RECORDS)))
            runs.add(_stage_runs(day, records))
            if day not in (CALIBRATION_DAY, FLEET_DAY):
                scans = current.select(
                    ["unit", "stage", "state", "reason", "header", "recording", "points"]
                ).to_pylist()
                status.append(SCAN_STATUS.from_rows(_status(root, scans)))
                references.add(REFERENCE_VALUES.from_rows(_certificates(scans)))
    with _Packed(SCAN_STATUS) as states:
        states.add(pa.concat_tables(status).sort_by("scan_id"))
    return CatalogRows(
        {name: sorted(set(pa.chunked_array(found).to_pylist())) for name, found in files.items()},
        pa.concat_tables(superseded),
        pa.concat_tables(since),
        {one.table.name: one.data for one in (states, references, lineage, runs)},
    )


class _Packed:
    """A table that is written part by part into a Parquet file in memory."""

    def __init__(self, table: Table) -> None:
        self.table = table
        self.data = b""
        self._sink = pa.BufferOutputStream()

    def __enter__(self) -> _Packed:
        self._writer = pq.ParquetWriter(self._sink, self.table.schema, compression="zstd")
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()
        self.data = self._sink.getvalue().to_pybytes()

    def add(self, rows: pa.Table) -> None:
        """Rows in the table's own schema."""
        if rows.num_rows:
            self._writer.write_table(rows)


def _complete(records: pa.Table) -> pa.Table:
    """With the columns that an older program did not write, as nulls."""
    columns = [
        records[f.name].cast(f.type) if f.name in records.column_names else pa.nulls(records.num_rows, f.type)
        for f in RECORD
    ]
    return pa.Table.from_arrays(columns, schema=RECORD).combine_chunks()


def _is_scan(records: pa.Table) -> pa.ChunkedArray:
    """Not a reference scan that was triangulated again with another calibration."""
    return pc.invert(pc.match_substring(records["unit"], "@"))


def _lists(records: pa.Table, name: str) -> tuple[np.ndarray, np.ndarray, pa.StructArray]:
    """Lengths (rows,), first places (rows,), and the joined items of a column of lists."""
    column = records[name].combine_chunks()
    column = column if isinstance(column, pa.Array) else pa.array([], RECORD.field(name).type)
    length = np.asarray(pc.fill_null(column.value_lengths(), 0), np.int64)
    return length, np.concatenate([[0], np.cumsum(length)[:-1]]).astype(np.int64), column.flatten()


def _outputs(records: pa.Table) -> tuple[pa.Array, pa.StructArray]:
    """Each output of the records, and the row of its record."""
    length, _, flat = _lists(records, "outputs")
    return pa.array(np.repeat(np.arange(records.num_rows), length)), flat


def _files(current: pa.Table) -> dict[str, pa.Array]:
    good = current.filter(pc.equal(current["state"], "ok"))
    row, outputs = _outputs(good)
    derived = pc.match_substring(good["unit"].take(row), "@").combine_chunks()
    found = {}
    for table in ALL_TABLES:
        mine = pc.and_(pc.equal(outputs.field("table"), table.name), pc.not_equal(outputs.field("path"), ""))
        if table.layout == "scan":
            mine = pc.and_not(mine, derived)
        paths = pc.unique(outputs.field("path").filter(mine)).drop_null()
        if len(paths):
            found[table.name] = paths
    return found


def _superseded(records: pa.Table) -> pa.Table:
    old = records.filter(pc.and_(pc.is_valid(records["superseded_at"]), _is_scan(records)))
    row, outputs = _outputs(old)
    mine = pc.equal(outputs.field("table"), MEASUREMENTS.name)
    mine = pc.and_(mine, pc.not_equal(pc.fill_null(outputs.field("path"), ""), ""))
    old, outputs = old.take(row.filter(mine)), outputs.filter(mine)
    return pa.Table.from_arrays(
        [
            outputs.field("path"),
            old["unit"],
            outputs.field("version"),
            pc.coalesce(old["valid_from"], old["produced_at"]),
            *(old[name] for name in ("superseded_at", "superseded_by", "code_version", "config_fingerprint")),
        ],
        schema=SUPERSEDED,
    )


def _since(current: pa.Table) -> pa.Table:
    mine = pc.and_(pc.equal(current["stage"], MEASUREMENTS.name), pc.equal(current["state"], "ok"))
    found = current.filter(pc.and_(mine, _is_scan(current)))
    return pa.Table.from_arrays(
        [found["unit"], pc.coalesce(found["valid_from"], found["produced_at"])], schema=CURRENT_SINCE
    )


def _lineage(records: pa.Table) -> pa.Table:
    """One row for each output and each of its inputs; a record without outputs stands for one of its stage's name."""
    good = records.filter(pc.equal(records["state"], "ok"))
    n_out, first_out, outputs = _lists(good, "outputs")
    n_in, first_in, inputs = _lists(good, "inputs")
    rows = np.arange(good.num_rows)
    record = np.repeat(rows, np.maximum(n_out, 1))
    nth = _counting(np.maximum(n_out, 1))
    output = np.where(n_out[record] > 0, first_out[record] + nth, -1)
    n_each = np.maximum(n_in, 1)[record]
    record, output = np.repeat(record, n_each), np.repeat(output, n_each)
    source = np.where(n_in[record] > 0, first_in[record] + _counting(n_each), -1)
    of_record = good.take(pa.array(record))
    named = _picked(outputs, output, ("table", "version", "path"))
    # What a record without outputs stands for is its stage and its fingerprint.
    columns: dict[str, Any] = {
        "output_name": pc.coalesce(named["table"], of_record["stage"]),
        "output_version": pc.coalesce(named["version"], of_record["fingerprint"]),
        "path": named["path"],
    }
    columns |= {f"input_{name}": values for name, values in _picked(inputs, source, ("name", "version")).items()}
    columns |= {c.name: of_record[c.name] for c in LINEAGE.columns if c.name not in columns}
    return LINEAGE.from_columns({c.name: _array(columns[c.name]) for c in LINEAGE.columns})


def _counting(lengths: np.ndarray) -> np.ndarray:
    """0, 1, … length - 1 for each of the lengths, joined."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def _picked(items: pa.StructArray, index: np.ndarray, names: tuple[str, ...]) -> dict[str, pa.Array]:
    """Fields of the items at an index; null where it is negative."""
    where = pa.array(index, mask=index < 0)
    return {name: items.field(name).take(where) for name in names}


def _array(values: pa.Array | pa.ChunkedArray) -> pa.Array:
    return values.combine_chunks() if isinstance(values, pa.ChunkedArray) else values


def _stage_runs(day: str, records: pa.Table) -> pa.Table:
    runs = records.filter(pc.not_equal(records["stage"], BUNDLE))
    length, _, outputs = _lists(runs, "outputs")
    row = np.repeat(np.arange(runs.num_rows), length)
    sums = {
        name: np.bincount(row, np.asarray(pc.fill_null(outputs.field(name), 0)), runs.num_rows).astype(np.int64)
        for name in ("rows", "bytes")
    }
    columns = {
        "day": pa.array([day] * runs.num_rows, pa.string()),
        "n_points": runs["points"],
        "n_rows": pa.array(sums["rows"]),
        "n_bytes": pa.array(sums["bytes"]),
    }
    columns |= {c.name: runs[c.name] for c in STAGE_RUNS.columns if c.name not in columns}
    return STAGE_RUNS.from_columns({c.name: _array(columns[c.name]) for c in STAGE_RUNS.columns})


def _status(root: Path, current: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What became of every scan of a day, from its current records."""
    by_unit: dict[str, dict[str, dict[str, Any]]] = defaultdict(dict)
    for record in current:
        by_unit[record["unit"]][record["stage"]] = record
    rows = []
    for unit, stages in by_unit.items():
        bundle = stages.get(BUNDLE)
        if bundle is None:
            continue
        header = ScanHeader.model_validate_json(bundle["header"]) if bundle["header"] else None
        ordered = [bundle, *(stages[s.name] for s in SCAN_STAGES if s.name in stages)]
        bad = next((r for r in ordered if r["state"] != "ok"), None)
        complete = all(s.name in stages for s in SCAN_STAGES)
        reason, _, details = (bad["reason"] or "").partition("\n") if bad else ("", "", "")
        rows.append(
            {
                "scan_id": unit,
                "rig_id": header.rig_id if header else None,
                "wheelset_id": header.wheelset.wheelset_id if header else None,
                "purpose": header.purpose if header else None,
                "captured_at": header.captured_at if header else None,
                "acquired_on": header.acquired_on if header else None,
                "state": bad["state"] if bad else "measured" if complete else "pending",
                "stage": bad["stage"] if bad else None,
                "reason": reason if bad else None,
                "details": details or None,
                "recording": next((str(root / r["recording"]) for r in ordered if r["recording"]), None),
                "n_points": sum(r["points"] for r in ordered) or None,
            }
        )
    return rows


def _certificates(current: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Values of the certificates that a day's reference scans carry."""
    rows = []
    for record in current:
        if record["stage"] == BUNDLE and record["state"] == "ok" and '"reference"' in (record["header"] or ""):
            header = ScanHeader.model_validate_json(record["header"])
            if header.purpose == "reference":
                rows += reviews.certificate_rows(header)
    return rows
