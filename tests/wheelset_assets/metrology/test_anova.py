"""ANOVA against certified answers: the StRD sets of the US standards institute, a textbook gauge study, scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from wheelset_assets.metrology.anova import gauge_study, linearity, one_way, precision, type_one

SILVER = (
    "8681568 8681465 8681572 8681785 8681446 8681903 8681526 8681494 8681616 8681587 8681519 8681486 8681419 8681569 "
    "8681508 8681672 8681385 8681518 8681662 8681424 8681360 8681333 8681610 8681477",
    "8681079 8681344 8681513 8681197 8681604 8681385 8681642 8681365 8681151 8681082 8681517 8681448 8681198 8681482 "
    "8681334 8681609 8681101 8681512 8681469 8681360 8681254 8681261 8681450 8681368",
)
SILICON = (
    "196.3052 196.1240 196.1890 196.2569 196.3403",
    "196.3042 196.3825 196.1669 196.3257 196.0422",
    "196.1303 196.2005 196.2889 196.0343 196.1811",
    "196.2795 196.1748 196.1494 196.1485 195.9885",
    "196.2119 196.1051 196.1850 196.0052 196.2090",
)


def simon_lesage(n: int, leading: int) -> tuple[list[str], list[str]]:
    """Nine treatments of n readings as Simon and Lesage made them, as decimal text behind constant leading digits."""
    values, parts = [], []
    for treatment in range(9):
        middle = 4 if treatment == 0 else 3 if treatment % 2 else 5
        for i in range(n):
            values.append(f"{leading}.{middle if i == 0 else middle - 1 if i % 2 else middle + 1}")
            parts.append(str(treatment + 1))
    return values, parts


CERTIFIED = {
    21: (1.68, 1.80, 21.0, 4.82758620689655e-1),
    201: (16.08, 18.0, 201.0, 4.71830985915493e-1),
    2001: (160.08, 180.0, 2001.0, 4.70712773465067e-1),
}


@pytest.mark.parametrize("n", list(CERTIFIED))
@pytest.mark.parametrize(("leading", "digits"), [(1, 14), (1_000_000, 9), (1_000_000_000_000, 3)])
def test_simon_lesage_to_the_digits_that_doubles_hold(n: int, leading: int, digits: int) -> None:
    text, parts = simon_lesage(n, leading)
    between, within, r_squared, n0 = one_way(np.array(text, dtype=float), parts)
    ss_between, ss_within, f, r2 = CERTIFIED[n]
    relative = 10.0**-digits
    assert (between.df, within.df) == (8, 9 * (n - 1))
    assert n0 == pytest.approx(n)
    for found, certified in ((between.sum_sq, ss_between), (within.sum_sq, ss_within), (between.f, f), (r_squared, r2)):
        assert found == pytest.approx(certified, rel=relative)


def of(groups: tuple[str, ...], prefix: str = "") -> tuple[np.ndarray, list[str]]:
    values = [(prefix + text, str(number)) for number, group in enumerate(groups) for text in group.split()]
    return np.array([float(text) for text, _ in values]), [label for _, label in values]


def test_atomic_weight_of_silver() -> None:
    between, within, r_squared, _ = one_way(*of(SILVER, "107."))
    assert between.sum_sq == pytest.approx(3.63834187500000e-09, rel=1e-9)
    assert within.sum_sq == pytest.approx(1.04951729166667e-08, rel=1e-9)
    assert between.f == pytest.approx(1.59467335677930e01, rel=1e-9)
    assert r_squared == pytest.approx(2.57426544538321e-01, rel=1e-9)


def test_silicon_resistivity() -> None:
    between, within, r_squared, _ = one_way(*of(SILICON))
    assert between.sum_sq == pytest.approx(5.11462616000000e-02, rel=1e-11)
    assert within.sum_sq == pytest.approx(2.16636560000000e-01, rel=1e-11)
    assert between.f == pytest.approx(1.18046237440255, rel=1e-11)
    assert np.sqrt(within.mean_sq) == pytest.approx(1.04076068334656e-01, rel=1e-11)
    assert r_squared == pytest.approx(1.90999039051129e-01, rel=1e-11)


# Ten parts, three operators, three trials: the worked example of AIAG's manual; by operator, trial and part.
AIAG = {
    "A": (
        "0.29 -0.56 1.34 0.47 -0.80 0.02 0.59 -0.31 2.26 -1.36",
        "0.41 -0.68 1.17 0.50 -0.92 -0.11 0.75 -0.20 1.99 -1.25",
        "0.64 -0.58 1.27 0.64 -0.84 -0.21 0.66 -0.17 2.01 -1.31",
    ),
    "B": (
        "0.08 -0.47 1.19 0.01 -0.56 -0.20 0.47 -0.63 1.80 -1.68",
        "0.25 -1.22 0.94 1.03 -1.20 0.22 0.55 0.08 2.12 -1.62",
        "0.07 -0.68 1.34 0.20 -1.28 0.06 0.83 -0.34 2.19 -1.50",
    ),
    "C": (
        "0.04 -1.38 0.88 0.14 -1.46 -0.29 0.02 -0.46 1.77 -1.49",
        "-0.11 -1.13 1.09 0.20 -1.07 -0.67 0.01 -0.56 1.45 -1.77",
        "-0.15 -0.96 0.67 0.11 -1.45 -0.49 0.21 -0.49 1.87 -2.16",
    ),
}


def aiag() -> tuple[np.ndarray, list[str], list[str]]:
    rows = [
        (float(text), str(part), operator)
        for operator, trials in AIAG.items()
        for trial in trials
        for part, text in enumerate(trial.split())
    ]
    return np.array([row[0] for row in rows]), [row[1] for row in rows], [row[2] for row in rows]


def test_the_textbook_gauge_study() -> None:
    found = gauge_study(*aiag())
    table = {line.source: line for line in found.anova}
    assert "pooled with repeatability" in found.pooling
    assert "part:operator" not in table
    assert table["part"].sum_sq == pytest.approx(88.3619, abs=5e-5)
    assert table["operator"].sum_sq == pytest.approx(3.1673, abs=5e-5)
    assert table["part"].f == pytest.approx(245.614, abs=5e-3)
    assert table["operator"].f == pytest.approx(39.617, abs=5e-3)
    s = found.standard_deviations
    assert s["repeatability"] == pytest.approx(0.199933, abs=5e-6)
    assert s["operator"] == pytest.approx(0.226838, abs=5e-6)
    assert s["gauge"] == pytest.approx(0.302373, abs=5e-6)
    assert s["part"] == pytest.approx(1.042327, abs=5e-6)
    assert s["total"] == pytest.approx(1.085300, abs=5e-5)
    assert found.grr_percent == pytest.approx(27.86, abs=5e-3)
    assert found.ndc == pytest.approx(np.sqrt(2) * s["part"] / s["gauge"])
    assert sum(line.df for line in found.anova if line.source != "total") == 89


def test_an_interaction_that_is_real_is_kept() -> None:
    rng = np.random.default_rng(0)
    parts = [str(p) for p in range(6) for _ in range(3) for _ in range(4)]
    operators = [str(o) for _ in range(6) for o in range(3) for _ in range(4)]
    cell = np.repeat(rng.standard_normal(18), 4)
    found = gauge_study(cell + 0.1 * rng.standard_normal(72), parts, operators, tolerance=6.0)
    assert "kept" in found.pooling
    grid = [[] for _ in range(18)]  # type: list[list[float]]
    assert len(grid) == 18
    assert found.variance_components["part:operator"] > 0.3
    assert found.variance_components["repeatability"] == pytest.approx(0.01, rel=0.6)
    assert found.grr_percent_of_tolerance == pytest.approx(100 * found.standard_deviations["gauge"])


def test_known_components_are_found_again() -> None:
    rng = np.random.default_rng(1)
    p, o, r, runs = 8, 5, 3, 300
    sums = np.zeros(4)
    parts = [str(i) for i in range(p) for _ in range(o * r)]
    operators = [str(j) for _ in range(p) for j in range(o) for _ in range(r)]
    for _ in range(runs):
        y = (
            1000.0
            + 2.0 * rng.standard_normal(p)[:, None, None]
            + 0.7 * rng.standard_normal(o)[None, :, None]
            + 0.5 * rng.standard_normal((p, o))[:, :, None]
            + 0.3 * rng.standard_normal((p, o, r))
        )
        c = gauge_study(y.ravel(), parts, operators).variance_components
        sums += [c["part"], c["operator"], c["part:operator"], c["repeatability"]]
    assert sums / runs == pytest.approx([4.0, 0.49, 0.25, 0.09], rel=0.12)


def test_one_way_agrees_with_scipy_and_common_parts_do_not_matter() -> None:
    rng = np.random.default_rng(2)
    groups = [rng.standard_normal(n) + i for i, n in enumerate((4, 7, 5))]
    labels = [str(i) for i, g in enumerate(groups) for _ in g]
    between, within, _, _ = one_way(np.concatenate(groups), labels)
    expected = stats.f_oneway(*groups)
    assert between.f == pytest.approx(expected.statistic, rel=1e-12)
    assert between.p == pytest.approx(expected.pvalue, rel=1e-9)
    moved, _, _, _ = one_way(np.concatenate(groups) + 1e6, labels)
    assert moved.sum_sq == pytest.approx(between.sum_sq, rel=1e-8)
    assert within.mean_sq > 0


def test_unequal_cells_are_said_and_empty_ones_refused() -> None:
    values, parts, operators = aiag()
    found = gauge_study(values[1:], parts[1:], operators[1:])
    assert "unweighted means" in found.notes[0]
    assert found.grr_percent == pytest.approx(27.86, abs=1.5)
    keep = [not (p == "3" and o == "B") for p, o in zip(parts, operators, strict=True)]
    with pytest.raises(ValueError, match="part 3 was not measured by operator B"):
        gauge_study(values[keep], *([x for x, k in zip(names, keep, strict=True) if k] for names in (parts, operators)))
    with pytest.raises(ValueError, match="one part only"):
        gauge_study(values[:3], ["a"] * 3)
    with pytest.raises(ValueError, match="two values"):
        gauge_study(values[:3], ["a", "b", "c"])
    with pytest.raises(ValueError, match="twice"):
        gauge_study(values[:4], ["a", "a", "b", "b"], ["x", "y", "x", "y"])
    with pytest.raises(ValueError, match="finite"):
        gauge_study(np.array([1.0, np.nan]), ["a", "a"])


def test_a_type_one_study_by_hand() -> None:
    values = np.array([10.01, 10.02, 10.00, 10.01, 10.01])
    found = type_one(values, 10.0, 0.5, resolution=0.01)
    s = np.std(values, ddof=1)
    assert found.bias == pytest.approx(0.01)
    assert found.cg == pytest.approx(0.2 * 0.5 / (6 * s))
    assert found.cgk == pytest.approx((0.05 - 0.01) / (3 * s))
    assert found.resolution_percent == pytest.approx(2.0)
    assert found.bias_p == pytest.approx(stats.ttest_1samp(values, 10.0).pvalue, rel=1e-6)


def test_linearity_agrees_with_scipy() -> None:
    rng = np.random.default_rng(3)
    reference = np.repeat([900.0, 905.0, 910.0, 915.0, 920.0], 6)
    values = reference + 0.01 - 0.0005 * (reference - 910) + 0.002 * rng.standard_normal(30)
    found, expected = linearity(values, reference), stats.linregress(reference, values - reference)
    assert found.slope == pytest.approx(expected.slope, rel=1e-8)
    assert found.intercept == pytest.approx(expected.intercept, rel=1e-8)
    assert found.slope_standard_error == pytest.approx(expected.stderr, rel=1e-8)
    assert found.intercept_standard_error == pytest.approx(expected.intercept_stderr, rel=1e-8)
    assert found.slope_p == pytest.approx(expected.pvalue, rel=1e-6)
    assert found.r_squared == pytest.approx(expected.rvalue**2, rel=1e-8)


def test_precision_of_equal_groups_by_hand() -> None:
    values = np.array([1.0, 1.2, 1.1, 2.0, 2.2, 2.4, 1.5, 1.4, 1.6])
    found = precision(values, list("aaabbbccc"))
    groups = values.reshape(3, 3)
    s_r2 = groups.var(axis=1, ddof=1).mean()
    s_l2 = groups.mean(axis=1).var(ddof=1) - s_r2 / 3
    assert found.s_r == pytest.approx(np.sqrt(s_r2))
    assert found.s_l == pytest.approx(np.sqrt(s_l2))
    assert found.reproducibility_limit == pytest.approx(2.8 * np.sqrt(s_r2 + s_l2))
