"""Surfaces of revolution: exact radii, mean meridians and harmonics of the turn against truth, under dirt and gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from two_sided import assert_pulls, assert_unbiased

from wheelset_assets.metrology import grids, rigid
from wheelset_assets.metrology import revolution as rev

# --- meridian coordinates


def test_radius_is_the_distance_from_the_axle_however_far_the_laser_misses_it():
    """Eq. 28: points of a 460 mm wheel in a plane 5 mm beside the axle. rho = K + z would err by 27 um."""
    radius, sideways = 460.0, 5.0
    lateral = np.linspace(-20, 20, 9)[None]
    height = np.sqrt(radius**2 - sideways**2)
    psi = np.radians(70)
    turn = Rotation.from_rotvec([psi - np.pi / 2, 0, 0]).as_matrix()  # the meridian stands at 70 degrees from +Y
    in_rig = np.stack([lateral, np.full((1, 9), sideways), np.full((1, 9), height)], axis=-1) @ turn.T
    pose = rigid.transform(Rotation.from_euler("xyz", [170, 3, -5], degrees=True).as_matrix(), [4.0, 250.0, 650.0])
    x, y, z = np.moveaxis(rigid.apply(rigid.inverse(pose), in_rig), -1, 0)
    found = rev.to_meridian("s", 1, x, y, z, np.zeros((1, 9)), pose)
    assert found.radial_mm == pytest.approx(radius, abs=1e-9)
    assert found.lateral_mm == pytest.approx(lateral, abs=1e-9)
    assert found.direction_deg == pytest.approx(70 - np.degrees(sideways / height), abs=1e-3)
    assert 1e3 * (radius - height) == pytest.approx(27, abs=0.5)
    assert (found.sensor_id, found.line) == ("s", 1)


def test_missing_points_stay_missing_and_an_empty_grid_has_no_direction():
    grid = np.array([[1.0, np.nan]])
    found = rev.to_meridian("s", 0, grid, grid, grid, grid, np.eye(4))
    assert np.array_equal(np.isfinite(found.radial_mm), [[True, False]])
    assert found.direction_deg == pytest.approx(45)
    assert np.isnan(rev.to_meridian("s", 0, grid * np.nan, grid, grid * np.nan, grid, np.eye(4)).direction_deg)


@given(st.floats(-180, 180), st.floats(-0.05, 0.05), st.floats(-2, 2), st.floats(-2, 2))
def test_meridian_motion_turns_from_lateral_to_radial_about_its_pivot_and_stays_in_the_plane(psi, rotation, da, dr):
    """Against the plane rotation written out, for a point of the meridian at psi."""
    pivot, (a, r) = (30.0, 455.0), (48.0, 441.0)
    motion = rev.meridian_motion(psi, pivot, rotation, da, dr)
    c, s = np.cos(np.radians(psi)), np.sin(np.radians(psi))
    moved = rigid.apply(motion, np.array([a, r * c, r * s]))
    cos, sin = np.cos(rotation), np.sin(rotation)
    expected_a = pivot[0] + cos * (a - pivot[0]) - sin * (r - pivot[1]) + da
    expected_r = pivot[1] + sin * (a - pivot[0]) + cos * (r - pivot[1]) + dr
    assert moved == pytest.approx([expected_a, expected_r * c, expected_r * s], abs=1e-9)


# --- coverage


@given(st.lists(st.integers(-7200, 7200), min_size=2, max_size=30, unique_by=lambda a: a % 3600))
def test_coverage_is_a_share_and_the_gap_is_the_largest_arc(tenths):
    share, gap = rev.coverage(np.array(tenths) / 10)
    turn = sorted(a % 3600 for a in tenths)
    arcs = [(b - a) % 3600 / 10 for a, b in zip(turn, [*turn[1:], turn[0]], strict=True)]
    assert gap == pytest.approx(max(arcs), abs=1e-9)
    assert 0 < share <= 1 + 1e-12


def test_coverage_of_a_turn_with_and_without_a_gap():
    step = 3.0
    whole = np.arange(0, 360, step) + 17.0
    assert rev.coverage(whole) == pytest.approx((1.0, step))
    kept = whole[(whole < 100) | (whole >= 190)]
    share, gap = rev.coverage(kept)
    # 90 frames stand for their own arc of 3 degrees, the gap's edge for twice that: 273 of 360.
    assert gap == pytest.approx(93.0)
    assert share == pytest.approx(273 / 360)
    assert rev.coverage(np.concatenate([whole, whole + 360])) == pytest.approx((1.0, step))  # two turns are one
    assert rev.coverage(np.array([5.0])) == (0.0, 360.0)


# --- harmonics


def turn(random, n=120, sigma=0.01, amplitude=0.05, orders=(1, 2, 3)):
    """Angles, values about 460, truth of the run-out by its harmonics; noise white."""
    angle = np.arange(n) * 360.0 / n + random.uniform(0, 360)
    a, b = amplitude * random.normal(size=(2, len(orders))) / np.array(orders) ** 2
    theta = np.radians(angle)[:, None] * orders
    wave = np.cos(theta) @ a + np.sin(theta) @ b
    return angle, 460 + wave + sigma * random.standard_normal(n), a, b


def spoilt(values, angle, *, dirt_deg=0.0, dirt_mm=0.15, gap_deg=0.0, shape="plateau"):
    """Values with dirt from 40 degrees on and a gap from 200 degrees on; where the dirt lies."""
    at = np.mod(angle - 40.0, 360.0)
    inside = at < dirt_deg
    x = 2 * at / max(dirt_deg, 1e-9) - 1
    values = values + np.where(inside, dirt_mm * (1.0 if shape == "plateau" else 1 - x * x), 0.0)
    values[np.mod(angle - 200.0, 360.0) < gap_deg] = np.nan
    return values, inside


@pytest.mark.parametrize(("dirt_deg", "gap_deg"), [(0, 0), (25, 0), (0, 50), (25, 40)])
def test_mean_under_dirt_and_gaps_two_sided(dirt_deg, gap_deg):
    """Dirt of 0.15 mm over 25 degrees shifts a plain mean by 10 um, eleven times the mean's own noise."""
    pulls = []
    for seed in range(200):
        random = np.random.default_rng(seed)
        angle, values, _, _ = turn(random)
        values, dirty = spoilt(values, angle, dirt_deg=dirt_deg, gap_deg=gap_deg)
        fit = rev.fit_harmonics(angle, values, 6 if gap_deg == 0 else 3, 4.0)
        assert fit is not None
        assert not fit.used[dirty | np.isnan(values)].any()
        pulls.append((fit.mean - 460) / fit.u_mean)
    assert_pulls(pulls)
    assert_unbiased(pulls)


