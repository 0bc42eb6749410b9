"""Sub-pixel stripe centres on rendered stripes whose centres are known: bias, noise, dropouts, edges, two lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from wheelset_assets.metrology.stripes import extract_centres, second_line, tell_lines_apart

METHODS = ("centroid", "parabola")
ALL_METHODS = (*METHODS, "steger")
WIDTH, SIGMA, WINDOW = 256, 1.7, 7


def rendered(centre, *, bits=8, noise=0.0, amplitude=0.7, seed=0, sigma=SIGMA):
    """Frames (frames, rows, columns) of Gaussian stripes at centre (frames, rows), integrated over each pixel.

    Background 8 % of full scale, falling by a third across the image; noise in grey levels of 255.
    """
    full = 2**bits - 1
    edge = np.arange(WIDTH + 1) - 0.5
    total = 0.5 * erf((edge - np.asarray(centre)[..., None]) / (np.sqrt(2) * sigma))
    stripe = np.nan_to_num(np.diff(total, axis=-1)) * sigma * np.sqrt(2 * np.pi)
    grey = full * (0.08 - 0.025 * np.arange(WIDTH) / WIDTH + amplitude * stripe)
    grey = grey + noise * full / 255 * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, full).astype(np.uint8 if bits == 8 else np.uint16)


def curved(frames=10, rows=200, seed=1):
    """Centres that run over all phases of a pixel and far across the image."""
    phase = np.random.default_rng(seed).uniform(0, 1, (frames, rows))
    return 60 + 100 * np.linspace(0, 1, rows) ** 2 + phase


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("method", METHODS)
def test_centres_are_unbiased_at_every_phase_of_a_pixel(method, bits):
    truth = curved(20, 400)
    found = extract_centres(rendered(truth, bits=bits, noise=1.0), method, 12.0, WINDOW)
    error = found.u_px - truth
    assert np.isfinite(error).all()
    # 8000 rows of 0.01 to 0.02 px: 0.0002 px. The background's slope pulls a centroid by 0.001 px.
    assert abs(error.mean()) < 0.002
    phase = np.floor(8 * (truth % 1)).astype(int)
    for k in range(8):
        assert abs(error[phase == k].mean() - error.mean()) < 0.003  # 1000 rows each: 0.0006 px


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("method", "factor"), [("centroid", 1.1), ("parabola", 1.3)])
def test_noise_of_a_centre_stands_near_the_bound_of_the_image(method, factor, bits):
    """Cramer-Rao: sqrt(2 sigma / sqrt(pi)) noise / peak; a parabola through three pixels wastes the others."""
    truth, noise = curved(20, 400, seed=2), 2.0
    found = extract_centres(rendered(truth, bits=bits, noise=noise), method, 12.0, WINDOW)
    spread = (found.u_px - truth).std()
    # A pixel's square adds 1/12 px^2 to the stripe's own width; rounding to 8 bits adds 1/12 grey level^2.
    bound = np.sqrt(2 * np.hypot(SIGMA, 0.29) / np.sqrt(np.pi)) * np.hypot(noise, 0.29) / (0.7 * 255)
    assert 0.97 * bound < spread < factor * bound  # 0.97: three standard deviations of a spread over 8000 rows


@pytest.mark.parametrize("method", METHODS)
def test_rows_without_a_stripe_have_no_centre(method):
    truth = curved()
    gone = np.random.default_rng(3).random(truth.shape) < 0.2
    found = extract_centres(rendered(np.where(gone, np.nan, truth), noise=2.0), method, 20.0, WINDOW)
    assert np.array_equal(np.isnan(found.u_px), gone)
    assert np.all(found.peak[gone] == 0)
    assert found.peak[~gone] == pytest.approx(0.7 * 255, abs=20)


@pytest.mark.parametrize("bits", [8, 16])
def test_contrast_is_on_the_scale_of_eight_bits(bits):
    truth = np.tile(np.linspace(100, 130, 50), (2, 1))
    for amplitude, seen in ((40 / 255, False), (60 / 255, True)):
        found = extract_centres(rendered(truth, bits=bits, amplitude=amplitude), "centroid", 50.0, WINDOW)
        assert np.isfinite(found.u_px).all() == seen
        assert np.isfinite(found.u_px).any() == seen


@pytest.mark.parametrize("method", METHODS)
def test_a_stripe_that_the_image_cuts_off_is_right_or_absent(method):
    """Within two widths of the image's edge a flank is missing: no centre is better than one drawn inwards."""
    truth = np.tile(np.concatenate([np.linspace(-3, 12, 150), np.linspace(WIDTH - 13, WIDTH + 2, 150)]), (2, 1))
    found = extract_centres(rendered(truth), method, 12.0, WINDOW).u_px
    seen = np.isfinite(found)
    assert np.abs(found - truth)[seen].max() < 0.05
    assert seen[(truth > 6) & (truth < WIDTH - 7)].all()


