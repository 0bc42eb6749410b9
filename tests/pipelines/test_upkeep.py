"""Commands that look after a warehouse, as a data engineer calls them; and the hook, which never sinks a run."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import pytest
from small_campaign import Campaign, run
from typer.testing import CliRunner

from pipelines import runner
from pipelines.cli import app
from pipelines.notify import send
from pipelines.settings import settings
from warehouse.lock import WarehouseLock
from warehouse.night import Night
from warehouse.planner import plan
from wheelset_assets.config import Config
from wheelset_assets.quality import ConfigError


def called(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(arguments), standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result.return_value, result.stdout


def test_gc_verify_and_summary(campaign: Campaign, tmp_path: Path) -> None:
    own = campaign.copy(tmp_path)
    place = ["--warehouse", str(own.warehouse), "--json"]
    (own.warehouse / "recordings" / "stray.rrd").write_bytes(b"stray")
    code, text = called("gc", *place, "--keep-days", "0")
    assert (code, json.loads(text)["deleted"]) == (0, False)
    assert "recordings/stray.rrd" in json.loads(text)["paths"]  # beside files of checkpoints, if the run took long
    assert json.loads(text)["runs"] >= 3
    code, text = called("gc", *place, "--keep-days", "0", "--yes")
    assert not (own.warehouse / "recordings" / "stray.rrd").exists()
    assert json.loads(called("gc", *place, "--keep-days", "0")[1])["runs"] == 0
    code, text = called("verify", *place)
    assert (code, json.loads(text)["broken"], json.loads(text)["unnamed"]) == (0, [], 0)
    code, text = called("summary", *place)
    found = json.loads(text)
    assert (found["outcome"], found["refused"], found["failed"]) == ("done", 3, 1)
    assert sum(row["n_scans"] for row in found["reasons"]) == 4
    code, text = called("summary", "--warehouse", str(own.warehouse), "--format", "html")
    assert text.startswith("<!DOCTYPE html>")
    assert "What went wrong" in text
    code, text = called("summary", "--warehouse", str(own.warehouse), "--out", str(tmp_path / "night.txt"))
    assert "empty" in (tmp_path / "night.txt").read_text()


def test_the_hook_gets_the_summary_and_its_failure_is_a_warning(campaign: Campaign, tmp_path: Path) -> None:
    own = campaign.copy(tmp_path)
    target = tmp_path / "sent.json"
    script = f"import sys; open({str(target)!r}, 'w').write(sys.stdin.read())"
    command = shlex.join([sys.executable, "-c", script])
    summary = runner.run(settings(own.inbox, own.warehouse, None, 0, notify=command))
    assert summary.warnings == []
    assert json.loads(target.read_text())["unchanged"] == summary.unchanged
    summary = runner.run(settings(own.inbox, own.warehouse, None, 0, notify="/no/such/command"))
    assert "--notify '/no/such/command'" in summary.warnings[0]
    failing = shlex.join([sys.executable, "-c", "import sys; sys.exit('no network')"])
    assert "ended with 1: no network" in str(send(failing, {}))


def test_a_run_that_an_error_ends_says_so(campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = campaign.copy(tmp_path)

    def broken(_: Night) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr(Night, "prepare", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        run(own.inbox, own.warehouse)
    found = json.loads(called("summary", "--warehouse", str(own.warehouse), "--json")[1])
    assert (found["outcome"], found["error"]) == ("stopped", "RuntimeError: a bug")


def test_a_new_review_is_work_and_nothing_is_computed_for_it(campaign: Campaign, tmp_path: Path) -> None:
    own = campaign.copy(tmp_path)
    assert plan(own.warehouse, own.inbox, Config()).idle
    old = (own.inbox / "cmm" / "review.csv").read_text().splitlines()
    (own.inbox / "cmm" / "second.csv").write_text("\n".join([old[0], old[1]]) + "\n")
    found = plan(own.warehouse, own.inbox, Config())
    assert (found.idle, found.reviews_changed, found.days) == (False, True, [])
    query = ["sql", "--warehouse", str(own.warehouse), "--json", "SELECT count(*) AS n FROM reference_values"]
    before = json.loads(called(*query)[1])[0]["n"]
    summary = run(own.inbox, own.warehouse)
    assert (summary["measured"], summary["points"]) == (0, 0)
    assert json.loads(called(*query)[1])[0]["n"] == before + 1
    assert plan(own.warehouse, own.inbox, Config()).idle


def test_two_runs_at_once(campaign: Campaign, tmp_path: Path) -> None:
    own = campaign.copy(tmp_path)
    lock = WarehouseLock(own.warehouse)
    lock.acquire()
    with pytest.raises(
        ConfigError, match=r"another run \(process \d+\) is writing to this warehouse; wait for it to end"
    ):
        run(own.inbox, own.warehouse)
    lock.release()
    assert run(own.inbox, own.warehouse)["unchanged"] > 0
