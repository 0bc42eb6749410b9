"""Uncertainty by the GUM (JCGM 100): contributions of independent sources to one value. No distributions are drawn here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COVERAGE_FACTOR = 2.0
"""k: about 95.45 % for a normal distribution."""


@dataclass(frozen=True)
class Source:
    """One line of a budget: the source's standard uncertainty, its unit, and the value's sensitivity to it."""

    name: str
    standard_uncertainty: float
    unit: str
    sensitivity: float

    @property
    def contribution(self) -> float:
        """Standard uncertainty of the value from this source."""
        return abs(self.sensitivity) * self.standard_uncertainty


def combined(sources: list[Source]) -> float:
    """Combined standard uncertainty of independent sources (JCGM 100, eq. 10)."""
    return float(np.sqrt(sum(source.contribution**2 for source in sources)))
