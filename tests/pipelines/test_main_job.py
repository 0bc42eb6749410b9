"""The main job from end to end: what is measured, what is refused and why, what is recomputed and what is not."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import duckdb
import pyarrow.parquet as pq
import pytest
from scipy import stats
from small_campaign import Campaign, run, simulated


def ask(warehouse: Path, query: str) -> list[tuple]:
    """Rows of a query, as any client of the catalog would ask it."""
    with duckdb.connect(str(warehouse / "warehouse.duckdb"), read_only=True) as connection:
        return connection.execute(query).fetchall()


def versions(warehouse: Path) -> set[tuple]:
    """Every current output with its version and inputs: what two warehouses must agree in."""
    return set(
        ask(
            warehouse,
            "SELECT unit, stage, output_name, output_version, input_name, input_version FROM lineage WHERE superseded_at IS NULL",
        )
    )


def test_faulty_scans_are_named_and_the_others_measured(campaign: Campaign) -> None:
    status = {row[0]: row[1:] for row in ask(campaign.warehouse, "SELECT scan_id, state, reason FROM scan_status")}
    expected = {"corrupt": "refused", "wrong-hash": "refused", "missing-image": "refused", "empty-stripes": "failed"}
    words = {
        "corrupt": "not readable as Parquet",
        "wrong-hash": "sha256",
        "missing-image": "is missing",
        "empty-stripes": "empty",
    }
    for scan, kind in campaign.faults.items():
        state, reason = status.pop(scan)
        assert state == expected[kind]
        assert words[kind] in reason
    assert status
    assert {state for state, _ in status.values()} == {"measured"}
    assert campaign.summary["refused"] == 3
    assert campaign.summary["failed"] == 1
    assert campaign.summary["measured"] == len(status)


def test_failed_scan_has_its_recording(campaign: Campaign) -> None:
    rows = ask(campaign.warehouse, "SELECT state, recording FROM scan_status WHERE state <> 'measured'")
    for state, recording in rows:
        assert (recording is not None) == (state == "failed")
        if recording:
            assert Path(recording).stat().st_size > 1000


def test_values_lie_within_their_uncertainty_of_the_truth_but_not_suspiciously(campaign: Campaign) -> None:
    truth = campaign.inbox.with_name("inbox.truth.parquet")
    rows = ask(
        campaign.warehouse,
        f"""SELECT (value - truth_mm) / (expanded_uncertainty / 2)
        FROM measurements JOIN read_parquet('{truth}') USING (scan_id, quantity, side)
        WHERE purpose = 'production' AND value IS NOT NULL
        AND quantity IN ('wheel_diameter', 'journal_diameter', 'inner_distance', 'shoulder_distance')""",
    )
    pulls = [row[0] for row in rows]
    assert len(pulls) >= 20
    # Scans of a day share their reference, so the pulls are not independent: two days leave about 12 degrees of freedom.
    mean_square = sum(p * p for p in pulls) / len(pulls)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 12) / 12
    assert low < mean_square < high


def test_every_value_has_uncertainty_and_every_refusal_a_reason(campaign: Campaign) -> None:
    assert ask(campaign.warehouse, "SELECT count(*) FROM measurements WHERE (value IS NULL) = (reason IS NULL)") == [
        (0,)
    ]
    assert ask(
        campaign.warehouse, "SELECT count(*) FROM measurements WHERE value IS NOT NULL AND NOT expanded_uncertainty > 0"
    ) == [(0,)]
    first = ask(
        campaign.warehouse,
        "SELECT DISTINCT reason FROM measurements WHERE scan_id = (SELECT min(scan_id) FROM scan_status WHERE purpose = 'reference')",
    )
    assert first == [("no earlier reference",)]


def test_second_run_recomputes_nothing(campaign: Campaign, tmp_path: Path) -> None:
    copy = campaign.copy(tmp_path)
    before = versions(copy.warehouse)
    again = run(copy.inbox, copy.warehouse)
    assert {k: again[k] for k in ("measured", "refused", "failed", "points")} == {
        "measured": 0,
        "refused": 0,
        "failed": 0,
        "points": 0,
    }
    assert again["unchanged"] == len(list((copy.inbox / "scans").iterdir()))
    assert versions(copy.warehouse) == before


def test_a_knob_of_filtering_recomputes_filtering_and_downstream_only(campaign: Campaign, tmp_path: Path) -> None:
    copy = campaign.copy(tmp_path)
    config = tmp_path / "knobs.toml"
    config.write_text("[filtering]\ngaussian_sigma_rows = 0.7\n")
    made = "SELECT unit, stage, run_id FROM lineage WHERE superseded_at IS NULL AND stage NOT IN ('bundle', 'repeatability')"
    before = {(u, s): r for u, s, r in ask(copy.warehouse, made)}
    run(copy.inbox, copy.warehouse, config=config)
    after = {(u, s): r for u, s, r in ask(copy.warehouse, made)}
    recomputed = {stage for (unit, stage), run_id in after.items() if before[unit, stage] != run_id}
    assert recomputed == {"filtered_clouds", "features", "registrations", "alignments", "measurements"}
    kept = {stage for (unit, stage), run_id in after.items() if before[unit, stage] == run_id}
    assert kept == {"calibrations", "triangulated_clouds"}
    history = ask(copy.warehouse, "SELECT count(*), count(superseded_at) FROM measurements_history")[0]
    assert history[0] == history[1] > 0


def test_a_new_scan_computes_itself_only(campaign: Campaign, tmp_path: Path) -> None:
    copy = campaign.copy(tmp_path)
    held_back = tmp_path / "held"
    good = next(
        s
        for (s,) in ask(
            copy.warehouse,
            "SELECT scan_id FROM scan_status WHERE state = 'measured' AND purpose = 'production' ORDER BY 1",
        )
    )
    shutil.move(copy.inbox / "scans" / good, held_back)
    shutil.rmtree(copy.warehouse)
    run(copy.inbox, copy.warehouse)
    before = {(u, s): r for u, s, r in ask(copy.warehouse, "SELECT unit, stage, run_id FROM lineage")}
    shutil.move(held_back, copy.inbox / "scans" / good)
    summary = run(copy.inbox, copy.warehouse)
    assert summary["measured"] == 1
    changed = {
        (u, s)
        for u, s, r in ask(copy.warehouse, "SELECT unit, stage, run_id FROM lineage WHERE superseded_at IS NULL")
        if before.get((u, s)) != r
    }
    assert {unit for unit, _ in changed} == {good, "fleet"}
    assert versions(copy.warehouse) == versions(campaign.warehouse)


@pytest.mark.parametrize("workers", [1, 4])
def test_data_do_not_depend_on_the_number_of_workers(campaign: Campaign, tmp_path: Path, workers: int) -> None:
    run(campaign.inbox, tmp_path / "warehouse", workers=workers)
    assert versions(tmp_path / "warehouse") == versions(campaign.warehouse)


def test_moved_warehouse_is_readable(campaign: Campaign, tmp_path: Path) -> None:
    from pipelines.ask import query

    shutil.copytree(campaign.warehouse, tmp_path / "elsewhere")
    n = query(tmp_path / "elsewhere", "SELECT count(*) AS n FROM filtered_clouds").to_pylist()[0]["n"]
    assert n == ask(campaign.warehouse, "SELECT count(*) FROM filtered_clouds")[0][0] > 0
    assert (
        str(tmp_path)
        in ask(tmp_path / "elsewhere", "SELECT sql FROM duckdb_views() WHERE view_name = 'filtered_clouds'")[0][0]
    )


def test_views_are_typed_before_the_first_row(tmp_path: Path) -> None:
    (tmp_path / "inbox" / "scans").mkdir(parents=True)
    summary = run(tmp_path / "inbox", tmp_path / "warehouse")
    assert summary["measured"] == 0
    kinds = dict(ask(tmp_path / "warehouse", "SELECT column_name, column_type FROM (DESCRIBE measurements)"))
    assert kinds["value"] == "DOUBLE"
    assert kinds["captured_at"] == "TIMESTAMP WITH TIME ZONE"
    assert kinds["acquired_on"] == "DATE"
    assert kinds["quality_flags"] == "VARCHAR[]"
    contract = (
        "measurements measurements_history scan_status calibrations triangulated_clouds filtered_clouds features registrations "
        "alignments repeatability budgets reference_values lineage"
    )
    for view in contract.split():
        assert ask(tmp_path / "warehouse", f"SELECT count(*) FROM {view}") == [(0,)], view


def test_lineage_reaches_the_hashes_of_the_files(campaign: Campaign) -> None:
    scan = ask(
        campaign.warehouse, "SELECT min(scan_id) FROM scan_status WHERE state = 'measured' AND purpose = 'production'"
    )[0][0]
    listed = json.loads((campaign.inbox / "scans" / scan / "scan.json").read_text())["files"]
    raw = dict(
        ask(
            campaign.warehouse,
            f"SELECT input_name, input_version FROM lineage WHERE scan_id = '{scan}' AND stage = 'bundle'",
        )
    )
    assert {k: v for k, v in raw.items() if k != "scan.json"} == listed
    chain = ask(campaign.warehouse, f"SELECT DISTINCT stage FROM lineage WHERE scan_id = '{scan}'")
    assert len(chain) == 7


def test_all_assets_of_a_scan_take_at_most_twenty_bytes_a_point(campaign: Campaign) -> None:
    scan, points = ask(
        campaign.warehouse, "SELECT scan_id, n_points FROM scan_status WHERE state = 'measured' ORDER BY 1 LIMIT 1"
    )[0]
    stored = sum(p.stat().st_size for p in campaign.warehouse.rglob(f"scan_id={scan}/*.parquet"))
    assert stored > 0
    assert stored / points <= 20


def test_crash_before_the_ledger_leaves_nothing_visible_and_the_next_run_resumes(
    campaign: Campaign, tmp_path: Path
) -> None:
    """Files without a ledger are what a kill leaves; they must neither be seen nor be in the way."""
    copy = campaign.copy(tmp_path)
    day = max((copy.warehouse / "_ledger").glob("day=20*.parquet"))
    day.unlink()
    (copy.warehouse / "measurements" / ".tmp-1-measurements.parquet").write_bytes(b"torn")
    run(copy.inbox, copy.warehouse)
    assert versions(copy.warehouse) == versions(campaign.warehouse)
    assert not list(copy.warehouse.rglob(".tmp-*"))


def test_a_second_writer_is_turned_away(campaign: Campaign) -> None:
    from warehouse.lock import WarehouseLock
    from wheelset_assets.quality import ConfigError

    lock = WarehouseLock(campaign.warehouse)
    lock.acquire()
    try:
        with pytest.raises(ConfigError, match="another run"):
            WarehouseLock(campaign.warehouse).acquire()
    finally:
        lock.release()


def test_reference_of_another_calibration_is_triangulated_again(tmp_path: Path) -> None:
    """A scan that names a newer calibration is compared with its reference under that calibration, and says so."""
    simulated(tmp_path / "inbox", wheelsets=1, days=1, repeats=1)
    old = next((tmp_path / "inbox" / "calibrations").iterdir())
    new = old.with_name("cal-again")
    shutil.copytree(old, new)
    header = json.loads((new / "calibration.json").read_text())
    (new / "calibration.json").write_text(json.dumps(header | {"calibration_id": "cal-again"}))
    scan = next(p for p in (tmp_path / "inbox" / "scans").iterdir() if not p.name.startswith("ref"))
    header = json.loads((scan / "scan.json").read_text())
    (scan / "scan.json").write_text(json.dumps(header | {"calibration_id": "cal-again"}))
    summary = run(tmp_path / "inbox", tmp_path / "warehouse")
    assert summary["measured"] == 2
    rows = ask(
        tmp_path / "warehouse",
        f"SELECT value IS NOT NULL, quality_flags FROM measurements WHERE scan_id = '{scan.name}' AND quantity = 'wheel_diameter'",
    )
    assert rows
    for known, flags in rows:
        assert known
        assert "reference_of_another_calibration" in flags
    assert ask(tmp_path / "warehouse", "SELECT count(*) FROM registrations WHERE scan_id LIKE '%@%'") == [(0,)]


@pytest.mark.parametrize("rig", ["compact", "wide"])
def test_other_rigs_are_measured_by_the_defaults(tmp_path: Path, rig: str) -> None:
    """Two laser lines a sensor and one sensor a wheel; or three sensors a wheel and two a journal. Truth within 1.5 U."""
    simulated(tmp_path / "inbox", wheelsets=1, days=1, repeats=2, rig=rig, rows=1024, frames=24, seed=9, profile="LMA")
    assert run(tmp_path / "inbox", tmp_path / "warehouse")["measured"] == 3
    rows = ask(
        tmp_path / "warehouse",
        f"""SELECT quantity, side, (value - truth_mm) / expanded_uncertainty
        FROM measurements JOIN read_parquet('{tmp_path / "inbox.truth.parquet"}') USING (scan_id, quantity, side)
        WHERE purpose = 'production' AND value IS NOT NULL
        AND quantity IN ('wheel_diameter', 'journal_diameter', 'inner_distance', 'shoulder_distance')""",
    )
    assert len(rows) == 12
    assert all(abs(ratio) < 1.5 for _, _, ratio in rows), rows
    assert max(abs(ratio) for _, _, ratio in rows) > 0.05


def test_an_unregistered_sensor_enters_no_value(campaign: Campaign, tmp_path: Path) -> None:
    """A sensor whose pose is known to 2 mm only must not be measured with, and its station says so."""
    config = tmp_path / "knobs.toml"
    config.write_text("[registration]\nmin_pairs = 100000\n")
    copy = campaign.copy(tmp_path)
    run(copy.inbox, copy.warehouse, config=config)
    methods = ask(copy.warehouse, "SELECT DISTINCT method FROM registrations")
    assert set(methods) == {("nominal",), ("single",)}
    rows = ask(
        copy.warehouse,
        "SELECT value, quality_flags FROM measurements WHERE purpose = 'production' AND quantity = 'flange_thickness'",
    )
    assert rows
    assert all(value is None or "no_registration" in flags for value, flags in rows)


LIMITS_MM = {
    "journal_diameter": (0.003, 0.002),
    "wheel_diameter": (0.010, 0.006),
    "inner_distance": (0.010, 0.008),
    "shoulder_distance": (0.010, 0.012),
}
"""Largest error and largest expanded uncertainty on the bench's inbox."""


