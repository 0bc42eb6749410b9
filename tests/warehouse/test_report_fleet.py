"""The fleet and wheelset reports against numpy and scipy, and against what a depot would decide by hand."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import pytest
from report_data import UTC, at, failed, measurement, warehouse
from scipy import stats

from warehouse.render_figures import draw
from warehouse.report import Report, build
from wheelset_assets.quality import ConfigError

FIRST = datetime.datetime(2024, 1, 1, 12, tzinfo=UTC)


def worn(
    wheelset: str, values: list[float], days: list[int], expanded: float = 0.02, **given: Any
) -> list[dict[str, Any]]:
    """Flange heights of one wheel on some days; the example limits of CRH3 allow at most 36 in operation, 33 in planning."""
    return [
        measurement(
            f"{wheelset}-{day}",
            given.get("quantity", "flange_height"),
            "left",
            value,
            wheelset_id=wheelset,
            captured_at=FIRST + datetime.timedelta(days=day),
            expanded_uncertainty=expanded,
        )
        for value, day in zip(values, days, strict=True)
    ]


def rows(report: Report, block: str) -> list[dict[str, Any]]:
    return report.blocks[block].table.to_pylist()


def fleet(*wheelsets: list[dict[str, Any]], **parameters: str) -> Report:
    return build(warehouse([row for rows in wheelsets for row in rows]), "fleet", parameters)


def action(report: Report) -> dict[str, str]:
    return {row["wheelset_id"]: row["action"] for row in rows(report, "turning")}


def test_the_list_says_what_a_depot_would_say() -> None:
    days = [0, 30, 60, 90]
    report = fleet(
        worn("now", [36.2, 36.3, 36.4, 36.5], days),
        worn("undecided", [35.99], [90]),
        worn("soon", [35.0, 35.33, 35.66, 35.97], days),
        worn("planned", [32.0, 32.4, 32.8, 33.2], days),
        worn("good", [28.0, 28.01, 28.02, 28.03], days),
    )
    assert action(report) == {
        "now": "turn now",
        "undecided": "turn this week",
        "soon": "turn this week",
        "planned": "turn at next visit",
        "good": "none",
    }
    assert next(row["wheelset_id"] for row in rows(report, "turning")) == "now"
    chance = {row["wheelset_id"]: row["probability"] for row in rows(report, "turning")}
    assert chance["now"] > 0.999
    assert chance["good"] > 0.999
    assert chance["undecided"] == pytest.approx(stats.norm.sf(0.01 / 0.01), abs=1e-9)
    assert 0.5 < chance["soon"] <= 1


def test_small_wheels_are_for_the_workshop_and_missing_values_for_the_rig() -> None:
    small = [
        measurement("a", "wheel_diameter", "left", 829.9, wheelset_id="small", captured_at=at(4, 1)),
        measurement("b", "flange_height", "left", 28.0, wheelset_id="blind", captured_at=at(4, 1)),
        measurement("b", "flange_thickness", "left", None, wheelset_id="blind", captured_at=at(4, 1)),
        measurement("c", "nothing_limited", "left", 1.0, wheelset_id="free", captured_at=at(4, 1)),
    ]
    assert action(fleet(small)) == {"small": "workshop now", "blind": "measure again", "free": "no limit applies"}


def test_the_trend_is_a_least_squares_line_through_the_visits() -> None:
    rng = np.random.default_rng(1)
    days = np.array([0, 20, 45, 70, 110])
    values = 30 + 0.004 * days + 0.01 * rng.standard_normal(days.size)
    (found,) = rows(fleet(worn("w", list(values), days.tolist())), "trends")
    fit = stats.linregress(days, values)
    month = 365.25 / 12
    half = stats.t.ppf(0.975, 3) * fit.stderr
    assert found["change_per_month"] == pytest.approx(month * fit.slope, rel=1e-9)
    assert found["change_low_per_month"] == pytest.approx(month * (fit.slope - half), rel=1e-6)
    assert found["change_high_per_month"] == pytest.approx(month * (fit.slope + half), rel=1e-6)
    assert found["change_p"] == pytest.approx(fit.pvalue, abs=1e-9)


def test_the_forecast_is_the_line_and_its_interval_is_fiellers() -> None:
    days = np.array([0.0, 30, 60, 90, 120])
    values = np.array([31.0, 31.52, 31.98, 32.51, 32.99])
    report = fleet(worn("w", list(values), [int(day) for day in days]))
    (found,) = [row for row in rows(report, "forecasts") if row["level"] == "operating" and row["bound"] == "max"]
    fit = stats.linregress(days, values)
    reach = (36 - fit.intercept) / fit.slope
    as_of = (FIRST + datetime.timedelta(days=120)).date()
    assert abs((found["reaches_on"] - as_of).days - (reach - 120)) < 1.01
    t, s = stats.t.ppf(0.975, 3), np.sqrt(np.sum((values - fit.intercept - fit.slope * days) ** 2) / 3)
    sxx = np.sum((days - days.mean()) ** 2)

    def outside(day: float) -> float:
        line = fit.intercept + fit.slope * day
        return (36 - line) ** 2 - 0.02**2 - (t * s) ** 2 * (1 / 5 + (day - days.mean()) ** 2 / sxx)

    for column in ("earliest_on", "latest_on"):
        day = (found[column] - as_of).days + 120
        assert outside(day - 1) * outside(day + 1) < 0 or abs(outside(day)) < 0.01, column
    assert found["earliest_on"] < found["reaches_on"] < found["latest_on"]
    u_line = s * np.sqrt(1 / 5 + (127 - days.mean()) ** 2 / sxx)
    assert found["expanded_uncertainty_in_a_week"] == pytest.approx(2 * np.hypot(0.01, u_line), rel=1e-9)


def test_the_claimed_interval_of_the_day_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    days = [0, 30, 60, 90, 120]
    true_reach = (36 - 33.0) / 0.015
    fleetwide = []
    for number in range(400):
        common = 0.01 * rng.standard_normal()  # shared by all visits, as the value's own uncertainty is taken to be
        values = [33.0 + 0.015 * day + common + 0.03 * rng.standard_normal() for day in days]
        fleetwide += worn(f"w{number}", values, days)
    found = [
        row for row in rows(fleet(fleetwide), "forecasts") if row["level"] == "operating" and row["bound"] == "max"
    ]
    truth = (FIRST + datetime.timedelta(days=true_reach)).date()
    held = np.mean(
        [row["earliest_on"] <= truth and (row["latest_on"] is None or truth <= row["latest_on"]) for row in found]
    )
    assert len(found) == 400
    assert 0.92 < held < 0.995  # 95 %, rounding to days, and the width not far above what is needed
    narrow = [row for row in found if row["latest_on"] and (row["latest_on"] - row["earliest_on"]).days < 200]
    assert len(narrow) > 100


def test_a_turning_begins_the_trend_anew() -> None:
    report = fleet(worn("w", [33.0, 33.5, 34.0, 28.0, 28.3, 28.6], [0, 30, 60, 90, 120, 150]))
    (trend,) = rows(report, "trends")
    assert trend["n_visits"] == 3
    assert trend["change_per_month"] == pytest.approx(0.3 * 365.25 / 12 / 30, rel=1e-6)
    assert [row["n_turnings"] for row in rows(report, "visits")] == [0, 0, 0, 1, 1, 1]


def test_changes_are_judged_against_their_uncertainty() -> None:
    (change,) = rows(fleet(worn("w", [30.0, 30.05], [0, 30], expanded=0.02)), "changes")
    assert change["change"] == pytest.approx(0.05)
    assert change["change_ratio"] == pytest.approx(0.05 / (0.02 * np.sqrt(2)))


def test_the_last_night_is_told_with_reasons() -> None:
    measured = worn("w", [30.0], [90])
    blind = measurement("w-90", "qr", "left", None, wheelset_id="w", captured_at=measured[0]["captured_at"])
    bad = failed("x", measured[0]["captured_at"], "no stripe") | {"wheelset_id": "x"}
    old = failed("y", at(1, 2), "long ago")
    report = build(warehouse([*measured, blind], status=[bad, old]), "fleet", {})
    told = {(row["scan_id"], row["what"]): row["reason"] for row in rows(report, "last_night")}
    assert told == {("x", "failed"): "no stripe", ("w-90", "qr left"): "not seen"}


def test_the_day_of_the_report_can_be_set() -> None:
    courses = worn("w", [32.0, 32.5, 33.0, 35.99], [0, 30, 60, 90])
    early = fleet(courses, until=(FIRST + datetime.timedelta(days=60)).date().isoformat())
    assert action(early) == {"w": "turn at next visit"}
    assert action(fleet(courses))["w"].startswith("turn")


def test_the_page_of_a_wheelset_shows_its_last_turn() -> None:
    angle = np.arange(0, 360, 10.0)
    radius = 460 + 0.05 * np.cos(np.radians(angle - 30)) + 0.004 * np.cos(3 * np.radians(angle))
    frames = [
        {"scan_id": scan, "station": "lw", "series": "tread_radius", "frame": i, "angle_deg": a, "value_mm": r,
         "used": True, "fitted_mm": r}
        for scan in ("w-0", "w-90") for i, (a, r) in enumerate(zip(angle, radius, strict=True))
    ]  # fmt: skip
    stations = [{"scan_id": scan, "station": "lw", "side": "left"} for scan in ("w-0", "w-90")]
    connection = warehouse(worn("w", [30.0, 30.1], [0, 90]), others={"turns": frames, "alignments": stations})
    report = build(connection, "wheelset", {"wheelset_id": "w"})
    (run,) = rows(report, "runs")
    assert run["scan_id"] == "w-90"
    assert run["n"] == 36
    assert run["runout_um"] == pytest.approx(1000 * np.ptp(radius), rel=1e-9)
    assert run["roundness_um"] == pytest.approx(1000 * np.ptp(0.004 * np.cos(3 * np.radians(angle))), rel=1e-6)


def test_a_page_names_its_wheelset_or_chooses_the_most_urgent() -> None:
    connection = warehouse(worn("bad", [37.0], [90]) + worn("fine", [28.0], [90]))
    chosen = build(connection, "wheelset", {})
    assert chosen.parameters["wheelset_id"] == "bad"
    assert "first of the fleet's list" in chosen.notes[0]
    assert build(connection, "wheelset", {"wheelset_id": "nobody"}).is_empty
    with pytest.raises(ConfigError, match="no parameter"):
        build(connection, "wheelset", {"wheelset": "bad"})


def test_the_profile_is_drawn_beside_the_nominal() -> None:
    lateral = np.arange(2.0, 130.0, 0.1)
    points = [
        {"scan_id": "w-90", "station": "lw", "from_inner_face_mm": x, "height_mm": 0.01 * x, "deviation_um": -300.0}
        for x in lateral
    ]
    stations = [{"scan_id": "w-90", "station": "lw", "side": "left"}]
    tables = {"wheel_profiles": points, "alignments": stations}
    report = build(warehouse(worn("w", [30.1], [90]), others=tables), "wheelset", {"wheelset_id": "w"})
    found = rows(report, "profile")
    assert {row["deviation_um"] for row in found} == {-300.0}
    assert sum(row["n"] for row in found) == lateral.size
    at_datum = next(row for row in found if row["lateral_mm"] == 0)
    assert at_datum["height_mm"] == pytest.approx(0.7, abs=0.003)


def test_what_a_rig_never_sees_is_no_reason_to_measure_again() -> None:
    def scans(n: int, given: int) -> list[dict[str, Any]]:
        return [
            row
            for k in range(n)
            for row in (
                measurement(f"s{k:02}", "flange_height", "left", 28.0, wheelset_id="w", captured_at=at(4, k + 1)),
                measurement(
                    f"s{k:02}",
                    "rim_width",
                    "left",
                    135.0 if k < given else None,
                    wheelset_id="w",
                    captured_at=at(4, k + 1),
                ),
            )
        ]

    never = fleet(scans(10, 0))
    assert action(never) == {"w": "none"}
    assert [(row["quantity"], row["n_scans"]) for row in rows(never, "unseen")] == [("rim_width", 10)]
    for seldom in (fleet(scans(9, 0)), fleet(scans(10, 1))):
        assert action(seldom) == {"w": "measure again"}
        assert rows(seldom, "unseen") == []


def test_values_missing_for_one_reason_are_one_line() -> None:
    day = at(4, 1)
    missing = [measurement(f"s{k}", "qr", "left", None, wheelset_id=f"w{k}", captured_at=day) for k in range(5)]
    given = [measurement("old", "qr", "left", 10.8, wheelset_id="w0", captured_at=at(3, 1))]
    given += [measurement("s0", "qr", "right", 10.8, wheelset_id="w0", captured_at=day)]
    (row,) = rows(fleet(missing, given), "last_night")
    assert (row["what"], row["n_scans"], row["scan_id"], row["given_before"]) == ("qr left", 5, "s4", True)


def test_the_surface_is_drawn_unrolled() -> None:
    bins = [
        {"scan_id": "w-90", "station": "lw", "angle_deg": angle, "from_inner_face_mm": place, "n_points": n}
        | {"deviation_um": 10.0 * n}
        for angle, n in ((0.5, 1), (1.5, 3), (3.0, 2))
        for place in (68.25, 69.75, 71.25)
    ]
    stations = [{"scan_id": "w-90", "station": "lw", "side": "left"}]
    tables = {"tread_maps": bins, "alignments": stations}
    report = build(warehouse(worn("w", [30.1], [90]), others=tables), "wheelset", {"wheelset_id": "w"})
    found = {(row["angle_deg"], row["lateral_mm"]): row["deviation_um"] for row in rows(report, "map")}
    assert len(found) == 6
    assert found[1.25, -1.75] == pytest.approx((10 * 1 + 30 * 3) / 4)  # weighted by the points of each bin
    assert found[3.75, 1.25] == pytest.approx(20)
    (drawing,) = [draw(report, figure) for figure in report.spec.figures if figure.name == "map"]
    assert [panel.title for group in drawing.groups for panel in group.panels] == ["left wheel"]
