"""Laser planes: fit against a known plane with outliers, points off it, and a plane that moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from two_sided import assert_pulls

from wheelset_assets.metrology import rigid
from wheelset_assets.metrology.laser_plane import Make, Sensing, fit_laser_plane, off_plane, plane_shift, turned_to_axle

NORMAL = np.array([0.99, 0.04, -0.13]) / np.linalg.norm([0.99, 0.04, -0.13])


def points_on_plane(n=4000, noise_mm=0.02, outliers=0.0, normal=NORMAL, distance=12.0, seed=0):
    """Points (n, 3) mm whose noise lies along their lines of sight; some are mismatches by centimetres."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-60, 60, n), random.uniform(240, 300, n)
    points = np.column_stack([(distance - normal[1] * y - normal[2] * z) / normal[0], y, z])
    points *= 1 + noise_mm * random.standard_normal((n, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    wrong = random.random(n) < outliers
    points[wrong] *= 1 + random.uniform(0.02, 0.2, (wrong.sum(), 1)) * random.choice([-1, 1], (wrong.sum(), 1))
    return points, wrong


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_the_plane_is_found_among_mismatches(outliers):
    points, wrong = points_on_plane(outliers=outliers)
    plane = fit_laser_plane(points)
    across = abs(points[0] @ NORMAL) / np.linalg.norm(points[0])
    assert np.degrees(np.arccos(min(1.0, plane.normal @ NORMAL))) < 0.01
    assert plane.distance_mm == pytest.approx(12.0, abs=0.02)
    assert 0.3 * 0.02 * across < plane.rms_mm < 0.02
    flagged = off_plane(plane, points, np.full(len(points), 0.02), sigmas=6.0, floor_mm=0.02)
    assert flagged[wrong].mean() > 0.95 if wrong.any() else True
    assert not flagged[~wrong].any()


def test_what_is_no_plane_gives_none():
    points, _ = points_on_plane(50)
    assert fit_laser_plane(points) is None
    line = np.outer(np.linspace(-1, 1, 500), [0, 40, 5.0]) + np.array([10, 0, 260])
    assert fit_laser_plane(line + 0.01 * np.random.default_rng(1).standard_normal(line.shape)) is None
    assert fit_laser_plane(np.full((200, 3), np.nan)) is None


def test_a_plane_that_moved_is_told_by_how_much():
    then = fit_laser_plane(points_on_plane(noise_mm=0)[0])
    same = fit_laser_plane(points_on_plane(noise_mm=0, seed=2)[0])
    shift, angle = plane_shift(same, then)
    assert shift < 1e-6
    assert angle < 1e-6
    shift, angle = plane_shift(fit_laser_plane(points_on_plane(noise_mm=0, distance=12.3)[0]), then)
    assert shift == pytest.approx(0.3, abs=1e-6)
    turned = NORMAL + np.cross([0, np.radians(0.2), 0], NORMAL)
    shift, angle = plane_shift(
        fit_laser_plane(points_on_plane(noise_mm=0, normal=turned / np.linalg.norm(turned))[0]), then
    )
    assert angle == pytest.approx(0.2, rel=0.02)
    assert shift > 0.1


# --- how a plane lies to the axle

MAKE = Make(2.0, float(np.radians(1.0)), 3.0, float(np.radians(0.5)))


def in_a_ball(random, size):
    vector = random.standard_normal(3)
    return size * random.random() ** (1 / 3) * vector / np.linalg.norm(vector)


def a_sensor(random, *, offset_mm, yaw_rad, pose_mm=2.0, pose_deg=1.0):
    """Nominal and true rig_from_sensor of a sensor above the axle, and the plane that its laser cuts, in its own frame.

    The true plane passes the axle at offset_mm beside the points, and makes the angle yaw_rad with it.
    """
    psi = random.uniform(0.4, 2.7)
    outward, around = np.array([0.0, np.cos(psi), np.sin(psi)]), np.array([0.0, -np.sin(psi), np.cos(psi)])
    place, eye = np.array([-705.0, 0, 0]) + 460.0 * outward, np.array([-820.0, 0, 0]) + 680.0 * outward + 60.0 * around
    z = (place - eye) / np.linalg.norm(place - eye)
    x = np.cross(np.array([1.0, 0, 0]), z) / np.linalg.norm(np.cross(np.array([1.0, 0, 0]), z))
    nominal = rigid.transform(np.column_stack([x, np.cross(z, x), z]), eye)
    turn = rigid.rotation_from_vector(in_a_ball(random, np.radians(pose_deg)))
    true = rigid.transform(turn @ nominal[:3, :3], eye + in_a_ball(random, pose_mm))
    normal = np.cos(yaw_rad) * around + np.sin(yaw_rad) * np.array([1.0, 0, 0])
    through = np.array([place[0], 0, 0]) + offset_mm * around
    along = np.cross(normal, np.array([1.0, 0, 0]))
    level = np.cross(along / np.linalg.norm(along), normal)
    heights, widths = random.uniform(445, 490, 3000), random.uniform(-40, 40, 3000)
    points = (
        through + heights[:, None] * along / np.linalg.norm(along) * np.sign(along @ outward) + widths[:, None] * level
    )
    plane = fit_laser_plane(rigid.apply(rigid.inverse(true), points))
    return nominal, true, plane


def lies(pose, plane):
    """Signed distance from the axle beside what is lit, and angle with it, of a plane under a pose."""
    normal, lit = pose[:3, :3] @ plane.normal, rigid.apply(pose, plane.centre_mm)
    across = normal - normal[0] * np.array([1.0, 0, 0])
    return float(across @ lit / np.linalg.norm(across)), float(np.arcsin(normal[0]))


def test_turned_sensors_lie_to_the_axle_as_claimed_two_sided():
    """Four hundred sensors whose poses and planes are all within what the make promises: pulls of distance and angle."""
    pulls, before = [], []
    for seed in range(400):
        random = np.random.default_rng([5, seed])
        offset, yaw = random.uniform(-3, 3), np.radians(random.uniform(-0.5, 0.5))
        nominal, true, plane = a_sensor(random, offset_mm=offset, yaw_rad=yaw)
        pose, sensing, far = turned_to_axle(nominal, plane, MAKE)
        assert not far
        wanted, found, left = lies(true, plane), lies(pose, plane), lies(nominal, plane)
        assert (abs(found[0]), abs(found[1])) == pytest.approx((sensing.offset_mm, sensing.yaw_rad), rel=0.02, abs=2e-5)
        pulls.append(
            [(f - w) / u for f, w, u in zip(found, wanted, (sensing.u_offset_mm, sensing.u_yaw_rad), strict=True)]
        )
        before.append([n - w for n, w in zip(left, wanted, strict=True)])
    for column in np.array(pulls).T:
        assert_pulls(column, overclaim=1.08, underclaim=1.08)  # the prior's parts are not normal
    assert np.std(before, axis=0)[0] > 2.5 * 1.7  # the nominal poses alone leave several times as much open
    assert np.std(before, axis=0)[1] > 1.5 * 4.2e-3


def test_a_turned_sensor_stays_where_it_was_but_for_the_turn():
    """Its points move along the turn by what the pose's own tolerance allows, and little in the meridian."""
    nominal, _, plane = a_sensor(np.random.default_rng(2), offset_mm=1.0, yaw_rad=2e-3)
    pose, _, _ = turned_to_axle(nominal, plane, MAKE)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    lit = [rigid.apply(m, plane.centre_mm) for m in (nominal, pose)]
    assert abs(lit[0][0] - lit[1][0]) < 1e-9
    assert abs(np.hypot(*lit[0][1:]) - np.hypot(*lit[1][1:])) < 1.0
    assert np.linalg.norm(lit[0] - lit[1]) < 12.0


def test_a_pose_that_the_make_does_not_allow_is_told():
    random = np.random.default_rng(3)
    nominal, _, plane = a_sensor(random, offset_mm=0.0, yaw_rad=0.0)
    outward = np.array([1.0, 0, 0])
    for turn in (
        rigid.rotation_from_vector(np.radians(4.0) * outward),
        rigid.rotation_from_vector(np.radians(3.0) * nominal[:3, 2]),
    ):
        wrong = rigid.transform(turn @ nominal[:3, :3], nominal[:3, 3])
        assert turned_to_axle(wrong, plane, MAKE)[2]
    beyond = rigid.transform(nominal[:3, :3], nominal[:3, 3] + [0, 0, 5000.0])
    away = replace(plane, distance_mm=plane.distance_mm + 1e5)
    pose, sensing, far = turned_to_axle(beyond, away, MAKE)
    assert far
    assert pose == pytest.approx(beyond)
    assert np.isfinite([sensing.u_shear, sensing.u_cosine]).all()


def test_the_strain_of_meridians_is_that_of_planes_beside_the_axle():
    """Two sensing planes, each at a distance from the axle and at an angle with it that are known to a part only.

    The meridian of a section at the distance b, turned by psi: lateral xi cos psi, radius hypot(h, b + xi sin psi); its
    derivatives in the middle of what is seen, against those of the planes that are believed in.
    """
    random, height = np.random.default_rng(6), 460.0
    known = [Sensing(height, *numbers) for numbers in ((0.0, 0.0, 1.7, 4e-3), (1.5, 6e-3, 1.2, 5e-3))]

    def strains(b, psi, step=0.5):
        def section(xi, h):
            return xi * np.cos(psi), np.hypot(h, b + xi * np.sin(psi))

        return (
            section(step, height)[0] - section(-step, height)[0],
            section(0, height + step)[1] - section(0, height - step)[1],
            section(step, height)[1] - section(-step, height)[1],
        )

    errors = []
    for s in known:
        b, psi = (
            mean + u * random.standard_normal(200_000)
            for mean, u in ((s.offset_mm, s.u_offset_mm), (s.yaw_rad, s.u_yaw_rad))
        )
        errors.append(np.array(strains(b, psi)) - np.array(strains(s.offset_mm, s.yaw_rad))[:, None])
    for component, u in zip(
        zip(*errors, strict=True), np.linalg.norm([s.u_strains for s in known], axis=0), strict=True
    ):
        assert np.sqrt(np.mean(component[0] ** 2) + np.mean(component[1] ** 2)) == pytest.approx(u, rel=0.02)
