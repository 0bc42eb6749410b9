"""The accuracy report on pairs from a file, against the paper's Table 1; and malformed files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from warehouse.report import accuracy_from_pairs
from wheelset_assets.quality import ConfigError

HEADER = "quantity,side,measured_mm,reference_mm,expanded_uncertainty_mm\n"
TABLE_1 = {  # detection and check values in the order of the paper's Table 1
    ("journal_diameter", "left"): (
        (130.453, 130.454, 130.453, 130.454, 130.452, 130.453),
        (130.452, 130.451, 130.450, 130.452, 130.452, 130.452),
    ),
    ("journal_diameter", "right"): (
        (130.525, 130.525, 130.525, 130.524, 130.523, 130.525),
        (130.526, 130.527, 130.524, 130.524, 130.524, 130.526),
    ),
    ("wheel_diameter", "left"): (
        (920.655, 920.657, 920.655, 920.655, 920.656, 920.655),
        (920.635, 920.627, 920.635, 920.615, 920.636, 920.635),
    ),
    ("wheel_diameter", "right"): (
        (921.166, 921.166, 921.166, 921.165, 921.166, 921.164),
        (921.176, 921.186, 921.186, 921.185, 921.176, 921.194),
    ),
    ("inner_distance", "both"): (
        (1354.296, 1354.296, 1354.297, 1354.295, 1354.296, 1354.297),
        (1354.306, 1354.316, 1354.297, 1354.285, 1354.316, 1354.307),
    ),
}
EXPECTED_UM = {  # mean and sample standard deviation of measured - reference
    ("journal_diameter", "left"): (1.667, 1.211),
    ("journal_diameter", "right"): (-0.667, 1.033),
    ("wheel_diameter", "left"): (25.000, 8.367),
    ("wheel_diameter", "right"): (-18.333, 7.528),
    ("inner_distance", "both"): (-8.333, 11.690),
}


def table_1() -> str:
    return HEADER + "".join(
        f"{quantity},{side},{measured},{reference},\n"
        for (quantity, side), columns in TABLE_1.items()
        for measured, reference in zip(*columns, strict=True)
    )


def test_table_1_has_the_errors_that_it_has(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(table_1(), encoding="utf-8")
    report = accuracy_from_pairs(tmp_path / "table.csv")
    found = {(row["quantity"], row["side"]): row for row in report.blocks["summary"].table.to_pylist()}
    assert list(found) == list(EXPECTED_UM)
    for key, (bias, s) in EXPECTED_UM.items():
        assert found[key]["n"] == 6
        assert found[key]["bias_um"] == pytest.approx(bias, abs=5e-4)
        assert found[key]["standard_deviation_um"] == pytest.approx(s, abs=5e-4)
        assert found[key]["max_error_um"] <= (found[key]["paper_error_um"] or np.inf) + 1e-6
        assert found[key]["within_ratio"] is None  # the table states no uncertainty
    assert found["inner_distance", "both"]["verdict"] == "unbiased"
    assert found["wheel_diameter", "left"]["verdict"] == "biased"


def test_the_table_that_the_docs_ship_is_table_1() -> None:
    shipped = (Path(__file__).parents[2] / "docs" / "paper-table-1.csv").read_text(encoding="utf-8")
    read, expected = (list(csv.DictReader(text.splitlines())) for text in (shipped, table_1()))
    numbers = [
        [(row["quantity"], row["side"], float(row["measured_mm"]), float(row["reference_mm"])) for row in rows]
        for rows in (read, expected)
    ]
    assert numbers[0] == numbers[1]


def test_uncertainties_of_both_sides_enter(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    header = HEADER.strip() + ",reference_expanded_uncertainty_mm,wheelset_id,scan_id,note\n"
    path.write_text("\ufeff" + header + "wheel_diameter,left,920.005,920.000,0.003,0.004,W1,s1,x\n\n", encoding="utf-8")
    report = accuracy_from_pairs(path)
    (row,) = report.blocks["pairs"].table.to_pylist()
    assert row["e_n"] == pytest.approx(1.0)
    assert (row["scan_id"], row["wheelset_id"]) == ("s1", "W1")
    assert report.notes == ("Columns that this report does not use: note.",)


def test_a_file_without_pairs_gives_an_empty_report(tmp_path: Path) -> None:
    (tmp_path / "none.csv").write_text(HEADER, encoding="utf-8")
    report = accuracy_from_pairs(tmp_path / "none.csv")
    assert report.is_empty
    assert "no pair" in report.spec.nothing


GOOD = "wheel_diameter,left,920.1,920.1,0.002\n"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", ["line 1", "empty", "expected the columns quantity, side"]),
        (HEADER.replace("side", "seite"), ["line 1", "no column side", "found quantity, seite"]),
        (HEADER.replace(",", ";"), ["line 1", "separated by commas"]),
        (HEADER.replace("reference_mm", "measured_mm"), ["line 1", "no column reference_mm"]),
        (HEADER.strip() + ",side\n", ["line 1", "column side", "2 times"]),
        (HEADER + GOOD + "wheel_diameter,middle,1,1,0\n", ["line 3", "column side", "'middle'", "left, right, both"]),
        (HEADER + GOOD * 2 + "wheel_diameter,left,abc,1,0\n", ["line 4", "column measured_mm", "'abc'", "in mm"]),
        (HEADER + "wheel_diameter,left,1,,0\n", ["line 2", "column reference_mm", "''"]),
        (HEADER + "wheel_diameter,left,nan,1,0\n", ["line 2", "column measured_mm", "'nan'"]),
        (HEADER + "wheel_diameter,left,1,1,-0.1\n", ["line 2", "column expanded_uncertainty_mm", "zero or more"]),
        (HEADER + ",left,1,1,0\n", ["line 2", "column quantity"]),
        (HEADER + "wheel_diameter,left,920,1,920,1,0\n", ["line 2", "7 cells", "expected 5", "decimal point"]),
        (HEADER + 'wheel_diameter,left,"1"2,1,0\n', ["line 2", "no CSV"]),
    ],
)  # fmt: skip
def test_a_malformed_file_is_named_with_line_and_column(tmp_path: Path, text: str, named: list[str]) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        accuracy_from_pairs(path)
    assert all(part in str(caught.value) for part in [str(path), *named]), str(caught.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.csv: cannot be read"):
        accuracy_from_pairs(tmp_path / "absent.csv")
    (tmp_path / "latin.csv").write_bytes(b"quantit\xe9")
    with pytest.raises(ConfigError, match=r"latin\.csv: byte 7 is no UTF-8"):
        accuracy_from_pairs(tmp_path / "latin.csv")
