"""Analysis of variance for measurement systems: one-way, and crossed parts and operators, with variance components.

Data are centred about an exactly rounded mean before anything is squared, means and sums of squares are compensated sums
(`math.fsum`), and squares carry their rounding errors: large common parts of the values (Simon and Lesage's constant
leading digits) cost no digits that the data themselves still hold.

Formulas: AIAG Measurement Systems Analysis, 4th edition, chapter III (crossed gauge R&R); ISO 5725-2 (repeatability and
reproducibility). Values are in their own unit, sums of squares in its square.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POOLING_P = 0.25
"""An interaction with a p-value above this is pooled with the repeatability (AIAG's choice)."""
NDC_FACTOR = math.sqrt(2.0)
"""Number of distinct categories = √2 · part / gauge; AIAG prints it as 1.41."""


@dataclass(frozen=True)
class Line:
    """One line of an ANOVA table; `f` and `p` are None where nothing is tested."""

    source: str
    df: int
    sum_sq: float
    mean_sq: float
    f: float | None = None
    p: float | None = None


@dataclass(frozen=True)
class GaugeStudy:
    """A gauge study: table, variance components by name, and shares of the standard deviation.

    `grr_percent` is of the total standard deviation, `grr_percent_of_tolerance` 6 σ over the tolerance; `ndc` is None
    where the gauge shows no variance. `pooling` names the rule that was applied, `design` what was analysed.
    """

    design: str
    pooling: str
    n: int
    anova: tuple[Line, ...]
    variance_components: dict[str, float]
    standard_deviations: dict[str, float]
    grr_percent: float
    grr_percent_of_tolerance: float | None
    ndc: float | None
    r_squared: float
    notes: tuple[str, ...] = ()


def exact_centre(values: Array) -> tuple[float, Array]:
    """Mean, correctly rounded, and deviations from it; the deviation is exact where value and mean are within a factor 2."""
    centre = math.fsum(values) / len(values)
    return centre, values - centre


def sum_of_squares(deviations: Array, weights: Array | None = None) -> float:
    """Σ w d² about the deviations' own mean, with the mean's residue taken off: Σ w d² − (Σ w d)² / Σ w."""
    w = np.ones_like(deviations) if weights is None else weights
    total = math.fsum(w)
    first = math.fsum(w * deviations)
    return max(math.fsum(w * deviations * deviations) - first * first / total, 0.0)


def exact_sums(values: list[float], labels: NDArray[np.int64]) -> tuple[float, float]:
    """Sums of squares between and within groups in rational arithmetic: exact for the doubles given. For small sets.

    values: n floats; labels: n group numbers from 0.
    """
    groups: dict[int, list[Fraction]] = {}
    for value, label in zip(values, labels.tolist(), strict=True):
        groups.setdefault(label, []).append(Fraction(value))
    n = len(values)
    total = sum((sum(group, Fraction(0)) for group in groups.values()), Fraction(0))
    between = sum((sum(g, Fraction(0)) ** 2 / len(g) for g in groups.values()), Fraction(0)) - total * total / n
    within = sum(
        (sum((v * v for v in g), Fraction(0)) - sum(g, Fraction(0)) ** 2 / len(g) for g in groups.values()), Fraction(0)
    )
    return float(between), float(within)


def _coded(labels: list[str]) -> tuple[list[str], NDArray[np.int64]]:
    names = list(dict.fromkeys(labels))
    index = {name: number for number, name in enumerate(names)}
    return names, np.array([index[label] for label in labels], dtype=np.int64)


def _group_means(deviations: Array, codes: NDArray[np.int64], n_groups: int) -> tuple[Array, Array]:
    """Compensated mean of each group, and how many values it has. Sorting makes one pass over groups, not over values."""
    order = np.argsort(codes, kind="stable")
    counts = np.bincount(codes, minlength=n_groups)
    ends = np.cumsum(counts)
    ordered = deviations[order]
    parts = [math.fsum(ordered[end - count : end]) for end, count in zip(ends, counts, strict=True)]
    return np.array(parts) / counts, counts.astype(float)


def _tail(f: float | None, df: int, df_error: int) -> float | None:
    if f is None or not math.isfinite(f):
        return None
    from scipy.special import fdtrc

    return float(fdtrc(df, df_error, f))


def _tested(source: str, df: int, sum_sq: float, error: tuple[int, float] | None) -> Line:
    mean_sq = sum_sq / df if df else 0.0
    f = mean_sq / error[1] if error and error[1] > 0 and df else None
    return Line(source, df, sum_sq, mean_sq, f, _tail(f, df, error[0]) if error else None)


def one_way(values: Array, parts: list[str]) -> tuple[Line, Line, float, float]:
    """One-way table: between parts, within parts; R² and the effective replicates n₀ of unequal groups.

    values: n floats, at least two parts, at least one part with two values; ValueError otherwise.
    """
    names, codes = _coded(parts)
    if len(names) < 2:
        raise ValueError("one part only: nothing between parts can be told")
    n = len(values)
    if n <= len(names):
        raise ValueError("no part has two values: nothing within parts can be told")
    _, deviations = exact_centre(values)
    means, counts = _group_means(deviations, codes, len(names))
    between = sum_of_squares(means, counts)
    residual = deviations - means[codes]
    within = math.fsum(residual * residual)
    if n <= 20_000 and between + within > 0 and _few_digits(values, deviations):
        between, within = exact_sums(values.tolist(), codes)
    df = n - len(names)
    n0 = (n - float(np.sum(counts**2)) / n) / (len(names) - 1)
    lines = _tested("part", len(names) - 1, between, (df, within / df)), _tested("repeatability", df, within, None)
    return *lines, between / (between + within) if between + within > 0 else 0.0, n0


def _few_digits(values: Array, deviations: Array) -> bool:
    """Whether the spread is so small beside the values that rounding of the deviations could show in nine digits."""
    return float(np.max(np.abs(values))) > 1e5 * float(np.sqrt(np.mean(deviations**2)))


def gauge_study(
    values: Array, parts: list[str], operators: list[str] | None = None, tolerance: float | None = None
) -> GaugeStudy:
    """Gauge study of values by part, and crossed with operators if there are any.

    values: n floats; parts, operators: n labels. Crossed data with unequal cells are analysed by unweighted cell means
    with the harmonic mean of the cells' counts (exact where the cells are equal); an empty cell is refused.
    ValueError: fewer than two parts or operators, no replicate, an empty cell, or values that are not finite.
    """
    if not np.all(np.isfinite(values)):
        raise ValueError("a value is not a finite number")
    if tolerance is not None and not tolerance > 0:
        raise ValueError("the tolerance must be above zero")
    if operators is None or len(set(operators)) == 1:
        return _one_way_study(values, parts, tolerance, operators is not None)
    return _crossed(values, parts, operators, tolerance)


def _one_way_study(values: Array, parts: list[str], tolerance: float | None, one_operator: bool) -> GaugeStudy:
    between, within, r_squared, n0 = one_way(values, parts)
    repeatability = within.mean_sq
    part = max((between.mean_sq - within.mean_sq) / n0, 0.0)
    notes = ("one operator only: reproducibility cannot be told",) if one_operator else ()
    components = {"repeatability": repeatability, "gauge": repeatability, "part": part, "total": repeatability + part}
    total = Line("total", between.df + within.df, between.sum_sq + within.sum_sq, 0.0)
    table = (between, within, Line("total", total.df, total.sum_sq, total.sum_sq / total.df))
    return _study(
        "one-way",
        "none: no interaction in a one-way study",
        len(values),
        table,
        components,
        tolerance,
        r_squared,
        notes,
    )


def _crossed(values: Array, parts: list[str], operators: list[str], tolerance: float | None) -> GaugeStudy:
    part_names, part = _coded(parts)
    operator_names, operator = _coded(operators)
    p, o, n = len(part_names), len(operator_names), len(values)
    if p < 2:
        raise ValueError("one part only: nothing between parts can be told")
    cell = part * o + operator
    counts = np.bincount(cell, minlength=p * o)
    if (empty := int(np.argmin(counts))) >= 0 and counts[empty] == 0:
        raise ValueError(f"part {part_names[empty // o]} was not measured by operator {operator_names[empty % o]}")
    if n == p * o:
        raise ValueError(
            "no part was measured twice by an operator: repeatability and interaction cannot be told apart"
        )
    _, deviations = exact_centre(values)
    means, _ = _group_means(deviations, cell, p * o)
    r = p * o / math.fsum(1.0 / counts)
    grid = means.reshape(p, o)
    part_mean, operator_mean = grid.mean(axis=1), grid.mean(axis=0)
    grand = math.fsum(means) / (p * o)
    ss_part = r * o * math.fsum((part_mean - grand) ** 2)
    ss_operator = r * p * math.fsum((operator_mean - grand) ** 2)
    ss_interaction = r * math.fsum(((grid - part_mean[:, None] - operator_mean[None, :] + grand) ** 2).ravel())
    residual = deviations - means[cell]
    ss_error = math.fsum(residual * residual)
    df_interaction, df_error = (p - 1) * (o - 1), n - p * o
    interaction = _tested("part:operator", df_interaction, ss_interaction, (df_error, ss_error / df_error))
    pooled = interaction.p is not None and interaction.p > POOLING_P
    if pooled:
        df_error, ss_error = df_error + df_interaction, ss_error + ss_interaction
    error = (df_error, ss_error / df_error)
    against = error if pooled else (df_interaction, interaction.mean_sq)
    lines = [_tested("part", p - 1, ss_part, against), _tested("operator", o - 1, ss_operator, against)]
    lines += [] if pooled else [interaction]
    total = ss_part + ss_operator + ss_interaction + (ss_error - ss_interaction if pooled else ss_error)
    lines += [_tested("repeatability", df_error, ss_error, None), Line("total", n - 1, total, total / (n - 1))]
    below = error[1] if pooled else interaction.mean_sq
    components = {
        "repeatability": error[1],
        "operator": max((lines[1].mean_sq - below) / (p * r), 0.0),
        "part:operator": 0.0 if pooled else max((interaction.mean_sq - error[1]) / r, 0.0),
        "part": max((lines[0].mean_sq - below) / (o * r), 0.0),
    }
    components["reproducibility"] = components["operator"] + components["part:operator"]
    components["gauge"] = components["repeatability"] + components["reproducibility"]
    components["total"] = components["gauge"] + components["part"]
    shown = "-" if interaction.p is None else f"{interaction.p:.4g}"
    rule = f"interaction p = {shown}: {'pooled with repeatability' if pooled else 'kept'} (pooled above {POOLING_P})"
    equal = len(set(counts.tolist())) == 1
    notes = () if equal else (f"unequal cells: unweighted means with {r:.4g} replicates (harmonic mean)",)
    explained = (total - (ss_error - ss_interaction if pooled else ss_error)) / total if total > 0 else 0.0
    return _study("crossed", rule, n, tuple(lines), components, tolerance, explained, notes)


def _study(
    design: str,
    pooling: str,
    n: int,
    table: tuple[Line, ...],
    components: dict[str, float],
    tolerance: float | None,
    r_squared: float,
    notes: tuple[str, ...],
) -> GaugeStudy:
    deviations = {name: math.sqrt(variance) for name, variance in components.items()}
    gauge, total = deviations["gauge"], deviations["total"]
    return GaugeStudy(
        design=design,
        pooling=pooling,
        n=n,
        anova=table,
        variance_components=components,
        standard_deviations=deviations,
        grr_percent=100 * gauge / total if total > 0 else 0.0,
        grr_percent_of_tolerance=None if tolerance is None else 100 * 6 * gauge / tolerance,
        ndc=NDC_FACTOR * deviations["part"] / gauge if gauge > 0 else None,
        r_squared=r_squared,
        notes=notes,
    )


@dataclass(frozen=True)
class TypeOne:
    """Type-1 study of repeated readings of one reference part (ISO 22514-7, VDA 5): Cg = 0.2 T / 6 s, Cgk with the bias."""

    n: int
    mean: float
    standard_deviation: float
    bias: float
    bias_t: float | None
    bias_p: float | None
    cg: float | None
    cgk: float | None
    resolution_percent: float | None


def type_one(values: Array, reference: float, tolerance: float, resolution: float | None = None) -> TypeOne:
    """Type-1 study; `resolution` is compared with the tolerance (5 % is the usual limit). ValueError for fewer than two values."""
    if len(values) < 2:
        raise ValueError("a type-1 study needs at least two readings")
    if not tolerance > 0:
        raise ValueError("the tolerance must be above zero")
    mean, deviations = exact_centre(values)
    s = math.sqrt(sum_of_squares(deviations) / (len(values) - 1))
    bias = math.fsum([*values, *([-reference] * len(values))]) / len(values)
    t = bias / (s / math.sqrt(len(values))) if s > 0 else None
    from scipy.special import stdtr

    return TypeOne(
        n=len(values),
        mean=mean,
        standard_deviation=s,
        bias=bias,
        bias_t=t,
        bias_p=None if t is None else float(2 * stdtr(len(values) - 1, -abs(t))),
        cg=0.2 * tolerance / (6 * s) if s > 0 else None,
        cgk=(0.1 * tolerance - abs(bias)) / (3 * s) if s > 0 else None,
        resolution_percent=None if resolution is None else 100 * resolution / tolerance,
    )


@dataclass(frozen=True)
class Linearity:
    """Bias against reference: a straight line, with p-values against no slope and no intercept (AIAG, linearity)."""

    n: int
    slope: float
    intercept: float
    slope_standard_error: float
    intercept_standard_error: float
    slope_p: float
    intercept_p: float
    residual_standard_deviation: float
    r_squared: float
    mean_bias: float


def linearity(values: Array, references: Array) -> Linearity:
    """Straight line through biases (value − reference) over references; ValueError below three values or two references."""
    if len(values) < 3 or len(set(references.tolist())) < 2:
        raise ValueError("linearity needs at least three values at two references")
    centre, x = exact_centre(references)
    mean_bias, y = exact_centre(values - references)
    n, sxx = len(values), sum_of_squares(x)
    slope = (math.fsum(x * y) - math.fsum(x) * math.fsum(y) / n) / sxx
    intercept = mean_bias - slope * centre
    residual = y - slope * x
    s = math.sqrt(sum_of_squares(residual) / (n - 2))
    errors = s / math.sqrt(sxx), s * math.sqrt(1 / n + centre**2 / sxx)
    from scipy.special import stdtr

    slope_p, intercept_p = (
        float(2 * stdtr(n - 2, -abs(b / e))) if e > 0 else 0.0 for b, e in zip((slope, intercept), errors, strict=True)
    )
    syy = sum_of_squares(y)
    return Linearity(
        n=n,
        slope=slope,
        intercept=intercept,
        slope_standard_error=errors[0],
        intercept_standard_error=errors[1],
        slope_p=slope_p,
        intercept_p=intercept_p,
        residual_standard_deviation=s,
        r_squared=1 - s * s * (n - 2) / syy if syy > 0 else 1.0,
        mean_bias=mean_bias,
    )


@dataclass(frozen=True)
class Precision:
    """ISO 5725-2: repeatability s_r, between-laboratory s_L and reproducibility s_R, limits r and R at 2.8 s."""

    n_groups: int
    n: int
    s_r: float
    s_l: float
    s_reproducibility: float
    repeatability_limit: float
    reproducibility_limit: float


def precision(values: Array, groups: list[str]) -> Precision:
    """Repeatability and reproducibility with any grouping (days, rigs) as the laboratory; ValueError as in `one_way`."""
    between, within, _, n0 = one_way(values, groups)
    s_r2 = within.mean_sq
    s_l2 = max((between.mean_sq - s_r2) / n0, 0.0)
    s_r, s_R = math.sqrt(s_r2), math.sqrt(s_r2 + s_l2)
    return Precision(between.df + 1, len(values), s_r, math.sqrt(s_l2), s_R, 2.8 * s_r, 2.8 * s_R)
