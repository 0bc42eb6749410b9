"""How values follow their sensors: against sensors that are really moved, and calibrations that are really drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from nominal_profiles import by_arc_length, s1002
from test_reading import FACE, PLACE, RADIUS, SETTINGS
from two_sided import assert_pulls

from wheelset_assets.metrology import registration as reg
from wheelset_assets.metrology import rigid
from wheelset_assets.metrology import triangulation as tri
from wheelset_assets.metrology.calibration import BoardPose, calibrate_stereo
from wheelset_assets.metrology.levers import CalibrationField, station_steps
from wheelset_assets.metrology.point_uncertainty import moved
from wheelset_assets.metrology.profile import profile_values
from wheelset_assets.metrology.reading import Meridians, mean_at
from wheelset_assets.metrology.revolution import MeridianGrid
from wheelset_assets.simulation.boards import board_of, board_poses, project_corners
from wheelset_assets.simulation.rig import build_rig

MIRROR = np.array([-1.0, 1.0])
"""The wheel of these tests stands on the right, in front of a rig's left sensors it is mirrored."""
NAMES = ("flange_height_mm", "flange_thickness_mm", "qr_mm")
INNER = np.concatenate([FACE, by_arc_length(s1002, -69.9, 10.0, 0.15)])
OUTER = by_arc_length(s1002, -38.0, 50.0, 0.15)
ICP = reg.IcpSettings(
    prior_translation_mm=2.8, prior_rotation_rad=np.radians(1.4), max_iterations=60, convergence_mm=1e-6,
    max_pair_mm=6.0, min_pairs=30, form_floor_mm=1e-3, constrained_ratio=0.1,
)  # fmt: skip


def meridians(*profiles) -> Meridians:
    """Two sensors' turns of four frames that see one right wheel; what noise there is averages out."""
    grids = []
    for k, points in enumerate(profiles):
        a = np.tile(points[:, 0], (4, 1))
        r = points[:, 1] + 1e-4 * np.array([[1.0], [-1.0], [1.0], [-1.0]])
        grids.append(MeridianGrid(f"s{k}", 0, a, r, 90.0, np.full(a.shape, 0.01)))
    return Meridians(grids, np.ones(4, bool))


def placed(points):
    return points + np.array([70.0 + PLACE, RADIUS])


def faces(m):
    """Rows of the inner face, which come first."""
    return np.arange(len(m.owner)) < len(FACE)


def reader(m, face):
    def values(a, r):
        s = a - mean_at(a, m.weight, face)
        found = profile_values(s, r, m.weight, SETTINGS.definition)
        return np.array([getattr(found, name) for name in NAMES])

    return values


def read(*profiles):
    m = meridians(*profiles)
    return reader(m, faces(m))(m.lateral, m.radial)


def turned(points, angle, middle):
    c, s = np.cos(angle), np.sin(angle)
    return (points - middle) @ np.array([[c, s], [-s, c]]) + middle


def test_a_second_sensor_that_is_moved_changes_the_values_as_its_levers_say():
    inner, outer = placed(INNER), placed(OUTER)
    m = meridians(inner, outer)
    face = faces(m)
    found = station_steps(m, face, {}).levers(reader(m, face))
    base, middle = read(inner, outer), outer.mean(axis=0)
    steps = [outer + np.array([0.03, 0]), outer + np.array([0, 0.03]), turned(outer, 3e-4, middle)]
    for k, (step, size) in enumerate(zip(steps, (0.03, 0.03, 3e-4), strict=True)):
        changed = (read(inner, step) - base) / size
        told = np.array([lever.views["s1", 0][k] for lever in found])
        assert told == pytest.approx(changed, abs=0.02 * max(1.0, float(np.abs(changed).max())))
    # What each rests on: the height on the radial step alone, the thickness on the lateral one.
    height, thickness, _ = (np.array(lever.views["s1", 0]) for lever in found)
    assert abs(height[0]) < 0.1 < 0.5 < abs(height[1])
    assert abs(thickness[0]) > 0.3
    assert all(lever.u_calibration_mm is None for lever in found)


def test_a_station_that_is_tilted_changes_the_values_as_its_levers_say():
    inner, outer = placed(INNER), placed(OUTER)
    m = meridians(inner, outer)
    face = faces(m)
    found, base = station_steps(m, face, {}).levers(reader(m, face)), read(inner, outer)
    middle = m.points.mean(axis=0)
    tilted = read(turned(inner, 2e-4, middle), turned(outer, 2e-4, middle)) - base
    assert np.array([lever.tilt_mm for lever in found]) == pytest.approx(tilted / 2e-4, rel=0.03, abs=1.0)
    assert abs(found[0].tilt_mm) == pytest.approx(55.0, abs=3.0)  # from the flange's top to the datum circle


def put_together(inner, outer):
    """Two views, the outer one registered to the inner one, and both turned until the inner face is upright."""
    motion = reg.register_meridians(outer, inner, 90.0, np.eye(4), ICP).motion
    after = rigid.apply(motion, np.column_stack([outer[:, 0], np.zeros(len(outer)), outer[:, 1]]))
    outer = np.column_stack([after[:, 0], np.hypot(after[:, 1], after[:, 2])])
    upright = inner[: len(FACE)]
    tilt, middle = np.polyfit(upright[:, 1], upright[:, 0], 1)[0], upright.mean(axis=0)
    return turned(inner, tilt, middle), turned(outer, tilt, middle)


