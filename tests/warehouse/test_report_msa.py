"""The measurement system report against the ANOVA that is certified elsewhere in the tests."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from report_data import at, measurement, review, warehouse

from warehouse.report import build
from wheelset_assets.metrology.anova import linearity, one_way


def test_precision_and_gauge_are_those_of_the_analysis_of_variance() -> None:
    rng = np.random.default_rng(4)
    rows, values, cells, parts = [], [], [], []
    for part in range(6):
        size = 1353 + 0.05 * rng.standard_normal()
        for day in range(5):
            shift = 0.004 * rng.standard_normal()
            for repeat in range(4):
                value = size + shift + 0.002 * rng.standard_normal()
                moment = at(4, 1) + datetime.timedelta(days=day, minutes=repeat)
                rows.append(
                    measurement(
                        f"{part}-{day}-{repeat}",
                        "inner_distance",
                        "both",
                        value,
                        wheelset_id=f"W{part}",
                        captured_at=moment,
                    )
                )
                values.append(value)
                cells.append(f"{part}/{day}")
                parts.append(str(part))
    connection = warehouse(rows)
    report = build(connection, "msa", {})
    narrowest = connection.execute(
        "SELECT min(limit_max - limit_min) FROM limits WHERE quantity = 'inner_distance' AND wheelset_type = 'CRH3'"
    ).fetchall()
    (found,) = report.blocks["precision"].table.to_pylist()
    y = np.array(values)
    means = {part: y[[p == part for p in parts]].mean() for part in set(parts)}
    centred = y - np.array([means[part] for part in parts])
    between, within, _, _ = one_way(centred, cells)
    ms_between = between.sum_sq / (6 * 4)  # the parts' means were taken off: one degree of freedom each
    assert found["f_df_between"] == 24
    assert found["repeatability_um"] == pytest.approx(1000 * np.sqrt(within.mean_sq), rel=1e-6)
    between_days = np.sqrt((ms_between - within.mean_sq) / 4)
    assert found["between_days_um"] == pytest.approx(1000 * between_days, rel=1e-6)
    assert found["between_days_um"] == pytest.approx(4, rel=0.4)
    assert found["reproducibility_limit_um"] == pytest.approx(
        2800 * np.hypot(np.sqrt(within.mean_sq), between_days), rel=1e-6
    )
    (gauge,) = report.blocks["gauge"].table.to_pylist()
    variance = np.var(list(means.values()), ddof=1) - within.mean_sq / 20 - between_days**2 / 5
    assert gauge["part_um"] == pytest.approx(1000 * np.sqrt(variance), rel=1e-6)
    assert [(gauge["tolerance"],)] == narrowest
    assert gauge["grr_percent_of_tolerance"] == pytest.approx(0.6 * gauge["gauge_um"] / gauge["tolerance"])
    assert gauge["n_distinct"] == pytest.approx(np.sqrt(2) * gauge["part_um"] / gauge["gauge_um"])


def test_linearity_is_the_line_through_the_errors() -> None:
    rng = np.random.default_rng(5)
    sizes = np.array([860.0, 880, 900, 920])
    reviews = [review("wheel_diameter", "left", size, at(4, 1), wheelset_id=f"{size}") for size in sizes]
    at_size = np.repeat(sizes, 3)
    values = at_size + 0.003 + 0.0001 * (at_size - 890) + 0.001 * rng.standard_normal(12)
    rows = [
        measurement(f"s{i}", "wheel_diameter", "left", value, wheelset_id=f"{size}", captured_at=at(4, 1 + i))
        for i, (value, size) in enumerate(zip(values, at_size, strict=True))
    ]
    (found,) = build(warehouse(rows, reviews), "msa", {}).blocks["linearity"].table.to_pylist()
    expected = linearity(values, at_size)
    assert found["slope_um_per_mm"] == pytest.approx(1000 * expected.slope, rel=1e-6)
    assert found["slope_standard_error_um_per_mm"] == pytest.approx(1000 * expected.slope_standard_error, rel=1e-6)
    assert found["slope_p"] == pytest.approx(expected.slope_p, rel=1e-5)


def test_one_day_tells_nothing_of_days() -> None:
    rows = [measurement(f"s{i}", "wheel_diameter", "left", 920 + i / 1000) for i in range(5)]
    assert build(warehouse(rows), "msa", {}).is_empty
