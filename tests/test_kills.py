"""Ten kills at random moments, each resumed: the warehouse is that of an undisturbed run. The full count is a benchmark."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import kills


def test_ten_kills_change_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--kills", "10", "--plain", "--scans", "4", "--days", "2", "--data", str(tmp_path), "--json"]
    code = kills.main(options)
    found = json.loads(capsys.readouterr().out)
    assert found["wrong"] == []
    assert found["kills"] == 10
    assert found["campaigns"] >= 1
    assert code == 0


def test_a_difference_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = {"a": ({"x", "y"}, ["row 1"]), "b": ({"x"}, ["row 1", "row 2"])}
    monkeypatch.setattr(kills, "content", lambda warehouse: made[warehouse.name])
    assert kills.differences(tmp_path / "a", tmp_path / "a") == []
    assert kills.differences(tmp_path / "a", tmp_path / "b") == [
        "data file in one only: y",
        "lineage in one only: row 2",
    ]
