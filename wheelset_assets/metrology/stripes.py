"""Sub-pixel centres of laser stripes in camera frames: one centre for each image row, each with its standard uncertainty.

Rows of all frames are worked on at once; no files are read here. Methods: `centroid`, `parabola`, `steger`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Frames = NDArray[Any]
"""Grey levels, uint8 or uint16."""

METHODS = ("centroid", "parabola", "steger")
LARGEST_HALF_PX = 96
"""Stripes wider than about a third of this are taken for lamps or reflections."""
ITERATIONS = 6
CLIPPED_U_PX = 0.02
"""Standard uncertainty of the centre of gravity of a clipped profile that depends on where pixels cut its flanks."""
LOWEST_SNR = 5.0
"""A peak lower than this multiple of the grey noise is no stripe, however small the contrast asked for."""


@dataclass(frozen=True)
class StripeCentres:
    """Centres of stripes, each array (frames, rows); NaN where no stripe was found.

    u_px: centre; sigma_px: its standard uncertainty from the frame's grey noise and the stripe's slopes; peak: height
    above background in grey levels, 0 where none was found; width_px: standard deviation of the stripe's profile;
    saturated: whether pixels of the stripe are at full scale.
    """

    u_px: Array
    peak: Array
    sigma_px: Array
    width_px: Array
    saturated: NDArray[np.bool_]


@dataclass(frozen=True)
class _Windows:
    """Grey levels above background about each row's peak: columns (n, k), signal (n, k), which pixels count (n, k)."""

    columns: NDArray[np.intp]
    signal: NDArray[np.float32]
    inside: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    peak: Array


def extract_centres(
    frames: Frames, method: str, min_contrast: float, window_px: int = 0, full_scale: float | None = None
) -> StripeCentres:
    """One stripe centre for each row of each frame (frames, rows, columns), 8-bit or 16-bit.

    `centroid`: centre of gravity under a Gaussian weight as wide as the stripe, which is moved to its own result; for a
    Gaussian stripe in white noise that is the maximum-likelihood centre. `parabola`: vertex of the parabola through the
    logarithms of all pixels above a fifth of the peak, weighted by their squares (Guo 2011). `steger`: where the slope
    across the ridge of the smoothed image vanishes (Steger 1998), carried along the ridge to the row's middle.

    Pixels at full scale are left out of the parabola, which `centroid` takes too where a stripe's core is saturated; the
    ridge rests on the symmetry of both flanks. Light that changes slowly along a row is taken off between the stripe's
    two sides. A row has no centre if its peak rises less than min_contrast (on the scale of 0-255) above that, or where
    the image's edge cuts a flank.
    window_px: half window of the centre; 0 follows the stripe's width. full_scale: largest possible grey level.
    """
    n, rows, width = frames.shape
    scale = full_scale or (65535.0 if frames.dtype == np.uint16 else 255.0)
    flat = np.ascontiguousarray(frames).reshape(n * rows, width)
    sigma = _typical_width(flat, scale, min_contrast)
    reach = float(window_px) / 3.0 if window_px else np.inf
    sigma = float(np.clip(sigma, 0.6, min(reach, LARGEST_HALF_PX / 4)))
    half = int(np.ceil(3.5 * sigma)) + 1
    noise = _grey_noise(flat)
    windows = _windows(flat, _coarse(flat, sigma), half, max(6, int(2 * sigma)), scale)
    found = (windows.peak * (255.0 / scale) >= min_contrast) & (windows.peak > LOWEST_SNR * noise)
    start = _half_height_middle(windows)
    centre, u, own_width = _weighted_centroid(windows, start, sigma, noise)
    ok = np.isfinite(own_width) & (own_width < 3 * sigma)
    if method == "parabola":
        centre, u = _log_parabola(windows, noise)
    elif method == "centroid":
        centre, u = _from_flanks_where_saturated(windows, centre, u, noise)
    elif method == "steger":
        centre, u = _steger(frames, centre, max(sigma, 1.0), noise)
    with np.errstate(invalid="ignore"):
        clear = (centre >= 2.5 * sigma) & (centre <= width - 1 - 2.5 * sigma)
        found &= ok & clear & np.isfinite(u) & (np.abs(centre - start) < half)
    shape = (n, rows)
    hidden = lambda values: np.where(found, values, np.nan).astype(float).reshape(shape)  # noqa: E731
    return StripeCentres(
        hidden(centre),
        np.where(found, windows.peak, 0.0).astype(float).reshape(shape),
        hidden(u),
        hidden(own_width),
        (found & (windows.saturated & windows.inside).any(axis=1)).reshape(shape),
    )