def test_bench_inbox(shared_data: Path, tmp_path: Path) -> None:
    """An inbox made by a program that shares no code with this one."""
    summary = run(shared_data / "bench-inbox", tmp_path / "warehouse", workers=2)
    assert summary["measured"] == 3
    assert summary["refused"] == summary["failed"] == 0
    rows = ask(
        tmp_path / "warehouse",
        "SELECT scan_id, quantity, side, value, expanded_uncertainty FROM measurements WHERE purpose = 'production'",
    )
    values = {row[:3]: row[3:] for row in rows}
    with (shared_data / "bench-inbox.expected.csv").open() as file:
        expected = {(r["scan_id"], r["quantity"], r["side"]): float(r["truth_mm"]) for r in csv.DictReader(file)}
    assert len(expected) == 12
    ratios = []
    for key, truth in expected.items():
        value, u = values[key]
        largest, largest_u = LIMITS_MM[key[1]]
        assert abs(value - truth) <= largest, key
        assert u <= largest_u, key
        ratios.append(abs(value - truth) / u)
    assert sum(r > 1 for r in ratios) <= 1
    assert max(ratios) <= 1.5
    assert max(ratios) > 0.05  # an error far below every claim would mean that the claims are padded
    stored = pq.read_table(next((tmp_path / "warehouse" / "measurements").rglob("*.parquet")))
    assert stored.num_rows == len(rows) * 3 // 2  # the reference scan has a row for every quantity, too


def test_the_time_of_every_stage_over_every_scan_can_be_asked(campaign: Campaign) -> None:
    rows = ask(
        campaign.warehouse,
        "SELECT stage, count(*), min(seconds), sum(n_points), bool_and(n_rows > 0) FROM stage_runs WHERE state = 'ok' GROUP BY 1",
    )
    found = {stage: rest for stage, *rest in rows}
    measured, points = campaign.summary["measured"], campaign.summary["points"]
    assert found["measurements"][0] >= measured
    assert found["triangulated_clouds"][2] == points
    assert all(least > 0 and wrote for _, least, _, wrote in found.values())
    bad = dict(ask(campaign.warehouse, "SELECT scan_id, state FROM stage_runs WHERE state <> 'ok'"))
    assert 0 < len(bad) < len(campaign.faults), "those refused before any stage are not among them"
    assert set(bad) < set(campaign.faults)
    assert all(ask(campaign.warehouse, "SELECT reason IS NOT NULL FROM stage_runs WHERE state <> 'ok'")[0])
