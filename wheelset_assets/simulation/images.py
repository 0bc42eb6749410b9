"""Raw camera frames of laser stripes: a Gaussian line across each row, a dark ground, grey noise. 8 bit.

Here: rendering from stripe centres, noisy or not. Not here: the centres (`stripes`, `noise`), PNG files (`bundle`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from .noise import correlated

Array = NDArray[np.float64]

GROUND, GREY_NOISE = 9.0, 1.6
PEAK, PEAK_SPREAD, PEAK_ROWS = 165.0, 22.0, 25.0  # mean, spread and correlation length (rows) of the peak's intensity


def render_frames(
    centres_u: Sequence[Array], image_size: tuple[int, int], sigma_px: float, rng: np.random.Generator
) -> Iterator[NDArray[np.uint8]]:
    """One image (height, width) a frame from the lines' centres, each (frames, rows), NaN where there is no light."""
    for frame in range(centres_u[0].shape[0]):
        light = np.full((image_size[1], image_size[0]), GROUND, np.float32)
        for u in centres_u:
            _draw(light, u[frame], sigma_px, rng)
        light += GREY_NOISE * rng.standard_normal(light.shape, dtype=np.float32)
        yield np.clip(np.rint(light), 0, 255).astype(np.uint8)


def _draw(light: NDArray[np.float32], u: Array, sigma_px: float, rng: np.random.Generator) -> None:
    """Add a line of centres u (rows,) to an image; centres beyond the image show as far as their flank reaches in."""
    height, width = light.shape
    peak = np.maximum(PEAK + PEAK_SPREAD * correlated(rng, (height,), PEAK_ROWS), 60.0)
    half = int(np.ceil(5.0 * sigma_px))
    rows = np.flatnonzero(np.isfinite(u) & (u > -half) & (u < width + half))
    columns = np.rint(u[rows]).astype(int)[:, None] + np.arange(-half, half + 1)
    values = peak[rows, None] * np.exp(-0.5 * ((columns - u[rows, None]) / sigma_px) ** 2)
    inside = (columns >= 0) & (columns < width)
    light[np.broadcast_to(rows[:, None], columns.shape)[inside], columns[inside]] += values[inside].astype(np.float32)
