"""Filters on grids whose noise, outliers and gaps are known; slow loops as oracles of the fast ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.signal import lfilter, savgol_coeffs, savgol_filter
from two_sided import mean_square_interval

from wheelset_assets.metrology import filtering, grids, window_median, windows

KINDS = ("median", "mean", "gaussian")
KNOBS = {"window_rows": 5, "window_frames": 1, "sigma_rows": 1.0}
masks = arrays(bool, (4, 40), elements=st.booleans())


def profile(frames=120, rows=400):
    """Depth (frames, rows) mm of a wheel-like profile with a steep flank, turning with run-out."""
    row = np.arange(rows)
    shape = 250 + 6 * np.sin(row / 45) + 25 / (1 + np.exp(-(row - 180) / 6.0))
    turn = np.linspace(0, 2 * np.pi, frames, endpoint=False)[:, None]
    return shape + 0.05 * np.cos(turn) + 0.02 * np.sin(2 * turn + 1) + 0.0004 * np.gradient(shape) * np.cos(turn)


# --- outliers


@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_outliers_are_found_and_nothing_else(sigma):
    """Five sigma on 48,000 points: at most a few false positives, and all outliers that stand clear of the noise."""
    random = np.random.default_rng(1)
    depth = profile() + sigma * random.standard_normal((120, 400))
    truth = random.random(depth.shape) < 0.003
    size = random.choice([-1.0, 1.0], depth.shape) * random.uniform(8 * sigma, 30.0, depth.shape)
    depth[truth] += size[truth]
    depth[random.random(depth.shape) < 0.01] = np.nan
    found = filtering.outliers(depth, 5.0, 11)
    truth &= np.isfinite(depth)
    # Normal noise exceeds 5 sigma once in 1.7 million; 3 points in 48,000 leave room for the scale's own noise.
    assert (found & ~truth).sum() <= 3
    assert (truth & ~found).sum() <= 1
    assert truth.sum() > 100
    assert not found[np.isnan(depth)].any()


def test_the_threshold_is_where_it_says():
    """Two-sided: of outliers of 4 sigma few go at a limit of 5, of 7 sigma few stay.

    One outlier a row. It is a clipped part of its own local mean, 3 of 11 sigma: the limit acts at 5.3.
    """
    random = np.random.default_rng(2)
    clean = profile() + 0.02 * random.standard_normal((120, 400))
    rows = np.arange(3, 400, 3)
    frames = rows * 37 % 120
    shares = {}
    for size in (3.0, 4.0, 6.0, 7.0, 9.0):
        depth = clean.copy()
        depth[frames, rows] += size * 0.02
        shares[size] = filtering.outliers(depth, 5.0, 11)[frames, rows].mean()
    # Normal distribution: 1 %, 10 %, 76 %, 96 %, 100 %; 133 points each, so three standard deviations are 4 to 11 %.
    assert shares[3.0] < 0.05
    assert 0.01 < shares[4.0] < 0.2
    assert 0.6 < shares[6.0] < 0.9
    assert shares[7.0] > 0.88
    assert shares[9.0] == 1.0


def test_noise_that_grows_along_the_rows_has_a_local_scale():
    random = np.random.default_rng(3)
    sigma = 0.01 * 4 ** (np.arange(512) / 511)
    depth = profile(rows=512) + sigma * random.standard_normal((120, 512))
    # Over a block of 64 rows the noise grows by a fifth: the limit of 5 is 4.6 at its noisy end, 4e-6 of the points.
    assert filtering.outliers(depth, 5.0, 11).sum() <= 4
    depth[10, [40, 480]] += 0.1  # ten sigma where it is quiet, under three where it is not
    assert filtering.outliers(depth, 5.0, 11)[10, [40, 480]].tolist() == [True, False]


def test_edges_flats_and_single_frames_are_not_eaten():
    """A part that only some frames show, a flat over five frames, a frame apart: no outliers."""
    random = np.random.default_rng(4)
    depth = profile() + 0.02 * random.standard_normal((120, 400))
    depth[:, :30] = np.nan
    depth[40:60, 30:90] = np.nan
    depth[::2, 250:253] = np.nan
    depth[70:75, 300:] += 0.1 * np.hanning(200)[:100]  # five sigma deep, but long along the rows
    depth[100] += 0.15
    found = filtering.outliers(depth, 5.0, 11)
    assert found.sum() <= 3


def test_a_shape_that_stands_clear_of_the_turn_is_kept_and_single_points_in_it_are_not():
    """A flat of 1 mm on a third of the rows, dirt of 0.15 mm on some: judged by their frames, later; reflections go."""
    random = np.random.default_rng(14)
    depth = profile() + 0.02 * random.standard_normal((120, 400))
    depth[70:73, 120:250] += np.array([[0.6], [1.0], [0.5]])
    depth[20:26, 300:340] -= 0.15
    wrong = np.zeros(depth.shape, bool)
    wrong[71, [130, 171, 172, 220]] = wrong[22, 320] = True
    depth[wrong] += 3.0
    found = filtering.outliers(depth, 5.0, 11)
    assert found[wrong].all()
    inside = np.zeros(depth.shape, bool)
    inside[70:73, 125:245] = inside[20:26, 305:335] = True
    assert (found & inside & ~wrong).sum() <= 25  # a few about the points that are wrong
    assert (found & ~inside).sum() <= 60  # and at the walls of a shape
    assert found.sum() < 0.2 * inside.sum()


def test_few_frames_are_judged_along_the_rows():
    random = np.random.default_rng(5)
    depth = 250 + 0.002 * np.arange(400) + 0.01 * random.standard_normal((4, 400))
    depth[1, 50], depth[3, 399], depth[2, 200] = depth[1, 50] + 0.5, depth[3, 399] - 0.5, np.nan
    found = filtering.outliers(depth, 5.0, 11)
    assert found[1, 50]
    assert found[3, 399]
    assert found.sum() <= 4  # a median of eleven is itself noisy: 1600 points at an effective 4.8 sigma


def test_empty_grids_have_no_outliers():
    for shape in ((20, 50), (3, 50)):
        assert not filtering.outliers(np.full(shape, np.nan), 5.0, 11).any()


# --- range gate, isolated points, thinning


def test_range_gate_keeps_the_margin_about_all_but_the_extreme_hundredths():
    depth = np.linspace(200, 300, 1001)[None].repeat(10, 0)
    depth[0, :4] = [180.7, 181.3, 318.7, 319.3]
    depth[1, 0] = np.nan
    out = filtering.range_gate(depth, 20.0)
    # The percentiles are 201 and 299 to one step of 0.1.
    assert [tuple(p) for p in np.argwhere(out)] == [(0, 0), (0, 3)]
    assert not filtering.range_gate(np.full((3, 4), np.nan), 1.0).any()


@given(masks, st.integers(1, 8))
def test_isolated_is_the_slow_loop(seen, min_run):
    expected = np.zeros(seen.shape, bool)
    for frame in range(len(seen)):
        row = 0
        while row < seen.shape[1]:
            stop = row
            while stop < seen.shape[1] and seen[frame, stop]:
                stop += 1
            if 0 < stop - row < min_run:
                expected[frame, row:stop] = True
            row = max(stop, row + 1)
    assert np.array_equal(filtering.isolated(seen, min_run), expected)


@given(masks, st.integers(1, 5))
def test_thinning_keeps_every_nth_row_that_was_seen(seen, step):
    keep = filtering.thin(seen, step)
    assert np.array_equal(keep[:, ::step], seen[:, ::step])
    assert keep.sum() == seen[:, ::step].sum()


@given(masks, st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 5, 11]))
def test_running_mean_is_the_slow_loop(seen, seed, window):
    values = np.where(seen, np.random.default_rng(seed).normal(100, 1, seen.shape), np.nan)
    found = filtering.running_mean(values, window)
    half = window // 2
    for frame in range(len(values)):
        for row in range(values.shape[1]):
            part = values[frame, max(0, row - half) : row + half + 1]
            part = part[np.isfinite(part)]
            expected = part.mean() if part.size else np.nan
            assert found[frame, row] == pytest.approx(expected, abs=1e-9, nan_ok=True)


# --- smoothing


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=60)
@given(seen=masks, slope=st.floats(-3, 3), window=st.sampled_from([3, 5, 7]), frames=st.sampled_from([1, 3]))
def test_a_slope_is_unbiased_up_to_every_gap_and_nothing_is_invented(kind, seen, slope, window, frames):
    """A plane stays a plane, to rounding, wherever points are missing; what is missing stays missing."""
    plane = 250 + slope * np.arange(40) + 0.7 * slope * np.arange(4)[:, None]
    depth = np.where(seen, plane, np.nan)
    found = filtering.smooth(depth, kind, window_rows=window, window_frames=frames, sigma_rows=1.2)
    assert np.array_equal(np.isfinite(found.depth_mm), seen)
    assert np.array_equal(np.isfinite(found.noise_factor), seen)
    assert np.allclose(found.depth_mm[seen], plane[seen], atol=1e-9, rtol=0)
    assert np.all(found.noise_factor[seen] <= 1.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gap", [1, 2, 3])
def test_nothing_is_averaged_across_a_gap(kind, gap):
    """A step of 5 mm hidden by a gap: both sides keep their own height, and the same holds from frame to frame."""
    depth = np.where(np.arange(40) < 20, 250.0, 255.0)[None].repeat(9, 0)
    depth[:, 20 - gap : 20] = np.nan
    found = filtering.smooth(depth, kind, window_rows=9, window_frames=1, sigma_rows=2.0)
    assert np.allclose(found.depth_mm, depth, equal_nan=True, atol=1e-9)
    turned = filtering.smooth(depth.T, kind, window_rows=1, window_frames=9, sigma_rows=2.0)
    assert np.allclose(turned.depth_mm, depth.T, equal_nan=True, atol=1e-9)
    # In noise a median over both sides would take the nearest value of its own side: one sigma of bias.
    noise = 0.05 * np.random.default_rng(20).standard_normal((4000, 40))
    found = filtering.smooth(depth[:1] + noise, kind, window_rows=9, window_frames=1, sigma_rows=2.0)
    assert np.abs(
        np.delete(found.depth_mm - depth[:1], np.s_[20 - gap : 20], axis=1).mean(axis=0)
    ).max() < 4 * 0.05 / np.sqrt(4000)


@pytest.mark.parametrize("kind", ["mean", "gaussian"])
def test_full_windows_are_plain_convolutions(kind):
    """Eq. 15 and 16-17 where nothing is missing: numpy's convolution with the written-out kernel."""
    depth = 250 + np.random.default_rng(6).normal(size=(3, 60))
    offsets = np.arange(-3, 4)
    kernel = np.ones(7) if kind == "mean" else np.exp(-(offsets**2) / (2 * 1.5**2))
    found = filtering.smooth(depth, kind, window_rows=7, window_frames=1, sigma_rows=1.5)
    expected = np.stack([np.convolve(line, kernel / kernel.sum(), "valid") for line in depth])
    assert np.allclose(found.depth_mm[:, 3:-3], expected, atol=1e-11)