@pytest.mark.parametrize("method", METHODS)
def test_a_second_line_is_found_beside_the_first(method):
    first = curved(6, 120)
    other = first + 45 + 10 * np.cos(np.arange(120) / 20)
    both = rendered(first, amplitude=0.7, noise=1.0).astype(int) + rendered(other, amplitude=0.5, noise=1.0, seed=9)
    frames = np.clip(both - 15, 0, 255).astype(np.uint8)
    bright = extract_centres(frames, method, 20.0, WINDOW)
    assert np.abs(bright.u_px - first).max() < 0.15
    rest = second_line(frames, bright, WINDOW)
    assert rest.dtype == frames.dtype
    assert np.abs(extract_centres(rest, method, 20.0, WINDOW).u_px - other).max() < 0.2


def test_no_second_line_is_made_up_where_there_is_only_one():
    frames = rendered(curved(4, 100), noise=1.0)
    first = extract_centres(frames, "centroid", 20.0, WINDOW)
    assert np.isnan(extract_centres(second_line(frames, first, WINDOW), "centroid", 20.0, WINDOW).u_px).all()


@pytest.mark.parametrize("swap", [False, True])
def test_lines_are_told_apart_where_only_one_is_seen(swap):
    """Two curved lines 20 px apart that move by 60 px along the image: gaps in one, in the other, and at the ends."""
    low = 100 + 60 * np.sin(np.arange(300) / 60) + np.array([[0.0], [3.0], [-2.0]])
    high = low + 20 + 5 * np.cos(np.arange(300) / 30)
    seen_low, seen_high = np.ones((3, 300), bool), np.ones((3, 300), bool)
    seen_low[:, 80:140], seen_high[:, 170:230] = False, False
    seen_low[0, :20], seen_high[1, 280:] = False, False
    seen_low[2, 50:60], seen_high[2, 55:62] = False, False
    a, b = np.where(seen_low, low, np.nan), np.where(seen_high, high, np.nan)
    first = np.where(np.isnan(a), b, a)  # the detector finds one first, whichever it is
    other = np.where(np.isnan(a) | np.isnan(b), np.nan, b)
    if swap:
        first, other = np.where(np.isnan(other), first, other), np.where(np.isnan(other), np.nan, a)
    found_low, found_high = tell_lines_apart(first, other)
    assert np.array_equal(found_low, a, equal_nan=True)
    assert np.array_equal(found_high, b, equal_nan=True)


def test_a_frame_that_never_shows_two_lines_has_one():
    u = np.array([[10.0, np.nan, 12.0]])
    low, high = tell_lines_apart(u, u * np.nan)
    assert np.array_equal(low, u, equal_nan=True)
    assert np.isnan(high).all()


# --- over widths and noise, with uncertainty


def slanted(frames=6, rows=400, seed=5):
    """Straight stripes that cross a fifth of a pixel a row, so that a method may smooth along them."""
    phase = np.random.default_rng(seed).uniform(0, 1, (frames, 1))
    return 80 + 0.2 * np.arange(rows) + phase


def crb_px(sigma, noise, peak=0.7 * 255):
    """Cramer-Rao bound of one row's centre: a Gaussian integrated over pixels, white noise and rounding to levels."""
    return np.sqrt(2 * np.hypot(sigma, 0.29) / np.sqrt(np.pi)) * np.hypot(noise, 0.29) / peak


