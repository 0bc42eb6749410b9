"""What a run takes up, what it leaves alone, which reference sets whose zero: with stages that cost nothing."""

from __future__ import annotations

import json
import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from fake_inbox import (
    FakeStages,
    counts,
    inbox_of,
    rows,
    run_night,
    seal,
    states,
    write_calibration,
    write_rig,
    write_scan,
)

from warehouse.inbox import Inbox
from warehouse.lineage import Ledger
from warehouse.night import Night
from warehouse.planner import plan
from warehouse.state import State
from wheelset_assets.config import Config
from wheelset_assets.quality import ConfigError
from wheelset_assets.stages import CALIBRATION, MEASUREMENT, SCAN_STAGES, TRIANGULATION

DAY = "2025-04-05"
ALL_STAGES = [s.name for s in SCAN_STAGES]


def touch(folder: Path) -> None:
    """Make every file of a bundle look new."""
    for path in folder.rglob("*"):
        os.utime(path, ns=(path.stat().st_mtime_ns + 10**9,) * 2)


def zero_of(warehouse: Path) -> dict[str, str]:
    """For each scan, the reference that its measurement was compared with."""
    query = "SELECT scan_id, input_version FROM lineage WHERE stage = 'measurements' AND input_name = 'reference' AND superseded_at IS NULL"
    return dict(rows(warehouse, query + " AND unit NOT LIKE '%@%'"))


def measured_ids(warehouse: Path) -> list[str]:
    return [r[0] for r in rows(warehouse, "SELECT scan_id FROM measurements ORDER BY 1")]


@pytest.fixture
def warehouse(tmp_path: Path) -> Path:
    return tmp_path / "warehouse"


# --- what is taken up --------------------------------------------------------------------------------------------


def test_a_first_run_does_everything_and_a_second_nothing(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 0)
    ran = stages.take()
    assert len(ran) == len(set(ran)) == 1 + 3 * len(ALL_STAGES) + 1
    before = Ledger(warehouse).files(), [Path(p).stat().st_mtime_ns for p in Ledger(warehouse).files()]
    summary = run_night(inbox, warehouse)
    assert (counts(summary), summary.points, summary.pending) == ((0, 0, 0, 3), 0, 0)
    assert stages.take() == []
    assert before == (Ledger(warehouse).files(), [Path(p).stat().st_mtime_ns for p in Ledger(warehouse).files()])
    assert plan(warehouse, inbox, Config()).idle


def test_a_refused_scan_is_not_tried_again_until_it_changes(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    bad = inbox / "scans" / f"scan-{DAY}-0"
    stray = bad / "stray"
    stray.write_text("x")
    summary = run_night(inbox, warehouse)
    assert counts(summary) == (2, 1, 0, 0)
    (trouble,) = summary.troubles
    assert (trouble["scan_id"], trouble["state"], trouble["stage"]) == (bad.name, "refused", "bundle")
    assert "not listed" in trouble["reason"]
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 3)
    touch(bad)
    assert counts(run_night(inbox, warehouse)) == (0, 1, 0, 2)
    stray.unlink()
    assert counts(run_night(inbox, warehouse)) == (1, 0, 0, 2)
    assert states(warehouse)[bad.name] == ("measured", None)


def test_a_refused_scan_with_a_readable_json_has_its_times(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    bad = inbox / "scans" / f"scan-{DAY}-0"
    (bad / "frames.parquet").write_bytes(b"")
    run_night(inbox, warehouse)
    query = f"SELECT state, rig_id, purpose, acquired_on::VARCHAR, captured_at IS NOT NULL FROM scan_status WHERE scan_id = '{bad.name}'"
    assert rows(warehouse, query) == [("refused", "rig-1", "production", DAY, True)]


@pytest.mark.parametrize("name", [f"scan-{DAY}-0", "a@b", "ö x"])
def test_a_scan_whose_json_cannot_be_read_has_its_row_and_sinks_nothing(
    inbox: Path, warehouse: Path, stages: FakeStages, name: str
) -> None:
    folder = inbox / "scans" / f"scan-{DAY}-0"
    folder.rename(inbox / "scans" / name)
    (inbox / "scans" / name / "scan.json").write_text("{")
    assert counts(run_night(inbox, warehouse)) == (2, 1, 0, 0)
    query = "SELECT scan_id, rig_id, purpose, captured_at, acquired_on FROM scan_status WHERE state = 'refused'"
    assert rows(warehouse, query) == [(name, None, None, None, None)]
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 3)


