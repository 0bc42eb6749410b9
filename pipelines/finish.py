"""What ends every run: recordings of the scans that failed in it, the catalog, and the summary for the morning."""

from __future__ import annotations

import contextlib
import logging
from dataclasses import replace

from pipelines.notify import send
from warehouse import catalog, morning, reviews
from warehouse.events import event
from warehouse.night import Night
from warehouse.summary import Summary


def finish(night: Night, notify: str | None = None) -> Summary:
    """Write the recordings of this run's failed scans, rebuild the catalog, keep and send the summary, and return it.

    A recording that cannot be written is a trouble of its own and never sinks the run.
    """
    summary = night.summary()
    for trouble in summary.troubles:
        if trouble["state"] == "failed":
            trouble["recording"] = _record(night, trouble["scan_id"])
    catalog.update(night.root, night.ledger, night.state.inbox.reviews())
    summary.warnings += reviews.review_troubles(night.root) + catalog.limit_troubles(night.root)
    counts = {k: v for k, v in summary.as_json().items() if isinstance(v, int | float)}
    event("run finished", run_id=night.run_id, **counts)
    for warning in summary.warnings:
        event("warning", logging.WARNING, run_id=night.run_id, text=warning)
    _tell(night, summary, None, notify)
    return summary


def stopped(night: Night, error: BaseException, notify: str | None) -> None:
    """Keep and send what there is to say of a run that an error ends; never raises."""
    with contextlib.suppress(Exception):
        _tell(night, night.summary(), error, notify)


def _tell(night: Night, summary: Summary, error: BaseException | None, notify: str | None) -> None:
    document = morning.document(night, summary, error)
    morning.keep(night.root, document)
    if notify is not None and (why := send(notify, document)):
        summary.warnings.append(why)


def _record(night: Night, scan_id: str) -> str | None:
    from pipelines.replay import write_recording

    path = f"recordings/{scan_id}.rrd"
    try:
        write_recording(night.root, scan_id, night.root / path, night.inbox_root)
    except Exception as error:
        night.progress("recording", f"{scan_id}: not written: {error}", 1, 1)
        return None
    ledger = night.ledger.day(night.state.scans[scan_id].day)
    for key, record in ledger.current.items():
        if key[0] == scan_id and not record.ok:
            ledger.current[key] = replace(record, recording=path)
            ledger.dirty = True
    night.ledger.save(ledger.day)
    night.ledger.release()
    return str(night.root / path)
