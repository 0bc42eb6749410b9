"""Get, run, audit, publish: a stage's output is checked before anybody can see it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from fake_inbox import fake_row, inbox_of

from warehouse import execute as module
from warehouse.audit import audit
from warehouse.execute import Outcome, Task, execute, fingerprint, stage_config
from warehouse.inbox import Inbox
from wheelset_assets.bundle import ScanHeader
from wheelset_assets.config import Config
from wheelset_assets.declare import Check, Column, Stage, Table
from wheelset_assets.quality import AlgorithmFailed, ScanUnusable
from wheelset_assets.stages import SCAN_STAGES, STAGES
from wheelset_assets.tables import MEASUREMENTS

SMALL = Table(
    "small",
    1,
    "Small",
    key=("name", "number"),
    layout="fleet",
    columns=(
        Column("name", "string", "Name", values=("a", "b")),
        Column("number", "int32", "Number", minimum=0, maximum=9),
        Column("value_mm", "float64", "Value", unit="mm", nullable=True, minimum=-1),
    ),
    checks=(Check("value_is_small", "SELECT * FROM {table} WHERE value_mm > 5", "small", "warn"),),
)


def small(**changes: list) -> pa.Table:
    return SMALL.from_columns({"name": ["a", "a", "b"], "number": [0, 1, 0], "value_mm": [1.0, None, 2.0]} | changes)


def test_good_tables_pass_and_soft_checks_warn() -> None:
    assert audit(SMALL, small()) == []
    assert audit(SMALL, SMALL.empty()) == []
    (warning,) = audit(SMALL, small(value_mm=[1.0, 6.0, 2.0]))
    assert "table small: check value_is_small (small)" in warning


@pytest.mark.parametrize(
    ("changes", "check"),
    [
        ({"value_mm": [float("nan"), 1.0, 1.0]}, "value_mm_limits"),
        ({"value_mm": [float("inf"), 1.0, 1.0]}, "value_mm_limits"),
        ({"value_mm": [-2.0, 1.0, 1.0]}, "value_mm_limits"),
        ({"number": [0, 10, 0]}, "number_limits"),
        ({"number": [0, -1, 0]}, "number_limits"),
        ({"name": ["a", "c", "b"]}, "name_values"),
        ({"number": [0, 0, 0]}, "key_unique"),
    ],
)
def test_rows_that_break_the_declaration_are_refused(changes: dict, check: str) -> None:
    with pytest.raises(RuntimeError, match=f"table small: check {check}"):
        audit(SMALL, small(**changes))
    assert audit(SMALL, small()) == []  # and nothing of it stays behind


def test_other_schemas_and_nulls_are_refused() -> None:
    with pytest.raises(RuntimeError, match="schema differs"):
        audit(SMALL, small().select(["number", "name", "value_mm"]))
    with pytest.raises(RuntimeError, match="schema differs"):
        audit(SMALL, small().set_column(1, "number", pa.array([0, 1, 0], pa.int64())))
    with pytest.raises(RuntimeError, match="column name has 1 nulls"):
        audit(SMALL, small(name=["a", None, "b"]))


def test_measurements_need_a_value_with_uncertainty_or_a_reason() -> None:
    scan = ScanHeader.model_validate(
        {
            "format": "wheelset-scan/1",
            "scan_id": "s",
            "rig_id": "r",
            "calibration_id": "c",
            "captured_at": "2025-04-05T09:00:00Z",
            "purpose": "production",
            "wheelset": {"wheelset_id": "w", "type": "t"},
            "temperature_c": {"wheelset": 20.0, "rig": 20.0},
            "files": {},
        }
    )
    good = fake_row(MEASUREMENTS, Task(Path(), "measurements", "s", "2025-04-05", Config().measurement, scan=scan))
    assert audit(MEASUREMENTS, MEASUREMENTS.from_rows([good])) == []
    spoilt: list[tuple[dict, str]] = [
        ({"reason": "x"}, "value_or_reason"),
        ({"value": None}, "value_or_reason"),
        ({"expanded_uncertainty": None}, "value_with_uncertainty"),
        ({"expanded_uncertainty": 0.0}, "value_with_uncertainty"),
    ]
    for changes, check in spoilt:
        with pytest.raises(RuntimeError, match=check):
            audit(MEASUREMENTS, MEASUREMENTS.from_rows([good | changes]))


def test_keys_of_large_tables_are_checked_by_their_order() -> None:
    n = 100_001
    names = ["a"] * 50_000 + ["b"] * 50_001
    table = replace(
        SMALL, columns=(replace(SMALL.columns[0], values=()), replace(SMALL.columns[1], maximum=None), SMALL.columns[2])
    )
    numbers = np.r_[np.arange(50_000), np.arange(50_001)]
    good = {"name": names, "number": numbers, "value_mm": np.zeros(n)}
    assert audit(table, table.from_columns(good)) == []
    numbers = numbers.copy()
    numbers[7] = 6
    with pytest.raises(RuntimeError, match="strictly ascending order of name, number"):
        audit(table, table.from_columns(good | {"number": numbers}))


# --- whole tasks -------------------------------------------------------------------------------------------------


def stage_of(run: Any, outputs: tuple[Table, ...] = (SMALL,)) -> Stage:
    return Stage(1, "Test", "fleet", (), outputs, type(Config().repeatability), run)


def run_with(monkeypatch: pytest.MonkeyPatch, root: Path, run: Any, **changes: Any) -> Outcome:
    stage = stage_of(run)
    monkeypatch.setitem(module.STAGE_BY_NAME, stage.name, stage)
    return execute(Task(root, stage.name, "u", "2025-04-05", Config().repeatability, **changes))


def test_an_output_is_published_under_its_version(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    outcome = run_with(monkeypatch, tmp_path, lambda *, config: {"small": small(value_mm=[1.0, 6.0, 2.0])})
    (output,) = outcome.outputs
    assert (outcome.state, output.rows, output.path) == ("ok", 3, f"small/{output.version}.parquet")
    assert (tmp_path / output.path).is_file()
    assert len(outcome.warnings) == 1


def test_failures_that_people_can_mend_become_outcomes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def unusable(*, config: object) -> Any:
        raise ScanUnusable("file x: broken")

    def stuck(*, config: object) -> Any:
        raise AlgorithmFailed("no convergence", iterations=7)

    assert run_with(monkeypatch, tmp_path, unusable).state == "refused"
    outcome = run_with(monkeypatch, tmp_path, stuck)
    assert (outcome.state, outcome.reason, outcome.outputs) == ("failed", "no convergence (iterations 7)", ())


@pytest.mark.parametrize("returned", [{}, {"other": small()}, {"small": small(), "other": small()}])
def test_a_stage_that_returns_other_tables_is_a_bug(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, returned: dict
) -> None:
    with pytest.raises(RuntimeError, match="stage small returned"):
        run_with(monkeypatch, tmp_path, lambda *, config: returned)
    assert not list(tmp_path.iterdir())


def test_nothing_that_fails_its_audit_is_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="number_limits"):
        run_with(monkeypatch, tmp_path, lambda *, config: {"small": small(number=[0, 1, 99])})
    assert not list(tmp_path.iterdir())


def test_an_input_that_was_not_bound_is_a_bug(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="input triangulated_clouds was not bound"):
        execute(Task(tmp_path, "filtered_clouds", "u", "2025-04-05", Config().filtering))


def test_a_bundle_that_vanished_refuses_the_scan(tmp_path: Path) -> None:
    inbox = Inbox(inbox_of(tmp_path / "inbox"))
    entry = inbox.scans()[0]
    verified = inbox.verify_scan(entry)
    assert isinstance(verified.header, ScanHeader)
    (entry.folder / "frames.parquet").unlink()
    tables = {name: pa.table({}) for name in ("calibrations",)}
    task = Task(
        tmp_path,
        "triangulated_clouds",
        entry.identifier,
        "2025-04-05",
        Config().triangulation,
        tables=tables,
        bundle_folder=entry.folder,
        bundle_files=tuple(verified.files),
        scan=verified.header,
        rig=inbox.rigs["rig-1"][0],
    )
    outcome = execute(task)
    assert outcome.state == "refused"
    assert "frames.parquet" in str(outcome.reason)


def test_the_fingerprint_depends_on_stage_knobs_and_inputs() -> None:
    config = Config()
    changed = config.model_copy(update={"filtering": config.filtering.model_copy(update={"window_rows": 9})})
    inputs = (("a", "1"), ("b", "2"))
    prints = [fingerprint(stage, stage_config(config, stage), inputs) for stage in STAGES]
    prints += [
        fingerprint(SCAN_STAGES[1], stage_config(changed, SCAN_STAGES[1]), inputs),
        fingerprint(SCAN_STAGES[1], stage_config(config, SCAN_STAGES[1]), inputs[:1]),
        fingerprint(replace(SCAN_STAGES[1], version=99), stage_config(config, SCAN_STAGES[1]), inputs),
    ]
    assert len(set(prints)) == len(prints)
    assert stage_config(changed, SCAN_STAGES[2]).fingerprint() == stage_config(config, SCAN_STAGES[2]).fingerprint()
