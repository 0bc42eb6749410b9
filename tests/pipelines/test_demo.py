"""The newcomer's tour, on a campaign made smaller still."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pipelines.demo import MARK, tour
from warehouse.summary import Summary
from wheelset_assets import simulation
from wheelset_assets.quality import ConfigError


@pytest.fixture
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = simulation.SimulationPlan
    small: dict[str, Any] = {
        "wheelsets": 1,
        "days": 1,
        "repeats": 2,
        "frames": 24,
        "rows": 256,
        "board_poses": 7,
        "span_days": None,
    }
    monkeypatch.setattr(simulation, "SimulationPlan", lambda **given: plan(**(given | small)))
    monkeypatch.setenv("WHEELSET_WORKERS", "0")
    monkeypatch.setenv("DAGSTER_HOME", "")


@pytest.mark.usefixtures("_small")
def test_the_tour_says_where_everything_lies(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    out.mkdir()
    (out / MARK).touch()
    (out / "left-over").write_text("of a former demonstration")
    assert tour(out, as_json=False) == 0
    said = capfd.readouterr().out
    for path in ("inbox", "warehouse", "accuracy.html", "stability.html"):
        assert (out / path).exists()
        assert str(out / path) in said
    (recording,) = (out / "warehouse" / "recordings").glob("*.rrd")
    assert str(recording) in said
    assert "measured" in said
    assert not (out / "left-over").exists()


def test_the_tour_as_one_document(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulation, "simulate", lambda *_: None)
    monkeypatch.setattr("pipelines.runner.run", lambda *_, **__: Summary(measured=3))
    monkeypatch.setattr("pipelines.demo._quietly", lambda *_: None)
    assert tour(tmp_path / "demo", as_json=True) == 0
    document = json.loads(capfd.readouterr().out)
    assert document["summary"]["measured"] == 3
    assert document["report"] == str(tmp_path / "demo" / "accuracy.html")


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("x")
    for out, words in (
        (tmp_path, "not empty and not a former demonstration"),
        (tmp_path / "mine", "expected a folder"),
    ):
        with pytest.raises(ConfigError, match=words):
            tour(out, as_json=True)
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]
    assert MARK.startswith(".")
