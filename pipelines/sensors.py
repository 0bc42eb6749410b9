"""The inbox sensor: launches runs for the days on which bundles are new, changed or completed late."""

import hashlib
import json

import dagster as dg

from pipelines.schedules import night_job, requests
from pipelines.settings import settings
from warehouse.lock import WarehouseLock
from warehouse.planner import plan


@dg.sensor(job=night_job, minimum_interval_seconds=300, default_status=dg.DefaultSensorStatus.STOPPED)
def inbox_sensor(context):
    """When the inbox holds something new or stale that has not been asked for yet.

    The cursor is `<number>:<what was asked for>`; the number makes the keys of equal requests differ, weeks apart.
    """
    s = settings()
    if WarehouseLock(s.warehouse).taken():
        return dg.SkipReason("a run is under way; what it leaves is asked for after it")
    number, _, asked = (context.cursor or "0:").partition(":")
    found = plan(s.warehouse, s.inbox, s.config)
    if found.idle:
        if asked:
            context.update_cursor(f"{number}:")
        return dg.SkipReason("nothing is new or stale")
    text = json.dumps([found.as_json()["days"], found.calibrations, found.reviews_changed], sort_keys=True)
    wanted = hashlib.sha256(text.encode()).hexdigest()[:16]
    if wanted == asked:
        return dg.SkipReason("what is new or stale has been asked for already")
    cursor = f"{int(number) + 1}:{wanted}"
    context.update_cursor(cursor)
    return requests(found, context.instance, f"inbox {cursor}")
