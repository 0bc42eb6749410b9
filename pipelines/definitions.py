"""Dagster's entry point: assets, resources, schedule, sensor. `dagster dev -m pipelines.definitions` shows it.

Places come from the environment: WHEELSET_INBOX, WHEELSET_WAREHOUSE, WHEELSET_CONFIG.
"""

from collections.abc import Iterator

import dagster as dg

from pipelines import logs
from pipelines.assets import build_assets
from pipelines.finish import finish, started, stopped
from pipelines.schedules import nightly
from pipelines.sensors import inbox_sensor
from pipelines.settings import configuration, settings
from warehouse.night import Night

A_NIGHT = 12 * 3600.0
"""Seconds for which a run that Dagster launched waits for the one before it."""


@dg.resource(description="One run over the inbox: holds the warehouse's lock and the worker pool")
def night_resource(_context) -> Iterator[Night]:
    """A night for runs that Dagster itself launches; the command line brings its own."""
    logs.configure()
    s = settings()
    with Night(
        s.warehouse, s.inbox, s.config, workers=s.workers, cluster=s.cluster, wait_seconds=A_NIGHT, bounds=s.bounds
    ) as night:
        started(night, s)
        try:
            night.prepare()
            yield night
        except BaseException as error:
            night.error = night.error or error
            raise
        finally:  # Dagster ends a resource in good order also when a step failed: the night knows better
            if night.error is None:
                finish(night, s.notify)
            else:
                stopped(night, night.error, s.notify)


ASSETS = build_assets(configuration())

defs = dg.Definitions(
    assets=ASSETS,
    resources={"night": night_resource},
    schedules=[nightly],
    sensors=[inbox_sensor],
    executor=dg.in_process_executor,
)