@pytest.mark.parametrize("frames", [24, 48])
def test_short_turns_two_sided(frames):
    """Few frames for thirteen coefficients: their residuals are small, but that is no reason to exclude good frames."""
    pulls, used = [], []
    for seed in range(200):
        angle, values, _, _ = turn(np.random.default_rng(seed), n=frames)
        fit = rev.fit_harmonics(angle, values, 6, 4.0)
        pulls.append((fit.mean - 460) / fit.u_mean)
        used.append(fit.used.mean())
    assert np.mean(used) > 0.98
    # Student's t of 48 - 13 or 24 - 7 degrees of freedom: variance 1.06 or 1.13; a little for the few left out.
    assert_pulls(pulls, underclaim=1.1)
    assert_unbiased(np.array(pulls) / 1.06)


def test_dirt_with_soft_edges_costs_little():
    """A parabolic heap: its feet stay under the limit of four sigma and pull the mean by half its own noise."""
    pulls = []
    for seed in range(200):
        angle, values, _, _ = turn(np.random.default_rng(seed))
        values, _ = spoilt(values, angle, dirt_deg=25, shape="heap")
        fit = rev.fit_harmonics(angle, values, 6, 4.0)
        pulls.append((fit.mean - 460) / fit.u_mean)
    assert abs(np.mean(pulls)) < 0.8
    assert_pulls(pulls, underclaim=1.25)


