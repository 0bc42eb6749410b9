"""`wheelset tool profile`: the nominal profiles' own figures, whatever way a file is turned, and reasons for what is unseen."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from configs import nominal_profile
from pipelines.cli import app
from pipelines.tools.profile import evaluated
from wheelset_assets.exchange import miniprof, simpack
from wheelset_assets.quality import ConfigError

L = (2.0, 70.0, 10.0)
FIGURES = {"S1002": (28.000, 32.500, 10.794), "LMA": (28.000, 32.900, 9.740)}


def written(path: Path, s, z, separator=",") -> Path:
    path.write_text("lateral,height\n" + "\n".join(f"{a:.5f}{separator}{b:.5f}" for a, b in zip(s, z, strict=True)))
    return path


def figures(row) -> tuple[float, float, float]:
    return row["flange_height_mm"], row["flange_thickness_mm"], row["qr_mm"]


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize("way", ["plain", "mirrored", "turned", "from-face", "whl", "prw"])
def test_nominal_profiles_give_their_figures(tmp_path: Path, name: str, way: str) -> None:
    s, z = nominal_profile(name)
    if way == "whl":
        path = tmp_path / "a.whl"
        path.write_text(miniprof.write(miniprof.MiniProfProfile(s, z)))
    elif way == "prw":
        path = tmp_path / "a.prw"
        path.write_text(simpack.write(s, z))
    else:
        path = written(
            tmp_path / "a.csv",
            {"mirrored": -s, "from-face": s + 70.0}.get(way, s),
            -z if way == "turned" else z,
            separator="\t" if way == "plain" else ",",
        )
    row = evaluated(path, "auto", "auto", None, L)
    assert figures(row) == pytest.approx(FIGURES[name], abs=1e-3)
    assert row["alignment"] == "frame of the file"


def test_the_inner_face_sets_the_zero_where_it_was_seen(tmp_path: Path) -> None:
    s, z = nominal_profile("S1002")
    face = np.linspace(-30.0, 9.0, 80)
    path = written(tmp_path / "a.csv", np.concatenate([np.full(80, -70.0), s]) + 1.7, np.concatenate([face, z]))
    row = evaluated(path, "auto", "datum", None, L)
    assert row["alignment"] == "inner face"
    assert figures(row) == pytest.approx(FIGURES["S1002"], abs=1e-3)
    moved = evaluated(path, "frame", "datum", None, L)
    assert moved["flange_thickness_mm"] == pytest.approx(32.5 + 1.7, abs=0.1)


def test_wear_against_a_nominal_profile(tmp_path: Path) -> None:
    s, z = nominal_profile("S1002")
    worn = z - 0.4 * np.clip(1 - (s / 40) ** 2, 0, None) ** 2
    row = evaluated(written(tmp_path / "a.csv", s, worn), "auto", "auto", "S1002", L)
    assert row["tread_wear_mm"] == pytest.approx(0.4, abs=2e-3)
    assert row["deviation_max_mm"] == pytest.approx(-0.4, abs=2e-3)
    assert evaluated(written(tmp_path / "b.csv", s, z), "auto", "auto", "S1002", L)["deviation_rms_mm"] < 1e-4


def test_what_is_not_seen_is_null_with_a_reason(tmp_path: Path) -> None:
    s, z = nominal_profile("S1002")
    path = written(tmp_path / "a.csv", s[s > -20], z[s > -20])
    answer = CliRunner().invoke(app, ["tool", "profile", str(path), "--json", "--origin", "datum"])
    (row,) = json.loads(answer.stdout)
    assert figures(row) == (None, None, None)
    assert set(row["reasons"]) == {"flange_height_mm", "flange_thickness_mm", "qr_mm"}


def test_a_copied_header_is_told(tmp_path: Path) -> None:
    s, z = nominal_profile("S1002")
    path = tmp_path / "a.whl"
    path.write_text(miniprof.write(miniprof.MiniProfProfile(s, z)).replace("Sh=28.0", "Sh=29.5"))
    notes = " ".join(evaluated(path, "auto", "auto", None, L)["notes"])
    assert "Sh" in notes
    assert "29.5" in notes


@pytest.mark.parametrize(("text", "said"), [("a,b\n1,2\n", "20 or more; found 1"), ("", "found 0")])
def test_a_file_that_is_no_profile_is_named(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"a\.csv") as caught:
        evaluated(path, "auto", "auto", None, L)
    assert said in str(caught.value)
    with pytest.raises(ConfigError, match="cannot be read"):
        evaluated(tmp_path / "none.csv", "auto", "auto", None, L)