@pytest.mark.parametrize("view", [0, 1])
@pytest.mark.parametrize("component", [0, 1, 2], ids=["along", "away", "shear"])
def test_a_view_that_is_strained_changes_the_values_as_its_levers_say(view, component):
    """One view strained, then registered and squared for real.

    The first one, which shows the flange whole, takes its values along; the second one's registration takes nearly all of
    its own strain off the rows that both see.
    """
    clouds = [placed(INNER), placed(OUTER)]
    m = meridians(*clouds)
    face = faces(m)
    found, base = station_steps(m, face, {}).levers(reader(m, face)), read(*clouds)
    a, r = (clouds[view] - clouds[view].mean(axis=0)).T
    field = [(a, 0 * a), (0 * a, r), (0 * a, a)][component]
    clouds[view] = clouds[view] + 3e-4 * np.column_stack(field)
    changed = (read(*put_together(*clouds)) - base) / 3e-4
    told = np.array([lever.strains[f"s{view}", 0][component] for lever in found])
    assert told == pytest.approx(changed, rel=0.02, abs=0.8)
    assert (np.abs(told).max() > 5.0) == (view == 0)


@pytest.fixture(scope="module")
def sensors():
    """The left wheel's two sensors of a rig: calibration from noisy corners, and pose."""
    rig, found = build_rig(11, "bench", "b", 512), []
    board = board_of(rig)
    for index, sensor in enumerate(s for s in rig.sensors if s.station == "left_wheel"):
        random, poses = np.random.default_rng([4, index]), []
        for k, pose in enumerate(board_poses(board, sensor, 10, 4, 0, index)):
            seen = [px + 0.05 * random.standard_normal(px.shape) for px in project_corners(board, sensor, pose)]
            poses.append(BoardPose(f"{k}", seen[0], seen[1]))
        made = calibrate_stereo(
            poses, board.corners().reshape(-1, 3), sensor.image_size,
            min_poses=5, min_tilt_deg=10.0, max_pose_rms_ratio=3.0,
        )  # fmt: skip
        found.append((made.adjustment, sensor.rig_from_sensor))
    return found


def test_calibrations_move_the_values_as_claimed_two_sided(sensors):
    """Sixty draws of both calibrations: points displaced, registered and squared anew, and read. The claim's own way goes
    through modes, linear registration and squaring; this one through the real ones."""
    m = meridians(placed(INNER), placed(OUTER))
    face = faces(m)
    fields = {
        (f"s{k}", 0): Mirrored(CalibrationField(a.sensor, a.parameter_names, a.covariance, pose))
        for k, (a, pose) in enumerate(sensors)
    }
    claimed = np.array([lever.u_calibration_mm for lever in station_steps(m, face, fields).levers(reader(m, face))])
    base, random, errors = reader(m, face)(m.lateral, m.radial), np.random.default_rng(8), []
    for _ in range(60):
        seen = []
        for points, (adjusted, pose) in zip((INNER, OUTER), sensors, strict=True):
            values, vectors = np.linalg.eigh(adjusted.covariance)
            draw = vectors @ (np.sqrt(np.maximum(values, 0)) * random.standard_normal(len(values)))
            seen.append(displaced(placed(points) * MIRROR, adjusted, pose, draw))
        errors.append(read(*put_together(seen[0] * MIRROR, seen[1] * MIRROR)) - base)
    for pulls in (np.array(errors) / claimed).T:
        assert_pulls(pulls, overclaim=1.1, underclaim=1.1)
    assert (claimed > 2e-4).all()


class Mirrored:
    """The field of a left wheel's sensor for rows that are mirrored to the right."""

    def __init__(self, field):
        self.field = field

    def modes(self, lateral, radial, direction_deg):
        return self.field.modes(-lateral, radial, direction_deg) * MIRROR


def displaced(points, adjusted, pose, draw):
    """Where a calibration that is off by a draw of its parameters sees meridian points (n, 2) above the axle."""
    there = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]])
    seen = rigid.apply(rigid.inverse(pose), there)
    s, off = adjusted.sensor, moved(adjusted.sensor, dict(zip(adjusted.parameter_names, draw, strict=True)))
    rays = []
    for camera, wrong, p in ((s.left, off.left, seen), (s.right, off.right, seen @ s.rotation.T + s.translation_mm)):
        rays += tri.undistort(wrong, *tri.distort(camera, p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]))
    found = rigid.apply(pose, tri.intersect_rays(off, *rays))
    return points + (found - there)[:, [0, 2]]


def test_modes_are_few_and_carry_the_covariance(sensors):
    adjusted, pose = sensors[0]
    field = CalibrationField(adjusted.sensor, adjusted.parameter_names, adjusted.covariance, pose)
    points = placed(INNER) * [-1.0, 1.0]
    modes = field.modes(points[:, 0], points[:, 1], 90.0)
    assert 1 <= len(modes) <= 10
    silent = replace(field, covariance=0 * adjusted.covariance)
    assert silent.modes(points[:, 0], points[:, 1], 90.0).shape == (0, len(points), 2)
    assert moved(adjusted.sensor, {}).left.matrix == pytest.approx(adjusted.sensor.left.matrix)