def test_harmonics_and_run_out_two_sided():
    """Each cosine and sine, and max - min of the model, over 200 turns; noise of 10 um against 0.1 mm of run-out."""
    pulls, ranges = [], []
    fine = np.radians(np.arange(0, 360, 0.25))[:, None] * (1, 2, 3)
    for seed in range(200):
        random = np.random.default_rng(1000 + seed)
        angle, values, a, b = turn(random)
        fit = rev.fit_harmonics(angle, values, 3, 4.0)
        u = fit.scatter * np.sqrt(2 / fit.used.sum())
        pulls += [*(fit.cosine - a) / u, *(fit.sine - b) / u]
        truth = np.ptp(np.cos(fine) @ a + np.sin(fine) @ b)
        ranges.append((fit.peak_to_peak - truth) / fit.u_peak_to_peak)
        assert fit.used.sum() >= 117  # four sigma: one frame in 16,000
    # Small harmonics are drawn towards zero by their noise's share: less than their u by a little.
    assert_pulls(pulls, overclaim=1.03, underclaim=1.03)
    assert_pulls(ranges)


def test_scatter_is_the_noise():
    found = [rev.fit_harmonics(*turn(np.random.default_rng(s), sigma=0.02)[:2], 4, 4.0).scatter for s in range(60)]
    # 60 variances of 111 degrees of freedom each; cutting at four sigma takes 0.1 %.
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.02, rel=3.3 / np.sqrt(2 * 60 * 111) + 0.002)


def test_noise_alone_is_not_run_out():
    """Twelve coefficients of pure noise: max - min stays below three of its own standard uncertainties."""
    found = [rev.fit_harmonics(*turn(np.random.default_rng(s), amplitude=0.0)[:2], 6, 4.0) for s in range(60)]
    assert all(f.u_peak_to_peak > 0 for f in found)  # zero, but never known without an uncertainty
    assert np.median([f.peak_to_peak / f.u_peak_to_peak for f in found]) < 3.0


def test_a_flat_is_excluded_and_the_rest_is_used():
    angle, values, _, _ = turn(np.random.default_rng(5), n=240)
    flat = np.abs(np.mod(angle - 100, 360) - 180) < 6
    values[flat] -= 0.4 * (1 - ((np.mod(angle[flat] - 100, 360) - 180) / 6) ** 2)
    fit = rev.fit_harmonics(angle, values, 6, 4.0)
    deep = flat & (np.abs(np.mod(angle - 100, 360) - 180) < 5)
    assert not fit.used[deep].any()
    assert fit.used[~flat].mean() > 0.99
    assert fit.fitted[~flat] == pytest.approx(values[~flat], abs=0.05)


def test_frames_that_a_low_order_alone_misses_come_back():
    """Orders up to 6 that a first pass of order 2 takes for dirt: they are the wheel's shape, and all of its frames count."""
    angle, worst = np.arange(256) * 360.0 / 256, 0.0
    for seed in range(60):
        random = np.random.default_rng(seed)
        phase = random.uniform(0, 2 * np.pi, 6)
        shape = sum(
            a * np.cos(k * np.radians(angle) + phase[k - 1])
            for k, a in enumerate((0.040, 0.020, 0.008, 0.006, 0.005, 0.004), 1)
        )
        fit = rev.fit_harmonics(angle, shape + 0.001 * random.standard_normal(256), 6, 4.0)
        assert fit is not None
        assert fit.used.sum() >= 250, seed
        worst = max(worst, abs(fit.mean) / fit.u_mean)
    assert worst < 4.0


def test_coverage_of_several_revolutions():
    """Frames of later turns lie between, beside or upon those of the first."""
    random = np.random.default_rng(0)
    for turns in (1.0, 2.0, 2.1, 3.0):
        angle = np.arange(round(128 * turns)) * 360.0 / 128
        for noise in (0.0, 0.003, 0.5):
            share, gap = rev.coverage(angle + noise * random.standard_normal(len(angle)))
            assert share > 0.97
            assert gap < 8
            hole = np.mod(angle, 360.0)
            share, gap = rev.coverage(angle[(hole < 100) | (hole > 190)])
            assert share == pytest.approx(0.75, abs=0.03)
            assert gap == pytest.approx(90, abs=6)


