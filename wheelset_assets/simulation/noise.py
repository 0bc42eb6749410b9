"""What a real rig adds to a perfect stripe: a second call, so that a scan exists with and without it.

Here: noise of stripe centres, outliers, dropouts, gaps; errors of the encoder and of the thermometers.
Not here: the stripes (`stripes`), grey-value noise of images (`images`, `boards`), deliberate faults (`faults`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .stripes import Stripes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations and shares; `speckle_rows` is the correlation length: correlation exp(-d^2 / (2 rows^2))."""

    white_px: float = 0.06
    speckle_px: float = 0.04
    speckle_rows: float = 3.0
    outlier_share: float = 0.002
    dropout_share: float = 0.003
    gaps_per_frame: float = 0.05
    gap_rows: int = 12
    encoder_deg: float = 0.003
    encoder_periodic_deg: float = 0.001
    thermometer_c: float = 0.05

    @classmethod
    def none(cls) -> NoiseModel:
        """A perfect instrument."""
        return cls(0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 12, 0.0, 0.0, 0.0)


def add_noise(stripes: Stripes, model: NoiseModel, width_px: int, rng: np.random.Generator) -> Stripes:
    """Noisy copy of perfect stripes. The two cameras get independent noise; a gap (dirt, shadow) strikes both."""
    gap = _gaps(stripes.left_u.shape, model, rng)
    return Stripes(*(_one_camera(u, gap, model, width_px, rng) for u in (stripes.left_u, stripes.right_u)))


def _one_camera(u: Array, gap: NDArray[np.bool_], model: NoiseModel, width_px: int, rng: np.random.Generator) -> Array:
    noisy = u.copy()
    if model.white_px:
        noisy += model.white_px * rng.standard_normal(u.shape)
    if model.speckle_px:
        noisy += model.speckle_px * correlated(rng, u.shape, model.speckle_rows)
    if model.outlier_share:
        struck = np.flatnonzero(rng.random(u.shape) < model.outlier_share)
        # Reflections: half of them anywhere in the image or 20 % beyond it, half within +-40 px of the stripe.
        anywhere = rng.uniform(-0.2, 1.2, struck.size) * width_px
        near = u.flat[struck] + rng.choice((-1.0, 1.0), struck.size) * rng.uniform(1.0, 40.0, struck.size)
        noisy.flat[struck] = np.where(rng.random(struck.size) < 0.5, anywhere, near)
    if model.dropout_share:
        noisy[rng.random(u.shape) < model.dropout_share] = np.nan
    noisy[gap] = np.nan
    return noisy


def correlated(rng: np.random.Generator, shape: tuple[int, ...], length: float) -> Array:
    """Unit-variance normal noise, correlated as exp(-d^2 / (2 length^2)) along the last axis, white along others."""
    if length <= 0:
        return rng.standard_normal(shape)
    # A Gaussian of width length / sqrt(2) convolved with itself is the wanted correlation.
    half = int(np.ceil(3.0 * length))
    kernel = np.exp(-((np.arange(-half, half + 1) / length) ** 2))
    kernel /= np.sqrt((kernel**2).sum())
    white = rng.standard_normal((*shape[:-1], shape[-1] + 2 * half))
    out = np.zeros(shape)
    for k, weight in enumerate(kernel):
        out += weight * white[..., k : k + shape[-1]]
    return out


def _gaps(shape: tuple[int, int], model: NoiseModel, rng: np.random.Generator) -> NDArray[np.bool_]:
    frames, rows = shape
    gap = np.zeros(shape, bool)
    if not model.gaps_per_frame:
        return gap
    count = int(rng.poisson(model.gaps_per_frame * frames))
    frame = rng.integers(0, frames, count)
    start = rng.integers(0, rows, count)
    length = rng.integers(1, 2 * model.gap_rows, count)
    edges = np.zeros((frames, rows + 1), np.int32)
    np.add.at(edges, (frame, start), 1)
    np.add.at(edges, (frame, np.minimum(start + length, rows)), -1)
    return np.cumsum(edges, axis=1)[:, :rows] > 0


def encoder_error_deg(angle_deg: Array, model: NoiseModel, rng: np.random.Generator) -> Array:
    """Error (deg) of the encoder at each reading: one period a turn (eccentric disc) and independent jitter.

    Jitter is limited to a third of the smallest step, so that readings stay in order.
    """
    step = float(np.diff(angle_deg).min()) if angle_deg.size > 1 else 360.0
    phase = rng.uniform(0.0, 2 * np.pi)
    jitter = np.clip(model.encoder_deg * rng.standard_normal(angle_deg.shape), -step / 3, step / 3)
    return model.encoder_periodic_deg * np.sin(np.deg2rad(angle_deg) + phase) + jitter
