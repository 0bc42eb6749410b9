"""The accuracy report against hand calculation, numpy and scipy, on synthetic tables."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import pytest
from report_data import UTC, at, campaign, failed, measurement, refused, review, warehouse
from scipy import stats

from warehouse.report import Report, build
from wheelset_assets.quality import ConfigError


def rows(report: Report, block: str) -> list[dict[str, Any]]:
    return report.blocks[block].table.to_pylist()


def only(report: Report, block: str) -> dict[str, Any]:
    (row,) = rows(report, block)
    return row


def wheel(scan_id: str, value: float | None, **given: Any) -> dict[str, Any]:
    return measurement(scan_id, "wheel_diameter", "left", value, **given)


def reviewed(value_mm: float, measured_at: datetime.datetime, **given: Any) -> dict[str, Any]:
    return review("wheel_diameter", "left", value_mm, measured_at, **given)


def pair_of(errors_um: list[float], **given: Any) -> Report:
    values = [wheel(f"s{i}", 920 + error / 1000, **given) for i, error in enumerate(errors_um)]
    return build(warehouse(values, [reviewed(920.0, at(4, 1))]), "accuracy", {})


def test_each_value_meets_the_review_nearest_in_time() -> None:
    reviews = [reviewed(920.001, at(3, 1)), reviewed(920.002, at(4, 10)), reviewed(920.003, at(7, 1))]
    values = [wheel("early", 920.0, captured_at=at(2, 1)), wheel("late", 920.0, captured_at=at(5, 1))]
    found = {row["scan_id"]: row for row in rows(build(warehouse(values, reviews), "accuracy", {}), "pairs")}
    assert found["early"]["reference_mm"] == 920.001
    assert found["late"]["reference_mm"] == 920.002
    assert found["late"]["days_to_reference"] == pytest.approx(-21)
    assert found["late"]["error_um"] == pytest.approx(-2, abs=1e-6)
    assert found["late"]["e_n"] == pytest.approx(-0.002 / np.hypot(0.002, 0.001))


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_equally_near_reviews_the_later_counts(order: int) -> None:
    reviews = [reviewed(920.001, at(4, 1, 6)), reviewed(920.002, at(4, 1, 14))][::order]
    report = build(warehouse([wheel("s", 920.0, captured_at=at(4, 1, 10))], reviews), "accuracy", {})
    assert only(report, "pairs")["reference_mm"] == 920.002


def test_nearness_is_absolute_time_whatever_the_zone() -> None:
    east = datetime.timezone(datetime.timedelta(hours=8))
    reviews = [
        reviewed(920.001, datetime.datetime(2024, 4, 2, 1, tzinfo=east)),  # the evening before, in UTC
        reviewed(920.002, datetime.datetime(2024, 4, 1, 6, tzinfo=UTC)),
    ]
    report = build(warehouse([wheel("s", 920.0, captured_at=at(4, 1, 13))], reviews), "accuracy", {})
    assert only(report, "pairs")["reference_mm"] == 920.001


def test_another_wheelset_side_or_quantity_is_no_review() -> None:
    reviews = [
        reviewed(920.0, at(4, 1), wheelset_id="W2"),
        review("wheel_diameter", "right", 920.0, at(4, 1)),
        review("inner_distance", "both", 1353.0, at(4, 1)),
    ]
    report = build(warehouse([wheel("s", 920.0)], reviews), "accuracy", {})
    assert report.is_empty
    assert only(report, "unreviewed")["why"] == "no review of this quantity and side"


def test_reference_scans_and_certificates_never_enter() -> None:
    values = [wheel("ref", 920.0, purpose="reference"), wheel("s", 920.0)]
    reviews = [reviewed(919.0, at(4, 1), source="certificate"), reviewed(920.001, at(9, 1))]
    report = build(warehouse(values, reviews), "accuracy", {})
    assert only(report, "pairs")["scan_id"] == "s"
    assert only(report, "pairs")["reference_mm"] == 920.001


def test_only_lengths_are_compared() -> None:
    values = [measurement("s", "cone_angle", "left", 1.5, unit="deg")]
    report = build(warehouse(values, [review("cone_angle", "left", 1.5, at(4, 1))]), "accuracy", {})
    assert report.is_empty
    assert only(report, "unreviewed")["why"] == "a review states lengths in mm"


def test_the_summary_is_what_numpy_and_scipy_say() -> None:
    report = build(campaign(), "accuracy", {})
    pairs = rows(report, "pairs")
    assert len(pairs) == 480
    for found in rows(report, "summary"):
        same = [row for row in pairs if (row["quantity"], row["side"]) == (found["quantity"], found["side"])]
        errors = np.array([1000 * (row["measured_mm"] - row["reference_mm"]) for row in same])
        n, bias, s = len(errors), errors.mean(), errors.std(ddof=1)
        u_reference = np.mean([500 * row["reference_expanded_uncertainty_mm"] for row in same])
        u_bias = np.hypot(s / np.sqrt(n), u_reference)
        df = min(1e6, np.floor((n - 1) * (u_bias / (s / np.sqrt(n))) ** 4))
        half = stats.t.ppf(0.975, df) * u_bias
        expected = {
            "n": 80,
            "n_wheelsets": 2,
            "n_reviews": 2,
            "bias_um": bias,
            "standard_deviation_um": s,
            "u_reference_um": u_reference,
            "bias_low_um": bias - half,
            "bias_high_um": bias + half,
            "max_error_um": abs(errors).max(),
            "mean_expanded_uncertainty_um": np.mean([1000 * row["expanded_uncertainty_mm"] for row in same]),
            "mean_e_n": np.mean([row["e_n"] for row in same]),
            "max_e_n": max(abs(row["e_n"]) for row in same),
            "within_ratio": np.mean([abs(row["e_n"]) <= 1 for row in same]),
        }
        assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-6)


def test_repeats_do_not_average_out_the_uncertainty_of_their_review() -> None:
    few, many = (only(pair_of([0.1, -0.1] * n), "summary") for n in (2, 200))
    for found in (few, many):
        assert found["bias_high_um"] - found["bias_um"] > 1.9 * 0.5  # U = 1 µm means u = 0.5 µm
    assert many["bias_high_um"] == pytest.approx(1.96 * 0.5, abs=1e-3)


def test_limits_of_agreement_by_hand() -> None:
    found = only(pair_of([1.0, 2.0, 3.0, 4.0, 5.0]), "limits")
    s = np.sqrt(2.5)
    half = 2.776445 * s * np.sqrt(3 / 5)
    assert found["lower_limit_um"] == pytest.approx(3 - 1.96 * s, abs=1e-6)
    assert found["upper_limit_um"] == pytest.approx(3 + 1.96 * s, abs=1e-6)
    assert found["upper_limit_low_um"] == pytest.approx(3 + 1.96 * s - half, abs=1e-5)
    assert found["lower_limit_low_um"] == pytest.approx(3 - 1.96 * s - half, abs=1e-5)
    assert found["slope_um_per_mm"] is None  # one size only


def test_an_error_that_grows_with_size_shows_as_a_slope() -> None:
    rng = np.random.default_rng(1)
    sizes = np.linspace(830, 920, 12)
    errors = 0.05 * (sizes - 880) + rng.standard_normal(12)
    values = [
        wheel(f"s{i}", d + e / 1000, wheelset_id=f"W{i}") for i, (d, e) in enumerate(zip(sizes, errors, strict=True))
    ]
    reviews = [reviewed(d, at(4, 1), wheelset_id=f"W{i}") for i, d in enumerate(sizes)]
    found = only(build(warehouse(values, reviews), "accuracy", {}), "limits")
    expected = stats.linregress(sizes + errors / 2000, errors)
    assert found["slope_um_per_mm"] == pytest.approx(expected.slope, rel=1e-6)
    assert found["slope_p"] == pytest.approx(expected.pvalue, abs=1e-9)


@pytest.mark.parametrize(
    ("errors_um", "verdict"),
    [
        ([0.3, -0.4, 0.2, -0.1], "agrees"),
        ([1.5, 1.6, 1.4, 1.5], "biased"),  # the review's 1 µm does not explain it, the stated 2 µm does
        ([0.1, -0.1, 0.2, 5.0], "disagrees"),  # E_n 2.2
        ([3.0, -3.0, 3.0, -3.0], "disagrees"),  # every E_n 1.3
        ([0.0] * 39 + [2.5], "agrees"),  # one E_n of 1.1 in forty is chance
        ([0.5], "too few"),
    ],
)
def test_verdicts_follow_the_stated_rule(errors_um: list[float], verdict: str) -> None:
    assert only(pair_of(errors_um), "summary")["verdict"] == verdict


def test_the_papers_figures_stand_beside_ours() -> None:
    found = {row["quantity"]: row for row in rows(build(campaign(), "accuracy", {}), "summary")}
    paper = {name: row["paper_error_um"] for name, row in found.items()}
    assert paper == {"journal_diameter": 3, "wheel_diameter": 40, "inner_distance": 20, "shoulder_distance": None}
    wheels = found["wheel_diameter"]
    assert wheels["paper_ratio"] == pytest.approx(40 / wheels["max_error_um"])


def test_one_pair_has_no_spread_and_breaks_nothing() -> None:
    report = pair_of([0.5])
    found = only(report, "summary")
    assert (found["n"], found["standard_deviation_um"], found["bias_low_um"]) == (1, None, None)
    assert only(report, "limits")["upper_limit_um"] is None


def test_what_could_not_be_compared_is_accounted_for() -> None:
    values = [
        wheel("a", 920.0),
        wheel("b", None, reason="tread not seen at 70 mm"),
        wheel("c", 920.0, wheelset_id="W7"),
        measurement("c", "qr", "left", 9.7, wheelset_id="W7"),
    ]
    status = [
        failed("f", at(5, 1), "no reference"),
        refused("r", "hash"),
        failed("p", at(5, 1), "-") | {"state": "pending"},
    ]
    report = build(warehouse(values, [reviewed(920.0, at(4, 1))], status), "accuracy", {})
    lonely = only(report, "unreviewed")
    assert (lonely["wheelset_id"], lonely["why"], lonely["n_scans"], lonely["n"]) == (
        "W7",
        "no review of this wheelset",
        1,
        2,
    )
    assert lonely["quantities"] == "qr left, wheel_diameter left"
    missing = only(report, "not_given")
    assert (missing["reason"], missing["n"], missing["example_scan_id"]) == ("tread not seen at 70 mm", 1, "b")
    assert [(row["scan_id"], row["reason"]) for row in rows(report, "refused")] == [
        ("r", "hash"),
        ("f", "no reference"),
    ]
    assert only(report, "by_wheelset")["n"] == 1


def test_filters_narrow_the_report_and_leave_nothing_behind() -> None:
    connection = campaign()
    may = build(
        connection, "accuracy", {"since": datetime.date(2024, 5, 1), "until": "2024-05-31", "wheelset_id": "W2"}
    )
    assert {row["wheelset_id"] for row in rows(may, "pairs")} == {"W2"}
    assert len(rows(may, "pairs")) == 48
    assert dict(may.parameters) == {"since": "2024-05-01", "until": "2024-05-31", "wheelset_id": "W2"}
    assert build(connection, "accuracy", {"rig_id": "other", "since": None}).is_empty
    assert len(rows(build(connection, "accuracy", {}), "pairs")) == 480
    views = {
        name for (name,) in connection.execute("SELECT view_name FROM duckdb_views() WHERE NOT internal").fetchall()
    }
    assert not {"accuracy_pairs", "production_values"} & views


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("precision", {}, "there are: accuracy, stability"),
        ("accuracy", {"wheel": "W1"}, "no parameter wheel"),
        ("accuracy", {"since": "May"}, "since 'May': expected a day as YYYY-MM-DD"),
    ],
)
def test_wrong_usage_is_said_to_be_so(name: str, parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(warehouse(), name, parameters)
