"""Readings of a turn against truth: wheels and journals as grids whose every length, run-out and defect is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from nominal_profiles import by_arc_length, s1002
from scipy.signal import lfilter
from two_sided import assert_pulls, assert_unbiased

from wheelset_assets.metrology.journal_reading import JOURNAL_READINGS, read_journal
from wheelset_assets.metrology.profile import ProfileDefinition
from wheelset_assets.metrology.reading import DatumSettings, TurnSettings
from wheelset_assets.metrology.revolution import MeridianGrid
from wheelset_assets.metrology.wheel_reading import WHEEL_READINGS, read_wheel
from wheelset_assets.quality import Flag

SETTINGS = TurnSettings(
    ProfileDefinition(70.0, 10.0, 2.0, 10.0),
    DatumSettings(3.0, 1.0, 4.0, 3.0, 8.0, 4.0, 0.5),
    runout_order=6,
    min_coverage=0.6,
    max_gap_deg=100.0,
    min_frames=8,
    exclude_sigmas=4.0,
    outlier_flag_ratio=0.1,
    journal_sections_mm=(15.0, 65.0),
)
RADIUS, PLACE = 460.3, 676.5
RADIAL, AXIAL = ((0.04, 0.3), (0.02, 1.0), (0.008, 2.0)), ((0.025, 0.5), (0.01, 2.5))
FACE = np.column_stack([np.full(120, -70.0), np.linspace(-25.0, 9.4, 120)])
INNER = np.concatenate([FACE, by_arc_length(s1002, -69.9, 10.0, 0.25)])
OUTER = by_arc_length(s1002, -32.0, 58.0, 0.25)


def harmonics(angle_deg, terms):
    """Sum of amplitude cos(n angle + phase) for n = 1, 2, ..., at angles (n,)."""
    theta = np.radians(angle_deg)
    return sum((a * np.cos(n * theta + p) for n, (a, p) in enumerate(terms, 1)), np.zeros_like(theta))


def peak_to_peak(terms):
    return float(np.ptp(harmonics(np.arange(0, 360, 0.05), terms)))


def angles(random, n=96):
    return np.arange(n) * 360.0 / n + random.uniform(0, 360)


def seen(points, radial, axial, random, *, sigma=0.01, correlation=0.5, outward=1.0, name="s"):
    """Grid (frames, rows) of a profile (rows, 2) that runs out; noise along a line of sight, correlated along the rows."""
    shape = (len(radial), len(points) + 40)
    noise = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], random.standard_normal(shape), axis=1)[:, 40:]
    lateral = points[:, 0] + axial[:, None] + 0.4 * sigma * noise
    distance = points[:, 1] + radial[:, None] + np.sqrt(1 - 0.16) * sigma * noise
    return MeridianGrid(name, 0, outward * lateral, distance, 90.0, np.full(lateral.shape, sigma))


def wheel(random, *, outward=1.0, parts=(INNER, OUTER), sigma=0.01, frames=96):
    """Angles and the grids of two sensors that see one wheel."""
    angle = angles(random, frames)
    radial, axial = harmonics(angle, RADIAL), harmonics(angle, AXIAL)
    place = np.array([70.0 + PLACE, RADIUS])
    return angle, [seen(p + place, radial, axial, random, sigma=sigma, outward=outward) for p in parts]


def hidden(grid, where):
    """The same grid without the points where a mask (frames, rows) is true."""
    cut = lambda v: np.where(where, np.nan, v)  # noqa: E731
    return MeridianGrid(grid.sensor_id, grid.line, cut(grid.lateral_mm), cut(grid.radial_mm), 90.0, cut(grid.u_mm))


def by_name(found):
    return {r.quantity: r for r in found.readings}


WHEEL_TRUTH = {
    "wheel_diameter": 2 * RADIUS,
    "face_lateral": PLACE,
    "flange_height": 28.000,
    "flange_thickness": 32.500,
    "qr": 10.794,
    "radial_runout": peak_to_peak(RADIAL),
    "axial_runout": peak_to_peak(AXIAL),
}

# --- wheels


def test_wheel_readings_two_sided():
    """Forty turns of 96 frames: every quantity's pulls in their interval, each by itself, none biased."""
    pulls = {name: [] for name in WHEEL_TRUTH}
    for seed in range(40):
        random = np.random.default_rng(seed)
        angle, grids = wheel(random)
        found = by_name(read_wheel(grids, angle, "right", SETTINGS))
        assert set(found) == set(WHEEL_READINGS)
        for name, truth in WHEEL_TRUTH.items():
            assert found[name].reason is None
            pulls[name].append((found[name].value - truth) / found[name].u_noise)
    for name, values in pulls.items():
        # A jackknife over 24 groups knows its own u to 15 %: Student's t, variance 23 / 21.
        assert_pulls(values, underclaim=np.sqrt(23 / 21))
        if name not in ("qr", "flange_thickness"):  # off by 0.4 and 0.14 um, a fifth of u here: see the exact profiles
            assert_unbiased(np.array(values) / np.sqrt(np.mean(np.square(values))))


