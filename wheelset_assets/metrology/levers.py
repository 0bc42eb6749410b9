"""How a value of a station follows its sensors: derivatives by finite steps, for the budget of uncertainty.

A value may rest on one sensor alone, or on two against each other: the rows themselves tell. Each step moves rows of
the mean meridian and reads the values again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.reading import Lever, Meridians

Array = NDArray[Any]
Values = Callable[[Array, Array], Array]
"""Values (n,) in mm from the lateral and the radial coordinates of all rows, (rows,) each; NaN where there is none."""

STEP_MM = 0.02
"""Small against every window of a fit, large against its jumps when a row enters it."""


def levers(meridians: Meridians, values: Values) -> list[Lever]:
    """Levers of each of the values, in their order.

    The first grid is the one that the others are registered to. A value that a step loses counts as following it
    fully.
    """
    a, r = meridians.lateral, meridians.radial
    base = values(a, r)
    reach = 0.5 * max(float(np.ptp(a)), float(np.ptp(r)), 1.0)

    def slope(moved_a: Array, moved_r: Array, step: float) -> Array:
        found = (values(moved_a, moved_r) - base) / step
        return np.where(np.isfinite(found), found, STEP_MM / abs(step))

    views: list[tuple[str, int, Array]] = []
    for k, grid in enumerate(meridians.grids[1:], 1):
        own = meridians.owner == k
        if not own.any():
            continue
        turn = STEP_MM / reach
        turned = _turned(a, r, own, turn)
        steps = [
            slope(np.where(own, a + STEP_MM, a), r, STEP_MM),
            slope(a, np.where(own, r + STEP_MM, r), STEP_MM),
            slope(*turned, turn),
        ]
        views.append((grid.sensor_id, grid.line, np.array(steps)))
    everywhere = np.ones(len(a), bool)
    tilt = slope(*_turned(a, r, everywhere, STEP_MM / reach), STEP_MM / reach)
    middle = float(a.mean())
    stretch = slope(middle + (a - middle) * (1 + STEP_MM / reach), r, STEP_MM / reach)
    return [
        Lever(
            {(sensor, line): tuple(map(float, steps[:, i])) for sensor, line, steps in views},
            float(tilt[i]),
            float(stretch[i]),
        )
        for i in range(len(base))
    ]


def _turned(a: Array, r: Array, own: NDArray[np.bool_], angle_rad: float) -> tuple[Array, Array]:
    """Coordinates with the rows `own` turned about their middle, from lateral towards radial."""
    middle_a, middle_r = float(a[own].mean()), float(r[own].mean())
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turned_a = middle_a + c * (a - middle_a) - s * (r - middle_r)
    turned_r = middle_r + s * (a - middle_a) + c * (r - middle_r)
    return np.where(own, turned_a, a), np.where(own, turned_r, r)
