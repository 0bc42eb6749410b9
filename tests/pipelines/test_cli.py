"""The command line as outsiders call it: exit codes, one JSON document, nothing touched that was not asked for."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from small_campaign import Campaign

from pipelines import cli

CALL = [sys.executable, "-c", "from pipelines.cli import main; main()"]
COMMANDS = ["run", "status", "describe", "sql", "report", "replay", "lineage", "budget", "simulate", "verify", "demo"]


@dataclass(frozen=True)
class Called:
    """How a call ended and what it said."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Standard output as one JSON document."""
        return json.loads(self.out)


Caller = Callable[..., Called]


@pytest.fixture
def wheelset(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Caller:
    """Call the command line in this process."""
    for name in ("INBOX", "WAREHOUSE", "CONFIG", "WORKERS"):
        monkeypatch.delenv(f"WHEELSET_{name}", raising=False)
    monkeypatch.setenv("DAGSTER_HOME", "")

    def call(*words: object) -> Called:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["wheelset", *map(str, words)])
        with pytest.raises(SystemExit) as left:
            cli.main()
        out, err = capfd.readouterr()
        assert isinstance(left.value.code, int)
        return Called(left.value.code, out, err)

    return call


@pytest.fixture(scope="module")
def places(campaign: Campaign, tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """A copy of the campaign that no test changes."""
    return campaign.copy(tmp_path_factory.mktemp("cli"))


@pytest.fixture
def scan(places: Campaign) -> str:
    """A production scan that was measured."""
    return next(p.name for p in sorted((places.inbox / "scans").glob("WS-*")) if p.name not in places.faults)


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file."""
    return {str(p): (p.stat().st_size, p.stat().st_mtime_ns) for p in sorted(folder.rglob("*")) if p.is_file()}


# --- usage -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command(wheelset: Caller, command: str) -> None:
    called = wheelset(command, "--help")
    assert called.code == 0
    assert f"wheelset {command}" in called.out
    assert "--json" in called.out


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("nonsense",),
        ("run", "--workers", "many"),
        ("run", "--workers", "-1"),
        ("run", "--nonsense"),
        ("budget", "x"),
        ("report",),
        ("sql", "--format"),
    ],
)
def test_wrong_usage_is_2(wheelset: Caller, words: tuple[str, ...]) -> None:
    called = wheelset(*words)
    assert called.code == 2
    assert "Traceback" not in called.err


@pytest.mark.parametrize("command", ["run", "status"])
def test_missing_inbox_is_2_and_makes_nothing(wheelset: Caller, tmp_path: Path, command: str) -> None:
    called = wheelset(command, "--inbox", tmp_path / "no", "--warehouse", tmp_path / "w")
    assert called.code == 2
    assert "there is no such folder; name the inbox by --inbox or WHEELSET_INBOX" in called.err
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "no").mkdir()
    assert wheelset(command, "--inbox", tmp_path / "no", "--warehouse", tmp_path / "w").code == 2
    assert not (tmp_path / "w").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("sql", "SELECT 1"),
        ("report", "accuracy"),
        ("lineage", "x"),
        ("budget", "x", "--quantity", "qr"),
        ("replay", "x"),
        ("verify",),
    ],
)
def test_no_warehouse_is_2(wheelset: Caller, tmp_path: Path, words: tuple[str, ...]) -> None:
    called = wheelset(*words, "--warehouse", tmp_path / "no")
    assert called.code == 2
    assert "--warehouse" in called.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[filtering]\nwindow = 3", ("filtering.window", "describe config")),
        ("[nonsense]\nx = 1", ("nonsense",)),
        ('[filtering]\nwindow_rows = "three"', ("filtering.window_rows", "'three'")),
        ("[filtering]\nwindow_rows = 0", ("filtering.window_rows", "0")),
        ("window_rows", ("not a TOML file",)),
    ],
)
def test_wrong_configuration_names_file_and_key(
    wheelset: Caller, places: Campaign, tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    config = tmp_path / "knobs.toml"
    config.write_text(text)
    for command in (("run",), ("status",), ("describe", "config")):
        called = wheelset(*command, "--config", config, "--inbox", places.inbox, "--warehouse", tmp_path / "w")
        assert called.code == 2
        for word in (str(config), *words):
            assert word in called.err
    assert not (tmp_path / "w").exists()
    assert wheelset("describe", "--config", tmp_path / "no.toml").code == 2


@pytest.mark.parametrize("text", ["25:00", "5", "05:30:00", "tomorrow", "", "-1:00"])
def test_until_that_is_no_time(wheelset: Caller, places: Campaign, text: str) -> None:
    for more in ((), ("--dry-run",)):
        called = wheelset("run", "--inbox", places.inbox, "--warehouse", places.warehouse, f"--until={text}", *more)
        assert called.code == 2
        assert "expected a local time such as 05:30" in called.err


def test_until_that_has_passed_today_is_tomorrow() -> None:
    now = datetime.now().astimezone()
    for minutes in (-2, 2):
        then = now + timedelta(minutes=minutes)
        moment = cli._moment(f"{then:%H:%M}")
        assert moment is not None
        assert timedelta(0) < moment - now < timedelta(days=1)


# --- run, status -------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="the time zone of a process cannot be set here")
@pytest.mark.parametrize("evening", ["2025-03-29T22:00:00+01:00", "2025-10-25T22:00:00+02:00"])
def test_until_is_the_clock_on_the_wall_also_if_it_is_put_forward_or_back(
    monkeypatch: pytest.MonkeyPatch, evening: str
) -> None:
    class Clock(datetime):
        @classmethod
        def now(cls, tz=None):  # type: ignore[no-untyped-def,override]
            return cls.fromtimestamp(datetime.fromisoformat(evening).timestamp(), tz)

    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        patch.setattr(cli, "datetime", Clock)
        moment = cli._moment("05:30")
        assert moment is not None
        assert datetime.fromtimestamp(moment.timestamp()).strftime("%H:%M") == "05:30"
    time.tzset()


def test_run_counts_and_exit_codes(wheelset: Caller, campaign: Campaign, tmp_path: Path) -> None:
    copy = campaign.copy(tmp_path)
    both = ("--inbox", copy.inbox, "--warehouse", copy.warehouse, "--workers", 0)
    calm = wheelset("run", *both, "--json")
    assert calm.code == 0
    integers = ("measured", "refused", "failed", "unchanged", "pending", "points")
    assert all(isinstance(calm.json[name], int) for name in integers)
    assert {k: calm.json[k] for k in integers} == dict.fromkeys(integers, 0) | {"unchanged": 10}
    assert isinstance(calm.json["seconds"], float | int)
    bad = next(name for name, kind in copy.faults.items() if kind == "wrong-hash")
    os.utime(copy.inbox / "scans" / bad / "frames.parquet", ns=(1, 1))
    (copy.inbox / "cmm" / "bad.csv").write_text("wheelset_id\n")
    refused = wheelset("run", *both, "--json")
    assert (refused.code, refused.json["refused"], refused.json["unchanged"]) == (3, 1, 9)
    assert refused.json["troubles"][0]["scan_id"] == bad
    assert refused.json["warnings"] == ["review left out: cmm/bad.csv: column quantity is missing"]
    shown = wheelset("run", *both)
    assert shown.code == 0
    assert "unchanged" in shown.out
    assert "warning: review left out: cmm/bad.csv" in shown.out


def test_scans_that_do_not_fit_their_calibration(wheelset: Caller, campaign: Campaign, tmp_path: Path) -> None:
    copy = campaign.copy(tmp_path)
    old, other = [p for p in sorted((copy.inbox / "scans").glob("WS-*")) if p.name not in copy.faults][:2]
    (rig,) = (copy.inbox / "rigs").glob("*.json")
    rig.with_name("rig-2.json").write_text(json.dumps(json.loads(rig.read_text()) | {"rig_id": "rig-2"}))
    for folder, changes in ((old, {"captured_at": "2028-01-01T08:00:00+08:00"}), (other, {"rig_id": "rig-2"})):
        path = folder / "scan.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    called = wheelset("run", "--inbox", copy.inbox, "--warehouse", copy.warehouse, "--workers", 0, "--json")
    assert (called.code, called.json["failed"], called.json["unchanged"]) == (3, 2, 8)
    reasons = {trouble["scan_id"]: trouble["reason"] for trouble in called.json["troubles"]}
    assert "limit_days 730" in reasons[old.name]
    assert f"is of rig {rig.stem}, the scan of rig rig-2" in reasons[other.name]


def test_dry_run_and_status_touch_nothing(wheelset: Caller, places: Campaign, tmp_path: Path) -> None:
    before = state_of(places.inbox), state_of(places.warehouse)
    both = ("--inbox", places.inbox, "--warehouse", places.warehouse)
    for words in (("run", "--dry-run"), ("status",)):
        assert wheelset(*words, *both, "--json").json["idle"] is True
        assert "nothing to do: 10 scans" in wheelset(*words, *both).out
        fresh = wheelset(*words, "--inbox", places.inbox, "--warehouse", tmp_path / "w", "--json")
        assert fresh.code == 0
        assert sum(len(day["new"]) for day in fresh.json["days"]) == 10
    config = tmp_path / "knobs.toml"
    config.write_text("[alignment]\nmin_face_mm = 4.0\n")
    stale = wheelset("status", *both, "--config", config)
    assert "configuration changed" in stale.out
    assert (state_of(places.inbox), state_of(places.warehouse)) == before
    assert not (tmp_path / "w").exists()


def test_scan_that_is_not_there_names_its_neighbours(wheelset: Caller, places: Campaign, scan: str) -> None:
    called = wheelset("run", "--scan", scan[:-1], "--inbox", places.inbox, "--warehouse", places.warehouse)
    assert called.code == 2
    assert "no such scan" in called.err
    assert scan in called.err
    one = wheelset("run", "--dry-run", "--json", "--scan", scan, "--inbox", places.inbox, "--warehouse", "none")
    assert [day["new"] for day in one.json["days"]] == [[scan]]


def test_places_from_the_environment(
    wheelset: Caller, places: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WHEELSET_INBOX", str(places.inbox))
    monkeypatch.setenv("WHEELSET_WAREHOUSE", str(places.warehouse))
    assert wheelset("status", "--json").json["idle"] is True
    assert wheelset("status", "--json", "--warehouse", tmp_path).json["idle"] is False
    assert wheelset("sql", "SELECT count(*) AS n FROM scan_status", "--json").json == [{"n": 10}]
    config = tmp_path / "knobs.toml"
    config.write_text("[alignment]\nmin_face_mm = 4.0\n")
    monkeypatch.setenv("WHEELSET_CONFIG", str(config))
    assert wheelset("status", "--json").json["idle"] is False
    knobs = {row["key"]: row for row in wheelset("describe", "config", "--json").json["config"]}
    assert (knobs["alignment.min_face_mm"]["value"], knobs["alignment.min_face_mm"]["default"]) == (4.0, 3.0)
    for text, code in (("", 0), ("1", 0), ("two", 2), ("-1", 2), ("²", 2)):
        monkeypatch.setenv("WHEELSET_WORKERS", text)
        called = wheelset("status", "--json")
        assert called.code == code, text
        assert code == 0 or "WHEELSET_WORKERS: expected a whole number" in called.err


def test_a_warehouse_that_is_a_file(wheelset: Caller, places: Campaign, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    called = wheelset("run", "--inbox", places.inbox, "--warehouse", tmp_path / "file")
    assert called.code == 2
    assert "cannot hold a warehouse" in called.err


# --- describe, verify, lineage, budget, replay -------------------------------------------------------------------


@pytest.mark.parametrize(
    "topic", [None, "tables", "quantities", "config", "flags", "stages", "measurements", "scan_status", "lineage"]
)
def test_describe(wheelset: Caller, topic: str | None) -> None:
    words = ("describe",) if topic is None else ("describe", topic)
    assert wheelset(*words, "--json").json
    shown = wheelset(*words)
    assert shown.code == 0
    assert shown.out.strip()


def test_describe_what_is_not_there(wheelset: Caller) -> None:
    called = wheelset("describe", "nonsense")
    assert called.code == 2
    assert "quantities" in called.err


def test_verify(wheelset: Caller, campaign: Campaign, tmp_path: Path) -> None:
    copy = campaign.copy(tmp_path)
    both = ("--inbox", copy.inbox, "--warehouse", copy.warehouse)
    sound = wheelset("verify", *both, "--json")
    assert sound.code == 0
    assert sound.json["broken"] == []
    next(copy.warehouse.glob("filtered_clouds/*/*/*.parquet")).write_bytes(b"x")
    broken = wheelset("verify", *both, "--json")
    assert broken.code == 1
    assert "its bytes do not hash to its name" in broken.json["broken"][0]
    assert "broken: filtered_clouds" in wheelset("verify", *both).out
    assert wheelset("verify", "--warehouse", copy.warehouse, "--inbox", tmp_path / "no").code == 2


def test_lineage(wheelset: Caller, places: Campaign, scan: str) -> None:
    there = ("--warehouse", places.warehouse)
    tree = wheelset("lineage", scan, *there, "--json")
    assert tree.code == 0
    assert tree.json["name"] == f"measurements of {scan}"
    assert "measurements of" in wheelset("lineage", scan, *there).out
    one = wheelset("lineage", "--measurement", f"{scan}/wheel_diameter/left", *there, "--json").json
    assert one["kind"] == "measurement"
    for words in (
        ("nothing",),
        (),
        (scan, "--measurement", "a/b/c"),
        ("--measurement", "a/b"),
        ("--measurement", f"{scan}/x/left"),
    ):
        assert wheelset("lineage", *words, *there).code == 2, words


def test_budget(wheelset: Caller, places: Campaign, scan: str) -> None:
    there = ("--warehouse", places.warehouse)
    rows = wheelset("budget", scan, "--quantity", "wheel_diameter", "--side", "left", *there, "--json").json
    assert abs(sum(row["share"] for row in rows) - 1) < 1e-6
    assert {row["side"] for row in rows} == {"left"}
    assert "U = " in wheelset("budget", scan, "--quantity", "wheel_diameter", *there).out
    for words in ((scan, "--quantity", "nonsense"), ("nothing", "--quantity", "qr")):
        called = wheelset("budget", *words, *there)
        assert called.code == 2
        assert "budget: no" in called.err


def test_replay(wheelset: Caller, places: Campaign, scan: str, tmp_path: Path) -> None:
    out = tmp_path / "one.rrd"
    called = wheelset("replay", scan, "--warehouse", places.warehouse, "--out", out, "--json")
    assert (called.code, called.json) == (0, {"scan_id": scan, "recording": str(out)})
    assert out.stat().st_size > 1000
    assert wheelset("replay", "nothing", "--warehouse", places.warehouse).code == 2


# --- sql, report -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "query",
    [
        "COPY (SELECT 1) TO '{w}/x.parquet'",
        "EXPLAIN ANALYZE COPY (SELECT 1) TO '{w}/x.parquet'",
        "EXPLAIN (ANALYZE, FORMAT json) COPY (SELECT 1) TO '{w}/x.parquet'",
        "CREATE TABLE x (a INT)",
        "INSERT INTO superseded SELECT * FROM superseded",
        "DROP VIEW measurements",
        "ATTACH '{w}/x.db'",
        "INSTALL httpfs",
        "LOAD httpfs",
        "PRAGMA database_list",
        "SET threads = 1",
        "EXPORT DATABASE '{w}/x'",
        "SELECT 1; SELECT 2",
        "SELECT 1; COPY (SELECT 1) TO '{w}/x.parquet'",
        "",
        "SELECT * FROM read_text('/etc/passwd')",
        "SELECT * FROM read_csv('/etc/passwd')",
        "SELECT * FROM '{w}/../inbox/cmm/review.csv'",
        "SELECT * FROM glob('/*')",
        "SELECT * FROM read_csv('https://example.org/x.csv')",
        "SELECT nonsense FROM measurements",
        "SELEKT",
        "SELECT ?",
    ],
)
def test_queries_that_write_reach_out_or_are_wrong(wheelset: Caller, places: Campaign, query: str) -> None:
    before = state_of(places.warehouse)
    called = wheelset("sql", query.format(w=places.warehouse), "--warehouse", places.warehouse)
    assert called.code == 2
    assert called.out == ""
    assert called.err.startswith("wheelset: sql: ")
    assert state_of(places.warehouse) == before


def test_queries_in_every_format(
    wheelset: Caller, places: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = (
        "SELECT scan_id, captured_at, acquired_on, value, quality_flags, {'a': 1.5} AS struct, sum(1) OVER () AS n, 0.5 AS share, "
        "'nan'::DOUBLE AS nan, NULL AS nothing, INTERVAL 1 DAY AS span FROM measurements WHERE value IS NOT NULL ORDER BY ALL LIMIT 2"
    )
    there = ("--warehouse", places.warehouse)
    rows = wheelset("sql", query, *there, "--json").json
    assert rows == wheelset("sql", query, *there, "--format", "json").json
    first = rows[0]
    assert isinstance(first["value"], float)
    assert isinstance(first["quality_flags"], list)
    assert first["captured_at"].endswith("+00:00")
    assert (first["struct"], first["share"], first["nan"], first["nothing"]) == ({"a": 1.5}, 0.5, None, None)
    assert isinstance(first["n"], int)
    assert "scan_id" in wheelset("sql", query, *there).out
    lines = wheelset("sql", query, *there, "--format", "csv").out.splitlines()
    assert len(lines) == 3
    assert '"{""a"": 1.5}"' in lines[1]
    assert first["captured_at"] in lines[1]
    out = tmp_path / "below" / "x.parquet"
    refused = wheelset("sql", query, *there, "--format", "parquet", "--out", out)
    assert (refused.code, out.exists()) == (2, False)
    assert "cast it in the query" in refused.err
    query = query.replace(", INTERVAL 1 DAY AS span", "")
    assert wheelset("sql", query, *there, "--format", "parquet", "--out", out).code == 0
    assert pq.read_table(out).num_rows == 2
    file = tmp_path / "q.sql"
    file.write_text("-- a comment\nSELECT 1 AS a, 2 AS a")
    assert wheelset("sql", "--file", file, *there, "--json").json == [{"a": 1, "a_2": 2}]
    assert wheelset("sql", "SELECT * FROM measurements WHERE false", *there, "--json").json == []
    for words in (
        ("EXPLAIN SELECT 1",),
        ("DESCRIBE measurements",),
        ("EXPLAIN ANALYZE SELECT 1",),
        ("FROM scan_status",),
    ):
        assert wheelset("sql", *words, *there).code == 0, words
    monkeypatch.setattr(sys, "stdin", io.StringIO(" "))
    for words in ((query, "--format", "xml"), (query, "--file", file), (), ("--file", tmp_path / "no.sql")):
        assert wheelset("sql", *words, *there).code == 2, words
    assert wheelset("sql", query, *there, "--out", tmp_path / "q.sql" / "x").code == 2
    for moment, some in (("2024-01-01", False), ("2999-01-02", True)):
        made = wheelset("report", "stability", "--as-of", moment, *there, "--json").json
        assert bool(made["blocks"]["over_all"]["rows"]) == some
        assert made["parameters"]["as_of"].startswith(moment[:10])
    assert wheelset("report", "stability", "--as-of", "yesterday", *there).code == 2
    monkeypatch.setattr(sys, "stdin", io.StringIO("SELECT 1 AS a"))
    assert wheelset("sql", *there, "--json").json == [{"a": 1}]
    assert "scan_id" in wheelset("sql", ".schema measurements", *there).out
    wrong = wheelset("sql", ".schema measurement", *there)
    assert wrong.code == 2
    assert "did you mean measurements" in wrong.err


def test_reports(wheelset: Caller, places: Campaign, tmp_path: Path) -> None:
    there = ("--warehouse", places.warehouse)
    for name in ("accuracy", "stability"):
        called = wheelset("report", name, *there, "--json")
        assert called.code == 0
        assert called.json["report"] == name
    assert wheelset("report", "accuracy", *there).out.strip()
    assert wheelset("report", "accuracy", *there, "--format", "html", "--out", tmp_path / "a.html").code == 0
    for words in (
        ("nonsense",),
        ("accuracy", "--format", "doc"),
        ("stability", "--pairs", "x.csv"),
        ("accuracy", "--pairs", "no.csv"),
    ):
        called = wheelset("report", *words, *there)
        assert called.code == 2, words
        assert "Traceback" not in called.err


# --- simulate ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ("--rig", "nonsense"),
        ("--fault", "nonsense"),
        ("--profile", "nonsense"),
        ("--first-day", "yesterday"),
        ("--days", "0"),
        ("--frames", "1"),
    ],
)
def test_simulate_refuses(wheelset: Caller, tmp_path: Path, words: tuple[str, ...]) -> None:
    called = wheelset("simulate", "--out", tmp_path / "new", *words)
    assert called.code == 2
    assert "Traceback" not in called.err


def test_simulate_does_not_overwrite(wheelset: Caller, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("x")
    for out in (tmp_path, tmp_path / "mine"):
        called = wheelset("simulate", "--out", out)
        assert called.code == 2
        assert "not an empty folder" in called.err
    assert (tmp_path / "mine").read_text() == "x"
    assert "wrong-hash" in wheelset("simulate", "--out", tmp_path, "--fault", "list", "--json").json


# --- ends that nobody wants --------------------------------------------------------------------------------------


def test_broken_pipe_is_quiet(places: Campaign) -> None:
    words = ["sql", "SELECT * FROM range(300000)", "--format", "csv", "--warehouse", str(places.warehouse)]
    for read in (10, 0):
        with subprocess.Popen([*CALL, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            process.stdout.read(read)
            process.stdout.close()
            assert process.stderr.read() == b""
        assert process.returncode == 0


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_says_that_nothing_is_lost(campaign: Campaign, tmp_path: Path) -> None:
    words = ["run", "--inbox", str(campaign.inbox), "--warehouse", str(tmp_path / "w"), "--workers", "1", "--json"]
    process = subprocess.Popen(
        [*CALL, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 60
    while not list((tmp_path / "w").glob("triangulated_clouds/*/*/*.parquet")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert err.strip().splitlines()[-1] == (
        "wheelset: interrupted; what was finished is kept, and the next run goes on from there"
    )
    assert "Traceback" not in err


def test_a_bug_keeps_its_traceback_and_is_1(tmp_path: Path) -> None:
    script = "from pipelines import cli, describe\ndescribe.describe = lambda *_: 1 / 0\ncli.main()"
    done = subprocess.run([sys.executable, "-c", script, "describe"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "ZeroDivisionError" in done.stderr
