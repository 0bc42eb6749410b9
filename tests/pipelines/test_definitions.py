"""What Dagster sees: a golden snapshot, the schedule and the sensor asked in process, and a day made by Dagster itself."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import dagster as dg
import duckdb
import pytest
from dagster._core.definitions.partitions.context import partition_loading_context
from small_campaign import Campaign

from pipelines.assets import DAYS_NAME, build_assets
from pipelines.definitions import defs
from pipelines.history import run_tags
from pipelines.schedules import nightly
from pipelines.sensors import inbox_sensor
from warehouse.bounds import DiskFull
from warehouse.lock import WarehouseLock
from warehouse.night import Night
from warehouse.planner import DayPlan, Plan
from wheelset_assets.config import Config
from wheelset_assets.quality import flag_names

GOLDEN = Path(__file__).with_name("definitions.json")
DAYS = ["2025-04-05", "2025-04-06"]


def snapshot() -> dict[str, Any]:
    """Everything of the definitions that users and other code locations rely on."""
    assets: dict[str, Any] = {}
    for made in build_assets(Config()):
        (spec,) = made.specs
        columns = spec.metadata["dagster/column_schema"].columns
        assets[spec.key.to_user_string()] = {
            "deps": sorted(dep.asset_key.to_user_string() for dep in spec.deps),
            "partitions": made.partitions_def.name
            if isinstance(made.partitions_def, dg.DynamicPartitionsDefinition)
            else None,
            "checks": sorted(check.name for check in made.check_specs),
            "tables": spec.metadata["tables"],
            "columns": [column.name for column in columns],
            "group": spec.group_name,
            "kinds": sorted(spec.kinds),
            "described": bool(spec.description) and all(column.description for column in columns),
            "versioned": bool(spec.code_version),
        }
    return {
        "assets": assets,
        "schedules": {s.name: {"cron": s.cron_schedule, "job": s.job_name} for s in defs.schedules or []},
        "sensors": {s.name: {"job": s.job_name, "every_s": s.minimum_interval_seconds} for s in defs.sensors or []},  # type: ignore[union-attr]
        "resources": sorted(defs.resources or {}),
    }


def test_the_snapshot_is_the_golden_one() -> None:
    """A change on purpose: WHEELSET_GOLDEN=1 writes the snapshot anew, and the diff is reviewed."""
    found = snapshot()
    if os.environ.get("WHEELSET_GOLDEN"):
        GOLDEN.write_text(json.dumps(found, indent=1) + "\n")
    assert found == json.loads(GOLDEN.read_text())


def test_code_versions_follow_the_knobs() -> None:
    changed = Config.model_validate({"filtering": {"window_rows": 9}})
    versions = [
        {a.key.to_user_string(): next(iter(a.specs)).code_version for a in build_assets(c)} for c in (Config(), changed)
    ]
    assert {name for name in versions[0] if versions[0][name] != versions[1][name]} == {"filtered_clouds"}


def test_dagster_validates_the_module(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "dagster", "definitions", "validate", "-m", "pipelines.definitions"],
        capture_output=True,
        text=True,
        env=os.environ | {"DAGSTER_HOME": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr[-2000:]


# --- schedule and sensor -----------------------------------------------------------------------------------------


@pytest.fixture
def copy(campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Campaign:
    """A copy of the campaign, to which the environment points."""
    copied = campaign.copy(tmp_path)
    monkeypatch.setenv("WHEELSET_INBOX", str(copied.inbox))
    monkeypatch.setenv("WHEELSET_WAREHOUSE", str(copied.warehouse))
    monkeypatch.setenv("WHEELSET_WORKERS", "0")
    monkeypatch.delenv("WHEELSET_CONFIG", raising=False)
    return copied


def scheduled(instance: dg.DagsterInstance) -> list[str | None]:
    """Partitions that the schedule asks for."""
    moment = datetime(2025, 5, 1, 2, tzinfo=UTC)
    with dg.build_schedule_context(
        instance, scheduled_execution_time=moment, repository_def=defs.get_repository_def()
    ) as context:
        asked = nightly.evaluate_tick(context)
    return [request.partition_key for request in asked.run_requests or []]


def sensed(
    instance: dg.DagsterInstance, cursor: str | None
) -> tuple[list[str | None], list[str | None], str | None, str | None]:
    """Partitions and run keys that the sensor asks for, its new cursor, and why it skipped."""
    with (
        dg.build_sensor_context(instance, cursor=cursor, repository_def=defs.get_repository_def()) as context,
        partition_loading_context(dynamic_partitions_store=instance),
    ):
        asked = inbox_sensor.evaluate_tick(context)
    requests = asked.run_requests or []
    return [r.partition_key for r in requests], [r.run_key for r in requests], asked.cursor, asked.skip_message


def test_idle_is_skipped(copy: Campaign) -> None:
    with dg.DagsterInstance.local_temp() as instance:
        assert scheduled(instance) == []
        assert sensed(instance, None)[::3] == ([], "nothing is new or stale")


def test_exactly_the_days_with_work_are_asked_for(copy: Campaign, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = copy.inbox / "scans" / "ref-20250406"
    os.utime(scan / "frames.parquet", ns=(1, 1))
    with dg.DagsterInstance.local_temp() as instance:
        assert scheduled(instance) == ["2025-04-06"]
        assert list(instance.get_dynamic_partitions(DAYS_NAME)) == ["2025-04-06"]
    shutil.rmtree(copy.warehouse)
    with dg.DagsterInstance.local_temp() as instance:
        assert scheduled(instance) == DAYS
        days, keys, cursor, _ = sensed(instance, None)
        assert days == DAYS
        assert len(set(keys)) == 2
        for _ in range(2):  # whatever was launched has died: it is asked for again, under other keys, but not for ever
            days, again, cursor, _ = sensed(instance, cursor)
            assert days == DAYS
            assert not set(keys) & set(again)
        assert "asked for 3 times already" in str(sensed(instance, cursor)[3])


def test_what_was_asked_for_is_waited_for(copy: Campaign) -> None:
    os.utime(copy.inbox / "scans" / "ref-20250406" / "frames.parquet", ns=(1, 1))
    with dg.DagsterInstance.local_temp() as instance:
        run = dg.DagsterRun("night", status=dg.DagsterRunStatus.STARTING)
        instance.add_run(run)
        assert "have not ended yet" in str(sensed(instance, None)[3])
        instance.delete_run(run.run_id)
        assert sensed(instance, None)[0] == ["2025-04-06"]


def test_a_bundle_that_came_anew_during_the_run_is_asked_for(copy: Campaign) -> None:
    """Its name and its day are the same as before: what counts is that it is another bundle."""
    frames = copy.inbox / "scans" / "ref-20250406" / "frames.parquet"
    with dg.DagsterInstance.local_temp() as instance:
        os.utime(frames, ns=(1, 1))
        _, first, cursor, _ = sensed(instance, None)
        for _ in range(2):
            cursor = sensed(instance, cursor)[2]
        assert sensed(instance, cursor)[0] == []
        os.utime(frames, ns=(2, 2))
        days, second, _, _ = sensed(instance, cursor)
        assert days == ["2025-04-06"]
        assert not set(first) & set(second)


def test_a_run_of_the_command_line_that_was_killed_is_closed(copy: Campaign) -> None:
    """By whoever next holds the lock, or finds it free; or it would be under way for ever and keep all others waiting."""
    os.utime(copy.inbox / "scans" / "ref-20250406" / "frames.parquet", ns=(1, 1))
    with dg.DagsterInstance.local_temp() as instance:
        dead = dg.DagsterRun(
            "__ephemeral_asset_job__", status=dg.DagsterRunStatus.STARTED, tags=run_tags(copy.warehouse, "gone")
        )
        others = dg.DagsterRun("somebody", status=dg.DagsterRunStatus.STARTED)
        elsewhere = dg.DagsterRun(
            "x", status=dg.DagsterRunStatus.STARTED, tags=run_tags(copy.warehouse.parent / "other", "lives")
        )
        for run in (dead, others, elsewhere):
            instance.add_run(run)
        lock = WarehouseLock(copy.warehouse)
        lock.acquire()
        sensed(instance, None)
        assert instance.get_run_by_id(dead.run_id).status == dg.DagsterRunStatus.STARTED  # type: ignore[union-attr]
        lock.release()
        assert sensed(instance, None)[0] == ["2025-04-06"]
        assert instance.get_run_by_id(dead.run_id).status == dg.DagsterRunStatus.FAILURE  # type: ignore[union-attr]
        for run in (others, elsewhere):
            assert instance.get_run_by_id(run.run_id).status == dg.DagsterRunStatus.STARTED  # type: ignore[union-attr]


def test_equal_work_weeks_apart_is_asked_for_again(
    copy: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "knobs.toml"
    config.write_text("[alignment]\nmin_face_mm = 4.0\n")
    with dg.DagsterInstance.local_temp() as instance:
        monkeypatch.setenv("WHEELSET_CONFIG", str(config))
        days, first, cursor, _ = sensed(instance, None)
        assert days == DAYS
        monkeypatch.delenv("WHEELSET_CONFIG")
        _, _, cursor, why = sensed(instance, cursor)
        assert why == "nothing is new or stale"
        monkeypatch.setenv("WHEELSET_CONFIG", str(config))
        days, second, _, _ = sensed(instance, cursor)
        assert days == DAYS
        assert not set(first) & set(second)


def test_a_late_calibration_is_asked_for_with_its_days(copy: Campaign, tmp_path: Path) -> None:
    calibration = next((copy.inbox / "calibrations").iterdir())
    (calibration / "calibration.json").write_text((calibration / "calibration.json").read_text() + "\n")
    with dg.DagsterInstance.local_temp() as instance:
        assert scheduled(instance) == DAYS


def test_what_has_no_day_is_asked_for_too(copy: Campaign) -> None:
    (copy.inbox / "scans" / "unreadable").mkdir()
    (copy.inbox / "scans" / "unreadable" / "scan.json").write_text("{")
    with dg.DagsterInstance.local_temp() as instance:
        assert scheduled(instance) == ["undated"]
    from pipelines.schedules import requests

    with dg.DagsterInstance.local_temp() as instance:
        unnamed = Plan([], ["cal-9"], 0, None)
        assert [r.partition_key for r in requests(unnamed, instance, "x")] == ["undated"]
        both = Plan([DayPlan("2025-04-05", ["a"]), DayPlan("undated", ["b"])], [], 2, None)
        assert [r.partition_key for r in requests(both, instance, "x")] == ["2025-04-05"]


def test_the_sensor_waits_for_a_run_under_way(copy: Campaign) -> None:
    shutil.rmtree(copy.inbox / "scans" / "ref-20250405")
    lock = WarehouseLock(copy.warehouse)
    lock.acquire()
    try:
        with dg.DagsterInstance.local_temp() as instance:
            _, _, _, why = sensed(instance, "3:abc")
        assert why is not None
        assert "a run is under way" in why
    finally:
        lock.release()


# --- runs that Dagster launches ----------------------------------------------------------------------------------

CURRENT = "SELECT unit, stage, output_name, output_version, input_name, input_version FROM lineage WHERE superseded_at IS NULL"


def lineage(warehouse: Path, day: str) -> set[tuple]:
    """Outputs and inputs of a day's scans."""
    with duckdb.connect(str(warehouse / "warehouse.duckdb"), read_only=True) as connection:
        return set(
            connection.execute(
                CURRENT + f" AND scan_id IN (SELECT scan_id FROM scan_status WHERE acquired_on = '{day}')"
            ).fetchall()
        )


