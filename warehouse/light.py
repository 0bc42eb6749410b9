"""Light tables of one day: one file a day and table, merged by the driver from what the workers return."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa

from warehouse import store
from warehouse.lineage import Ledger
from wheelset_assets.declare import Table
from wheelset_assets.tables import TABLES

LIGHT = {name: table for name, table in TABLES.items() if table.layout == "day"}


class LightTables:
    """Rows of a day's light tables by unit; read when first asked for, written by `flush`."""

    def __init__(self, root: Path, ledger: Ledger, day: str) -> None:
        self.root, self.ledger, self.day = root, ledger, day
        self._rows: dict[str, dict[str, pa.Table]] = {}
        self._changed: set[str] = set()

    def _path(self, table: str) -> str | None:
        for record in self.ledger.day(self.day).current.values():
            for output in record.outputs:
                if output.table == table and output.path and record.ok:
                    return output.path
        return None

    def _of(self, table: str) -> dict[str, pa.Table]:
        if table not in self._rows:
            path = self._path(table)
            self._rows[table] = rows_by_unit(store.read_table(self.root, path)) if path else {}
        return self._rows[table]

    def get(self, table: str, unit: str) -> pa.Table:
        """Rows of a unit, none if it has none."""
        found = self._of(table).get(unit)
        return LIGHT[table].empty() if found is None else found

    def put(self, table: str, unit: str, rows: pa.Table) -> None:
        """Replace the rows of a unit."""
        self._of(table)[unit] = rows
        self._changed.add(table)

    def drop(self, unit: str, stage_tables: tuple[Table, ...]) -> None:
        """Remove the rows of a unit from the light tables of a stage."""
        for table in stage_tables:
            if table.name in LIGHT and self._of(table.name).pop(unit, None) is not None:
                self._changed.add(table.name)

    def prune(self) -> None:
        """Remove the rows of units of which no current record accounts for: their bundles were refused or moved."""
        named: dict[str, set[str]] = {}
        for (unit, _), record in self.ledger.day(self.day).current.items():
            for output in record.outputs if record.ok else ():
                named.setdefault(output.table, set()).add(unit)
        for name, units in named.items():
            if name in LIGHT and (gone := set(self._of(name)) - units):
                for unit in gone:
                    del self._rows[name][unit]
                self._changed.add(name)

    def flush(self, flushed: bool = True) -> None:
        """Write the changed tables and let the ledger's current records name the new files.

        flushed: see `store.write_table`.
        """
        if not self._changed:
            return
        ledger = self.ledger.day(self.day)
        paths = {}
        wanted = {output.table for record in ledger.current.values() for output in record.outputs}
        for name in sorted(self._changed & wanted):
            rows = self._of(name)
            data = pa.concat_tables([rows[unit] for unit in sorted(rows)] or [LIGHT[name].empty()])
            data = data.combine_chunks()
            paths[name], _, _ = store.write_table(self.root, LIGHT[name], data, self.day, None, flushed=flushed)
        for key, record in ledger.current.items():
            if any(output.table in paths for output in record.outputs):
                outputs = tuple(replace(o, path=paths.get(o.table, o.path)) for o in record.outputs)
                ledger.current[key] = replace(record, outputs=outputs)
        ledger.dirty = True
        self._changed.clear()


def rows_by_unit(table: pa.Table) -> dict[str, pa.Table]:
    """A day's table cut into its units' rows, which lie together."""
    encoded = table["scan_id"].combine_chunks().dictionary_encode()
    codes = encoded.indices.to_numpy()
    if len(codes) == 0:
        return {}
    starts = np.concatenate([[0], np.flatnonzero(np.diff(codes)) + 1, [len(codes)]])
    names = encoded.dictionary.to_pylist()
    return {names[codes[a]]: table.slice(a, b - a) for a, b in pairwise(starts)}