def test_uncertainties_shrink_with_the_number_of_frames():
    u = {}
    for frames in (48, 192):
        angle, grids = wheel(np.random.default_rng(50), frames=frames)
        u[frames] = by_name(read_wheel(grids, angle, "right", SETTINGS))
    for name in WHEEL_TRUTH:
        assert u[48][name].u_noise / u[192][name].u_noise == pytest.approx(2.0, rel=0.6)


def test_the_left_wheel_is_the_mirror_image_of_the_right():
    found = {}
    for side, outward in (("right", 1.0), ("left", -1.0)):
        angle, grids = wheel(np.random.default_rng(51), outward=outward)
        found[side] = by_name(read_wheel(grids, angle, side, SETTINGS))
    for name in WHEEL_TRUTH:
        sign = -1.0 if name == "face_lateral" else 1.0
        assert found["left"][name].value == pytest.approx(sign * found["right"][name].value, abs=1e-6)
        assert found["left"][name].side == "left"


def test_series_over_the_turn_follow_the_run_out():
    angle, grids = wheel(np.random.default_rng(52))
    turns = {t.series: t for t in read_wheel(grids, angle, "right", SETTINGS).turns}
    assert set(turns) == {"face_lateral", "tread_radius"}
    face = PLACE + harmonics(angle, AXIAL)
    tread = RADIUS + harmonics(angle, RADIAL)
    for name, truth in (("face_lateral", face), ("tread_radius", tread)):
        # A frame's value is a mean of over a hundred correlated points of 10 um.
        assert np.abs(turns[name].value_mm - truth).max() < 0.01
        assert np.abs(turns[name].fitted_mm - truth).max() < 0.003
        assert turns[name].used.mean() > 0.97


def test_a_radius_is_measured_from_the_face_of_the_same_meridian():
    """Axial run-out on a tread of 1:20 is no radial run-out: 0.5 mm of it would be 25 um."""
    random = np.random.default_rng(53)
    angle = angles(random)
    axial = harmonics(angle, ((0.25, 0.0),))
    place = np.array([70.0 + PLACE, RADIUS])
    grids = [seen(p + place, np.zeros(96), axial, random) for p in (INNER, OUTER)]
    found = by_name(read_wheel(grids, angle, "right", SETTINGS))
    assert found["radial_runout"].value < 0.004
    assert found["axial_runout"].value == pytest.approx(0.5, abs=0.004)
    assert found["wheel_diameter"].value == pytest.approx(2 * RADIUS, abs=5 * found["wheel_diameter"].u_noise)


def test_dirt_on_the_tread_is_left_out_everywhere():
    """0.15 mm over 18 degrees: neither diameter nor flange height move, and the share left out is said."""
    pulls = []
    for seed in range(20):
        angle, grids = wheel(np.random.default_rng(100 + seed))
        dirty = np.mod(angle - 30, 360) < 18
        for grid, part in zip(grids, (INNER, OUTER), strict=True):
            on_tread = part[:, 0] > -25
            grid.radial_mm[np.ix_(dirty, on_tread)] += 0.15
        found = read_wheel(grids, angle, "right", SETTINGS)
        values = by_name(found)
        used = next(t for t in found.turns if t.series == "tread_radius").used
        assert not used[dirty].any()
        diameter = values["wheel_diameter"]
        beside = (~used[~dirty]).sum()  # one frame at either end of the dirt, and by chance one that is off
        assert 2 <= beside <= 5
        assert diameter.excluded_ratio == pytest.approx(dirty.mean() + beside / len(angle))
        assert diameter.flags & Flag.OUTLIERS == Flag.NONE  # 5 % and its ends: under the share that is flagged
        pulls.append(
            [(values[n].value - WHEEL_TRUTH[n]) / values[n].u_noise for n in ("wheel_diameter", "flange_height")]
        )
    for column in np.array(pulls).T:
        assert_pulls(column, underclaim=np.sqrt(23 / 21))


