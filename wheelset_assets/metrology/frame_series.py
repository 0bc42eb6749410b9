"""One value a frame from the rows of a straight part: the series, the noise that its rows show, and what they missed.

The rows of a frame know its noise without regard to the other frames: parts of the rows that move together differ by it
alone. So a turn whose frames scatter by more is told from a noisy one. Here: no harmonics (`revolution`, `roundness`)
and no judgement (`reading`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.revolution import coverage, frame_offsets
from wheelset_assets.quality import Flag

if TYPE_CHECKING:
    from wheelset_assets.metrology.reading import Meridians

Array = NDArray[Any]
Mask = NDArray[np.bool_]

BLOCK_ROWS = 12
"""Neighbouring rows share their noise over three rows or so, and over half a dozen once they are smoothed: blocks of so
many are nearly independent of each other."""
SHARED_ROWS = 3.6
"""Neighbouring blocks of B rows still share noise: it hides a part SHARED_ROWS / B of their variance (from simulated scans)."""
MAX_BLOCKS = 16
TILT_BLOCKS = 4
"""From so many blocks on, a tilt of the frame's part is no noise."""
CLIP_SCATTERS = 4.0
LEAST_SHARE = 0.1
"""A sensor with a smaller share of the rows decides nothing."""
FULL_COVERAGE = 0.95


@dataclass(frozen=True)
class FrameSeries:
    """Offset of each frame (frames,) from what was expected; NaN where too few rows saw it."""

    value_mm: Array
    noise_mm: float
    """Standard uncertainty of a frame's value, from the scatter between blocks of its rows; NaN where these are too few."""
    freedom: int
    """Degrees of freedom of noise_mm."""
    flags: Flag
    """COVERAGE_GAP or FRAMES_MISSING where one of the sensors that see the part lacks some of the turn."""


def frame_series(meridians: Meridians, mask: Mask, values: str, expected: list[Array], angle_deg: Array) -> FrameSeries:
    """Series of the masked rows of all sensors, weighted by their points.

    values: name of the grids' coordinate; expected: for each grid what it is compared with, broadcast over (frames,
    rows); angle_deg (frames,): how far the wheelset had turned.
    """
    n_frames = len(meridians.grids[0].lateral_mm)
    total, weight = np.zeros(n_frames), np.zeros(n_frames)
    variance, parts, freedom = 0.0, 0, 0
    rows_in_all = max(int(mask.sum()), 1)
    flags = Flag.NONE
    for k, grid in enumerate(meridians.grids):
        rows = meridians.rows(mask, k)
        if not rows.any():
            continue
        offset, count = frame_offsets(getattr(grid, values), expected[k], rows)
        total = total + np.where(np.isfinite(offset), offset * count, 0.0)
        weight = weight + np.where(np.isfinite(offset), count, 0)
        if rows.sum() >= LEAST_SHARE * rows_in_all:
            flags |= missed(np.isfinite(offset), angle_deg)
        deviation = getattr(grid, values)[:, rows] - np.broadcast_to(expected[k], grid.lateral_mm.shape)[:, rows]
        noise, its_freedom = _noise_of_mean(deviation)
        if its_freedom:
            variance += (rows.sum() * noise) ** 2
            parts += int(rows.sum())
            freedom += its_freedom
    noise = float(np.sqrt(variance)) / parts if parts else float("nan")
    if not (weight > 0).any():
        return FrameSeries(np.full(n_frames, np.nan), noise, freedom, flags)
    enough = weight >= 0.25 * np.median(weight[weight > 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        return FrameSeries(np.where(enough & (weight > 0), total / weight, np.nan), noise, freedom, flags)


def missed(seen: Mask, angle_deg: Array) -> Flag:
    """Flags of a sensor that saw its part in the frames `seen` (frames,) of a turn."""
    flags = Flag.NONE
    if seen.mean() < 0.999:
        flags |= Flag.FRAMES_MISSING
        if coverage(angle_deg[seen])[0] < FULL_COVERAGE:
            flags |= Flag.COVERAGE_GAP
    return flags


def sensors_missed(meridians: Meridians, angle_deg: Array) -> Flag:
    """The same for all sensors of a station and all the rows that they see."""
    flags = Flag.NONE
    for grid, rows in zip(meridians.grids, meridians.row_of, strict=True):
        if len(rows) >= LEAST_SHARE * len(meridians.lateral):
            count = np.isfinite(grid.lateral_mm[:, rows]).sum(axis=1)
            flags |= missed(count >= 0.25 * max(float(np.median(count[count > 0])), 1.0), angle_deg)
    return flags


def _noise_of_mean(deviation: Array) -> tuple[float, int]:
    """Standard deviation of the mean over the rows of deviation (frames, rows) from the scatter between blocks of rows.

    What all frames share in a block, what all blocks share in a frame, and a frame's tilt are no noise. With its degrees
    of freedom; 0 of them for too few rows.
    """
    n_blocks = min(deviation.shape[1] // BLOCK_ROWS, MAX_BLOCKS)
    if n_blocks < 2 or len(deviation) < 3:
        return float("nan"), 0
    edges = np.linspace(0, deviation.shape[1], n_blocks + 1).astype(int)
    filled, seen = np.where(np.isfinite(deviation), deviation, 0.0), np.isfinite(deviation)
    count = np.add.reduceat(seen, edges[:-1], axis=1, dtype=np.int64)
    sums = np.add.reduceat(filled, edges[:-1], axis=1)
    whole = (count >= 0.75 * np.diff(edges)).all(axis=1)  # a gap leaves no contrast of equal parts
    if whole.sum() < 3:
        return float("nan"), 0
    means = sums[whole] / count[whole]
    means = means - np.median(means, axis=0)
    place = np.linspace(-1.0, 1.0, n_blocks)
    shape = np.ones((n_blocks, 1)) if n_blocks < TILT_BLOCKS else np.column_stack([np.ones(n_blocks), place])
    rest = means - means @ shape @ np.linalg.pinv(shape)
    per_frame = n_blocks - shape.shape[1]
    size = np.sqrt((rest**2).sum(axis=1) / per_frame)
    kept = size <= CLIP_SCATTERS * max(float(np.median(size)), 1e-9)
    freedom = (int(kept.sum()) - 1) * per_frame
    variance = float((size[kept] ** 2).sum()) * per_frame / freedom
    variance *= 1.0 + SHARED_ROWS * n_blocks / deviation.shape[1]
    return float(np.sqrt(variance / n_blocks)), freedom
