"""The stability report against numpy and scipy, on synthetic tables."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import pytest
from report_data import SIX, at, campaign, measurement, review, warehouse
from scipy import stats

from warehouse.report import Report, build

DAYS_PER_MONTH = 365.25 / 12


@pytest.fixture(scope="module")
def report() -> Report:
    return build(campaign(), "stability", {})


def rows(report: Report, block: str) -> list[dict[str, Any]]:
    return report.blocks[block].table.to_pylist()


def values_of(report: Report, found: dict[str, Any]) -> list[dict[str, Any]]:
    names = [name for name in ("wheelset_id", "quantity", "side", "month") if name in found]
    return [row for row in rows(report, "values") if all(row[name] == found[name] for name in names)]


def series(values: list[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([row[name] for row in values])


def test_the_six_dimensions_of_every_wheelset_are_there(report: Report) -> None:
    assert len(rows(report, "values")) == 480
    assert len(rows(report, "over_all")) == 12
    first = [(row["quantity"], row["side"]) for row in rows(report, "over_all")][:6]
    assert first == [(quantity, side) for quantity, side, _, _ in SIX]
    other = warehouse([measurement("s", "qr", "left", 9.7)])
    assert build(other, "stability", {}).is_empty


def test_months_are_what_numpy_says(report: Report) -> None:
    months = rows(report, "by_month")
    assert len(months) == 60
    for found in months:
        same = values_of(report, found)
        compensated, raw = (1000 * series(same, name) for name in ("value_mm", "value_uncompensated_mm"))
        assert found["n"] == 8
        assert found["mean_mm"] == pytest.approx(compensated.mean() / 1000, abs=1e-9)
        assert found["standard_deviation_um"] == pytest.approx(compensated.std(ddof=1), abs=1e-6)
        assert found["range_um"] == pytest.approx(np.ptp(compensated), abs=1e-6)
        assert found["range_uncompensated_um"] == pytest.approx(np.ptp(raw), abs=1e-6)
        assert found["mean_rig_temperature_c"] == pytest.approx(series(same, "rig_temperature_c").mean())
        mean_time = np.mean([row["captured_at"].timestamp() for row in same])
        assert found["mean_captured_at"].timestamp() == pytest.approx(mean_time, abs=1e-3)


def test_the_whole_is_what_numpy_says_beside_the_papers_range(report: Report) -> None:
    paper = {("journal_diameter", "left"): 4, ("journal_diameter", "right"): 5}
    paper |= {("wheel_diameter", "left"): 40, ("wheel_diameter", "right"): 30}
    reviews = {(row["wheelset_id"], row["quantity"], row["side"]): row for row in rows(report, "reviews")}
    for found in rows(report, "over_all"):
        same = values_of(report, found)
        compensated = 1000 * series(same, "value_mm")
        line = reviews[found["wheelset_id"], found["quantity"], found["side"]]
        assert (found["n"], found["n_months"]) == (40, 5)
        assert found["range_um"] == pytest.approx(np.ptp(compensated), abs=1e-6)
        assert found["from_review_um"] == pytest.approx(compensated.mean() - 1000 * line["review_mm"], abs=1e-6)
        assert found["largest_month_range_um"] <= found["range_um"]
        assert found["range_uncompensated_um"] > 10 * found["range_um"]
        assert found["paper_range_um"] == paper.get((found["quantity"], found["side"]))
        if found["paper_range_um"]:
            assert found["paper_ratio"] == pytest.approx(found["paper_range_um"] / found["range_um"])


@pytest.mark.parametrize(
    ("column", "slope", "error", "p"),
    [
        ("value_mm", "drift_um_per_month", "drift_standard_error_um_per_month", "drift_p"),
        ("value_uncompensated_mm", "drift_uncompensated_um_per_month",
         "drift_uncompensated_standard_error_um_per_month", "drift_uncompensated_p"),
    ],
)  # fmt: skip
def test_drift_is_scipys_regression(report: Report, column: str, slope: str, error: str, p: str) -> None:
    for found in rows(report, "drift"):
        same = values_of(report, found)
        months = np.array([row["captured_at"].timestamp() for row in same]) / 86400 / DAYS_PER_MONTH
        expected = stats.linregress(months - months.min(), 1000 * (series(same, column) - series(same, column).mean()))
        assert found[slope] == pytest.approx(expected.slope, abs=1e-7)
        assert found[error] == pytest.approx(expected.stderr, abs=1e-7)
        assert found[p] == pytest.approx(expected.pvalue, abs=1e-9)
        assert found["span_months"] == pytest.approx(np.ptp(months))


def test_a_drift_that_is_there_is_found() -> None:
    rng = np.random.default_rng(2)
    start = at(4, 1)
    values = [
        measurement(
            f"s{day}",
            "inner_distance",
            "both",
            1353 + 0.002 * day / DAYS_PER_MONTH + 0.0005 * rng.standard_normal(),
            captured_at=start + datetime.timedelta(days=day),
        )
        for day in range(0, 150, 3)
    ]
    (found,) = rows(build(warehouse(values), "stability", {}), "drift")
    assert found["drift_low_um_per_month"] < 2 < found["drift_high_um_per_month"]
    assert found["drift_p"] < 1e-6


def test_correlation_with_temperature_is_scipys(report: Report) -> None:
    for found in rows(report, "temperature"):
        same = values_of(report, found)
        warm = series(same, "wheelset_temperature_c")
        expected = stats.pearsonr(warm, series(same, "value_mm"))
        assert found["correlation_wheelset"] == pytest.approx(expected.statistic, abs=1e-7)
        assert found["correlation_wheelset_p"] == pytest.approx(expected.pvalue, abs=1e-7)
        assert found["correlation_wheelset_uncompensated"] < -0.99
        assert found["correlation_rig_uncompensated"] < -0.99
        assert found["slope_uncompensated_um_per_k"] == pytest.approx(-5.3, abs=0.1)


def test_few_or_constant_values_give_nulls_and_no_nonsense() -> None:
    same = [measurement(f"s{i}", "wheel_diameter", "left", 920.0, value_uncompensated=None) for i in range(4)]
    report = build(warehouse([*same, measurement("t", "wheel_diameter", "right", 920.0)]), "stability", {})
    left, right = rows(report, "over_all")
    assert (left["range_um"], left["range_uncompensated_um"], left["from_review_um"]) == (0, None, None)
    assert (right["n"], right["range_um"], right["standard_deviation_um"]) == (1, None, None)
    (drift,) = rows(report, "drift")
    assert (drift["drift_um_per_month"], drift["drift_p"], drift["drift_uncompensated_p"]) == (None, None, None)
    (temperature,) = rows(report, "temperature")
    assert {temperature[name] for name in temperature if name.startswith(("correlation", "slope"))} == {None}


def test_reference_scans_and_certificates_stay_out() -> None:
    wheel = ("wheel_diameter", "left")
    values = [measurement("r", *wheel, 900.0, purpose="reference"), measurement("s", *wheel, 920.0)]
    reviews = [review(*wheel, 920.001, at(4, 1)), review(*wheel, 910.0, at(4, 1), source="certificate")]
    report = build(warehouse(values, reviews), "stability", {})
    assert [row["scan_id"] for row in rows(report, "values")] == ["s"]
    assert [row["review_mm"] for row in rows(report, "reviews")] == [920.001]