@pytest.mark.parametrize("window", [5, 7, 9])
def test_the_parabola_of_equal_weights_is_savitzky_and_golays(window):
    depth = 250 + np.random.default_rng(6).normal(size=(3, 60))
    found = filtering.smooth(depth, "quadratic", window_rows=window, window_frames=1, sigma_rows=1e6)
    half = window // 2
    assert np.allclose(found.depth_mm[:, half:-half], savgol_filter(depth, window, 2, axis=1)[:, half:-half], atol=1e-9)
    kernel = savgol_coeffs(window, 2)
    assert np.allclose(found.noise_factor[:, half:-half], np.sqrt((kernel**2).sum()), atol=1e-9)


def test_the_parabola_keeps_a_curved_surface_where_the_gaussian_draws_it_in():
    """A flank of 13 mm radius, rows 0.5 mm apart: kappa sigma^2 / 2 is some 10 um; quartic terms leave a hundredth."""
    x = 0.5 * np.arange(-20, 21)
    depth = 250 - np.sqrt(13.0**2 - x**2)[None]
    middle = np.s_[:, 5:-5]
    off = {k: (filtering.smooth(depth, k, **KNOBS).depth_mm - depth)[middle] for k in ("gaussian", "quadratic")}
    assert np.abs(off["gaussian"]).min() > 0.005
    assert np.abs(off["quadratic"]).max() < 0.0015
    assert np.abs(off["quadratic"])[0, 15] < 2e-5


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_the_parabola_leaves_the_noise_that_it_claims(correlation):
    random = np.random.default_rng(31)
    noise = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], random.standard_normal((400, 130)), axis=1)[
        :, 30:
    ]
    found = filtering.smooth(250 + 0.02 * noise, "quadratic", **KNOBS, noise_correlation=correlation)
    left = (found.depth_mm - 250)[:, 5:-5].std() / 0.02
    assert left / found.noise_factor[:, 5:-5].mean() == pytest.approx(1.0, abs=0.03)
    assert found.noise_factor[0, 50] < 0.95


