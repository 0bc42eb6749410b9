"""A run from the command line: materialises through Dagster in this process, into an instance inside the warehouse."""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable

from pipelines.finish import finish, started, stopped
from pipelines.history import close_dead, kept_open, run_tags
from pipelines.settings import Settings, dagster_home
from warehouse.night import Night, Progress, no_progress
from warehouse.summary import Summary
from wheelset_assets.quality import WheelsetError
from wheelset_assets.stages import SCAN_STAGES

QUIET = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}


def run(
    s: Settings,
    *,
    only: frozenset[str] = frozenset(),
    until: object = None,
    progress: Progress = no_progress,
    retry_failed: bool = False,
) -> Summary:
    """Process what is new or stale. Dagster is imported, and an instance made, only if there is something to do."""
    # A ledger is a hundred thousand objects without a cycle: looking for some takes a fifth of an idle night.
    gc.set_threshold(50_000, 20, 100)
    with Night(
        s.warehouse,
        s.inbox,
        s.config,
        workers=s.workers,
        cluster=s.cluster,
        only=only,
        until=until,  # type: ignore[arg-type]
        progress=progress,
        bounds=s.bounds,
        retry_failed=retry_failed,
    ) as night:
        started(night, s)
        try:
            _work(s, night)
            return finish(night, s.notify)
        except BaseException as error:
            stopped(night, error, s.notify)
            raise


def _work(s: Settings, night: Night) -> None:
    night.prepare()
    materialise: Callable | None = None
    if night.state.stale_calibrations():
        materialise = _materialiser(s, night)
        materialise(["calibrations"], None)
    for day in night.days_with_work():
        if night.references_only:  # the day is materialised when its turn comes, with what was done here in its figures
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
            continue
        materialise = materialise or _materialiser(s, night)
        materialise(None, day)
    if night.fleet_stale() is not None:
        materialise = materialise or _materialiser(s, night)
        materialise(["repeatability"], None)


def _materialiser(s: Settings, night: Night) -> Callable:
    """Function that materialises named unpartitioned assets, or all scan assets of a day."""
    dagster_home(s.warehouse)
    import dagster as dg
    from dagster._core.errors import DagsterExecutionInterruptedError

    from pipelines.assets import DAYS_NAME, build_assets

    logging.getLogger("dagster").setLevel(logging.CRITICAL)
    assets = build_assets(s.config)
    with kept_open():
        instance = dg.DagsterInstance.get()
        close_dead(instance, s.warehouse, night.run_id)
    resources = {"night": dg.ResourceDefinition.hardcoded_resource(night)}

    def materialise(names: list[str] | None, day: str | None) -> None:
        if day is not None:
            instance.add_dynamic_partitions(DAYS_NAME, [day])
        partitioned = [a for a in assets if a.partitions_def is not None]
        selection = [dg.AssetKey(n) for n in names] if names else [a.key for a in partitioned]
        try:
            with kept_open():
                dg.materialize(
                    assets,
                    selection=selection,
                    partition_key=day,
                    instance=instance,
                    resources=resources,
                    run_config=QUIET,
                    tags=run_tags(s.warehouse, night.run_id),
                )
        except DagsterExecutionInterruptedError:  # its own name for Ctrl-C, which it has taken over meanwhile
            raise KeyboardInterrupt from None
        except dg.DagsterError as error:
            if isinstance(error.__cause__, WheelsetError):
                raise error.__cause__ from None
            raise

    return materialise
