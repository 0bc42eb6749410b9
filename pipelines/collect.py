"""`wheelset gc`: retention in the warehouse, and of the runs in Dagster's own store."""

from __future__ import annotations

import logging
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pipelines.settings import dagster_home
from warehouse import collect as warehouse_collect
from warehouse.collect import Collected, Retention
from warehouse.place import is_remote


def collect(root: Path, keep_days: float, keep_versions: int, delete: bool) -> Collected:
    """Both, by one rule: runs of Dagster go when they ended more than `keep_days` ago."""
    found = warehouse_collect.collect(root, Retention(keep_days, keep_versions), delete)
    found.runs = _old_runs(root, keep_days, delete)
    return found


def _old_runs(root: Path, keep_days: float, delete: bool) -> int:
    """Number of Dagster's runs that go; their events and logs go with them, what they made stays."""
    if is_remote(root) or not (root / "_dagster" / "dagster.yaml").exists():
        return 0
    dagster_home(root)
    import dagster as dg

    logging.getLogger("dagster").setLevel(logging.CRITICAL)
    before = datetime.now(UTC) - timedelta(days=keep_days)
    with dg.DagsterInstance.get() as instance:
        records = instance.get_run_records(dg.RunsFilter(created_before=before))
        ended = [r.dagster_run.run_id for r in records if r.dagster_run.is_finished]
        for run_id in ended if delete else []:
            instance.delete_run(run_id)
        return len(ended)