def test_the_median_window_is_eq_14():
    depth = 250 + np.random.default_rng(7).normal(size=(12, 30))
    found = filtering.smooth(depth, "median", window_rows=5, window_frames=3, sigma_rows=1.0).depth_mm
    for i in range(1, 11):
        for j in range(2, 28):
            assert found[i, j] == np.median(depth[i - 1 : i + 2, j - 2 : j + 3])


def smoothed_slowly(depth, kind, half, sigma_rows, range_mm, edge_mm, correlation):
    """Point by point along the rows, as the docstrings say: depth and noise factor."""
    value, factor = np.full(depth.shape, np.nan), np.full(depth.shape, np.nan)
    through = []  # bilateral: of the frames that tell, variance let through by the derivatives and by the weights
    apart = depth[:, 1:-1] - (depth[:, 2:] + depth[:, :-2]) / 2
    noise = 1.4826 * np.nanmedian(np.abs(apart - np.nanmedian(apart))) / np.sqrt(1.5)
    for f, r in np.argwhere(np.isfinite(depth)):
        weights, members = {0: 1.0}, {0: depth[f, r]}
        for k in range(1, half + 1):
            if r - k < 0 or r + k >= depth.shape[1] or not np.isfinite(depth[f, [r - k, r + k]]).all():
                break
            away = depth[f, [r - k, r + k]].mean() - depth[f, r]
            if kind in ("mean", "gaussian", "quadratic") and abs(away) > edge_mm:
                break
            weight = 1.0 if kind in ("mean", "median") else np.exp(-((k / sigma_rows) ** 2) / 2)
            weight *= np.exp(-((away / range_mm) ** 2) / 2) if kind == "bilateral" else 1.0
            weights |= {-k: weight, k: weight}
            members |= {-k: depth[f, r - k], k: depth[f, r + k]}
        at, w, z = np.array(list(weights)), np.array(list(weights.values())), np.array(list(members.values()))
        if kind == "quadratic":  # the constant of a weighted fit, or the point itself where two pairs are not there
            powers = np.vander(at, 3, increasing=True).astype(float)
            fit = np.linalg.solve((powers.T * w) @ powers, powers.T * w)[0] if len(at) >= 5 else (at == 0.0)
            value[f, r] = fit @ z
            factor[f, r] = np.sqrt(fit @ correlation ** np.abs(np.subtract.outer(at, at)) @ fit)
            continue
        if kind != "median":
            w = w / w.sum()
            value[f, r] = w @ z
            joint = correlation ** np.abs(np.subtract.outer(at, at))
            factor[f, r] = np.sqrt(w @ joint @ w)
            if kind == "bilateral" and f % 16 == 0:
                slope = np.array([bilateral_slope(at, z, n, sigma_rows, range_mm) for n in range(len(z))])
                through.append((slope @ joint @ slope, factor[f, r] ** 2))
            continue
        value[f, r] = np.median(z)
        slope = (at @ z) / max((at**2).sum(), 1) / noise
        flat = 2 / max((np.arange(-half, half + 1) ** 2).sum(), 1)
        count = np.exp(-0.4 * at**2 * max(slope**2 - flat, 0)).sum()
        n = [int(np.floor(count)), int(np.floor(count)) + 1]
        means = [correlation ** np.abs(np.subtract.outer(np.arange(m), np.arange(m))) for m in n]
        along = np.interp(count, n, [np.sqrt(m.mean()) for m in means])
        factor[f, r] = min(1.0, np.sqrt(np.pi / 2 / (1 / along**2 + np.pi / 2 - 1)))
    if through:
        factor = np.minimum(factor * np.sqrt(np.divide(*np.sum(through, axis=0))), 1.0)
    return value, factor


