"""Whether the two cameras of a sensor saw the same instant, frame by frame.

Two rays of one instant meet on the laser plane, however the wheelset turns and wobbles. If one camera's frame is of
another instant, or its values were damaged on the way, they meet in front of the plane or behind it, all rows of the
frame alike. A single point does not show it; the mean over a frame's rows does. Here: that mean and its noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.grids import nan_median, robust_scatter
from wheelset_assets.metrology.laser_plane import LaserPlane

Array = NDArray[Any]
MIN_FRAMES = 8
"""Fewer frames do not tell a frame that is off from the bend of the laser sheet."""
CLIP_SIGMAS = 4.0


@dataclass(frozen=True)
class FrameOffsets:
    """Mean distance of each frame's points from the laser plane (frames,) in mm, less what all frames share row by row,
    and its standard uncertainty; NaN where a frame has too few points."""

    offset_mm: Array
    u_mm: Array

    def off(self, sigmas: float, floor_mm: float) -> NDArray[np.bool_]:
        """Which frames are off by more than their noise, and by more than floor_mm."""
        with np.errstate(invalid="ignore"):
            return np.abs(self.offset_mm) > np.maximum(sigmas * self.u_mm, floor_mm)

    def scatter(self) -> tuple[float, float] | None:
        """Standard deviation of the offsets in mm, and of offset over uncertainty, which is 1 where noise explains it and
        more where most frames are off by a little, whatever single ones do. None for too few frames."""
        pulls = self.offset_mm / self.u_mm
        with np.errstate(invalid="ignore"):
            kept = np.abs(pulls - nan_median(pulls, axis=0)) <= CLIP_SIGMAS * max(robust_scatter(pulls), 1.0)
        if kept.sum() < MIN_FRAMES:
            return None
        return float(self.offset_mm[kept].std(ddof=1)), float(pulls[kept].std(ddof=1))


def frame_offsets(
    plane: LaserPlane, points_mm: Array, good: NDArray[np.bool_], u_across_mm: Array, correlation_rows: float
) -> FrameOffsets | None:
    """Offsets of frames from points (frames, rows, 3), of which `good` (frames, rows) count; None for too few frames.

    u_across_mm (frames, rows): standard uncertainty across the plane; correlation_rows: integral length of that noise
    along the rows. The median over the frames at each row takes the bend of the sheet and the calibration's error.
    """
    if len(points_mm) < MIN_FRAMES:
        return None
    offsets = np.where(good, plane.offsets_mm(points_mm), np.nan)
    shared = np.where(good.sum(axis=0) >= MIN_FRAMES, nan_median(offsets, axis=0), np.nan)
    rest = offsets - shared
    sigma = np.maximum(u_across_mm, 1e-9)
    with np.errstate(invalid="ignore"):  # what is left of mismatches does not count, nor do a frame's own odd points
        seen = np.abs(rest - nan_median(rest, axis=1)[:, None]) <= CLIP_SIGMAS * sigma
    count = seen.sum(axis=1)
    variance = np.where(seen, sigma**2, 0.0).sum(axis=1)
    enough = np.where(count >= MIN_FRAMES, count, np.nan)
    return FrameOffsets(
        np.where(seen, rest, 0.0).sum(axis=1) / enough, np.sqrt(variance * max(correlation_rows, 1.0)) / enough
    )
