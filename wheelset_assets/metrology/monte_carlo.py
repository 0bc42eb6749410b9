"""Propagation of distributions (JCGM 101), as a check of the budgets that `uncertainty` combines by JCGM 100.

Here: what distribution each source of a budget has, draws of the value, the shortest coverage interval. Not here: where
the budgets come from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.uncertainty import COVERAGE_FACTOR, Source, combined

COVERAGE = 0.9545
"""Coverage that k = 2 claims for a normal distribution."""
Distribution = Literal["normal", "two discs", "half a square"]
DISTRIBUTIONS: dict[str, Distribution] = {
    "axis of rotation": "two discs",
    "sensor pose in unconstrained directions": "half a square",
}
"""Sources that are not normal. The axis lies within a disc in the scan and in the reference, and their difference counts;
a small angle that is normal enters by its cosine, 1 - angle^2 / 2."""
SIGNIFICANT_DIGITS = 2
Array = NDArray[Any]


@dataclass(frozen=True)
class Propagated:
    """What the draws say of a value, and how that compares with value ± k u.

    interval: shortest interval that holds COVERAGE of the draws. tolerance: half of the last of two significant digits of
    u (JCGM 101, 7.9.2). agrees: both ends lie within it of value ± k u (8.1).
    """

    value: float
    standard_uncertainty: float
    interval: tuple[float, float]
    gum_interval: tuple[float, float]
    tolerance: float
    agrees: bool
    draws: int


def propagate(value: float, sources: list[Source], draws: int = 1_000_000, seed: int = 0) -> Propagated:
    """Draws of a value from its sources, each independent and unbiased.

    The value is linear in the sources to picometres: products of a temperature's error and a coefficient's are left out.
    Raises ValueError for fewer than 10,000 draws: the interval's ends would be noise.
    """
    if draws < 10_000:
        raise ValueError(f"{draws} draws; the ends of the interval need 10,000 or more")
    random = np.random.default_rng(seed)
    drawn = np.full(draws, float(value))
    for source in sources:
        if source.contribution > 0:
            drawn += source.sensitivity * source.standard_uncertainty * _standard(source.name, draws, random)
    u = combined(sources)
    low, high = value - COVERAGE_FACTOR * u, value + COVERAGE_FACTOR * u
    interval = shortest_interval(drawn, COVERAGE)
    tolerance = 0.5 * 10.0 ** (np.floor(np.log10(u)) - SIGNIFICANT_DIGITS + 1) if u > 0 else 0.0
    apart = max(abs(interval[0] - low), abs(interval[1] - high))
    return Propagated(
        float(drawn.mean()),
        float(drawn.std(ddof=1)),
        interval,
        (low, high),
        float(tolerance),
        bool(apart <= tolerance),
        draws,
    )


def shortest_interval(drawn: Array, coverage: float) -> tuple[float, float]:
    """Shortest interval that holds this share of the draws (JCGM 101, 7.7.4)."""
    ordered = np.sort(drawn)
    held = max(1, round(coverage * len(ordered)))
    widths = ordered[held - 1 :] - ordered[: len(ordered) - held + 1]
    start = int(widths.argmin())
    return float(ordered[start]), float(ordered[start + held - 1])


def _standard(name: str, n: int, random: np.random.Generator) -> Array:
    """Draws (n,) of a source's distribution, mean 0 and standard deviation 1."""
    kind = DISTRIBUTIONS.get(name, "normal")
    if kind == "normal":
        return random.standard_normal(n)
    if kind == "half a square":
        return (random.standard_normal(n) ** 2 - 1.0) / np.sqrt(2.0)
    total = np.zeros(n)
    for sign in (1.0, -1.0):  # one coordinate of a point in a disc of radius 2 has a standard deviation of 1
        total += sign * 2.0 * np.sqrt(random.random(n)) * np.cos(2 * np.pi * random.random(n))
    return total / np.sqrt(2.0)