def bilateral_slope(at, z, n, sigma_rows, range_mm):
    """Derivative of the bilateral mean of z (members,), places `at`, by its n-th member: a complex step, exact to rounding."""
    z = z.astype(complex)
    z[n] += 1e-30j
    of = {int(place): k for k, place in enumerate(at)}
    pair = np.array([(z[of[int(place)]] + z[of[-int(place)]]) / 2 for place in at])
    weight = np.exp(-((at / sigma_rows) ** 2) / 2 - ((pair - z[of[0]]) / range_mm) ** 2 / 2)
    return (weight @ z / weight.sum()).imag / 1e-30


@pytest.mark.parametrize("kind", [*KINDS, "quadratic", "bilateral"])
@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    missing=st.sampled_from([0.0, 0.03, 0.3]),
    window=st.sampled_from([3, 5, 7, 9, 11]),
    correlation=st.sampled_from([0.0, 0.5]),
    block=st.sampled_from([1, 50, 10**6]),
)
def test_smoothing_is_the_slow_loop_whatever_the_blocks(kind, seed, missing, window, correlation, block):
    """With gaps, a slope that differs by frame, and a step, which whole-array passes meet in one grid."""
    random = np.random.default_rng(seed)
    row = np.arange(34)
    depth = 250 + random.uniform(0, 0.1, (5, 1)) * row + 4.0 * (row > 20) + 0.03 * random.standard_normal((5, 34))
    depth[random.random(depth.shape) < missing] = np.nan
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grids, "BLOCK_POINTS", block)
        found = filtering.smooth(
            depth, kind, window_rows=window, window_frames=1, sigma_rows=1.1, noise_correlation=correlation,
            range_mm=0.06, edge_mm=0.3,
        )  # fmt: skip
    value, factor = smoothed_slowly(depth, kind, window // 2, 1.1, 0.06, 0.3, correlation)
    assert np.allclose(found.depth_mm, value, rtol=0, atol=1e-11, equal_nan=True)
    # A median's factor comes from a table where its window has no gap.
    assert np.allclose(found.noise_factor, factor, rtol=0, atol=1.5e-4 if kind == "median" else 1e-11, equal_nan=True)
    if kind == "median":
        assert np.array_equal(found.depth_mm, value, equal_nan=True)


@pytest.mark.parametrize("kind", [*KINDS, "bilateral"])
@pytest.mark.parametrize("frames", [1, 3])
def test_blocks_change_no_bit(kind, frames, monkeypatch):
    depth = profile(40, 120) + 0.03 * np.random.default_rng(21).standard_normal((40, 120))
    depth[np.random.default_rng(22).random(depth.shape) < 0.02] = np.nan
    made = []
    for block in (1, 700, 10**9):
        monkeypatch.setattr(grids, "BLOCK_POINTS", block)
        made.append(filtering.smooth(depth, kind, window_rows=5, window_frames=frames, sigma_rows=1.0, edge_mm=0.3))
        made[-1] = (made[-1].depth_mm, made[-1].noise_factor, filtering.outliers(depth, 5.0, 11))
    for other in made[1:]:
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(made[0], other, strict=True))


