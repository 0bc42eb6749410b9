"""Dagster's own store of runs and events, for as long as this program writes to it: kept open, and not flushed for every event.

Dagster opens its SQLite files anew for every event, flushes each to disk, and moves the log of changes into the file
whenever the last connection closes: hundreds of flushes a day's run, while the workers wait. What the store loses in a
power cut is the end of a run's history, which the UI shows; SQLite keeps it whole, and the record is the ledger.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

RUN_TAG = "wheelset/run"
"""Tag of the runs that the command line makes, with the run's own identifier."""


WAREHOUSE_TAG = "wheelset/warehouse"
"""And with the place of what it writes to: several warehouses may share one store."""


def run_tags(warehouse: Path, run_id: str) -> dict[str, str]:
    """Tags of a run of the command line."""
    return {RUN_TAG: run_id, WAREHOUSE_TAG: str(warehouse.resolve())}


def close_dead(instance: Any, warehouse: Path, alive: str = "") -> None:
    """Put an end to runs of the command line on this warehouse that were killed: by themselves they would be under way for
    ever, and hold up whatever waits for a place. Only for whoever knows that none lives but `alive`: because the warehouse's
    lock is free, or its own.
    """
    import dagster as dg

    status = dg.DagsterRunStatus
    under_way = [status.NOT_STARTED, status.STARTING, status.STARTED, status.CANCELING]
    own = {WAREHOUSE_TAG: str(warehouse.resolve())}
    for run in instance.get_runs(filters=dg.RunsFilter(statuses=under_way, tags=own)):
        if run.tags.get(RUN_TAG) != alive:
            instance.report_run_failed(run, "its process was killed; the next run goes on from what it had finished")


@contextmanager
def kept_open() -> Iterator[None]:
    """Within the block, an SQLite file that was opened once stays open, and is flushed when SQLite moves its log."""
    from sqlalchemy import event
    from sqlalchemy.engine import Engine

    kept: dict[str, sqlite3.Connection] = {}

    def connected(connection: Any, _: Any) -> None:
        if not isinstance(connection, sqlite3.Connection):
            return
        # Dagster asks for this too, but only when the tables of a new file are there: each was flushed by itself.
        if connection.execute("PRAGMA journal_mode = WAL").fetchone()[0] != "wal":
            return  # a database in memory, or on a disk that cannot
        connection.execute("PRAGMA synchronous = NORMAL")
        path = connection.execute("PRAGMA database_list").fetchone()[2]
        if path and path not in kept:
            kept[path] = sqlite3.connect(path, check_same_thread=False)
            kept[path].execute("SELECT count(*) FROM sqlite_master").fetchone()  # takes part in the log from here on

    event.listen(Engine, "connect", connected)
    try:
        yield
    finally:
        event.remove(Engine, "connect", connected)
        for connection in kept.values():
            connection.close()