def data_versions(instance: dg.DagsterInstance, day: str) -> dict[str, str | None]:
    """Data version of every asset's newest materialization on a day."""
    found = {}
    for asset in build_assets(Config()):
        if asset.partitions_def is not None:
            (record,) = instance.fetch_materializations(
                dg.AssetRecordsFilter(asset.key, asset_partitions=[day]), limit=1
            ).records
            assert record.asset_materialization is not None
            found[asset.key.to_user_string()] = (record.asset_materialization.tags or {}).get("dagster/data_version")
    return found


def test_a_day_made_by_dagster_is_the_day_made_by_the_command_line(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    day = DAYS[0]
    monkeypatch.setenv("WHEELSET_INBOX", str(campaign.inbox))
    monkeypatch.setenv("WHEELSET_WAREHOUSE", str(tmp_path / "warehouse"))
    monkeypatch.setenv("WHEELSET_WORKERS", "0")
    monkeypatch.delenv("WHEELSET_CONFIG", raising=False)
    quiet = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
    with dg.DagsterInstance.ephemeral() as instance:
        instance.add_dynamic_partitions(DAYS_NAME, [day])
        job = defs.resolve_job_def("night")
        result = job.execute_in_process(partition_key=day, instance=instance, run_config=quiet)
        assert result.success
        made = data_versions(instance, day)
    assert lineage(tmp_path / "warehouse", day) == lineage(campaign.warehouse, day) != set()
    with duckdb.connect(str(tmp_path / "warehouse" / "warehouse.duckdb"), read_only=True) as connection:
        states = dict(connection.execute("SELECT state, count(*) FROM scan_status GROUP BY 1").fetchall())
    assert states == {"measured": 5, "pending": 3, "refused": 2}
    home = campaign.warehouse / "_dagster"
    with dg.DagsterInstance.from_config(str(home)) as instance:
        assert data_versions(instance, day) == made
    assert len(set(made.values())) == len(made)


@pytest.mark.parametrize("where", ["prepare", "run_stage"])
def test_a_run_of_dagster_that_an_error_ends_says_so_in_the_morning(
    copy: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Dagster ends its resources in good order also after a failed step."""

    def full(*_: Any) -> None:
        raise DiskFull("no room")

    os.utime(copy.inbox / "scans" / "ref-20250406" / "frames.parquet", ns=(1, 1))
    sent = tmp_path / "sent.json"
    script = f"import sys; open({str(sent)!r}, 'w').write(sys.stdin.read())"
    monkeypatch.setenv("WHEELSET_NOTIFY", shlex.join([sys.executable, "-c", script]))
    monkeypatch.setattr(Night, where, full)
    quiet = {"loggers": {"console": {"config": {"log_level": "CRITICAL"}}}}
    with dg.DagsterInstance.ephemeral() as instance:
        instance.add_dynamic_partitions(DAYS_NAME, [DAYS[1]])
        result = defs.resolve_job_def("night").execute_in_process(
            partition_key=DAYS[1], instance=instance, run_config=quiet, raise_on_error=False
        )
    assert not result.success
    told = json.loads(sent.read_text())
    assert (told["outcome"], told["error"]) == ("stopped", "DiskFull: no room")


def test_dagster_shows_the_figures_of_a_partition(campaign: Campaign) -> None:
    """Rows, seconds and failures by kind as the catalog has them; every flag, so that a plot shows the days without."""
    with duckdb.connect(str(campaign.warehouse / "warehouse.duckdb"), read_only=True) as connection:
        rows = connection.execute(
            "SELECT stage, day, sum(n_rows) FILTER (state = 'ok'), sum(seconds), "
            "count(*) FILTER (state = 'failed'), sum(n_points), count(*) FILTER (state = 'ok') "
            "FROM stage_runs WHERE superseded_at IS NULL AND day LIKE '20%' GROUP BY ALL"
        ).fetchall()
    assert sum(row[4] for row in rows) == 1
    with dg.DagsterInstance.from_config(str(campaign.warehouse / "_dagster")) as instance:
        for stage, day, n_rows, seconds, failed, points, units in rows:
            filter_ = dg.AssetRecordsFilter(dg.AssetKey(stage), asset_partitions=[day])
            (record,) = instance.fetch_materializations(filter_, limit=1).records
            assert record.asset_materialization is not None
            shown = {key: entry.value for key, entry in record.asset_materialization.metadata.items()}
            assert (shown["rows"], shown["failed"], shown["units"]) == (n_rows, failed, units)
            assert shown["seconds"] == pytest.approx(seconds, abs=1e-3)
            assert shown["bytes"] > 0
            if stage == "triangulated_clouds":
                assert shown["points"] == points > 0
                by_kind = [value for key, value in shown.items() if key.startswith("failures: ")]
                assert sum(by_kind) == failed + shown["refused"]  # type: ignore[arg-type,operator]
            if stage == "measurements":
                assert {f"flag: {name}" for name in flag_names()} <= set(shown)