@pytest.mark.parametrize("count", window_median.EXCHANGES)
def test_exchanges_put_the_median_in_the_middle(count):
    """Of all patterns of zeros and ones, which is enough (0-1 principle); and one missing value makes it missing."""
    pattern = np.arange(2**count) >> np.arange(count)[:, None] & 1
    assert np.array_equal(window_median._median_of(list(pattern.astype(float))), np.median(pattern, axis=0))
    holed = np.where(np.eye(count, dtype=bool), np.nan, np.arange(count)[:, None])
    assert np.isnan(window_median._median_of(list(holed))).all()


@pytest.mark.parametrize("kind", ["none", *KINDS])
def test_windows_of_one_change_nothing(kind):
    depth = np.array([[1.0, np.nan, 5.0, 2.0]])
    found = filtering.smooth(depth, kind, window_rows=1, window_frames=1, sigma_rows=1.0)
    assert np.array_equal(found.depth_mm, depth, equal_nan=True)
    assert np.array_equal(found.noise_factor, [[1.0, np.nan, 1.0, 1.0]], equal_nan=True)


@pytest.mark.parametrize("window", [3, 5, 7, 9])
@pytest.mark.parametrize("slope", [0.0, 0.3, 0.7, 1.0, 1.4, 2.0, 4.0])
def test_a_median_leaves_what_it_claims_on_every_slope(window, slope):
    """Slope in standard deviations of the noise a row: from averaging freely to letting each point be."""
    line = slope * np.arange(300.0)
    depth = line + np.random.default_rng(3).standard_normal((200, 300))
    found = filtering.smooth(depth, "median", window_rows=window, window_frames=1, sigma_rows=1.5)
    inside = np.s_[:, 10:-10]
    left = np.std((found.depth_mm - line)[inside])
    assert 0.95 < left / np.mean(found.noise_factor[inside]) < 1.08


