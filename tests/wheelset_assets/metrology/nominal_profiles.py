"""S1002 and LMA written out a second time, from the standards' numbers; not the simulator's code, nor the estimator's.

s counts from the tread datum circle towards the field side, z outward from the tread at s = 0, both in mm.
"""

from __future__ import annotations

import numpy as np

C = (4.320221063e3, 1.038384026e3, 1.065501873e2, 6.051367875e0, 2.054332446e-1, 4.169739389e-3, 4.687195829e-5)
C = (*C, 2.252755540e-7)
B = (0.0, -3.358537058e-2, 1.565681624e-3, -2.810427944e-5, 5.844240864e-8, -1.562379023e-8, 5.309217349e-15)
B = (*B, -5.957839843e-12, 2.646656573e-13)


def s1002(s):
    """Height z of S1002 (EN 13715, h 28, e 32.5, 6.7 %) at -70 <= s <= 60."""
    s = np.asarray(s, float)
    with np.errstate(invalid="ignore"):
        pieces = [
            (s < -62.764705882, 9.519259302 + np.sqrt(20.5**2 - (s + 49.5) ** 2)),
            (s < -49.662510381, 16.0 + np.sqrt(12.0**2 - (s + 55.0) ** 2)),
            (s < -39.764473993, 8.834924130 + np.sqrt(20.0**2 - (s + 58.558326413) ** 2)),
            (s < -38.426669071, -93.576667419 - 2.747477419 * s),
            (s < -35.0, 16.446 - np.sqrt(13.0**2 - (s + 26.210665) ** 2)),
            (s < -26.0, -np.polynomial.polynomial.polyval(s, C)),
            (s < 32.15796, np.polynomial.polynomial.polyval(s, B)),
        ]
    return np.select([test for test, _ in pieces], [z for _, z in pieces], 1.364323640 - 0.066666667 * s)


def lma(s):
    """Height z of LMA (CRH2, CRH380A, CR400AF) at -70 <= s <= 60."""
    s = np.asarray(s, float)

    def arc(centre, height, radius, sign):
        return height + sign * np.sqrt(radius**2 - (s - centre) ** 2)

    with np.errstate(invalid="ignore"):
        pieces = [
            (s < -62.307692, arc(-45.0, 6.6191685, 25.0, 1)),
            (s < -52.557372, arc(-54.0, 16.0, 12.0, 1)),
            (s < -40.265268, arc(-54.360657, 13.0217578, 15.0, 1)),
            (s < -38.053345, -92.4758546 - 2.747477419 * s),
            (s < -28.4709, arc(-24.8976483, 16.8631350, 14.0, -1)),
            (s < -10.75, arc(-5.5, 90.3459976, 90.0, -1)),
            (s < 4.253514, arc(15.5, 449.7329748, 450.0, -1)),
            (s < 30.0, -0.02012777 - s / 40),
        ]
    return np.select([test for test, _ in pieces], [z for _, z in pieces], 1.22987223 - s / 15)


def by_arc_length(height, low, high, spacing):
    """Points (n, 2) (s, z) along a profile, equally spaced in arc length, in order."""
    s = np.linspace(low, high, 400_001)
    z = height(s)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(s), np.diff(z)))])
    at = np.interp(np.arange(0.0, arc[-1], spacing), arc, s)
    return np.column_stack([at, height(at)])
