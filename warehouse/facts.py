"""Figures of one stage on one day as things stand: what an orchestrator shows of a partition, run after run."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow.compute as pc

from warehouse import store
from warehouse.lineage import Ledger, Output, Record
from wheelset_assets.declare import Stage
from wheelset_assets.quality import flag_names

FLAGS = "quality_flags"


@dataclass
class StageFacts:
    """Current outputs of a stage on a day: units done, rows, points, seconds of computation, bytes of files, rows by quality
    flag, and units refused or failed by reason (the reason's first clause, which says the kind)."""

    units: int = 0
    rows: int = 0
    points: int = 0
    seconds: float = 0.0
    bytes: int = 0
    flags: Counter[str] = field(default_factory=Counter)
    refused: int = 0
    failed: int = 0
    reasons: Counter[str] = field(default_factory=Counter)


def stage_facts(root: Path, ledger: Ledger, day: str, stage: Stage) -> StageFacts:
    """Sum up the current records of a stage on a day, as the ledger in memory has them."""
    facts = StageFacts()
    by_name = {table.name: table for table in stage.outputs}
    if any(column.name == FLAGS for table in stage.outputs for column in table.columns):
        facts.flags.update(dict.fromkeys(flag_names(), 0))  # a plot must show the days without
    files: dict[str, Output] = {}
    for (_, name), record in ledger.day(day).current.items():
        if name == stage.name:
            _add(facts, record)
            files |= {o.path: o for o in record.outputs if record.ok and o.path}
    for path, output in sorted(files.items()):
        table = by_name[output.table]
        # A day's file holds the rows of many units, none of which can tell its size.
        facts.bytes += (root / path).stat().st_size if table.layout == "day" else output.bytes
        if any(column.name == FLAGS for column in table.columns):
            facts.flags.update(count_flags(root, path))
    return facts


def _add(facts: StageFacts, record: Record) -> None:
    facts.seconds += record.seconds
    if record.ok:
        facts.units += 1
        facts.points += record.points
        facts.rows += sum(o.rows for o in record.outputs)
    else:
        facts.refused += record.state == "refused"
        facts.failed += record.state == "failed"
        facts.reasons[kind_of(record.reason)] += 1


def kind_of(reason: str | None) -> str:
    """The clause of a reason that says the kind, without the file before it and the names and figures that follow."""
    clauses = (reason or "no reason on record").partition("\n")[0].split(": ")
    kind = clauses[1] if len(clauses) > 1 and "/" in clauses[0] else clauses[0]
    return kind.partition(" (")[0][:80]


def count_flags(root: Path, path: str) -> dict[str, int]:
    """Rows of a stored table by quality flag; a row may have several."""
    column = store.read_table(root, path, [FLAGS])[FLAGS]
    return {str(pair["values"]): int(pair["counts"]) for pair in pc.value_counts(pc.list_flatten(column)).to_pylist()}