def test_order_falls_with_gaps_and_frames():
    angle, values, _, _ = turn(np.random.default_rng(6))
    holed = values.copy()
    holed[np.mod(angle, 360) < 150] = np.nan  # 270 / 153 = 1.8: first order at most
    assert rev.fit_harmonics(angle, holed, 6, 4.0).cosine.size == 1
    assert rev.fit_harmonics(angle, values, 6, 4.0).cosine.size == 6
    assert rev.fit_harmonics(angle[::12], values[::12], 6, 4.0).cosine.size == 1  # ten frames, three a coefficient


def test_too_few_frames_give_no_fit():
    angle, values, _, _ = turn(np.random.default_rng(7), n=12)
    values[3:] = np.nan
    assert rev.fit_harmonics(angle, values, 2, 4.0) is None
    assert rev.fit_harmonics(angle, values * np.nan, 2, 4.0) is None


def test_fit_is_independent_of_the_encoders_zero_and_of_where_the_values_lie():
    angle, values, _, _ = turn(np.random.default_rng(8))
    base = rev.fit_harmonics(angle, values, 4, 4.0)
    moved = rev.fit_harmonics(angle + 123.0, values + 1e5, 4, 4.0)
    assert moved.mean - 1e5 == pytest.approx(base.mean, abs=1e-7)
    assert moved.peak_to_peak == pytest.approx(base.peak_to_peak, abs=1e-4)  # evaluated every half degree
    assert np.array_equal(moved.used, base.used)


# --- mean meridians


def meridian_noise(random, frames=48, rows=60, sigma=0.02):
    """A curved profile seen along lines of sight that lean by 30 degrees, with noise along them."""
    lateral = np.linspace(0, 40, rows)
    radial = 460 - 0.002 * (lateral - 10) ** 2
    along = sigma * random.standard_normal((frames, rows))
    return lateral, radial, lateral + 0.5 * along, radial + np.sqrt(0.75) * along


def test_mean_meridian_two_sided():
    random = np.random.default_rng(9)
    lateral, radial, a, r = meridian_noise(random, rows=400)
    a[3, 50], r[3, 50] = a[3, 50] + 3.0, r[3, 50] + 5.0  # an outlier that a filter left
    a[:40, 7], r[:40, 7] = np.nan, np.nan
    found = rev.mean_meridian(a, r, np.ones(48, bool))
    along = 0.5 * (found.lateral_mm - lateral) + np.sqrt(0.75) * (found.radial_mm - radial)
    assert_pulls(along / found.u_mm)
    assert_unbiased(along / found.u_mm)
    assert found.n_frames[7] == 8
    assert found.n_frames[50] == 47


@given(
    n=st.integers(1, 12),
    missing=st.sampled_from([0.0, 0.2, 0.7]),
    seed=st.integers(0, 2**32 - 1),
    block=st.sampled_from([1, 6, 10**6]),
)
def test_the_frames_about_a_point_are_two_on_each_side_round_the_turn(n, missing, seed, block):
    random = np.random.default_rng(seed)
    values = random.normal(400, 1, (n, 3))
    values[random.random(values.shape) < missing] = np.nan
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grids, "BLOCK_POINTS", block)
        found = rev._from_frames_about(values)
    for frame, row in np.ndindex(values.shape):
        around = values[[(frame + k) % n for k in (-2, -1, 1, 2)], row]
        around = around[np.isfinite(around)] if np.isfinite(around).any() else values[:, row]
        if np.isfinite(values[frame, row]):
            assert found[frame, row] == abs(values[frame, row] - np.nanmedian(around))
        else:
            assert np.isnan(found[frame, row])


def test_blocks_change_no_bit_of_a_mean_meridian(monkeypatch):
    _, _, a, r = meridian_noise(np.random.default_rng(15), rows=40)
    a[:9, 7], r[:9, 7] = np.nan, np.nan
    made = []
    for block in (1, 90, 10**9):
        monkeypatch.setattr(grids, "BLOCK_POINTS", block)
        made.append(vars(rev.mean_meridian(a, r, np.ones(len(a), bool))))
    assert all(np.array_equal(made[0][k], other[k], equal_nan=True) for other in made[1:] for k in other)


