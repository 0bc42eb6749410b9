"""Stage 8: statistics over the measurements of all days."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from warehouse import store
from warehouse.execute import Outcome, Task, fingerprint, stage_config
from warehouse.lineage import FLEET_DAY, Ledger
from wheelset_assets.config import Config
from wheelset_assets.stages import MEASUREMENT, REPEATABILITY
from wheelset_assets.tables import MEASUREMENTS

COLUMNS = [
    "wheelset_id",
    "quantity",
    "side",
    "unit",
    "acquired_on",
    "purpose",
    "value",
    "value_uncompensated",
    "expanded_uncertainty",
]


def measurement_files(ledger: Ledger) -> list[str]:
    """Current day files of the measurements, over all days."""
    found = set()
    for _, record in ledger.records_of(MEASUREMENT.name):
        if record.ok:
            found |= {o.path for o in record.outputs if o.table == MEASUREMENTS.name and o.path}
    return sorted(found)


def stale(ledger: Ledger, config: Config) -> tuple[str, tuple[tuple[str, str], ...]] | None:
    """Fingerprint and inputs of the repeatability statistics, if they are stale."""
    files = measurement_files(ledger)
    inputs = tuple((f"measurements {Path(p).parent.name}", Path(p).stem) for p in files)
    wanted = fingerprint(REPEATABILITY, stage_config(config, REPEATABILITY), inputs)
    record = ledger.day(FLEET_DAY).get("fleet", REPEATABILITY.name)
    known = inputs == () if record is None else record.fingerprint == wanted
    return None if known else (wanted, inputs)


def run(root: Path, ledger: Ledger, config: Config, execute: Callable[[Task], Outcome]) -> Outcome:
    """The statistics over what is current."""
    parts = [_measured(store.read_table(root, path, COLUMNS)) for path in measurement_files(ledger)]
    data = pa.concat_tables(parts) if parts else MEASUREMENTS.empty().select(COLUMNS)
    section = stage_config(config, REPEATABILITY)
    return execute(Task(root, REPEATABILITY.name, "fleet", FLEET_DAY, section, tables={"measurements": data}))


def _measured(rows: pa.Table) -> pa.Table:
    """Rows with a value, their names as dictionaries: a fleet has few of them, and millions of rows."""
    rows = rows.filter(pc.is_valid(rows["value"]))
    for i, name in enumerate(rows.column_names):
        if pa.types.is_string(rows[name].type):
            rows = rows.set_column(i, name, rows[name].dictionary_encode())
    return rows
