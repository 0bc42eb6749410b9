"""How a value of a station follows its sensors, for the budget: by their registration, squaring and calibration.

A value may rest on one sensor alone, or on two against each other: the rows themselves tell. Each step moves rows of
the mean meridian and reads the values again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.point_uncertainty import displacement_modes
from wheelset_assets.metrology.reading import Lever, Meridians
from wheelset_assets.metrology.triangulation import StereoSensor

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Values = Callable[[Array, Array], Array]
"""Values (n,) in mm from the lateral and the radial coordinates of all rows, (rows,) each; NaN where there is none."""

Rows = tuple[Array, Array]
"""Lateral and radial coordinates in mm of all rows, (rows,) each."""

STEP_MM = 0.02
"""Small against every window of a fit, large against its jumps when a row enters it."""
FIELD_ROWS = 48
"""A calibration's error is smooth: it is worked out at so many rows and interpolated."""
KEPT = 1e-3
"""Modes that together carry less of the variance are left out."""
OVERLAP_MM = 1.0


@dataclass(frozen=True)
class CalibrationField:
    """A sensor with the covariance of its parameters, and its pose (4, 4): what its calibration's error does to rows."""

    sensor: StereoSensor
    parameter_names: tuple[str, ...]
    covariance: Array
    rig_from_sensor: Array

    def modes(self, lateral: Array, radial: Array, direction_deg: float) -> Array:
        """Independent displacements (modes, rows, 2) in mm, lateral and radial, of rows (n,) at one standard uncertainty,
        without the shift and turn in the meridian plane that they share."""
        chosen = np.unique(np.linspace(0, len(lateral) - 1, FIELD_ROWS).astype(int))
        psi = np.radians(direction_deg)
        outward = np.array([0.0, np.cos(psi), np.sin(psi)])
        points = lateral[chosen, None] * np.array([1.0, 0.0, 0.0]) + radial[chosen, None] * outward
        seen = rigid.apply(rigid.inverse(self.rig_from_sensor), points)
        fields = displacement_modes(self.sensor, self.parameter_names, self.covariance, seen)
        fields = fields @ self.rig_from_sensor[:3, :3].T
        planar = np.stack([fields[..., 0], fields @ outward], axis=-1)
        shared = _rigid_columns(lateral[chosen], radial[chosen])
        flat = planar.reshape(len(planar), -1).T
        flat = flat - shared @ (np.linalg.pinv(shared) @ flat)
        u, size, _ = np.linalg.svd(flat, full_matrices=False)
        share = np.cumsum(size[::-1] ** 2)[::-1] / max(float((size**2).sum()), 1e-300)
        kept = (u * size)[:, (share > KEPT) & (size > 0)].T.reshape(-1, len(chosen), 2)
        at, modes = np.arange(len(lateral)), np.empty((len(kept), len(lateral), 2))
        for made, mode in zip(modes, kept, strict=True):
            for axis in (0, 1):
                made[:, axis] = np.interp(at, chosen, mode[:, axis])
        return modes


@dataclass(frozen=True)
class Steps:
    """The rows of a station as they would lie after each step, worked out once for all of its values.

    The first grid is the one that the others are registered to.
    """

    still: Rows
    tilted: Rows
    views: dict[tuple[str, int], tuple[Rows, Rows, Rows]]
    """By sensor and line: shifted along the axle, away from it, and turned."""
    strained: dict[tuple[str, int], tuple[Rows, Rows, Rows]]
    """By sensor and line: strained along the axle, away from it, and sheared, after registration and squaring."""
    modes: list[tuple[Rows, float]]
    """Each mode of a calibration, after registration and squaring, and its largest displacement in mm."""
    turn_rad: float
    calibrated: bool
    """Whether the calibrations' covariances are known."""

    def levers(self, values: Values) -> list[Lever]:
        """Levers of each of the values, in their order. A value that a step loses counts as following it fully."""
        base = values(*self.still)

        def change(moved: Rows, size_mm: float) -> Array:
            found = values(*moved) - base
            return np.where(np.isfinite(found), found, size_mm)

        def slopes(of_views: dict[tuple[str, int], tuple[Rows, Rows, Rows]], sizes: tuple[float, ...]) -> Any:
            return {
                view: np.array([change(rows, STEP_MM) / size for rows, size in zip(moved, sizes, strict=True)])
                for view, moved in of_views.items()
            }

        tilt = change(self.tilted, STEP_MM) / self.turn_rad
        views = slopes(self.views, (STEP_MM, STEP_MM, self.turn_rad))
        strains = slopes(self.strained, (self.turn_rad,) * 3)
        square = sum((change(rows, size_mm) ** 2 for rows, size_mm in self.modes), np.zeros(len(base)))
        return [
            Lever(
                {view: (float(k[0, i]), float(k[1, i]), float(k[2, i])) for view, k in views.items()},
                float(tilt[i]),
                {view: (float(k[0, i]), float(k[1, i]), float(k[2, i])) for view, k in strains.items()},
                float(np.sqrt(square[i])) if self.calibrated else None,
            )
            for i in range(len(base))
        ]