def test_much_dirt_is_flagged():
    angle, grids = wheel(np.random.default_rng(54))
    dirty = np.mod(angle - 30, 360) < 50
    for grid, part in zip(grids, (INNER, OUTER), strict=True):
        grid.radial_mm[np.ix_(dirty, part[:, 0] > -25)] += 0.15
    diameter = by_name(read_wheel(grids, angle, "right", SETTINGS))["wheel_diameter"]
    assert diameter.flags & Flag.OUTLIERS
    assert diameter.value == pytest.approx(2 * RADIUS, abs=5 * diameter.u_noise)


def test_without_the_inner_face_nothing_is_read():
    angle, grids = wheel(np.random.default_rng(55), parts=(by_arc_length(s1002, -66.0, 10.0, 0.25), OUTER))
    found = by_name(read_wheel(grids, angle, "right", SETTINGS))
    assert set(found) == set(WHEEL_READINGS)
    assert {r.reason for r in found.values()} == {"the inner face was not seen"}
    assert all(np.isnan(r.value) for r in found.values())


def test_without_the_datum_circle_the_face_alone_is_read():
    angle, grids = wheel(np.random.default_rng(56))
    parts = (INNER, OUTER)
    grids = [
        hidden(g, np.broadcast_to(np.abs(p[:, 0]) < 7, g.radial_mm.shape)) for g, p in zip(grids, parts, strict=True)
    ]
    found = by_name(read_wheel(grids, angle, "right", SETTINGS))
    for name in ("wheel_diameter", "radial_runout", "flange_height", "flange_thickness", "qr"):
        assert "70 mm" in found[name].reason
    for name in ("face_lateral", "axial_runout"):
        assert found[name].reason is None
        assert found[name].value == pytest.approx(WHEEL_TRUTH[name], abs=5 * found[name].u_noise)


def test_a_hidden_flank_costs_its_own_quantities_only():
    angle, grids = wheel(np.random.default_rng(57))
    flank = (INNER[:, 0] > -47) & (INNER[:, 0] < -33) & (INNER[:, 1] < 26)
    grids[0] = hidden(grids[0], np.broadcast_to(flank, grids[0].radial_mm.shape))
    found = by_name(read_wheel(grids, angle, "right", SETTINGS))
    for name in ("flange_thickness", "qr"):
        assert "flank" in found[name].reason
    for name in ("wheel_diameter", "flange_height"):
        assert found[name].value == pytest.approx(WHEEL_TRUTH[name], abs=5 * found[name].u_noise)


@pytest.mark.parametrize(("gap_deg", "refused"), [(60.0, False), (120.0, True)])
def test_a_gap_of_the_turn_widens_the_uncertainty_or_refuses(gap_deg, refused):
    random = np.random.default_rng(58)
    angle, grids = wheel(random)
    gone = np.mod(angle - 10, 360) < gap_deg
    grids = [hidden(g, np.broadcast_to(gone[:, None], g.radial_mm.shape)) for g in grids]
    found = by_name(read_wheel(grids, angle, "right", SETTINGS))
    for name, truth in WHEEL_TRUTH.items():
        if refused:
            assert "gap of 12" in found[name].reason
            assert np.isnan(found[name].value)
        elif name == "radial_runout":
            assert found[name].reason == "the frames tell harmonics to order 4 only, 6 are needed"
        else:
            assert found[name].flags & Flag.COVERAGE_GAP
            assert found[name].flags & Flag.FRAMES_MISSING
            assert found[name].coverage_ratio == pytest.approx(1 - gap_deg / 360, abs=0.03)
            assert found[name].value == pytest.approx(truth, abs=5 * found[name].u_noise + 5e-4)


def test_a_complete_turn_has_no_flags():
    angle, grids = wheel(np.random.default_rng(59))
    for reading in read_wheel(grids, angle, "right", SETTINGS).readings:
        assert reading.flags == (Flag.NOT_DETECTED if reading.quantity.startswith("flat") else Flag.NONE)


@pytest.mark.parametrize("turns", [1.0, 2.0, 2.1, 3.0])
def test_more_than_one_revolution_is_no_gap_and_hides_no_flat(turns):
    """As many arcs lie between frames of nearly the same angle as between those of one turn; the encoder's noise parts them."""
    random, depth = np.random.default_rng(6), 0.3
    n = round(96 * turns)
    angle = np.sort(17.0 + np.arange(n) * 360.0 / 96 + random.normal(0, 0.003, n))
    radial, axial = harmonics(angle, RADIAL), harmonics(angle, AXIAL)
    along = np.radians(np.mod(angle - 123.3 + 180.0, 360.0) - 180.0) * RADIUS
    flat = np.minimum(along**2 / (2 * RADIUS) - depth, 0.0)
    place = np.array([70.0 + PLACE, RADIUS])
    for extra, truth in ((0.0, 0.0), (flat, depth)):
        found = by_name(
            read_wheel(
                [seen(p + place, radial + extra, axial, random) for p in (INNER, OUTER)], angle, "right", SETTINGS
            )
        )
        assert found["flat_depth"].value == pytest.approx(truth, abs=max(4 * found["flat_depth"].u_noise, 0.004))
        assert found["wheel_diameter"].reason is None
        assert found["wheel_diameter"].coverage_ratio > 0.95
        assert abs(found["wheel_diameter"].value - 2 * RADIUS) < 4 * found["wheel_diameter"].u_noise


