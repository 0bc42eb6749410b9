"""The nightly schedule: asks our planner which days have work, because Dagster cannot tell for partitioned assets."""

import dagster as dg

from pipelines.assets import DAYS_NAME
from pipelines.history import close_dead
from pipelines.settings import settings
from warehouse.lineage import UNDATED
from warehouse.lock import WarehouseLock
from warehouse.planner import Plan, plan

night_job = dg.define_asset_job(
    "night",
    selection="*",
    description="Everything that is stale on one acquisition day, calibrations before and statistics after it",
)


def requests(found: Plan, instance: dg.DagsterInstance, tag: str) -> list[dg.RunRequest]:
    """One run request for each day of a plan that has work, in order. Each run takes up all new bundles of the inbox.

    If nothing new has a day (bundles that cannot be read, a calibration that no scan names yet), the partition `undated`
    stands for them.
    """
    days = [day.day for day in found.days if day.day != UNDATED] or [UNDATED]
    instance.add_dynamic_partitions(DAYS_NAME, days)
    return [dg.RunRequest(run_key=f"{tag}:{day}", partition_key=day) for day in days]


@dg.schedule(cron_schedule="0 2 * * *", job=night_job, execution_timezone="UTC")
def nightly(context):
    """Every night: whatever is new or stale, and nothing else."""
    s = settings()
    if not WarehouseLock(s.warehouse).taken():
        close_dead(context.instance, s.warehouse)
    found = plan(s.warehouse, s.inbox, s.config)
    if found.idle:
        return dg.SkipReason("nothing is new or stale")
    return requests(found, context.instance, f"night {context.scheduled_execution_time:%Y-%m-%d}")