def test_jackknife_of_left_out_groups_is_the_uncertainty_of_the_mean():
    """sqrt((g - 1) / g sum (x - mean)^2) over delete-a-group means is unbiased for u: 24 groups, 400 rows."""
    _, radial, a, r = meridian_noise(np.random.default_rng(10), frames=72, rows=400)
    found = rev.mean_meridian(a, r, np.ones(72, bool))
    left = found.left_out_radial_mm
    assert left.shape == (24, 400)
    spread = np.sqrt(23 / 24 * ((left - left.mean(axis=0)) ** 2).sum(axis=0))
    pulls = (found.radial_mm - radial) / spread
    # With 23 degrees of freedom a pull is Student's t: variance 23 / 21.
    assert_pulls(pulls, underclaim=np.sqrt(23 / 21))


def test_left_out_groups_are_the_means_of_the_others():
    _, _, a, r = meridian_noise(np.random.default_rng(11), frames=20, rows=7)
    a[2, 3], r[2, 3] = np.nan, np.nan
    found = rev.mean_meridian(a, r, np.ones(20, bool), clip=1e9, groups=6)
    for g in range(6):
        rest = np.setdiff1d(np.arange(20), np.arange(g, 20, 6))
        assert found.left_out_lateral_mm[g] == pytest.approx(np.nanmean(a[rest], axis=0), abs=1e-12)
        assert found.left_out_radial_mm[g] == pytest.approx(np.nanmean(r[rest], axis=0), abs=1e-12)


def test_only_the_given_frames_and_rows_with_enough_of_them_count():
    _, _, a, r = meridian_noise(np.random.default_rng(12), frames=20, rows=5)
    a[2:, 4], r[2:, 4] = np.nan, np.nan
    used = np.arange(20) % 2 == 0
    r[~used] += 1.0
    found = rev.mean_meridian(a, r, used, clip=1e9)
    assert found.radial_mm[:4] == pytest.approx(r[used][:, :4].mean(axis=0), abs=1e-12)
    assert np.isnan(found.radial_mm[4])
    assert np.isnan(found.u_mm[4])
    assert found.n_frames.tolist() == [10, 10, 10, 10, 1]


def test_folding_takes_the_median_of_interleaved_frames():
    _, _, a, r = meridian_noise(np.random.default_rng(13), frames=17, rows=6)
    lateral, radial = rev.grouped_meridians(a, r, 5)
    for g in range(5):
        assert np.array_equal(lateral[g], np.median(a[g::5], axis=0))
        assert np.array_equal(radial[g], np.median(r[g::5], axis=0))
    assert rev.grouped_meridians(a[:3], r[:3], 5)[0].shape == (3, 6)


def test_frame_offsets_follow_each_frame_and_ignore_single_outliers():
    random = np.random.default_rng(14)
    expected = np.linspace(0, 5, 30)
    offset = random.normal(0, 0.1, 12)
    values = expected + offset[:, None] + 0.001 * random.standard_normal((12, 30))
    values[4, 11] += 2.0
    values[7] = np.nan
    values[8, 20:] = np.nan
    rows = np.arange(30) >= 10
    found, count = rev.frame_offsets(values, expected, rows)
    seen = np.arange(12) != 7
    # Means of 10 to 20 values of 1 um: 0.3 um.
    assert found[seen] == pytest.approx(offset[seen], abs=4 * 0.001 / np.sqrt(10))
    assert np.isnan(found[7])
    assert count[[0, 4, 7, 8]].tolist() == [20, 19, 0, 10]


def test_frame_offsets_with_weights_are_weighted_means():
    values = np.array([[1.0, 2.0, 4.0, 9.0]])
    rows = np.array([True, True, True, False])
    weighted, _ = rev.frame_offsets(values, np.zeros(4), rows, weights=np.array([1.0, 2.0, 1.0, 100.0]))
    assert weighted == pytest.approx([(1 + 4 + 4) / 4])