def _grey_noise(flat: Frames) -> float:
    """Standard deviation of the grey noise, from second differences along some rows: robust, as most pixels are ground.

    Rounding to whole grey levels hides noise far below one of them; its own 1/12 is the least that is claimed.
    """
    from scipy.special import ndtri

    rows = flat[:: max(1, len(flat) // 256)].astype(np.float32)
    second = np.abs(rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]).ravel()
    if not len(second):
        return 1.0
    # A median of whole numbers jumps; the mean square below a limit moves smoothly. It is that of a normal quantity
    # cut at the quantile q which the kept share tells of.
    limit = max(float(np.percentile(second, 90)), 1.0)
    kept = second[second <= limit].astype(float)
    share = min(len(kept) / len(second), 0.999)
    q = float(ndtri(0.5 + 0.5 * share))
    cut = 1 - 2 * q * np.exp(-0.5 * q * q) / np.sqrt(2 * np.pi) / share
    return float(np.sqrt(max((kept**2).mean() / cut / 6.0, 1 / 12)))


def _band_passed(flat: Frames, sigma: float) -> Frames:
    """Rows with what is much wider than the stripe taken off; negative values become zero."""
    import cv2

    narrow = max(1, 2 * round(0.6 * sigma) + 1)
    wide = 2 * int(np.ceil(6 * sigma)) + 11
    smooth = cv2.blur(flat, (narrow, 1), borderType=cv2.BORDER_REPLICATE)
    return cv2.subtract(smooth, cv2.blur(flat, (wide, 1), borderType=cv2.BORDER_REPLICATE))


def _coarse(flat: Frames, sigma: float) -> NDArray[np.intp]:
    """Column of the brightest place of each row (n,), among what is about as narrow as the stripe."""
    return _band_passed(flat, sigma).argmax(axis=1)


def _typical_width(flat: Frames, scale: float, min_contrast: float) -> float:
    """Standard deviation of the stripes' profiles: median over some rows of the width at half height."""
    some = np.ascontiguousarray(flat[:: max(1, len(flat) // 512)])
    sigma = 2.0
    for _ in range(3):  # the band-pass has to be wider than the stripe, and so has the window
        half = min(int(8 * sigma) + 4, LARGEST_HALF_PX)
        windows = _windows(some, _coarse(some, sigma), half, 4, scale)
        left, right = _half_height(windows)
        good = (windows.peak * (255.0 / scale) >= min_contrast) & (right - left < 1.9 * half)
        if not good.any():
            sigma *= 3
            continue
        # One pixel's own width comes on top of the distance between the outermost pixels above half height.
        measured = float(np.median((right - left)[good])) / 2.355
        if measured <= 1.5 * sigma:
            return measured
        sigma = measured
    return sigma


def _windows(flat: Frames, column: NDArray[np.intp], half: int, flank: int, scale: float) -> _Windows:
    """Pixels about each row's coarse place, with the ground between its two sides taken off."""
    width = flat.shape[1]
    reach = half + flank
    columns = column[:, None] + np.arange(-reach, reach + 1)
    inside = (columns >= 0) & (columns < width)
    grey = flat[np.arange(len(flat))[:, None], np.clip(columns, 0, width - 1)].astype(np.float32)
    sides = [np.median(grey[:, part], axis=1) for part in (slice(None, flank), slice(-flank, None))]
    cut = [~inside[:, part].any(axis=1) for part in (slice(None, flank), slice(-flank, None))]
    low, high = np.where(cut[0], sides[1], sides[0]), np.where(cut[1], sides[0], sides[1])
    rise = grey[:, flank : flank + 2 * half + 1].max(axis=1) - np.minimum(low, high)
    uneven = np.abs(high - low) > 0.2 * rise  # another line or a lamp stands on one side: trust the darker one
    low, high = (np.where(uneven, np.minimum(low, high), side) for side in (low, high))
    middle = slice(flank, flank + 2 * half + 1)
    ramp = np.linspace(-1, 1, 2 * reach + 1, dtype=np.float32)[middle] * (reach / (reach - 0.5 * flank))
    ground = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * ramp
    grey, columns, inside = grey[:, middle], columns[:, middle], inside[:, middle]
    signal = np.where(inside, grey - ground, 0.0).astype(np.float32)
    near = signal[:, max(half - 2, 0) : half + 3]
    return _Windows(columns, signal, inside, grey >= scale, near.max(axis=1).astype(float))


def _half_height(windows: _Windows) -> tuple[Array, Array]:
    """Where each profile falls below half its peak on either side of the window's middle, (n,) in px of the window,
    interpolated between two pixels; the window's end if it does not."""
    signal, half = windows.signal, windows.signal.shape[1] // 2
    level = 0.5 * windows.peak[:, None]
    rows = np.arange(len(signal))
    below = signal < level
    ends = []
    for side in (below[:, half::-1], below[:, half:]):
        step = np.where(side.any(axis=1), side.argmax(axis=1), half)
        ends.append(step)
    result = []
    for step, sign in zip(ends, (-1, 1), strict=True):
        outer = np.clip(half + sign * step, 0, 2 * half)
        inner = np.clip(outer - sign, 0, 2 * half)
        a, b = signal[rows, outer].astype(float), signal[rows, inner].astype(float)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip(np.nan_to_num((level[:, 0] - a) / (b - a)), 0, 1)
        result.append(outer - sign * share)
    return result[0], result[1]


def _half_height_middle(windows: _Windows) -> Array:
    left, right = _half_height(windows)
    return windows.columns[:, 0] + 0.5 * (left + right)


def _weighted_centroid(windows: _Windows, start: Array, sigma: float, noise: float) -> tuple[Array, Array, Array]:
    """Centre (n,), its standard uncertainty, and the profile's own standard deviation.

    The centre c makes sum (x - c) w(x - c) s(x) vanish; steps are twice the offset of the weighted centroid, which for
    a weight as wide as the stripe is Newton's step.
    """
    signal = windows.signal
    origin = windows.columns[:, 0]
    x = np.arange(signal.shape[1], dtype=np.float32)
    c = (start - origin).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(ITERATIONS):
            d = x - c[:, None]
            weight = np.exp((-0.5 / sigma**2) * d * d)
            ws = weight * signal
            total = ws.sum(axis=1)
            step = np.clip(2 * (ws * d).sum(axis=1) / total, -sigma, sigma)
            c = c + np.nan_to_num(step)
            if np.abs(step[np.isfinite(step)]).max(initial=0.0) < 1e-4:
                break
        d = x - c[:, None]
        weight = np.exp((-0.5 / sigma**2) * d * d)
        ws = weight * signal
        total, second = ws.sum(axis=1), (ws * d * d).sum(axis=1)
        slope = total - second / sigma**2
        free = ~windows.saturated
        u = noise * np.sqrt(((d * weight) ** 2 * free).sum(axis=1)) / np.abs(slope)
        spread = second / total
        own = np.sqrt(1 / (1 / spread - 1 / sigma**2))
    bad = (total <= 0) | (slope <= 0)
    return origin + np.where(bad, np.nan, c).astype(float), np.where(bad, np.nan, u).astype(float), own.astype(float)


def _from_flanks_where_saturated(windows: _Windows, centre: Array, u: Array, noise: float) -> tuple[Array, Array]:
    """The centres, those of saturated rows by the parabola through both flanks if these have enough pixels."""
    rows = np.flatnonzero((windows.saturated & windows.inside).any(axis=1))
    if not len(rows):
        return centre, u
    part = _Windows(*(getattr(windows, name)[rows] for name in ("columns", "signal", "inside", "saturated", "peak")))
    flanks, flanks_u = _log_parabola(part, noise)
    good = np.isfinite(flanks) & np.isfinite(flanks_u)
    centre, u = centre.copy(), u.copy()
    u[rows] = np.hypot(u[rows], CLIPPED_U_PX)
    centre[rows[good]], u[rows[good]] = flanks[good], flanks_u[good]
    return centre, u


def _log_parabola(windows: _Windows, noise: float) -> tuple[Array, Array]:
    """Centre (n,) and its standard uncertainty from a parabola through the logarithms, least squares."""
    signal = windows.signal.astype(float)
    k = signal.shape[1]
    x = np.arange(k) - k // 2
    left, right = (end - k // 2 for end in _half_height(windows))
    middle, wide = 0.5 * (left + right), 0.5 * (right - left)
    # Out to a fifth of the height, which for a Gaussian is 1.53 times as far out as half of it; where the core is
    # saturated, to a twentieth: only the flanks are left.
    core = (windows.saturated & windows.inside).any(axis=1)
    near = np.abs(x - middle[:, None]) <= np.where(core, wide + 3, np.maximum(1.53 * wide, 1.5))[:, None]
    level = (np.where(core, 0.05, 0.2) * windows.peak)[:, None]
    used = near & (signal > np.maximum(level, 3 * noise)) & ~windows.saturated & windows.inside
    weight = np.where(used, signal, 0.0) ** 2
    log = np.log(np.where(used, signal, 1.0))
    t = x - middle[:, None]
    basis = np.stack([np.ones_like(t), t, t * t], axis=2)
    weighted = basis * weight[..., None]
    normal = np.swapaxes(basis, 1, 2) @ weighted
    moment = np.swapaxes(weighted, 1, 2) @ log[..., None]
    few = (used.sum(axis=1) < 3) | ~(used & (t > 0)).any(axis=1) | ~(used & (t < 0)).any(axis=1)
    normal[few] = np.eye(3)
    scale = np.maximum(normal[:, 0, 0], 1e-12)[:, None, None]
    normal = normal / scale + 1e-12 * np.eye(3)
    with np.errstate(divide="ignore", invalid="ignore"):
        coefficients = np.linalg.solve(normal, moment / scale)[..., 0]
        _, b, c = coefficients.T
        centre = -0.5 * b / c
        gradient = np.stack([np.zeros_like(b), -0.5 / c, 0.5 * b / c**2], axis=1)
        by_log = np.einsum("nkj,nj->nk", weighted, np.linalg.solve(normal, gradient[..., None])[..., 0] / scale[..., 0])
        u = noise * np.sqrt((by_log**2 * np.where(used, 1 / np.where(used, signal, 1.0) ** 2, 0.0)).sum(axis=1))
    bad = few | ~(c < 0) | (np.abs(centre) > np.maximum(wide, 1.0) + 1.0)
    where = windows.columns[:, k // 2] + middle + centre
    return np.where(bad, np.nan, where), np.where(bad, np.nan, u)


def _steger(frames: Frames, near: Array, sigma: float, noise: float) -> tuple[Array, Array]:
    """Ridge of the smoothed image in each row, from first and second derivatives of a Gaussian as wide as the stripe.

    The Hessian's eigenvector of largest curvature is the direction across; on it the first derivative vanishes at the
    distance t. Carried along the ridge to the row's middle the centre is t / n_x beside the pixel.
    """
    import cv2

    n, rows = frames.shape[:2]
    half = int(np.ceil(4 * sigma))
    x = np.arange(-half, half + 1)
    g = np.exp(-0.5 * (x / sigma) ** 2)
    g /= g.sum()
    first = x / sigma**2 * g  # correlation, not convolution: the sign is that of the derivative
    second = (x**2 / sigma**4 - 1 / sigma**2) * g
    second -= g * second.sum() / g.sum()
    centre, u = np.full((2, n, rows), np.nan)
    energy = float((first**2).sum() * (g**2).sum())
    row = np.arange(rows)
    for k, frame in enumerate(frames.astype(np.float32)):  # one frame's five derivatives fit the cache, not all frames'
        at = near.reshape(n, rows)[k]
        seen = np.isfinite(at)
        filtered = [
            cv2.sepFilter2D(frame, cv2.CV_32F, a, b, borderType=cv2.BORDER_REPLICATE)
            for a, b in ((first, g), (g, first), (second, g), (first, first), (g, second))
        ]
        place = np.where(seen, at, 0.0)
        for _ in range(3):  # the derivatives are taken where the ridge is, not at the next pixel
            gx, gy, gxx, gxy, gyy = _between_pixels(filtered, row, place)
            angle = 0.5 * np.arctan2(2 * gxy, gxx - gyy)
            nx, ny = np.cos(angle), np.sin(angle)
            across = gxx * nx**2 + 2 * gxy * nx * ny + gyy * ny**2
            other = gxx * ny**2 - 2 * gxy * nx * ny + gyy * nx**2
            swap = other < across
            nx, ny = np.where(swap, -ny, nx), np.where(swap, nx, ny)
            across = np.minimum(across, other)
            with np.errstate(divide="ignore", invalid="ignore"):
                t = -(gx * nx + gy * ny) / across
                offset = np.where((across < 0) & (np.abs(nx) > 0.2), t / nx, np.nan)
            place = np.where(np.isfinite(offset), place + np.clip(offset, -1, 1), place)
        whole = (row >= 3 * sigma) & (row <= rows - 1 - 3 * sigma)  # beyond, the smoothing reaches out of the image
        centre[k] = np.where(seen & whole & (np.abs(offset) <= 0.05), place, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            u[k] = noise * np.sqrt(energy) / (np.abs(across) * np.abs(nx))
        # Smoothing along a bent stripe draws its centre inwards by half of sigma^2 times the bend.
        step = max(2, round(2 * sigma))
        bend = np.zeros(rows)
        if rows > 2 * step:
            bend[step:-step] = (centre[k, 2 * step :] - 2 * centre[k, step:-step] + centre[k, : -2 * step]) / step**2
        real = np.maximum(np.nan_to_num(bend) ** 2 - 6 * np.nan_to_num(u[k]) ** 2 / step**4, 0.0)  # less its own noise
        u[k] = np.sqrt(u[k] ** 2 + (0.5 * sigma**2) ** 2 * real)
    return centre.ravel(), u.ravel()


def _between_pixels(fields: list[Array], row: NDArray[np.intp], place: Array) -> list[Array]:
    """Values of fields (rows, columns) at one place of each row, by the cubic through four pixels."""
    base = np.clip(np.floor(place), 1, fields[0].shape[1] - 3).astype(int)
    f = place - base
    weights = (
        -f * (f - 1) * (f - 2) / 6,
        (f + 1) * (f - 1) * (f - 2) / 2,
        -(f + 1) * f * (f - 2) / 2,
        (f + 1) * f * (f - 1) / 6,
    )
    columns = [base + k - 1 for k in range(4)]
    return [np.sum([w * f[row, c] for w, c in zip(weights, columns, strict=True)], axis=0) for f in fields]


def second_line(frames: Frames, first: StripeCentres, window_px: int = 0) -> Frames:
    """The same frames with the stripe of `first` replaced by the row's median, so that a second line can be found.

    window_px: half width of what is replaced, halved; 0 follows the stripe's width.
    """
    columns = np.arange(frames.shape[2])
    typical = np.nanmedian(first.width_px) if np.isfinite(first.width_px).any() else 2.0
    reach = 2 * window_px if window_px else 5 * typical + 2
    near = np.abs(columns - first.u_px[..., None]) <= reach
    background = np.median(frames, axis=2, keepdims=True).astype(frames.dtype)
    return np.where(near, background, frames)


def tell_lines_apart(first_px: Array, other_px: Array) -> tuple[Array, Array]:
    """Centres (frames, rows) of the line of smaller u and of the other, from the two centres found in each row.

    A row with one centre only (the other line is hidden there) gives it to the line that it continues: the one whose
    last centre, going along the rows in either direction from where both are seen, is nearer. A frame that never shows
    both lines gives all to the first.
    """
    both = np.isfinite(first_px) & np.isfinite(other_px)
    low = np.where(both, np.fmin(first_px, other_px), np.nan)
    high = np.where(both, np.fmax(first_px, other_px), np.nan)
    open_ = np.isfinite(first_px) & ~both
    n_rows = first_px.shape[1]
    for rows in (range(n_rows), range(n_rows - 1, -1, -1)):
        last_low, last_high = np.full(len(first_px), np.nan), np.full(len(first_px), np.nan)
        for row in rows:
            u = first_px[:, row]
            near_low, near_high = np.abs(u - last_low), np.abs(u - last_high)
            to_high = open_[:, row] & (near_high < np.where(np.isnan(near_low), np.inf, near_low))
            to_low = open_[:, row] & ~to_high & np.isfinite(near_low)
            low[to_low, row], high[to_high, row] = u[to_low], u[to_high]
            open_[:, row] &= ~(to_low | to_high)
            last_low = np.where(np.isfinite(low[:, row]), low[:, row], last_low)
            last_high = np.where(np.isfinite(high[:, row]), high[:, row], last_high)
    return np.where(open_, first_px, low), high
