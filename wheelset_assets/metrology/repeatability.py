"""Statistics of repeated measurements. Grouping by period is the caller's; nothing is read or written here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Spreads:
    """Of each of m groups of values: their number, mean, sample standard deviation (n - 1; NaN for one value), extremes."""

    n: NDArray[np.int64]
    mean: Array
    standard_deviation: Array
    minimum: Array
    maximum: Array

    @property
    def range(self) -> Array:
        """Largest minus smallest value (m,)."""
        return self.maximum - self.minimum


def spreads(values: Array, starts: NDArray[np.int64]) -> Spreads:
    """Spreads of consecutive groups of values (n,), of which each begins at one of starts (m,), none of them empty.

    Taken about each group's first value, so that tight groups of large values lose no digits.
    """
    n = np.diff(np.append(starts, len(values)))
    first = values[starts]
    relative = values - np.repeat(first, n)
    mean = np.add.reduceat(relative, starts) / n
    squares = np.add.reduceat((relative - np.repeat(mean, n)) ** 2, starts)
    with np.errstate(invalid="ignore"):
        deviation = np.sqrt(squares / np.where(n > 1, n - 1, np.nan))
    return Spreads(n, first + mean, deviation, np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts))
