"""Judgement of claimed uncertainties against truth, from both sides: too large and too small both fail.

Shared by the tests of this folder. A pull is (estimate - truth) / claimed standard uncertainty.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

P = 0.001
"""Probability with which a correct claim fails; the seeds are fixed, so a test that passes once passes always."""


def mean_square_interval(n: int) -> tuple[float, float]:
    """Interval that holds the mean square of n independent pulls of unit variance with probability 1 - P."""
    low, high = chi2.ppf([P / 2, 1 - P / 2], n) / n
    return float(low), float(high)


def assert_pulls(pulls, *, overclaim: float = 1.0, underclaim: float = 1.0) -> float:
    """The mean square of independent pulls (n,) lies in its chi-square interval; returns it.

    overclaim: largest factor by which a claimed u may exceed the true spread for a reason that the caller states;
    underclaim: the same the other way (a first-order or truncated formula).
    """
    pulls = np.asarray(pulls, float).ravel()
    assert np.isfinite(pulls).all()
    low, high = mean_square_interval(pulls.size)
    found = float((pulls**2).mean())
    assert low / overclaim**2 <= found <= high * underclaim**2, (
        f"mean squared pull {found:.3f}: not in {low:.3f} to {high:.3f}"
    )
    return found


def assert_unbiased(pulls) -> None:
    """The mean of independent unit-variance pulls (n,) is zero within its own 3.3 standard deviations (p = 0.001)."""
    pulls = np.asarray(pulls, float).ravel()
    assert abs(pulls.mean()) < 3.3 / np.sqrt(pulls.size), f"mean pull {pulls.mean():.3f} over {pulls.size}"
