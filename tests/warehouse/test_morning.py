"""What a run leaves for the morning: a document that can be asked for later, and a page that escapes what it shows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_inbox import FakeStages

from warehouse import morning
from warehouse.night import Night
from wheelset_assets.config import Config
from wheelset_assets.quality import ConfigError
from wheelset_assets.stages import SCAN_STAGES

DAY = "2025-04-05"


def run(inbox: Path, warehouse: Path, error: Exception | None = None) -> dict:
    with Night(warehouse, inbox, Config(), workers=0, wait_seconds=0) as night:
        night.prepare()
        night.run_calibrations()
        for day in night.days_with_work():
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
        found = morning.document(night, night.summary(), error)
        morning.keep(warehouse, found)
        return found


def test_counts_reasons_and_times(inbox: Path, tmp_path: Path, stages: FakeStages) -> None:
    for i in range(2):
        stages.failing["features", f"scan-{DAY}-{i}"] = f"scan-{DAY}-{i} has <no> keypoints"
    first = run(inbox, tmp_path / "w")
    assert (first["outcome"], first["measured"], first["failed"], first["error"]) == ("done", 1, 2, None)
    (reason,) = first["reasons"]
    assert reason == {
        "state": "failed",
        "stage": "features",
        "reason": "… has <no> keypoints",
        "n_scans": 2,
        "scans": [f"scan-{DAY}-0", f"scan-{DAY}-1"],
    }
    times = {row["stage"]: (row["computed"], row["failed"], row["seconds"]) for row in first["stages"]}
    assert times["features"] == (1, 2, 0.25)
    assert times["filtered_clouds"] == (3, 0, 0.75)
    second = run(inbox, tmp_path / "w", RuntimeError("a bug"))
    assert (second["outcome"], second["error"], second["unchanged"]) == ("stopped", "RuntimeError: a bug", 3)
    assert morning.load(tmp_path / "w", first["run_id"][:6]) == json.loads(json.dumps(first))
    with pytest.raises(ConfigError, match="no summary of run zzz"):
        morning.load(tmp_path / "w", "zzz")
    page = morning.page(first)
    assert "… has &lt;no&gt; keypoints" in page
    assert "<no>" not in page
    assert "http" not in page.replace("http-equiv", "")


def test_none_yet(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no summary yet"):
        morning.load(tmp_path)
