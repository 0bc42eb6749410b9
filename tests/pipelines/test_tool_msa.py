"""`wheelset tool msa` from the command line: the contract's JSON, decimal readings, errors that help."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.tools.msa import msa, study
from wheelset_assets.quality import ConfigError


def written(path: Path, header: str, *lines: str) -> Path:
    path.write_text("\n".join((header, *lines)) + "\n")
    return path


def simon_lesage(path: Path, leading: int, n: int = 201) -> Path:
    """The certified set SmLs08 where the readings begin with thirteen common digits."""
    lines = []
    for treatment in range(9):
        middle = 4 if treatment == 0 else 3 if treatment % 2 else 5
        for i in range(n):
            lines.append(f"{treatment},{leading}.{middle if i == 0 else middle - 1 if i % 2 else middle + 1}")
    return written(path, "instrument,reading", *lines)


@pytest.mark.parametrize("leading", [1, 1_000_000, 1_000_000_000_000])
def test_common_leading_digits_cost_nothing(tmp_path: Path, leading: int) -> None:
    found = study(simon_lesage(tmp_path / "s.csv", leading), "reading", "instrument")
    between, within, _ = found["anova"]
    assert (between["df"], within["df"]) == (8, 1800)
    assert between["sum_sq"] == pytest.approx(16.08, rel=1e-12)
    assert within["sum_sq"] == pytest.approx(18.0, rel=1e-12)
    assert between["f"] == pytest.approx(201.0, rel=1e-12)
    assert found["r_squared"] == pytest.approx(4.71830985915493e-01, rel=1e-12)


def test_the_contract(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [f"{p},{o},{920 + p + 0.1 * o + 0.01 * t}" for p in range(4) for o in range(3) for t in range(2)]
    file = written(tmp_path / "g.csv", "part,who,mm", *lines)
    assert msa(file, "mm", "part", "who", 2.0, None, None, True) == 0
    found = json.loads(capsys.readouterr().out)
    assert {"anova", "variance_components", "grr_percent", "grr_percent_of_tolerance", "ndc", "pooling"} <= set(found)
    assert {"source", "df", "sum_sq", "mean_sq", "f", "p"} <= set(found["anova"][0])
    assert found["anova"][0]["source"] == "part"
    assert found["variance_components"]["repeatability"] == pytest.approx(0.01**2 / 2 * 12 / 18, rel=1e-6)
    assert msa(file, "mm", "part", "who", 2.0, None, None, False) == 0
    assert "GRR" in capsys.readouterr().out


def test_type_one_and_linearity(tmp_path: Path) -> None:
    file = written(
        tmp_path / "t.csv", "mm,ref", *(f"{920 + r + 0.001 * (i % 3)},{920 + r}" for r in range(3) for i in range(5))
    )
    single = study(file, "mm", tolerance=0.5, reference="920.0", resolution=0.001)
    assert single["type_one"]["n"] == 15
    assert single["resolution_percent_of_tolerance"] == pytest.approx(0.2)
    line = study(file, "mm", reference="ref")["linearity"]
    assert line["slope"] == pytest.approx(0, abs=1e-9)
    assert line["mean_bias"] == pytest.approx(0.0008, abs=1e-9)


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (("a,x", "a,1"), "line 2, column mm"),
        (("a,1", "b,2"), "no part has two values"),
        (("a,", "a,1"), "line 2, column mm: empty"),
    ],
)
def test_errors_name_file_line_and_column(tmp_path: Path, lines: tuple[str, ...], told: str) -> None:
    file = written(tmp_path / "e.csv", "part,mm", *lines)
    with pytest.raises(ConfigError, match=told):
        study(file, "mm", "part")
    with pytest.raises(ConfigError, match="no column 'nothing'; it has part, mm"):
        study(file, "nothing", "part")
    with pytest.raises(ConfigError, match="--part"):
        study(file, "mm")
