"""Statistics of repeated measurements. Grouping by period is the caller's; nothing is read or written here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Spread:
    """Mean, sample standard deviation (n - 1; None for one value) and extremes of n values."""

    n: int
    mean: float
    standard_deviation: float | None
    minimum: float
    maximum: float

    @property
    def range(self) -> float:
        """Largest minus smallest value."""
        return self.maximum - self.minimum


def spread(values: NDArray[np.float64]) -> Spread:
    """Spread of values (n,), n >= 1, taken about their first so that tight groups of large values lose no digits."""
    first = float(values[0])
    relative = np.asarray(values, float) - first
    mean = float(relative.mean())
    deviation = float(np.sqrt(((relative - mean) ** 2).sum() / (len(relative) - 1))) if len(relative) > 1 else None
    return Spread(len(relative), first + mean, deviation, float(np.min(values)), float(np.max(values)))