def test_a_part_of_the_turn_that_one_sensor_misses_shifts_nothing_between_the_sensors():
    """The crest of a large run-out was seen by one of two sensors: their means must be of the same frames."""
    pulls = []
    for seed in range(8):
        random = np.random.default_rng(seed)
        angle = angles(random)
        radial = harmonics(angle, ((0.1, 0.3),))
        place = np.array([70.0 + PLACE, RADIUS])
        inner, outer = (seen(p + place, radial, 0 * angle, random) for p in (INNER, OUTER))
        crest = np.degrees(-0.3)
        gone = np.abs(np.mod(angle - crest + 180.0, 360.0) - 180.0) < 40.0
        where = np.broadcast_to(gone[:, None], outer.lateral_mm.shape)
        found = by_name(read_wheel([inner, hidden(outer, where)], angle, "right", SETTINGS))
        for name in ("flange_height", "flange_thickness"):
            assert Flag.COVERAGE_GAP in found[name].flags
            pulls.append((found[name].value - WHEEL_TRUTH[name]) / found[name].u_noise)
    assert_pulls(pulls, underclaim=np.sqrt(23 / 21))


@pytest.mark.parametrize("directions", [(179.9, 179.7), (179.9, -179.9)])
def test_body_angles_of_a_station_whose_sensors_look_from_either_side_of_180_degrees(directions):
    """The flat lies where it lies, whichever name the sensors' directions have."""
    random = np.random.default_rng(3)
    angle, grids = wheel(random)
    turned = [replace(g, direction_deg=d) for g, d in zip(grids, directions, strict=True)]
    phase = lambda found: np.arctan2(found.sine[0], found.cosine[0])  # noqa: E731
    one = read_wheel(turned, angle, "right", SETTINGS).spectra["tread_radius"]
    other = read_wheel([replace(g, direction_deg=180.0) for g in grids], angle, "right", SETTINGS).spectra[
        "tread_radius"
    ]
    assert np.degrees(phase(one) - phase(other)) == pytest.approx(0.0, abs=0.2)


def test_few_frames_are_refused_with_their_number():
    angle, grids = wheel(np.random.default_rng(60), frames=7)
    reasons = {r.reason for r in read_wheel(grids, angle, "right", SETTINGS).readings}
    assert all(reason is not None and "frames see it" in reason for reason in reasons)


def test_one_sensor_is_enough_where_it_sees_what_is_needed():
    angle, grids = wheel(np.random.default_rng(61), parts=(INNER[:, :],))
    found = by_name(read_wheel(grids, angle, "right", SETTINGS))
    # It ends 10 mm beyond the datum circle, so the tread's band is there in full.
    for name, truth in WHEEL_TRUTH.items():
        assert found[name].value == pytest.approx(truth, abs=5 * found[name].u_noise + 1e-3)


# --- journals

SHOULDER, JOURNAL_RADIUS, OVAL = 1090.0, 65.1, 0.003
FILLET = np.radians(np.linspace(180, 270, 20))
JOURNAL = np.concatenate([
    np.column_stack([np.linspace(-30, -0.5, 120), np.full(120, 18.0)]),
    np.column_stack([np.zeros(70), np.linspace(17.5, 2.5, 70)]),
    2.5 + 2.5 * np.column_stack([np.cos(FILLET), np.sin(FILLET)]),
    np.column_stack([np.linspace(2.6, 80, 320), np.zeros(320)]),
])  # fmt: skip


def journal(random, *, points=JOURNAL, taper_per_mm=0.0, outward=1.0, frames=96, sigma=0.008):
    angle = angles(random, frames)
    radial = OVAL * np.cos(2 * np.radians(angle) + 0.7)
    sloped = points + np.column_stack([np.zeros(len(points)), taper_per_mm * np.maximum(points[:, 0], 0)])
    place = np.array([SHOULDER, JOURNAL_RADIUS])
    return angle, [seen(sloped + place, radial, np.zeros(frames), random, sigma=sigma, outward=outward)]


