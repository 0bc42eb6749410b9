"""Series over the frames: the noise that rows show of a frame, turns that scatter by more, sensors that missed a part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from test_reading import SETTINGS, by_name, hidden, wheel

from wheelset_assets.metrology.frame_series import frame_series
from wheelset_assets.metrology.reading import Meridians, uneven
from wheelset_assets.metrology.revolution import MeridianGrid
from wheelset_assets.metrology.roundness import Spectrum, peak_to_peak
from wheelset_assets.metrology.wheel_reading import read_wheel
from wheelset_assets.quality import Flag

FACE = {"face_lateral", "axial_runout"}


def part(random, *, frames=64, rows=90, sigma=0.02, correlation=0.5, tilt=0.0):
    """Grid of a straight part (frames, rows) with noise that rows share, and a tilt that turns with the wheelset."""
    noise = lfilter(
        [np.sqrt(1 - correlation**2)], [1, -correlation], random.standard_normal((frames, rows + 40)), axis=1
    )
    turn = np.sin(2 * np.pi * np.arange(frames) / frames)[:, None]
    lateral = sigma * noise[:, 40:] + tilt * turn * np.linspace(-1, 1, rows)
    radial = 400.0 + np.broadcast_to(np.linspace(0, 20, rows), lateral.shape)
    return MeridianGrid("s", 0, lateral, radial, 90.0, np.full(lateral.shape, sigma))


def series(grids, angle_deg):
    meridians = Meridians(grids, np.ones(len(angle_deg), bool))
    mask = np.ones(len(meridians.lateral), bool)
    return frame_series(meridians, mask, "lateral_mm", [m.lateral_mm for m in meridians.means], angle_deg)


@pytest.mark.parametrize(("rows", "tilt"), [(30, 0.0), (90, 0.0), (400, 0.0), (90, 0.05), (400, 0.05)])
def test_rows_tell_the_noise_of_a_frame_without_the_other_frames(rows, tilt):
    """Two blocks, of thirty rows, could not tell a tilt from noise; four can."""
    ratios = []
    for seed in range(20):
        found = series([part(np.random.default_rng(seed), rows=rows, tilt=tilt)], np.arange(64) * 5.6)
        assert found.freedom > 40
        ratios.append(np.std(found.value_mm, ddof=1) / found.noise_mm)
    assert 0.85 < np.sqrt(np.mean(np.square(ratios))) < 1.15


def test_what_a_frame_shares_is_no_noise():
    grid = part(np.random.default_rng(3))
    moved = replace(grid, lateral_mm=grid.lateral_mm + np.random.default_rng(4).normal(0, 1.0, (64, 1)))
    noise = [series([g], np.arange(64) * 5.6).noise_mm for g in (grid, moved)]
    assert noise[1] == pytest.approx(noise[0], rel=0.1)


def test_few_rows_tell_no_noise():
    found = series([part(np.random.default_rng(5), rows=20)], np.arange(64) * 5.6)
    assert found.freedom == 0
    assert np.isnan(found.noise_mm)
    assert uneven(1.0, 50, found, SETTINGS) is Flag.NONE


def test_noise_alone_does_not_make_a_turn_uneven():
    for seed in range(100):
        found = series([part(np.random.default_rng(seed))], np.arange(64) * 5.6)
        assert uneven(float(np.std(found.value_mm, ddof=1)), 63, found, SETTINGS) is Flag.NONE


def test_texture_below_the_floor_does_not_either():
    found = series([part(np.random.default_rng(6), sigma=0.0005)], np.arange(64) * 5.6)
    assert uneven(0.0035, 63, found, SETTINGS) is Flag.NONE
    assert uneven(0.0045, 63, found, SETTINGS) is Flag.UNEVEN_TURN


def test_frames_out_of_order_flag_what_turns_and_nothing_else():
    random = np.random.default_rng(7)
    angle, grids = wheel(random)
    assert not any(r.flags & Flag.UNEVEN_TURN for r in read_wheel(grids, angle, "right", SETTINGS).readings)
    order = random.permutation(len(angle))
    mixed = [
        replace(g, lateral_mm=g.lateral_mm[order], radial_mm=g.radial_mm[order], u_mm=g.u_mm[order]) for g in grids
    ]
    found = by_name(read_wheel(mixed, angle, "right", SETTINGS))
    for name in (*FACE, "wheel_diameter", "radial_runout"):
        assert found[name].flags & Flag.UNEVEN_TURN


def test_wrong_angles_flag_the_turn():
    angle, grids = wheel(np.random.default_rng(8))
    found = by_name(read_wheel(grids, 9.7 * angle, "right", SETTINGS))
    assert all(found[name].flags & Flag.UNEVEN_TURN for name in (*FACE, "wheel_diameter"))


def test_a_sensor_that_missed_a_part_of_the_turn_is_told_where_it_counts():
    """The outer sensor saw a quarter of the turn: the tread and the profile rest on it, the inner face does not."""
    angle, (inner, outer) = wheel(np.random.default_rng(9))
    late = np.broadcast_to(np.arange(96)[:, None] >= 24, outer.lateral_mm.shape)
    found = by_name(read_wheel([inner, hidden(outer, late)], angle, "right", SETTINGS))
    gaps = {name for name, reading in found.items() if reading.flags & Flag.COVERAGE_GAP and not reading.reason}
    assert {"wheel_diameter", "tread_hollow", "flange_height"} <= gaps
    assert not FACE & gaps


def test_a_single_frame_that_was_missed_is_no_gap_of_the_turn():
    angle, (inner, outer) = wheel(np.random.default_rng(10))
    one = np.broadcast_to(np.arange(96)[:, None] == 40, outer.lateral_mm.shape)
    found = by_name(read_wheel([inner, hidden(outer, one)], angle, "right", SETTINGS))
    assert found["flange_height"].flags & Flag.FRAMES_MISSING
    assert not found["flange_height"].flags & Flag.COVERAGE_GAP


def test_a_range_that_does_not_stand_out_of_the_noise_says_so():
    random = np.random.default_rng(11)
    angle, grids = wheel(random)
    found = by_name(read_wheel(grids, angle, "right", SETTINGS))
    assert found["axial_runout"].value > 0
    assert not found["axial_runout"].flags & Flag.NOT_DETECTED
    round_wheel = [
        replace(
            g, lateral_mm=g.lateral_mm - np.nanmean(g.lateral_mm - np.nanmean(g.lateral_mm, axis=0), axis=1)[:, None]
        )
        for g in grids
    ]
    still = by_name(read_wheel(round_wheel, angle, "right", SETTINGS))["axial_runout"]
    assert (still.value > 0) != bool(still.flags & Flag.NOT_DETECTED)
    assert peak_to_peak(Spectrum(0.0, 1.0, np.zeros(6), np.zeros(6), np.eye(13), 1.0, 96)).flags is Flag.NOT_DETECTED
