"""The inbox sensor: launches runs for the days on which bundles are new, changed or completed late."""

import dagster as dg

from pipelines.history import close_dead
from pipelines.schedules import night_job, requests
from pipelines.settings import settings
from warehouse.lock import WarehouseLock
from warehouse.planner import plan

MOST_TRIES = 3
"""So often the same work is asked for: a run that dies may be asked for again, one that cannot do it not for ever."""
WAITING = [dg.DagsterRunStatus[name] for name in ("QUEUED", "NOT_STARTED", "STARTING", "STARTED", "CANCELING")]


@dg.sensor(job=night_job, minimum_interval_seconds=300, default_status=dg.DefaultSensorStatus.STOPPED)
def inbox_sensor(context):
    """When the inbox holds something new or stale that has not been asked for yet.

    The cursor is `<number>:<what was asked for>:<times>`; the number makes the keys of equal requests differ, weeks apart.
    """
    s = settings()
    if WarehouseLock(s.warehouse).taken():
        return dg.SkipReason("a run is under way; what it leaves is asked for after it")
    close_dead(context.instance, s.warehouse)
    if context.instance.get_runs(filters=dg.RunsFilter(job_name=night_job.name, statuses=WAITING), limit=1):
        return dg.SkipReason("runs that were asked for have not ended yet")
    number, asked, times = [*(context.cursor or "0").split(":"), "", "0"][:3]
    found = plan(s.warehouse, s.inbox, s.config)
    if found.idle:
        if asked:
            context.update_cursor(number)
        return dg.SkipReason("nothing is new or stale")
    times = int(times or 0) + 1 if found.fingerprint == asked else 1
    if times > MOST_TRIES:
        return dg.SkipReason(
            f"what is new or stale has been asked for {MOST_TRIES} times already: see the runs that failed"
        )
    cursor = f"{int(number) + 1}:{found.fingerprint}:{times}"
    context.update_cursor(cursor)
    return requests(found, context.instance, f"inbox {cursor}")
