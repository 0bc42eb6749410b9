"""The ledger: what is current, what superseded what, and that a day's file is the old one or the new one."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from warehouse.lineage import (
    BUNDLE,
    CALIBRATION_DAY,
    FLEET_DAY,
    UNDATED,
    DayLedger,
    Ledger,
    Output,
    Record,
    as_json,
    git_commit,
    package_versions,
)

NOON = datetime(2025, 4, 5, 12, tzinfo=UTC)


def record(
    unit: str = "s-1", stage: str = "features", version: str = "v1", state: str = "ok", **changes: object
) -> Record:
    outputs = (Output("features", f"features/{version}.parquet", version, 3, 100),) if state == "ok" else ()
    made = Record(
        unit, unit, stage, state, None if state == "ok" else "why", f"f-{version}", "1.1", "c", (("a", "b"),), outputs
    )
    return replace(made, **({"produced_at": NOON, "run_id": "r"} | changes))  # type: ignore[arg-type]


def test_records_survive_writing_and_reading(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    first = record(
        header='{"scan_id": "s-1"}', signature="sig", seconds=1.5, points=7, packages="numpy 2", git_commit="abc+"
    )
    ledger.day("2025-04-05").put(first)
    ledger.day("2025-04-05").put(record(stage="alignments", state="failed"))
    ledger.save("2025-04-05")
    again = Ledger(tmp_path).day("2025-04-05")
    assert again.get("s-1", "features") == first
    assert again.get("s-1", "alignments") == record(stage="alignments", state="failed")
    assert again.get("s-2", "features") is None
    assert as_json(first)["inputs"] == {"a": "b"}
    assert "header" not in as_json(first)


def test_a_superseded_version_goes_to_the_history_with_when_and_by_what(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    day = ledger.day("2025-04-05")
    day.put(record())
    later = NOON + timedelta(hours=1)
    day.put(replace(record(version="v2"), produced_at=later))
    ledger.save("2025-04-05")
    again = Ledger(tmp_path).day("2025-04-05")
    assert again.current["s-1", "features"].version == "v2"
    (old,) = again.history
    assert (old.version, old.superseded_at, old.superseded_by) == ("v1", later, "v2")
    assert [r.version for r in again.records()] == ["v2", "v1"]


def test_equal_data_and_failures_leave_no_history() -> None:
    day = DayLedger("2025-04-05")
    day.put(record(state="failed"))
    day.put(record())
    day.put(record(run_id="another"))
    assert day.history == []
    assert day.current["s-1", "features"].run_id == "another"
    day.put(record(state="failed"))
    assert [r.version for r in day.history] == ["v1"]


def test_days_bundles_and_what_is_no_day(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    for day in ("2025-04-06", "2025-04-05", CALIBRATION_DAY, FLEET_DAY, UNDATED):
        ledger.day(day).put(record(unit=f"on {day}", stage=BUNDLE))
        ledger.save(day)
    again = Ledger(tmp_path)
    assert again.days() == ["2025-04-05", "2025-04-06"]
    assert again.bundle(f"on {UNDATED}") == (UNDATED, ledger.day(UNDATED).get(f"on {UNDATED}", BUNDLE))
    found = again.bundle("on 2025-04-06")
    assert found is not None
    assert found[0] == "2025-04-06"
    assert again.bundle(f"on {CALIBRATION_DAY}") is None
    assert len(again.files()) == 5


def test_only_what_changed_is_written(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.day("2025-04-05")
    ledger.save("2025-04-05")
    assert ledger.files() == []
    ledger.day("2025-04-05").put(record())
    ledger.save("2025-04-05")
    (path,) = ledger.files()
    before = Path(path).stat().st_mtime_ns
    ledger.save("2025-04-05")
    assert Path(path).stat().st_mtime_ns == before


def test_a_kill_while_saving_leaves_the_old_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = Ledger(tmp_path)
    ledger.day("2025-04-05").put(record())
    ledger.save("2025-04-05")

    def kill(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("warehouse.store.os.replace", kill)
    ledger.day("2025-04-05").put(record(version="v2"))
    with pytest.raises(KeyboardInterrupt):
        ledger.save("2025-04-05")
    assert ledger.day("2025-04-05").dirty
    assert Ledger(tmp_path).day("2025-04-05").current["s-1", "features"].version == "v1"
    assert Ledger(tmp_path).days() == ["2025-04-05"]


def test_version_of_a_record() -> None:
    two = replace(record(), outputs=(Output("a", "", "1", 0, 0), Output("b", "", "2", 0, 0)))
    assert two.version == "1+2"
    assert record(state="failed").version == "f-v1"
    assert two.output("b").version == "2"
    with pytest.raises(KeyError, match="features of s-1 wrote no c"):
        two.output("c")


def test_receipts_name_commit_and_packages() -> None:
    commit = git_commit()
    assert commit is None or len(commit.rstrip("+")) == 40
    assert "numpy" in package_versions()