def test_a_median_claims_nothing_on_a_slope_that_is_steeper_than_the_noise():
    """There the middle of the window is the point itself; a mean lowers the noise on any slope."""
    noise = np.random.default_rng(9).standard_normal((400, 40))
    for rise, low, high in ((0.0, 0.5, 0.62), (10.0, 0.98, 1.0)):
        found = filtering.smooth(rise * np.arange(40) + noise, "median", window_rows=5, window_frames=1, sigma_rows=1.0)
        left = (found.depth_mm - rise * np.arange(40))[:, 5:-5].std()
        claimed = np.median(found.noise_factor[:, 5:-5])
        assert low < claimed <= high
        assert left == pytest.approx(claimed, rel=0.06)


def test_bilateral_smoothing_keeps_a_step_a_slope_and_a_gap_and_lowers_noise_as_claimed():
    random = np.random.default_rng(10)
    course = 250 + 0.2 * np.arange(80) + np.where(np.arange(80) > 40, 3.0, 0.0)
    noise = 0.01 * random.standard_normal((2000, 80))
    depth = course + noise
    depth[:, 60:63] = np.nan
    knobs = {"window_rows": 5, "window_frames": 1, "sigma_rows": 1.0}
    found = filtering.smooth(depth, "bilateral", range_mm=0.06, **knobs)
    assert np.array_equal(np.isfinite(found.depth_mm), np.isfinite(depth))
    seen = np.isfinite(depth).all(axis=0)
    bias = (found.depth_mm - course)[:, seen].mean(axis=0)
    assert np.abs(bias).max() < 0.001  # five standard deviations of a mean over the frames
    smeared = (filtering.smooth(depth, "gaussian", **knobs).depth_mm - course)[:, seen]
    assert np.abs(smeared.mean(axis=0)).max() > 0.3
    inner = [10, 25, 50, 55]
    left = (found.depth_mm - course)[:, inner].std(axis=0)
    assert left / 0.01 == pytest.approx(np.median(found.noise_factor[:, inner], axis=0), rel=0.06)


@pytest.mark.parametrize(("noise_share", "low", "high"), [(0.2, 0.98, 1.02), (0.5, 0.95, 1.02), (1.0, 0.93, 1.01)])
@pytest.mark.parametrize("correlation", [0.0, 0.4])
def test_bilateral_claims_the_noise_that_its_weights_bring_in(noise_share, low, high, correlation):
    """Up to a noise as large as the range of the weights, on a slope: the noise left over the noise claimed."""
    white = np.random.default_rng(11).standard_normal((1500, 80))
    noise = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white, axis=1)[:, 20:]
    course = 0.1 * np.arange(60)
    found = filtering.smooth(
        course + 0.01 * noise, "bilateral", window_rows=7, window_frames=1, sigma_rows=1.5,
        range_mm=0.01 / noise_share, noise_correlation=correlation,
    )  # fmt: skip
    inner = slice(8, -8)
    left = (found.depth_mm - course)[:, inner].std() / 0.01
    assert low < left / np.sqrt(np.square(found.noise_factor[:, inner]).mean()) < high


