"""Figures of a partition: sums over its current records, sizes of its files, flags and reasons by kind."""

from __future__ import annotations

from pathlib import Path

import pytest

from warehouse import store
from warehouse.facts import kind_of, stage_facts
from warehouse.lineage import Ledger, Output, Record
from wheelset_assets.declare import Column, Stage, Table
from wheelset_assets.quality import flag_names

CLOUDS = Table("clouds", 1, "Clouds", key=("n",), layout="scan", columns=(Column("n", "int64", "Number"),))
VALUES = Table(
    "values",
    1,
    "Values",
    key=("scan_id",),
    layout="day",
    columns=(Column("scan_id", "string", "Scan"), Column("quality_flags", "strings", "Flags")),
)
DAY = "2025-01-01"


def run(*, config: object) -> dict:
    """A stage needs a function; this one is never called."""
    return {}


STAGE = Stage(1, "Clouds and values", "scan", (), (CLOUDS, VALUES), dict, run)


def put(
    ledger: Ledger,
    unit: str,
    outputs: tuple[Output, ...],
    state: str = "ok",
    reason: str | None = None,
    stage: str = "clouds",
) -> None:
    ledger.day(DAY).put(Record(unit, unit, stage, state, reason, "f", "1", "c", (), outputs, seconds=0.5, points=10))


def test_sums_sizes_flags_and_reasons(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    rows = [
        {"scan_id": "a", "quality_flags": ["outliers", "coverage_gap"]},
        {"scan_id": "a", "quality_flags": ["outliers"]},
        {"scan_id": "b", "quality_flags": []},
    ]
    path, _, size = store.write_table(tmp_path, VALUES, VALUES.from_rows(rows), DAY, None)
    sizes = []
    for unit, n in (("a", 2), ("b", 1)):
        cloud, version, n_bytes = store.write_table(
            tmp_path, CLOUDS, CLOUDS.from_rows([{"n": i} for i in range(n + 5)]), DAY, unit
        )
        sizes.append(n_bytes)
        put(ledger, unit, (Output("clouds", cloud, version, n + 5, n_bytes), Output("values", path, "v", n, 10**9)))
    put(ledger, "c", (), "failed", "no convergence: sensor left (rms 3)")
    put(ledger, "d", (), "failed", "no convergence: sensor right")
    put(ledger, "e", (), "refused", "the bundle is odd\nmore of it")
    put(ledger, "a", (), stage="another")
    facts = stage_facts(tmp_path, ledger, DAY, STAGE)
    assert (facts.units, facts.rows, facts.points, facts.seconds) == (2, 7 + 6 + 3, 20, 2.5)
    assert facts.bytes == sum(sizes) + size, "a day's file counts once, with its size on disk"
    assert {name: count for name, count in facts.flags.items() if count} == {"outliers": 2, "coverage_gap": 1}
    assert set(facts.flags) == set(flag_names()), "a plot must show the days without"
    assert (facts.refused, facts.failed) == (1, 2)
    assert facts.reasons == {"no convergence": 2, "the bundle is odd": 1}


def test_nothing_yet(tmp_path: Path) -> None:
    facts = stage_facts(tmp_path, Ledger(tmp_path), DAY, STAGE)
    assert (facts.units, facts.bytes, set(facts.flags.values())) == (0, 0, {0})


@pytest.mark.parametrize(
    ("reason", "kind"),
    [
        ("too few poses (found 2, required 5)", "too few poses"),
        ("scans/x/frames.parquet: column frame: expected 0, 1", "column frame"),
        (None, "no reason on record"),
        ("x" * 200, "x" * 80),
    ],
)
def test_the_kind_of_a_reason(reason: str | None, kind: str) -> None:
    assert kind_of(reason) == kind