def test_a_name_that_is_not_utf_8_has_its_row(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    os.rename(inbox / "scans" / f"scan-{DAY}-0", os.fsencode(inbox / "scans") + b"/\xff")
    assert counts(run_night(inbox, warehouse)) == (2, 1, 0, 0)
    assert states(warehouse)["\\xff"][0] == "refused"


def test_touched_but_equal_bundles_count_as_unchanged(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    stages.take()
    for folder in (inbox / "scans").iterdir():
        touch(folder)
    touch(inbox / "calibrations" / "cal-1")
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 3)
    assert stages.take() == []


def test_a_scan_that_was_measured_and_is_broken_now_loses_its_values(
    inbox: Path, warehouse: Path, stages: FakeStages
) -> None:
    run_night(inbox, warehouse)
    bad = f"scan-{DAY}-0"
    (inbox / "scans" / bad / "frames.parquet").write_bytes(b"")
    assert counts(run_night(inbox, warehouse)) == (0, 1, 0, 2)
    assert measured_ids(warehouse) == [f"ref-{DAY}", f"scan-{DAY}-1"]
    assert rows(warehouse, f"SELECT count(*) FROM filtered_clouds WHERE scan_id = '{bad}'") == [(0,)]
    query = "SELECT scan_id, superseded_at IS NOT NULL, superseded_by <> '' FROM measurements_history"
    assert rows(warehouse, query) == [(bad, True, True)]


def test_a_scan_dated_anew_moves(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    moved = f"scan-{DAY}-1"
    seal(inbox / "scans" / moved, captured_at="2025-04-07T10:00:00+08:00")
    assert counts(run_night(inbox, warehouse)) == (1, 0, 0, 2)
    query = f"SELECT count(*), min(acquired_on)::VARCHAR FROM measurements WHERE scan_id = '{moved}'"
    assert rows(warehouse, query) == [(1, "2025-04-07")]
    assert measured_ids(warehouse) == [f"ref-{DAY}", f"scan-{DAY}-0", moved]
    days = rows(warehouse, f"SELECT DISTINCT day FROM filtered_clouds WHERE scan_id = '{moved}'")
    assert days == [("2025-04-07",)]
    assert len(states(warehouse)) == 3


def test_a_deleted_bundle_keeps_its_results(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    stages.take()
    shutil.rmtree(inbox / "scans" / f"scan-{DAY}-0")
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 2)
    assert states(warehouse)[f"scan-{DAY}-0"] == ("measured", None)
    assert len(measured_ids(warehouse)) == 3


def test_a_deleted_reference_still_sets_the_zero(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    shutil.rmtree(inbox / "scans" / f"ref-{DAY}")
    stages.take()
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 2)
    assert stages.take() == []
    write_scan(inbox, "later", f"{DAY}T15:00:00+08:00")
    assert counts(run_night(inbox, warehouse)) == (1, 0, 0, 2)
    assert zero_of(warehouse)["later"] == f"ref-{DAY}"
    write_calibration(inbox, "cal-2")
    write_scan(inbox, "other", f"{DAY}T16:00:00+08:00", calibration_id="cal-2")
    assert counts(run_night(inbox, warehouse)) == (0, 0, 1, 3)
    query = "SELECT reason, details FROM scan_status WHERE scan_id = 'other'"
    (found,) = rows(warehouse, query)
    assert found == ("no reference", f"reference ref-{DAY}@cal-2: its bundle is no longer in the inbox")


# --- rigs and calibrations ---------------------------------------------------------------------------------------


def test_a_late_calibration_makes_its_failed_scans_run(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    shutil.move(inbox / "calibrations" / "cal-1", inbox / "held")
    assert counts(run_night(inbox, warehouse)) == (0, 0, 3, 0)
    assert set(states(warehouse).values()) == {("failed", "calibration cal-1 is not in the inbox")}
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 3)
    shutil.move(inbox / "held", inbox / "calibrations" / "cal-1")
    found = plan(warehouse, inbox, Config())
    assert found.calibrations == ["cal-1"]
    assert [(d.day, d.n_scans) for d in found.days] == [(DAY, 3)]
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 0)


def test_a_refused_calibration_says_why(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    (inbox / "calibrations" / "cal-1" / "more").write_text("x")
    summary = run_night(inbox, warehouse)
    assert counts(summary) == (0, 0, 3, 0)
    (warning,) = summary.warnings
    assert warning.startswith("calibration cal-1 was refused: calibrations/cal-1: file more is not listed")
    reason = states(warehouse)[f"ref-{DAY}"][1]
    assert reason is not None
    assert reason.startswith("calibration cal-1 was refused: calibrations/cal-1: file more is not listed")


def test_a_calibration_that_breaks_later_is_no_longer_used(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    (inbox / "calibrations" / "cal-1" / "more").write_text("x")
    assert counts(run_night(inbox, warehouse)) == (0, 0, 3, 0)
    assert rows(warehouse, "SELECT count(*) FROM calibrations") == [(0,)]
    (inbox / "calibrations" / "cal-1" / "more").unlink()
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 0)


def test_a_calibration_stage_that_fails_fails_its_scans_with_its_reason(
    inbox: Path, warehouse: Path, stages: FakeStages
) -> None:
    stages.failing[CALIBRATION.name, "cal-1"] = "too few boards"
    assert counts(run_night(inbox, warehouse)) == (0, 0, 3, 0)
    assert states(warehouse)[f"ref-{DAY}"] == ("failed", "calibration cal-1: too few boards")


@pytest.mark.parametrize("broken", [True, False])
def test_a_rig_that_is_broken_or_absent_fails_its_scans_alone(
    inbox: Path, warehouse: Path, stages: FakeStages, broken: bool
) -> None:
    write_scan(inbox, "other", f"{DAY}T12:00:00+08:00", rig_id="rig-2")
    if broken:
        (inbox / "rigs" / "rig-2.json").write_text("[]")
    assert counts(run_night(inbox, warehouse)) == (3, 0, 1, 0)
    reason = states(warehouse)["other"][1]
    assert reason is not None
    assert ("rigs/rig-2.json: expected a JSON object" if broken else "rig rig-2 is not in the inbox") in reason
    write_rig(inbox, "rig-2")
    run_night(inbox, warehouse)
    assert states(warehouse)["other"] == ("failed", "no reference")


def test_a_changed_rig_makes_everything_anew(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    stages.take()
    write_rig(inbox, expansion_per_k=12e-6)
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 0)
    assert {s for s, _ in stages.take()} >= {CALIBRATION.name, *ALL_STAGES} - {"repeatability"}


def test_an_inbox_without_rigs_is_no_bug(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    shutil.rmtree(inbox / "rigs")
    assert counts(run_night(inbox, warehouse)) == (0, 0, 3, 0)


# --- references --------------------------------------------------------------------------------------------------


def test_no_reference(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    shutil.rmtree(inbox / "scans" / f"ref-{DAY}")
    assert counts(run_night(inbox, warehouse)) == (0, 0, 2, 0)
    assert set(states(warehouse).values()) == {("failed", "no reference")}


def _is_no_reference(inbox: Path) -> str:
    return f"scan-{DAY}-1"


def _is_not_there(inbox: Path) -> str:
    return "nothing"


def _is_refused(inbox: Path) -> str:
    (write_scan(inbox, "bad-ref", f"{DAY}T07:00:00+08:00", "reference") / "more").write_text("x")
    return "bad-ref"


def _is_of_another_rig(inbox: Path) -> str:
    write_rig(inbox, "rig-2")
    write_scan(inbox, "other-ref", f"{DAY}T07:00:00+08:00", "reference", rig_id="rig-2")
    return "other-ref"


@pytest.mark.parametrize("name", [_is_no_reference, _is_not_there, _is_refused, _is_of_another_rig])
def test_a_named_reference_that_is_unusable(inbox: Path, warehouse: Path, stages: FakeStages, name: object) -> None:
    scan = f"scan-{DAY}-0"
    seal(inbox / "scans" / scan, reference_scan_id=name(inbox))  # type: ignore[operator]
    summary = run_night(inbox, warehouse)
    assert summary.failed == 1
    assert states(warehouse)[scan] == ("failed", "no reference")
    (details,) = rows(warehouse, f"SELECT details FROM scan_status WHERE scan_id = '{scan}'")
    assert "cannot be used" in details[0]
    (trouble,) = [t for t in summary.troubles if t["scan_id"] == scan]
    assert (trouble["reason"], trouble["details"]) == ("no reference", details[0])
    assert states(warehouse)[f"scan-{DAY}-1"] == ("measured", None)


def test_a_named_reference_may_be_newer(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    write_scan(inbox, "late-ref", "2025-04-09T08:00:00+08:00", "reference")
    seal(inbox / "scans" / f"scan-{DAY}-0", reference_scan_id="late-ref")
    assert counts(run_night(inbox, warehouse)) == (4, 0, 0, 0)
    assert zero_of(warehouse)[f"scan-{DAY}-0"] == "late-ref"


def test_references_that_name_each_other_or_themselves_wait_for_nobody(
    inbox: Path, warehouse: Path, stages: FakeStages
) -> None:
    write_scan(inbox, "ref-b", f"{DAY}T08:30:00+08:00", "reference", reference_scan_id="ref-c")
    write_scan(inbox, "ref-c", f"{DAY}T08:40:00+08:00", "reference", reference_scan_id="ref-b")
    write_scan(inbox, "ref-d", f"{DAY}T08:50:00+08:00", "reference", reference_scan_id="ref-d")
    summary = run_night(inbox, warehouse)
    assert (counts(summary), summary.pending) == ((6, 0, 0, 0), 0)
    assert zero_of(warehouse)[f"scan-{DAY}-0"] == "ref-d"
    assert zero_of(warehouse)["ref-c"] == "ref-b"


def test_each_reference_is_compared_with_the_one_before(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    write_scan(inbox, "ref-b", f"{DAY}T08:30:00+08:00", "reference")
    run_night(inbox, warehouse)
    assert zero_of(warehouse) == {
        f"ref-{DAY}": "no earlier reference",
        "ref-b": f"ref-{DAY}",
        f"scan-{DAY}-0": "ref-b",
        f"scan-{DAY}-1": "ref-b",
    }


def test_a_scan_of_the_same_second_uses_the_reference(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    write_scan(inbox, "a-scan", f"{DAY}T08:00:00+08:00")
    run_night(inbox, warehouse)
    assert zero_of(warehouse)["a-scan"] == f"ref-{DAY}"


def test_times_compare_across_offsets(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    write_scan(inbox, "before", f"{DAY}T23:59:00+23:59")  # 2025-04-05 00:00 UTC, as the reference
    write_scan(inbox, "just-before", f"{DAY}T23:58:00+23:59")
    run_night(inbox, warehouse)
    assert states(warehouse)["before"] == ("measured", None)
    assert states(warehouse)["just-before"] == ("failed", "no reference")
    assert rows(warehouse, "SELECT DISTINCT acquired_on::VARCHAR FROM scan_status") == [(DAY,)]


def test_a_reference_arriving_late_re_zeroes_exactly_those_after_it(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=(DAY, "2025-04-06")), tmp_path / "warehouse"
    assert counts(run_night(inbox, warehouse)) == (6, 0, 0, 0)
    stages.take()
    write_scan(inbox, "ref-new", f"{DAY}T09:30:00+08:00", "reference")  # between the two scans of the first day
    found = plan(warehouse, inbox, Config())
    assert [(d.day, d.new) for d in found.days] == [(DAY, ["ref-new"])]
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 4)
    again = {(s, u) for s, u in stages.take() if u not in ("ref-new", "fleet")}
    assert again == {(MEASUREMENT.name, f"scan-{DAY}-1"), (MEASUREMENT.name, "ref-2025-04-06")}
    zero = zero_of(warehouse)
    assert zero[f"scan-{DAY}-0"] == f"ref-{DAY}"
    assert zero[f"scan-{DAY}-1"] == zero["ref-2025-04-06"] == "ref-new"
    assert zero["scan-2025-04-06-0"] == "ref-2025-04-06"


def test_a_reference_that_fails_gives_way_to_the_one_before(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=(DAY, "2025-04-06")), tmp_path / "warehouse"
    stages.failing[SCAN_STAGES[2].name, "ref-2025-04-06"] = "nothing to see"
    assert counts(run_night(inbox, warehouse)) == (5, 0, 1, 0)
    assert zero_of(warehouse)["scan-2025-04-06-0"] == f"ref-{DAY}"


def test_the_fall_back_under_another_calibration_is_found_in_the_same_run(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=(DAY, "2025-04-06"), scans=1), tmp_path / "warehouse"
    write_calibration(inbox, "cal-2")
    for name in ("ref-2025-04-06", "scan-2025-04-06-0"):
        seal(inbox / "scans" / name, calibration_id="cal-2")
    stages.failing[SCAN_STAGES[2].name, "ref-2025-04-06"] = "nothing to see"
    summary = run_night(inbox, warehouse)
    assert (counts(summary), summary.pending) == ((3, 0, 1, 0), 0)
    assert zero_of(warehouse)["scan-2025-04-06-0"] == f"ref-{DAY}"


def test_a_reference_under_another_calibration_is_made_once_and_not_shown(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox"), tmp_path / "warehouse"
    write_calibration(inbox, "cal-2")
    for i in (0, 1):
        seal(inbox / "scans" / f"scan-{DAY}-{i}", calibration_id="cal-2")
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 0)
    assert stages.take().count((TRIANGULATION.name, f"ref-{DAY}@cal-2")) == 1
    for view in ("registrations", "measurements", "filtered_clouds", "readings"):
        assert rows(warehouse, f"SELECT count(*) FROM {view} WHERE scan_id LIKE '%@%'") == [(0,)], view
    assert len(states(warehouse)) == 3
    assert counts(run_night(inbox, warehouse)) == (0, 0, 0, 3)


def test_a_new_calibration_starts_a_new_chain_of_references(tmp_path: Path, stages: FakeStages) -> None:
    """The old reference cannot be read under the new calibration: the new one is the first of its own."""
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=(DAY, "2025-04-06"), scans=1), tmp_path / "warehouse"
    write_calibration(inbox, "cal-2")
    for name in ("ref-2025-04-06", "scan-2025-04-06-0"):
        seal(inbox / "scans" / name, calibration_id="cal-2")
    stages.failing[TRIANGULATION.name, f"ref-{DAY}@cal-2"] = "two years apart"
    assert counts(run_night(inbox, warehouse)) == (4, 0, 0, 0)
    assert zero_of(warehouse)["ref-2025-04-06"] == "no earlier reference"
    assert zero_of(warehouse)["scan-2025-04-06-0"] == "ref-2025-04-06"


# --- failures, limits --------------------------------------------------------------------------------------------


def test_a_failed_scan_drops_what_it_had_downstream(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    config = Config.model_validate({"filtering": {"window_rows": 9}})
    scan = f"scan-{DAY}-0"
    stages.failing[SCAN_STAGES[1].name, scan] = "empty"
    assert counts(run_night(inbox, warehouse, config)) == (2, 0, 1, 0)
    assert measured_ids(warehouse) == [f"ref-{DAY}", f"scan-{DAY}-1"]
    assert rows(warehouse, f"SELECT count(*) FROM registrations WHERE scan_id = '{scan}'") == [(0,)]
    assert rows(warehouse, f"SELECT count(*) FROM triangulated_clouds WHERE scan_id = '{scan}'") == [(1,)]
    history = rows(warehouse, "SELECT scan_id FROM measurements_history ORDER BY 1")
    assert (scan,) in history
    stages.failing.clear()
    run_night(inbox, warehouse)
    assert len(measured_ids(warehouse)) == 3


def test_a_knob_recomputes_its_stage_and_what_follows(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    stages.take()
    config = Config.model_validate({"alignment": {"min_face_mm": 4.0}})
    found = plan(warehouse, inbox, config)
    assert [d.stale for d in found.days] == [{"alignments": [f"ref-{DAY}", f"scan-{DAY}-0", f"scan-{DAY}-1"]}]
    assert counts(run_night(inbox, warehouse, config)) == (3, 0, 0, 0)
    assert {s for s, _ in stages.take()} == {"alignments", "measurements", "repeatability"}


def test_a_bug_ends_the_run_but_what_was_finished_is_kept(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    stages.failing["features", f"scan-{DAY}-1"] = ZeroDivisionError("bug")
    with pytest.raises(ZeroDivisionError) as caught:
        run_night(inbox, warehouse)
    assert caught.value.__notes__ == [f"while features worked on scan-{DAY}-1"]
    stages.failing.clear()
    stages.take()
    assert run_night(inbox, warehouse).measured == 3
    ran = stages.take()
    assert ("triangulated_clouds", f"scan-{DAY}-1") not in ran
    assert ("features", f"scan-{DAY}-0") not in ran
    assert ("features", f"scan-{DAY}-1") in ran


def test_an_interrupt_keeps_what_was_finished(
    inbox: Path, warehouse: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages.failing["triangulated_clouds", f"scan-{DAY}-1"] = KeyboardInterrupt()  # type: ignore[assignment]
    with pytest.raises(KeyboardInterrupt):
        run_night(inbox, warehouse)
    stages.failing.clear()
    stages.take()
    run_night(inbox, warehouse)
    assert ("triangulated_clouds", f"scan-{DAY}-0") not in stages.take()
    assert len(measured_ids(warehouse)) == 3
    assert rows(warehouse, "SELECT count(*) FROM stripe_statistics") == [(3,)]


def test_a_kill_between_write_and_ledger_is_not_seen_and_is_made_good(
    inbox: Path, warehouse: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_night(inbox, warehouse)
    before = rows(
        warehouse, "SELECT unit, output_name, output_version FROM lineage WHERE superseded_at IS NULL ORDER BY ALL"
    )
    config = Config.model_validate({"filtering": {"window_rows": 9}})

    class Killed(BaseException):
        pass

    def kill(ledger: Ledger, day: str) -> None:
        if ledger.day(day).dirty:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Ledger, "save", kill)
        with pytest.raises(Killed):
            run_night(inbox, warehouse, config)
    assert len(list(warehouse.glob("filtered_clouds/*/*/*.parquet"))) == 6
    assert rows(warehouse, "SELECT count(*) FROM filtered_clouds") == [(3,)]
    run_night(inbox, warehouse)
    after = rows(
        warehouse, "SELECT unit, output_name, output_version FROM lineage WHERE superseded_at IS NULL ORDER BY ALL"
    )
    assert after == before


def test_the_time_window_closes_between_tasks_and_the_next_run_goes_on(
    inbox: Path, warehouse: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Night, "out_of_time", lambda self: self.until is not None and len(stages.ran) >= 3)
    summary = run_night(inbox, warehouse, until=datetime.now(UTC) + timedelta(days=1))
    assert len(stages.take()) == 3
    assert (counts(summary), summary.pending) == ((0, 0, 0, 0), 3)
    assert {state for state, _ in states(warehouse).values()} == {"pending"}
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 0)


def test_stale_scans_that_were_not_reached_are_pending_not_unchanged(
    inbox: Path, warehouse: Path, stages: FakeStages
) -> None:
    run_night(inbox, warehouse)
    config = Config.model_validate({"filtering": {"window_rows": 9}})
    summary = run_night(inbox, warehouse, config, until=datetime.now(UTC) - timedelta(hours=1))
    assert (counts(summary), summary.pending) == ((0, 0, 0, 0), 3)


def test_one_scan_and_the_references_behind_it_on_other_days(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = inbox_of(tmp_path / "inbox", days=(DAY, "2025-04-06", "2025-04-07")), tmp_path / "warehouse"
    shutil.rmtree(inbox / "scans" / "ref-2025-04-07")
    summary = run_night(inbox, warehouse, only=frozenset({"scan-2025-04-07-1"}))
    assert (counts(summary), summary.pending) == ((3, 0, 0, 0), 5)
    assert measured_ids(warehouse) == [f"ref-{DAY}", "ref-2025-04-06", "scan-2025-04-07-1"]
    assert counts(run_night(inbox, warehouse)) == (5, 0, 0, 3)


def test_dates_far_back_and_ahead_are_data(tmp_path: Path, stages: FakeStages) -> None:
    inbox, warehouse = tmp_path / "inbox", tmp_path / "warehouse"
    write_rig(inbox)
    write_calibration(inbox)
    write_scan(inbox, "ref", "0001-01-01T00:00:00+00:00", "reference")
    write_scan(inbox, "old", "0001-01-02T00:00:00+14:00")
    write_scan(inbox, "far", "9999-12-31T23:59:59Z")
    assert counts(run_night(inbox, warehouse)) == (3, 0, 0, 0)
    found = dict(rows(warehouse, "SELECT scan_id, acquired_on::VARCHAR FROM measurements"))
    assert found == {"ref": "0001-01-01", "old": "0001-01-02", "far": "9999-12-31"}


def test_an_empty_inbox_makes_an_empty_warehouse(tmp_path: Path, stages: FakeStages) -> None:
    (tmp_path / "inbox" / "scans").mkdir(parents=True)
    assert counts(run_night(tmp_path / "inbox", tmp_path / "warehouse")) == (0, 0, 0, 0)
    assert stages.take() == []
    assert rows(tmp_path / "warehouse", "SELECT count(*) FROM lineage") == [(0,)]


def test_a_warehouse_that_cannot_be_made(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match="cannot hold a warehouse"):
        run_night(inbox, tmp_path / "file")
    with pytest.raises(ConfigError, match="cannot hold a warehouse"):
        run_night(inbox, tmp_path / "file" / "below")


def test_state_reads_no_more_than_the_ledger(inbox: Path, warehouse: Path, stages: FakeStages) -> None:
    run_night(inbox, warehouse)
    state = State(Inbox(inbox), Ledger(warehouse), Config())
    assert state.unknown_bundles() == []
    state.arrange()
    assert state.days() == [DAY]
    assert [u.key for u in state.units(DAY)] == [f"ref-{DAY}", f"scan-{DAY}-0", f"scan-{DAY}-1"]
    assert state.stale_calibrations() == []
    assert json.loads(json.dumps(plan(warehouse, inbox, Config()).as_json()))["idle"] is True
