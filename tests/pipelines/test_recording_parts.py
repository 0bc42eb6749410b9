"""Parts of recordings that can be judged without one: nominal profiles, distances, stripes cut into pieces, Markdown, the viewer."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from configs import nominal_profile, profile_names
from pipelines.recording.meridian import signed_distance
from pipelines.recording.report import Col, escape, listing
from pipelines.recording.stripes import _strips
from pipelines.replay import open_recording, viewer_command
from wheelset_assets.quality import ConfigError
from wheelset_assets.simulation.profiles import PROFILES, nominal_height


def test_nominal_profiles_are_those_of_the_standards() -> None:
    assert profile_names() == ("CONE20", "CONE40", "LMA", "S1002")
    for name, flange_height, thickness, qr in (("S1002", 28.0, 32.5, 10.794), ("LMA", 28.0, 32.9, 9.740)):
        s, z = nominal_profile(name)
        assert np.allclose(np.diff(s), 0.25)
        assert (s[0], s[-1]) == (-70.0, 65.0)
        assert np.abs(z - nominal_height(PROFILES[name], s)).max() < 2e-4  # the standard's own joints differ by that
        assert z.max() == pytest.approx(flange_height, abs=1e-3)
        flank = (s > s[z.argmax()]) & (s < 0)
        s10, s2 = (float(np.interp(-level, -z[flank], s[flank])) for level in (10.0, z.max() - 2.0))
        assert 70 + s10 == pytest.approx(thickness, abs=0.01)
        assert s10 - s2 == pytest.approx(qr, abs=0.02)
    with pytest.raises(KeyError, match="LMA, S1002"):
        nominal_profile("S1003")


@pytest.mark.parametrize("cone", [20, 40])
def test_conical_profiles_have_a_flange_and_a_straight_smooth_tread(cone: int) -> None:
    s, z = nominal_profile(f"CONE{cone}")
    tread = (s > -25) & (s < 60)
    assert np.abs(z - -s / cone)[tread].max() < 1.5e-6  # six decimals
    assert z.max() == pytest.approx(28.0, abs=1e-3)
    root = (s > -39.5) & (s < 59.5)
    step, rise = np.diff(s[root]), np.diff(z[root])
    assert rise.max() < 0
    turned = np.diff(np.arctan2(rise, step)) / np.hypot(step, rise)[1:]
    assert turned.min() > -1e-3
    assert turned.max() < 1.2 / 13.0  # no kink: nowhere sharper than the arc of 13 mm


def test_distance_from_the_nominal_profile_counts_outward_along_its_normal() -> None:
    s, z = nominal_profile("S1002")
    line = np.column_stack([s, z])
    step = np.gradient(line, axis=0)
    outward = np.column_stack([-step[:, 1], step[:, 0]]) / np.linalg.norm(step, axis=1)[:, None]
    inner = slice(40, -40)
    for offset in (0.3, -0.2, 0.0):
        assert np.abs(signed_distance(line + offset * outward, line)[inner] - offset).max() < 2e-3


def test_stripes_are_cut_at_gaps_and_jumps_and_keep_outliers() -> None:
    u = np.full((3, 40), np.nan)
    u[0, 5:25] = np.linspace(100, 110, 20)
    u[0, 12] = 300.0
    u[2, 30:33] = 50.0
    strips, count = _strips(u, 4)
    assert count.tolist() == [3, 0, 1]
    assert [int(s[0, 1]) for s in strips] == [5, 10, 13, 30]
    assert strips[1][:, 0].tolist() == [300.0, 300.0]
    assert strips[2][-1, 1] == 24


def test_documents_mean_nothing_to_markdown_but_what_is_meant() -> None:
    assert escape("a|b *c* <i>\n[d](e)") == r"a\|b \*c\* \<i> \[d](e)"
    rows = [{"name": "x", "value": 1.25}, {"name": "y|z", "value": None}]
    text = listing((Col("name", "name"), Col("v", "value", ".1f")), rows)
    assert text.splitlines() == ["| name | v |", "|---|---:|", "| x | 1.2 |", r"| y\|z | – |"]
    assert listing((Col("name", "name"),), []) == ""


def _viewer(path: Path, body: str) -> str:
    path.write_text(f"#!{sys.executable}\nimport json, os, sys, time\n{body}\n", encoding="utf-8")
    path.chmod(0o755)
    return str(path)


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in for the viewer is a script")
def test_viewer_is_started_for_this_machine_only_and_sends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tmp_path / "a.rrd"
    recording.touch()
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    said = tmp_path / "said.json"
    body = f"json.dump([sys.argv[1:], dict(os.environ)], open({str(said)!r}, 'w')); time.sleep(60)"
    monkeypatch.setenv("RERUN_CLI_PATH", _viewer(tmp_path / "viewer", body))
    viewer = open_recording(recording)
    try:
        assert viewer.poll() is None
    finally:
        os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait(60)
    arguments, environment = json.loads(said.read_text(encoding="utf-8"))
    assert arguments == viewer_command(recording)[3:]
    assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"
    assert environment["CI"] == "true"
    assert "FORCE_RERUN_ANALYTICS" not in environment


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in for the viewer is a script")
def test_viewer_that_does_not_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"no such recording"):
        open_recording(tmp_path / "a.rrd")
    (tmp_path / "a.rrd").touch()
    monkeypatch.setenv("RERUN_CLI_PATH", _viewer(tmp_path / "viewer", "sys.exit('no display here')"))
    with pytest.raises(ConfigError, match=r"did not start \(no display here\).*--web-viewer"):
        open_recording(tmp_path / "a.rrd")
