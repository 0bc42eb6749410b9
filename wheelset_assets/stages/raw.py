"""What a stage may get besides tables: the contents of a bundle, already read and verified by the inbox.

Plain holders of arrays and headers; no file is opened here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.bundle import CalibrationHeader, Rig, ScanHeader


@dataclass(frozen=True)
class StripeTable:
    """Stripe centres of one sensor and laser line: frame numbers (n,), u (n, rows) in px, NaN where none."""

    line: int
    frame: NDArray[np.int32]
    left_u_px: NDArray[np.float64]
    right_u_px: NDArray[np.float64]


@dataclass(frozen=True)
class StripeImages:
    """Raw frames of one sensor, a block at a time: frame numbers (n,), left and right (n, rows, columns)."""

    laser_lines: int
    blocks: Callable[[], Iterator[tuple[NDArray[np.int32], NDArray, NDArray]]]


@dataclass(frozen=True)
class Stripes:
    """Stripes of a scan by sensor; `load` reads one sensor's tables, or its images."""

    sensor_ids: tuple[str, ...]
    load: Callable[[str], list[StripeTable] | StripeImages]


@dataclass(frozen=True)
class Boards:
    """Board images of a calibration; `load` gives (pose, left, right) of one sensor, an image None if it is missing."""

    header: CalibrationHeader
    sensor_ids: tuple[str, ...]
    load: Callable[[str], Iterator[tuple[str, NDArray | None, NDArray | None]]]


@dataclass(frozen=True)
class Frames:
    """Encoder table of a scan: angle of the turn (n,) in degrees; the frame's number is its index."""

    angle_deg: NDArray[np.float64]


@dataclass(frozen=True)
class Reference:
    """The reference scan that sets the zero of another scan, or why there is none."""

    scan: ScanHeader | None
    reason: str | None = None
    recalibrated: bool = False


__all__ = [
    "Boards",
    "CalibrationHeader",
    "Frames",
    "Reference",
    "Rig",
    "ScanHeader",
    "StripeImages",
    "StripeTable",
    "Stripes",
]
