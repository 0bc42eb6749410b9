"""Noise of stripe centres, told from the frames themselves: its size, and its correlation along the image rows."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class StripeNoise:
    """Noise of stripe centres: standard deviation in px, and integral correlation length along the rows, in rows."""

    sigma_px: float
    correlation_rows: float
    neighbour_correlation: float = 0.0
    """Correlation of two neighbouring rows."""


def stripe_noise(u_px: Array, max_frames: int = 96) -> StripeNoise | None:
    """Noise of centres (frames, rows) from second differences between consecutive frames at one image row.

    Differences between frames keep the part that is correlated along the rows, which a smoother along the rows would
    hide; the surface changes slowly from frame to frame. Robust against outliers (clipped at 5 scatters). None if
    fewer than three frames or too few centres are there.
    """
    if len(u_px) < 3:
        return None
    start = np.unique(np.linspace(0, len(u_px) - 3, min(max_frames, len(u_px) - 2)).astype(int))
    second = (u_px[start] - 2 * u_px[start + 1] + u_px[start + 2]) / np.sqrt(6.0)
    seen = np.isfinite(second)
    if seen.sum() < 100:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without any centre
        second = second - np.nan_to_num(np.nanmedian(second, axis=1))[:, None]
    scatter = 1.4826 * float(np.median(np.abs(second[seen])))
    if scatter == 0.0:
        return StripeNoise(0.0, 1.0)
    kept = seen & (np.abs(second) < 5 * scatter)
    values = np.where(kept, second, 0.0)
    variance = float((values**2).sum() / kept.sum())
    length, neighbour = 1.0, 0.0
    for lag in range(1, 64):
        pairs = (kept[:, lag:] & kept[:, :-lag]).sum()
        if pairs < 100:
            break
        correlation = float((values[:, lag:] * values[:, :-lag]).sum() / pairs) / variance
        neighbour = correlation if lag == 1 else neighbour
        if correlation < 0.03:
            break
        length += 2 * correlation
    return StripeNoise(float(np.sqrt(variance)), length, float(np.clip(neighbour, 0.0, 1.0)))