@pytest.mark.parametrize("sigma", [1.0, 1.7, 3.0])
@pytest.mark.parametrize("snr", [20, 60])
@pytest.mark.parametrize("method", ALL_METHODS)
def test_bias_bound_and_claim_over_widths(method, snr, sigma):
    """Bias under 0.01 px at every phase of a pixel; the default near the bound; the claimed sigma two-sided."""
    truth, noise = slanted(), 0.7 * 255 / snr
    found = extract_centres(rendered(truth, noise=noise, sigma=sigma), method, 12.0)
    seen = np.isfinite(found.u_px)
    assert seen.mean() > 0.9
    error = (found.u_px - truth)[seen]
    phase = np.floor(5 * (truth[seen] % 1)).astype(int)
    assert max(abs(error[phase == k].mean()) for k in range(5)) < 0.01
    bound = crb_px(sigma, noise)
    if method != "steger":
        assert 0.95 * bound < error.std() < 1.3 * bound
        assert 0.9 < (error / found.sigma_px[seen]).std() < 1.1
    else:  # it smooths along the stripe: below the bound of one row, and its ends and the ground's slope remain
        assert error.std() < bound
        assert 0.9 < (error / found.sigma_px[seen]).std() < 1.6
    assert np.nanmedian(found.width_px) == pytest.approx(np.hypot(sigma, 0.29), rel=0.03)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("method", ALL_METHODS)
def test_saturated_cores_keep_their_centre_and_say_so(method, bits):
    """Six times full scale: a core of some nine pixels is flat."""
    truth = slanted()
    found = extract_centres(rendered(truth, bits=bits, noise=1.0, amplitude=6.0, sigma=2.0), method, 12.0)
    seen = np.isfinite(found.u_px)
    assert seen.mean() > 0.9
    assert found.saturated[seen].all()
    error = (found.u_px - truth)[seen]
    assert abs(error.mean()) < 0.01
    assert error.std() < 0.03
    if method != "steger":
        assert 0.8 < (error / found.sigma_px[seen]).std() < 1.3
    assert not extract_centres(rendered(truth, bits=bits), method, 12.0).saturated.any()


@pytest.mark.parametrize("method", ALL_METHODS)
def test_ambient_light_and_a_lamp_do_not_draw_the_centre(method):
    """A lamp brighter than the stripe, 40 px wide, and light that doubles across the image."""
    truth = slanted(rows=200)
    columns = np.arange(WIDTH)
    ambient = 30 * columns / WIDTH + 140 / (1 + np.exp(np.abs(columns - 215) - 20.0))
    frames = np.clip(rendered(truth, noise=1.0, amplitude=0.45).astype(float) + ambient, 0, 255)
    found = extract_centres(np.rint(frames).astype(np.uint8), method, 12.0)
    seen = np.isfinite(found.u_px)
    assert seen.mean() > 0.9
    assert np.abs(found.u_px - truth)[seen].max() < 0.1
    assert abs((found.u_px - truth)[seen].mean()) < 0.01


@pytest.mark.parametrize("sigma", [6.0, 14.0])
def test_a_wide_stripe_sets_its_own_window(sigma):
    truth = slanted()
    found = extract_centres(rendered(truth, noise=1.5, sigma=sigma), "centroid", 12.0)
    error = (found.u_px - truth)[np.isfinite(found.u_px)]
    assert len(error) > 0.9 * truth.size
    assert error.std() < 1.3 * crb_px(sigma, 1.5)
    assert np.nanmedian(found.width_px) == pytest.approx(sigma, rel=0.05)


def test_noise_alone_has_no_stripe():
    grey = np.clip(np.random.default_rng(1).normal(40, 6, (3, 300, 200)), 0, 255).astype(np.uint8)
    assert np.isfinite(extract_centres(grey, "centroid", 12.0).u_px).mean() < 0.01


def test_frames_do_not_depend_on_the_frames_beside_them():
    frames = rendered(slanted(), noise=2.0)
    whole = extract_centres(frames, "centroid", 12.0, WINDOW)
    alone = [extract_centres(f[None], "centroid", 12.0, WINDOW).u_px for f in frames]
    assert np.nanmax(np.abs(np.concatenate(alone) - whole.u_px)) < 2e-3  # the typical width moves by its own noise
