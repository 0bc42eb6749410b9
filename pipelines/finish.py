"""What begins and ends every run, whoever started it: its events, recordings of the scans that failed in it, the catalog, and
the summary for the morning.
"""

from __future__ import annotations

import contextlib
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipelines.notify import send
from pipelines.settings import Settings
from warehouse import catalog, morning, reviews
from warehouse.events import event
from warehouse.lineage import Ledger
from warehouse.night import Night
from warehouse.pool import Pool
from warehouse.summary import Summary


def started(night: Night, s: Settings) -> None:
    """Tell the log what this run works on."""
    event(
        "run started",
        run_id=night.run_id,
        inbox=s.inbox,
        warehouse=s.warehouse,
        workers=s.workers,
        cluster=s.cluster,
    )


def finish(night: Night, notify: str | None = None) -> Summary:
    """Write the recordings of this run's failed scans, rebuild the catalog, keep and send the summary, and return it.

    A recording that cannot be written is a trouble of its own and never sinks the run.
    """
    summary = night.summary()
    _record(night, [trouble for trouble in summary.troubles if trouble["state"] == "failed"])
    catalog.update(night.root, night.ledger, night.state.inbox.reviews())
    summary.warnings += reviews.review_troubles(night.root) + catalog.limit_troubles(night.root)
    counts = {k: v for k, v in summary.as_json().items() if isinstance(v, int | float)}
    event("run finished", run_id=night.run_id, **counts)
    for warning in summary.warnings:
        event("warning", logging.WARNING, run_id=night.run_id, text=warning)
    _tell(night, summary, None, notify)
    return summary


def stopped(night: Night, error: BaseException, notify: str | None) -> None:
    """Show what a run that an error ends has finished, keep and send what there is to say of it; never raises.

    The catalog is built from what is on disk: what is in memory may not have got there.
    """
    night.interrupted = True  # what it did not reach still waits
    with contextlib.suppress(Exception):
        catalog.update(night.root, Ledger(night.root), night.state.inbox.reviews())
    with contextlib.suppress(Exception):
        _tell(night, night.summary(), error, notify)


def _tell(night: Night, summary: Summary, error: BaseException | None, notify: str | None) -> None:
    document = morning.document(night, summary, error)
    morning.keep(night.root, document)
    if notify is not None and (why := send(notify, document)):
        summary.warnings.append(why)


def _drawn(job: tuple[Path, str, Path]) -> None:
    """Write one recording; runs in a worker."""
    from pipelines.replay import write_recording

    root, scan_id, inbox = job
    write_recording(root, scan_id, root / _path(scan_id), inbox)


def _path(scan_id: str) -> str:
    return f"recordings/{scan_id}.rrd"


def _record(night: Night, failed: list[dict[str, Any]]) -> None:
    """Recordings of scans that failed, by this machine's workers; each trouble gets the path of its own, or None."""
    by_name = {trouble["scan_id"]: trouble for trouble in failed}
    jobs = [(night.root, scan_id, night.inbox_root) for scan_id in by_name]
    if night.pool.cluster is None:
        results = night.pool.run(_drawn, jobs)
    else:
        results = Pool(0).run(_drawn, jobs)
    written: dict[str, list[str]] = {}
    for n, ((_, scan_id, _), result) in enumerate(results, start=1):
        by_name[scan_id]["recording"] = None
        if isinstance(result, Exception):
            night.progress("recording", f"{scan_id}: not written: {result}", n, len(jobs))
            continue
        by_name[scan_id]["recording"] = str(night.root / _path(scan_id))
        written.setdefault(night.state.scans[scan_id].day, []).append(scan_id)
    for day, names in sorted(written.items()):
        ledger = night.ledger.day(day)
        for key, record in ledger.current.items():
            if key[0] in names and not record.ok:
                ledger.current[key] = replace(record, recording=_path(key[0]))
                ledger.dirty = True
        night.ledger.save(day)
        night.ledger.release()
