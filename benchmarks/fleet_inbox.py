"""An inbox of thousands of small scans, made from a few simulated ones: bundles of their own, with files in common.

A scan is 16 frames of which 64 image rows saw the stripe. Every bundle has its own folder and JSON (identifier, time,
wheelset); its stripe files are hard links to those of one of the templates, because simulating each scan would take hours
and tell nothing more. Ten kinds of fault are spread evenly over the night.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FRAMES, ROWS, IMAGE_ROWS, BOARD_POSES = 16, 64, 256, 7
EXPECTED = {
    "corrupt": "refused",
    "wrong-hash": "refused",
    "missing-image": "refused",
    "bad-json": "refused",
    "missing-key": "refused",
    "unlisted-file": "refused",
    "path-escape": "refused",
    "empty-stripes": "failed",
    "unknown-calibration": "failed",
    "no-reference": "failed",
}
"""Ten kinds of fault, and what must become of a scan that has it."""


@dataclass(frozen=True)
class FleetInbox:
    """What was written: the inbox, its number of scans (references included), and the fault of each spoiled scan."""

    inbox: Path
    n_scans: int
    faults: dict[str, str]


def templates(folder: Path, wheelsets: int, repeats: int) -> Path:
    """A simulated campaign of a few scans, once: its good ones cut to 64 rows, its last ten spoiled."""
    from wheelset_assets.simulation import SimulationPlan, simulate

    inbox = folder / f"templates-{wheelsets}x{repeats}"
    done = inbox.with_suffix(".done")
    if done.exists():
        return inbox
    shutil.rmtree(inbox, ignore_errors=True)
    plan = SimulationPlan(
        out=inbox,
        wheelsets=wheelsets,
        repeats=repeats + -(-len(EXPECTED) // wheelsets),
        seed=7,
        faults=tuple(EXPECTED),
        frames=FRAMES,
        rows=IMAGE_ROWS,
        board_poses=BOARD_POSES,
    )
    made = simulate(plan)
    for scan in inbox.glob("scans/*"):
        if scan.name not in made.faults:
            _cut_rows(scan)
    done.write_text(json.dumps({"faults": dict(made.faults), "references": made.reference_scan_ids}), encoding="utf-8")
    return inbox


def _cut_rows(scan: Path) -> None:
    """Leave the middle 64 image rows of every stripe, and seal the bundle anew."""
    for path in scan.glob("stripes/*.parquet"):
        table = pq.read_table(path)
        for name in ("left_u", "right_u"):
            column = table[name].combine_chunks()
            height = column.type.list_size
            u = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, height).copy()
            start = (height - ROWS) // 2
            u[:, :start], u[:, start + ROWS :] = np.nan, np.nan
            cut = pa.FixedSizeListArray.from_arrays(pa.array(u.ravel()), height)
            table = table.set_column(table.column_names.index(name), name, cut)
        pq.write_table(table, path, compression="zstd")
    header = scan / "scan.json"
    content = json.loads(header.read_text(encoding="utf-8"))
    content["files"] = {name: hashlib.sha256((scan / name).read_bytes()).hexdigest() for name in content["files"]}
    header.write_text(json.dumps(content), encoding="utf-8")


def build(source: Path, out: Path, scans: int, days: int, *, first_day: str = "2025-06-02") -> FleetInbox:
    """Write an inbox of so many production scans over so many days, a reference scan first on each, 1 % faulty."""
    facts = json.loads(source.with_suffix(".done").read_text(encoding="utf-8"))
    by_kind = {kind: source / "scans" / name for name, kind in facts["faults"].items()}
    reference = source / "scans" / facts["references"][0]
    good = sorted(p for p in (source / "scans").iterdir() if p not in by_kind.values() and p != reference)
    for name in ("rigs", "calibrations", "cmm"):
        shutil.copytree(source / name, out / name, copy_function=os.link)
    start = datetime.fromisoformat(f"{first_day}T06:00:00+00:00")
    kinds, faults = list(EXPECTED), {}
    spacing = timedelta(hours=16) / (scans // days + 2)
    for day in range(days):
        _copy(reference, out, f"ref-{day:04d}", start + timedelta(days=day))
    for i in range(scans):
        kind = kinds[(i // 100) % len(kinds)] if i % 100 == 50 else None
        day, k = divmod(i, -(-scans // days))
        at = start + timedelta(days=day) + spacing * (k + 1)
        if kind == "no-reference":
            at = start - timedelta(minutes=5)
        name = f"scan-{i:06d}"
        _copy(by_kind[kind] if kind else good[i % len(good)], out, name, at, wheelset=f"WS-{i % 4000:04d}")
        if kind:
            faults[name] = kind
    return FleetInbox(out, scans + days, faults)


def _copy(template: Path, out: Path, name: str, at: datetime, wheelset: str | None = None) -> None:
    """A bundle of its own over a template's files; whatever was wrong with the template's JSON stays wrong."""
    target = out / "scans" / name
    shutil.copytree(template, target, copy_function=os.link)
    (target / "scan.json").unlink()
    text = (template / "scan.json").read_text(encoding="utf-8")
    try:
        content: dict[str, Any] = json.loads(text)
    except ValueError:
        (target / "scan.json").write_text(text, encoding="utf-8")
        return
    content |= {"scan_id": name, "captured_at": at.isoformat(), "comment": template.name}
    if wheelset:
        content["wheelset"] = {**content["wheelset"], "wheelset_id": wheelset}
    (target / "scan.json").write_text(json.dumps(content), encoding="utf-8")