@pytest.mark.parametrize("correlation", [0.0, 0.5])
@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_noise_factor_is_the_empirical_reduction(kind, frames, correlation):
    """White and first-order autoregressive noise along the rows, in full windows and beside a gap: two-sided."""
    random = np.random.default_rng(8)
    white = random.standard_normal((2001, 64))
    noise = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white, axis=1)
    noise[:, 0:20] = np.nan  # also lets the autoregression forget its start
    noise[:, 45] = np.nan
    found = filtering.smooth(
        250 + noise, kind, window_rows=5, window_frames=frames, sigma_rows=1.0, noise_correlation=correlation
    )
    inner = slice(frames, -frames)
    # Formulas for medians of correlated values do not exist in closed form: 6 % of the standard deviation is allowed;
    # means and Gaussians are exact.
    slack = 0.06 if kind == "median" else 0.0
    for row in (20, 21, 30, 44, 46, 47, 60):
        spread = (found.depth_mm[inner, row] - 250).std()
        claimed = found.noise_factor[inner, row]
        if kind == "median":  # where noise looks like a slope, a little less is claimed
            assert np.quantile(claimed, 0.75) < 1.1 * claimed.min()
            claimed = [np.median(claimed)]
        else:
            assert np.ptp(claimed) == 0
        low, high = mean_square_interval((2001 - 2 * frames) // frames)  # a window over frames correlates them
        assert np.sqrt(low) * (1 - slack) < spread / claimed[0] < np.sqrt(high) * (1 + slack), row


@pytest.mark.parametrize("kind", ["mean", "gaussian"])
def test_a_step_between_neighbouring_rows_is_not_smeared_and_a_slope_is_still_smoothed(kind):
    """Of 4 mm, without a missing row: two surfaces, one behind the other."""
    random = np.random.default_rng(8)
    row = np.arange(200)
    truth = 250 + 0.5 * row + 4.0 * (row >= 100)
    depth = truth + 0.03 * random.standard_normal((2000, 200))
    made = filtering.smooth(depth, kind, **KNOBS, edge_mm=0.3)
    bias = np.abs(made.depth_mm.mean(axis=0) - truth)
    assert bias.max() < 5 * 0.03 / np.sqrt(2000)
    smeared = filtering.smooth(depth, kind, **KNOBS)
    assert np.abs(smeared.depth_mm.mean(axis=0) - truth).max() > 0.5
    # Beside the step the claim grows to that of the point alone; elsewhere the window is whole.
    claimed = made.noise_factor.mean(axis=0)
    assert claimed[[99, 100]] == pytest.approx(1.0)
    assert claimed[50] < 0.6
    scatter = made.depth_mm.std(axis=0) / 0.03
    assert scatter[[50, 98, 99, 100, 101]] == pytest.approx(claimed[[50, 98, 99, 100, 101]], rel=0.1)


@pytest.mark.parametrize("half", [1, 2, 3, 4])
def test_the_table_of_a_whole_windows_noise_factor_is_what_it_stands_for(half):
    noise, run = 0.03, 2.0 * float((np.arange(half + 1) ** 2).sum())
    along = np.array([1.0] + [windows.noise_factor(np.full(n, 1.0 / n), 0.3) for n in range(1, 2 * half + 2)])
    claim = window_median._MedianClaim(half, noise, along)
    slope = noise * np.concatenate([np.linspace(-12.0, 12.0, 4001), [np.nan]])
    count = 2.0 * sum(claim.fading(slope[:-1].copy())[1:]) + 1.0
    found = claim.whole_factor(slope * run)
    assert found[:-1] == pytest.approx(claim.factor(count, count), abs=1.5e-4)
    assert found[0] == pytest.approx(1.0, abs=1e-6)
    assert found[2000] < 0.8
    assert np.isnan(found[-1])
    exact = window_median._MedianClaim(half, 1e-12, along)  # data without noise: no slope is gentle
    assert exact.whole_factor(run * np.array([1e-5, 1.0, np.inf])) == pytest.approx(1.0, abs=1e-6)
