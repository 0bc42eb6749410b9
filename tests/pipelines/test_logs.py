"""Structured logs: JSON lines where they are asked for, with scan and stage, and nothing where they are not."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_campaign import Campaign

from pipelines import logs
from warehouse.events import LOGGER, event
from wheelset_assets.quality import ConfigError

ROOT = Path(__file__).parents[2]


def lines(text: str) -> list[dict]:
    """Every line must be a JSON object."""
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture(autouse=True)
def _quiet_afterwards() -> object:
    yield
    logs.configure()


def test_facts_become_a_line(tmp_path: Path) -> None:
    file = tmp_path / "new" / "log.jsonl"
    logs.configure(file)
    event("stage", scan_id="WS-ü\n", seconds=0.5, reason=None, path=Path("a"))
    event("odd", logging.WARNING, level_of="x")
    try:
        raise ValueError("a bug")
    except ValueError:
        LOGGER.exception("crash")
    first, second, third = lines(file.read_text(encoding="utf-8"))
    assert first.pop("time").endswith("+00:00")
    assert first == {"level": "info", "event": "stage", "scan_id": "WS-ü\n", "seconds": 0.5, "path": "a"}
    assert (second["level"], second["event"], second["level_of"]) == ("warning", "odd", "x")
    assert "ValueError: a bug" in third["error"]


def test_nobody_listens_unless_asked(capfd: pytest.CaptureFixture[str]) -> None:
    logs.configure()
    event("stage")
    event("bad", logging.ERROR)
    assert capfd.readouterr() == ("", "")


def test_wrong_wishes_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"--log-json .*cannot be written"):
        logs.configure(tmp_path / "file" / "log.jsonl")
    monkeypatch.setenv("WHEELSET_LOG", "yaml")
    with pytest.raises(ConfigError, match="WHEELSET_LOG: expected json; found 'yaml'"):
        logs.configure()


def test_a_run_tells_every_stage_of_every_scan(tiny: Campaign, tmp_path: Path) -> None:
    program = [sys.executable, "-c", "from pipelines.cli import main; main()", "run", "--json", "--workers", "0"]
    places = ["--inbox", str(tiny.inbox), "--warehouse", str(tmp_path / "w"), "--log-json", str(tmp_path / "log.jsonl")]
    done = subprocess.run(
        [*program, *places],
        env=os.environ | {"WHEELSET_LOG": "json", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 3, done.stderr
    summary = json.loads(done.stdout)
    told = lines(done.stderr)
    assert [{k: v for k, v in t.items() if k != "time"} for t in lines((tmp_path / "log.jsonl").read_text())] == [
        {k: v for k, v in t.items() if k != "time"} for t in told
    ]
    assert [told[0]["event"], told[-1]["event"]] == ["run started", "run finished"]
    assert {t["run_id"] for t in told} == {told[0]["run_id"]}
    assert {n: told[-1][n] for n in ("measured", "refused", "failed")} == {
        n: summary[n] for n in ("measured", "refused", "failed")
    }
    stages = [t for t in told if t["event"] == "stage"]
    states = {(t["scan_id"], t["stage"]): t["state"] for t in stages if t["unit"] == t["scan_id"]}
    assert states["WS-000-20250405-00", "measurements"] == "ok"
    assert sorted(s for s in states.values() if s != "ok") == ["failed", "refused"]
    bad = {t["scan_id"]: t["reason"] for t in stages if t["state"] != "ok"}
    assert set(bad) == set(tiny.faults)
    assert all(t["seconds"] > 0 for t in stages if t["state"] == "ok" and t["stage"] != "bundle")