@pytest.mark.parametrize(
    ("frames", "length", "order", "runout_mm"),
    [
        (480, 1.0, 1, 2.0),
        (480, 3.0, 1, 2.0),
        (512, 3.0, 1, 0.5),
        (250, 3.0, 1, 0.2),
        (120, 3.0, 5, 0.012),
        (100, 3.0, 1, 0.03),
    ],
)
def test_the_noise_of_rows_is_found_beside_a_run_out_along_the_same_line(frames, length, order, runout_mm):
    """Noise along a known line of sight, correlated over the rows, and run-out along it; whatever the frames divide into."""
    random, rows, sigma = np.random.default_rng(3), 300, 0.02
    angle = np.radians(np.linspace(20, 140, rows))
    kernel = np.exp(-(np.linspace(-3, 3, 13) ** 2)) if length > 1 else np.ones(1)
    kernel /= np.sqrt((kernel**2).sum())
    white = random.standard_normal((frames, rows + len(kernel) - 1))
    noise = sigma * np.stack([np.convolve(line, kernel, "valid") for line in white])
    along = noise + runout_mm * np.sin(order * 2 * np.pi * np.arange(frames) / frames)[:, None]
    lateral = np.arange(rows) * 0.2 + along * np.cos(angle)
    mean = rev.mean_meridian(lateral, 460 + along * np.sin(angle), np.ones(frames, bool))
    found = mean.row_noise()
    size = np.linalg.norm(found.vectors_mm, axis=1)
    assert np.median(size) == pytest.approx(sigma / np.sqrt(frames), rel=0.06)
    across = found.vectors_mm[:, 0] * np.sin(angle) - found.vectors_mm[:, 1] * np.cos(angle)
    assert np.abs(across).max() < 0.02 * np.median(size)
    true = (np.convolve(kernel, kernel) / (kernel**2).sum()).sum()
    assert found.length_rows == pytest.approx(true, rel=0.15)


def test_views_share_the_frames_that_all_of_them_saw():
    full = np.zeros((60, 20))
    gap, sparse = full.copy(), full.copy()
    gap[10:25] = np.nan
    sparse[:, 4:] = np.nan  # a view of few rows saw all frames all the same
    sparse[40] = np.nan
    expected = np.ones(60, bool)
    expected[10:25] = expected[40] = False
    assert np.array_equal(rev.common_frames([full, gap, sparse]), expected)
    lone = full.copy()
    lone[5:] = np.nan
    assert rev.common_frames([full, lone]).all(), "five frames are no turn: each view keeps its own"
    assert rev.common_frames([full, full * np.nan]).all()


@pytest.mark.parametrize("frames", [8, 12, 24])
def test_the_jackknife_of_few_frames_leaves_out_single_ones(frames):
    """Two groups of frames would know their own scatter to one degree of freedom."""
    pulls = []
    for seed in range(400):
        random = np.random.default_rng(seed)
        radial = 460 + 0.01 * random.standard_normal((frames, 3))
        found = rev.mean_meridian(np.zeros_like(radial), radial, np.ones(frames, bool))
        left = found.left_out_radial_mm
        assert len(left) == frames
        u = np.sqrt((frames - 1) / frames * ((left - left.mean(axis=0)) ** 2).sum(axis=0))
        pulls.append(((found.radial_mm - 460) / u)[0])
    # Student's t of frames - 1 degrees of freedom: variance (n - 1) / (n - 3); clipping takes a little of the scatter.
    assert np.mean(np.square(pulls)) == pytest.approx((frames - 1) / (frames - 3), rel=0.35)


def test_rows_that_were_not_seen_have_no_noise_and_others_keep_their_order():
    random = np.random.default_rng(4)
    lateral = np.arange(50) + 0.01 * random.standard_normal((60, 50))
    lateral[:, 10:20] = np.nan
    mean = rev.mean_meridian(lateral, 460 + 0 * lateral, np.ones(60, bool))
    found = mean.row_noise()
    assert found.vectors_mm.shape == (40, 2)
    assert np.isfinite(found.vectors_mm).all()
    nothing = rev.mean_meridian(np.full((60, 5), np.nan), np.full((60, 5), np.nan), np.ones(60, bool)).row_noise()
    assert nothing.vectors_mm.shape == (0, 2)