def station_steps(meridians: Meridians, face: Mask, fields: Mapping[tuple[str, int], CalibrationField]) -> Steps:
    """Steps of a station's rows; `face` (rows,) squares the station. fields: by sensor and line."""
    a, r = meridians.lateral, meridians.radial
    turn = STEP_MM / (0.5 * max(float(np.ptp(a)), float(np.ptp(r)), 1.0))
    views: dict[tuple[str, int], tuple[Rows, Rows, Rows]] = {}
    strained: dict[tuple[str, int], tuple[Rows, Rows, Rows]] = {}
    modes: list[tuple[Rows, float]] = []
    fits = _overlaps(meridians)

    def followed(own: Mask, field: Array) -> Rows:
        """All rows when those of one view are displaced by a field (own rows, 2), and the station is put together anew."""
        step = np.zeros((len(a), 2))
        step[own] = field
        for fit in fits:
            fit.register(step)
        _square(step, a, r, face)
        return a + step[:, 0], r + step[:, 1]

    for k, grid in enumerate(meridians.grids):
        own = meridians.owner == k
        if not own.any():
            continue
        view = (grid.sensor_id, grid.line)
        if k:
            lateral, radial = (np.where(own, values + STEP_MM, values) for values in (a, r))
            views[view] = ((lateral, r), (a, radial), _turned(a, r, own, turn))
        for mode in fields[view].modes(a[own], r[own], grid.direction_deg) if view in fields else ():
            modes.append((followed(own, mode), float(np.abs(mode).max())))
        beside, above, still = a[own] - a[own].mean(), r[own] - r[own].mean(), np.zeros(int(own.sum()))
        along, away, shear = (
            followed(own, turn * np.column_stack(field)) for field in ((beside, still), (still, above), (still, beside))
        )
        strained[view] = along, away, shear
    everywhere = np.ones(len(a), bool)
    return Steps((a, r), _turned(a, r, everywhere, turn), views, strained, modes, turn, bool(fields))


@dataclass(frozen=True)
class _Overlap:
    """Where one view lies over the first: what the registration between them makes of displacements."""

    own: Array
    columns: Array
    """(2 own, 3) displacements of its rows by shifts and a turn."""
    source: Array
    target: Array
    normal: Array
    solve: Array
    """(3, pairs): shifts and turn that take distances along the normals away."""

    def register(self, step: Array) -> None:
        """Move the view's rows as its registration would, given displacements (rows, 2)."""
        apart = ((step[self.target] - step[self.source]) * self.normal).sum(axis=1)
        step[self.own] += (self.columns @ (self.solve @ apart)).reshape(-1, 2)


def _overlaps(meridians: Meridians) -> list[_Overlap]:
    points = meridians.points
    first = np.flatnonzero(meridians.owner == 0)
    found = []
    for k in range(1, len(meridians.grids)):
        own = np.flatnonzero(meridians.owner == k)
        if len(first) < 3 or len(own) < 3:
            continue
        distance, nearest = cKDTree(points[first]).query(points[own])
        both = distance < OVERLAP_MM
        if both.sum() < 3:
            continue
        along = np.gradient(points[first], axis=0)
        normal = np.column_stack([-along[:, 1], along[:, 0]])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
        columns = _rigid_columns(*points[own].T)
        across = normal[nearest[both]]
        seen = (columns.reshape(-1, 2, 3)[both] * across[:, :, None]).sum(axis=1)
        found.append(_Overlap(own, columns, own[both], first[nearest[both]], across, np.linalg.pinv(seen)))
    return found


def _rigid_columns(a: Array, r: Array) -> Array:
    """Displacements (2 n, 3), lateral and radial in turn, of rows by unit shifts and a turn about their middle."""
    columns = np.zeros((len(a), 2, 3))
    columns[:, 0, 0] = columns[:, 1, 1] = 1.0
    columns[:, 0, 2], columns[:, 1, 2] = r.mean() - r, a - a.mean()
    return columns.reshape(-1, 3)


def _square(step: Array, a: Array, r: Array, face: Mask) -> None:
    """Turn the station as its squaring would, given displacements (rows, 2): the face stays upright."""
    if face.sum() < 2 or np.ptp(r[face]) == 0:
        return
    tilt = float(np.polyfit(r[face] - r[face].mean(), step[face, 0], 1)[0])
    step[:, 0] -= tilt * (r - r[face].mean())
    step[:, 1] += tilt * (a - a[face].mean())


def _turned(a: Array, r: Array, own: Mask, angle_rad: float) -> tuple[Array, Array]:
    """Coordinates with the rows `own` turned about their middle, from lateral towards radial."""
    middle_a, middle_r = float(a[own].mean()), float(r[own].mean())
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turned_a = middle_a + c * (a - middle_a) - s * (r - middle_r)
    turned_r = middle_r + s * (a - middle_a) + c * (r - middle_r)
    return np.where(own, turned_a, a), np.where(own, turned_r, r)
