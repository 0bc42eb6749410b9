"""What a run leaves for the morning: one JSON document a run in `_runs/`, and a page of it."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warehouse import store
from warehouse.lineage import now
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    from warehouse.night import Night
    from warehouse.summary import Summary

FOLDER = "_runs"
SHOWN = 5
"""Scans that are named for each reason; the others are counted."""


def document(night: Night, summary: Summary, error: BaseException | None = None) -> dict[str, Any]:
    """What happened: counts in scans, reasons with some of their scans, time by stage; and what stopped the run, if so."""
    ended = now()
    stopped = f"{type(error).__name__}: {error}".rstrip(": ") if error is not None else None
    outcome = "stopped" if stopped else "out of time" if night.interrupted else "done"
    stages = [
        {
            "stage": name,
            "computed": found.computed,
            "refused": found.refused,
            "failed": found.failed,
            "points": found.points,
            "seconds": round(found.seconds, 3),
            "compute_seconds": round(found.compute_seconds, 3),
            "bytes": found.bytes,
        }
        for name, found in night.record.stages.items()
    ]
    return {
        "run_id": night.run_id,
        "started_at": (ended - timedelta(seconds=summary.seconds)).isoformat(),
        "ended_at": ended.isoformat(),
        "outcome": outcome,
        "error": stopped,
        **summary.as_json(),
        "reasons": reasons(summary.troubles),
        "stages": stages,
    }


def reasons(troubles: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Troubles by state, stage and reason, the most frequent first; what names the scan itself is left out of the reason."""
    counted: Counter[tuple[str, str, str]] = Counter()
    scans: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for trouble in troubles:
        key = trouble["state"], trouble["stage"] or "", trouble["reason"].replace(trouble["scan_id"], "…")
        counted[key] += 1
        scans[key].append(trouble["scan_id"])
    return [
        {"state": s, "stage": stage, "reason": reason, "n_scans": n, "scans": sorted(scans[s, stage, reason])[:SHOWN]}
        for (s, stage, reason), n in sorted(counted.items(), key=lambda item: (-item[1], item[0]))
    ]


def keep(root: Path, found: dict[str, Any]) -> Path:
    """Store a run's document; names sort by time."""
    started = datetime.fromisoformat(found["started_at"]).astimezone(UTC)
    path = root / FOLDER / f"{started:%Y%m%dT%H%M%S}-{found['run_id']}.json"
    store.write_bytes(path, json.dumps(found, indent=1, default=str).encode())
    return path


def load(root: Path, run_id: str | None = None) -> dict[str, Any]:
    """The document of a run, or of the last one; ConfigError if there is none."""
    stored = sorted((root / FOLDER).glob("*.json"), key=lambda p: p.name)
    if run_id is not None:
        stored = [p for p in stored if p.stem.partition("-")[2].startswith(run_id)]
    if not stored:
        which = f"of run {run_id}" if run_id else "yet"
        raise ConfigError(f"{root}: no summary {which}; every `wheelset run` leaves one in {FOLDER}/")
    found: dict[str, Any] = json.loads(stored[-1].read_text(encoding="utf-8"))
    return found


def page(found: dict[str, Any]) -> str:
    """The document as one self-contained HTML page; the template escapes what it is given."""
    from warehouse.render_page import environment

    return environment().get_template("summary.html.j2").render(run=found) + "\n"
