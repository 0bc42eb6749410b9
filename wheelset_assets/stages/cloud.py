"""Stage 3, between tables and arrays: filtering on the organised grid. Also the way from cloud tables to grids."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelset_assets import tables
from wheelset_assets.config import FilteringConfig
from wheelset_assets.metrology import filtering
from wheelset_assets.metrology.grids import to_grid
from wheelset_assets.quality import AlgorithmFailed
from wheelset_assets.stages.capture import quantised, rounded_um

Array = NDArray[Any]


@dataclass(frozen=True)
class CloudGrid:
    """One sensor and laser line as grids (frames, rows): coordinates in the sensor frame and uncertainty, mm."""

    sensor_id: str
    line: int
    first_row: int
    row_step: int
    x: Array
    y: Array
    z: Array
    u_mm: Array
    frame: NDArray[np.int64]
    """Frame and grid column of each point, in the table's order."""
    column: NDArray[np.int64]


def grids(cloud: pa.Table, n_frames: int) -> Iterator[CloudGrid]:
    """Grids of a cloud table, sensor by sensor and line by line, in the order of their names."""
    sensor = cloud["sensor_id"].combine_chunks()
    codes, names = sensor.indices.to_numpy(zero_copy_only=False), sensor.dictionary.to_pylist()
    line = cloud["line"].to_numpy()
    columns = {name: cloud[name].to_numpy() for name in ("frame", "row", "x_mm", "y_mm", "z_mm", "u_depth_um")}
    for name in sorted(names):
        of_sensor = codes == names.index(name)
        if not of_sensor.any():
            continue
        lines = line[_members(of_sensor)]
        for number in range(int(lines.min()), int(lines.max()) + 1):
            of_line = of_sensor & (line == number)
            if not of_line.any():
                continue
            member = _members(of_line)
            frame, row = columns["frame"][member].astype(np.int64), columns["row"][member].astype(np.int64)
            first = int(row.min())
            row -= first
            present = np.flatnonzero(np.bincount(row))
            step = int(np.gcd.reduce(np.diff(present))) if len(present) > 1 else 1
            column = row // step if step > 1 else row
            shape = (n_frames, int(present[-1]) // step + 1)
            u_mm = columns["u_depth_um"][member].astype(float)
            u_mm *= 1e-3
            x, y, z, u = to_grid(frame, column, shape, *(columns[f"{axis}_mm"][member] for axis in "xyz"), u_mm)
            yield CloudGrid(name, number, first, step, x, y, z, u, frame, column)


def _members(where: NDArray[np.bool_]) -> slice | NDArray[np.int64]:
    """Index of the true elements, at least one: a slice if they follow each other, which takes no copy."""
    first, last = int(where.argmax()), len(where) - 1 - int(where[::-1].argmax())
    return slice(first, last + 1) if where[first : last + 1].all() else np.flatnonzero(where)


def run_filtered_clouds(
    *, triangulated_clouds: pa.Table, stripe_statistics: pa.Table, config: FilteringConfig
) -> Mapping[str, pa.Table]:
    """Stage 3: gate, outliers, isolated points; then smoothing along the line of sight, and thinning of rows."""
    length = {(r["sensor_id"], r["line"]): r["noise_correlation_rows"] for r in stripe_statistics.to_pylist()}
    kept_parts, removed_parts = [], []
    n_frames = int(triangulated_clouds["frame"].to_numpy().max()) + 1
    for grid in grids(triangulated_clouds, n_frames):
        reason = _reasons(grid.z, config)
        z = np.where(reason > 0, np.nan, grid.z)
        integral = length.get((grid.sensor_id, grid.line)) or 1.0
        correlation = (integral - 1) / (integral + 1)  # first-order autoregressive noise of that integral length
        smoothed = smooth(z, config, float(np.nanmedian(grid.u_mm)), correlation)
        rows_seen = grid.first_row + grid.z.shape[1]
        keep = filtering.thin(np.isfinite(smoothed.depth_mm), max(1, round(rows_seen / config.max_rows)))
        kept_parts.append(_kept(grid, smoothed, keep))
        removed_parts.append(_removed(grid, reason))
    kept = pa.concat_tables(kept_parts).unify_dictionaries().combine_chunks()
    if kept.num_rows == 0:
        raise AlgorithmFailed("no point is left after filtering", points=triangulated_clouds.num_rows)
    return {
        "filtered_clouds": kept,
        "removed_points": pa.concat_tables(removed_parts).unify_dictionaries().combine_chunks(),
    }


def smooth(
    depth_mm: Array, config: FilteringConfig, noise_mm: float, correlation: float, kind: str | None = None
) -> filtering.Smoothed:
    """Depths (frames, rows) smoothed as configured, or by another kind of filter.

    noise_mm: standard uncertainty of a depth: where it is coarse, an edge must stand out of it to end a window.
    correlation: of the noise of neighbouring rows.
    """
    return filtering.smooth(
        depth_mm,
        kind or config.smoothing,
        window_rows=config.window_rows,
        window_frames=config.window_frames,
        sigma_rows=config.gaussian_sigma_rows,
        noise_correlation=correlation,
        range_mm=config.bilateral_um * 1e-3,
        edge_mm=max(config.edge_mm, config.edge_sigmas * noise_mm),
    )


def _reasons(z: Array, config: FilteringConfig) -> NDArray[np.int8]:
    """Why each point is removed: 0 kept, else 1 + index into REMOVAL_REASONS."""
    reason = np.zeros(z.shape, np.int8)
    current = z
    tests = (
        ("range", lambda v: filtering.range_gate(v, config.range_margin_mm)),
        ("outlier", lambda v: filtering.outliers(v, config.outlier_sigmas, config.outlier_window_rows)),
        ("isolated", lambda v: filtering.isolated(np.isfinite(v), config.min_cluster_rows)),
    )
    for name, test in tests:
        hit = test(current) & np.isfinite(current)
        reason[hit] = 1 + tables.REMOVAL_REASONS.index(name)
        current = np.where(hit, np.nan, current)
    return reason


def _kept(grid: CloudGrid, smoothed: filtering.Smoothed, keep: NDArray[np.bool_]) -> pa.Table:
    frame, column = np.nonzero(keep)
    along = smoothed.depth_mm[keep] / grid.z[keep]  # the point moves along its line of sight
    n = len(frame)
    return tables.FILTERED_CLOUDS.from_columns(
        {
            "sensor_id": pa.DictionaryArray.from_arrays(np.zeros(n, np.int32), [grid.sensor_id]),
            "line": np.full(n, grid.line, np.int8),
            "frame": frame.astype(np.int32),
            "row": (grid.first_row + column * grid.row_step).astype(np.int16),
            "x_mm": quantised(grid.x[keep] * along),
            "y_mm": quantised(grid.y[keep] * along),
            "z_mm": quantised(smoothed.depth_mm[keep]),
            "u_depth_um": rounded_um(grid.u_mm[keep] * smoothed.noise_factor[keep] * 1e3),
        }
    )


def _removed(grid: CloudGrid, reason: NDArray[np.int8]) -> pa.Table:
    at = reason[grid.frame, grid.column]
    gone = np.flatnonzero(at)
    return tables.REMOVED_POINTS.from_columns(
        {
            "sensor_id": pa.DictionaryArray.from_arrays(np.zeros(len(gone), np.int32), [grid.sensor_id]),
            "line": np.full(len(gone), grid.line, np.int8),
            "frame": grid.frame[gone].astype(np.int32),
            "row": (grid.first_row + grid.column[gone] * grid.row_step).astype(np.int16),
            "reason": pa.DictionaryArray.from_arrays((at[gone] - 1).astype(np.int32), list(tables.REMOVAL_REASONS)),
        }
    )