@pytest.mark.parametrize(("side", "outward"), [("right", 1.0), ("left", -1.0)])
def test_journal_readings_two_sided(side, outward):
    """Forty turns: diameter, place of the shoulder, ovality (twice 2 A, since r and its opposite add) and taper."""
    truth = {
        "journal_diameter": 2 * JOURNAL_RADIUS,
        "shoulder_lateral": outward * SHOULDER,
        "journal_ovality": 4 * OVAL,
        "journal_taper": 0.0,
    }
    pulls = {name: [] for name in truth}
    for seed in range(40):
        angle, grids = journal(np.random.default_rng(seed), outward=outward)
        found = by_name(read_journal(grids, angle, side, SETTINGS))
        assert set(found) == set(JOURNAL_READINGS)
        for name in truth:
            assert found[name].reason is None
            pulls[name].append((found[name].value - truth[name]) / found[name].u_noise)
    for name in ("journal_diameter", "shoulder_lateral", "journal_taper"):
        assert_pulls(pulls[name], underclaim=np.sqrt(23 / 21))
        assert_unbiased(np.array(pulls[name]) / np.sqrt(np.mean(np.square(pulls[name]))))
    assert_pulls(pulls["journal_ovality"], overclaim=1.3)  # a bound: the noise of every even order counts


def test_taper_is_the_difference_of_the_sections():
    """A slope of 0.1 um/mm on the radius, between sections 50 mm apart."""
    angle, grids = journal(np.random.default_rng(70), taper_per_mm=1e-4, sigma=0.002)
    found = by_name(read_journal(grids, angle, "right", SETTINGS))["journal_taper"]
    assert found.value == pytest.approx(2 * 1e-4 * 50.0, abs=4 * found.u_noise)


def test_a_journal_without_shoulder_or_without_cylinder_says_so():
    cylinder = JOURNAL[(JOURNAL[:, 0] > 2.6) & (JOURNAL[:, 1] < 1)]
    angle, grids = journal(np.random.default_rng(71), points=cylinder)
    found = by_name(read_journal(grids, angle, "right", SETTINGS))
    assert found["shoulder_lateral"].reason == "the shoulder's face was not seen"
    assert found["journal_diameter"].value == pytest.approx(
        2 * JOURNAL_RADIUS, abs=5 * found["journal_diameter"].u_noise
    )
    face = JOURNAL[(np.abs(JOURNAL[:, 0]) < 0.01) & (JOURNAL[:, 1] > 2)]
    angle, grids = journal(np.random.default_rng(72), points=face)
    found = by_name(read_journal(grids, angle, "right", SETTINGS))
    for name in ("journal_diameter", "journal_ovality", "journal_taper"):
        assert found[name].reason == "the journal's cylinder was not seen"
    assert found["shoulder_lateral"].value == pytest.approx(SHOULDER, abs=5 * found["shoulder_lateral"].u_noise)


def test_a_gap_of_the_turn_refuses_a_journal():
    angle, grids = journal(np.random.default_rng(73))
    gone = np.mod(angle, 360) < 130
    found = by_name(
        read_journal(
            [hidden(grids[0], np.broadcast_to(gone[:, None], grids[0].radial_mm.shape))], angle, "right", SETTINGS
        )
    )
    assert set(found) == set(JOURNAL_READINGS)
    assert all("gap of 13" in r.reason for r in found.values())


def test_a_dent_in_the_journal_is_left_out():
    angle, grids = journal(np.random.default_rng(74))
    dent = np.mod(angle - 100, 360) < 15
    grids[0].radial_mm[np.ix_(dent, JOURNAL[:, 0] > 2)] -= 0.08
    found = by_name(read_journal(grids, angle, "right", SETTINGS))["journal_diameter"]
    assert found.value == pytest.approx(2 * JOURNAL_RADIUS, abs=5 * found.u_noise)
    assert found.excluded_ratio == pytest.approx(dent.mean(), abs=0.03)


def test_too_few_frames_for_a_second_harmonic_give_no_roundness():
    """Twelve frames carry one harmonic: out-of-roundness is not zero then, it is unknown."""
    angle, grids = journal(np.random.default_rng(64), frames=12)
    found = by_name(read_journal(grids, angle, "right", SETTINGS))
    for name in ("journal_ovality", "journal_roundness"):
        assert np.isnan(found[name].value)
        assert found[name].reason == "the frames tell harmonics to order 1 only, 2 are needed"
    assert np.isfinite(found["journal_diameter"].value)
