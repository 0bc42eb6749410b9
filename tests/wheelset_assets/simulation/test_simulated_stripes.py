"""Stripes against independent geometry: root finding, two-ray triangulation, effects of temperature and shift."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from wheelset_assets.simulation.meridian import INNER_FACE, Wear
from wheelset_assets.simulation.optics import Camera
from wheelset_assets.simulation.profiles import PROFILES, nominal_height
from wheelset_assets.simulation.rig import build_rig
from wheelset_assets.simulation.scan import node_step_mm
from wheelset_assets.simulation.stripes import Placement, trace
from wheelset_assets.simulation.wheelset import SIDES, Harmonics, Wheel, Wheelset, draw_wheelset

TURN = np.deg2rad([10.0, 200.0, 311.0])
PLACE = Placement(0.3, (1e-4, 2e-4), 1.00002)


@pytest.fixture(scope="module")
def wheelset():
    """Out of round and shifted, but unworn: its surfaces have closed forms."""
    drawn = draw_wheelset(1, 0, "WS-000", "S1002")
    return replace(drawn, wheels=tuple(replace(w, wear=Wear()) for w in drawn.wheels))


def stripes_of(wheelset, sensor, pose, line=0, place=PLACE, turn=TURN, **kwargs):
    surface = wheelset.surface(sensor.kind, sensor.side, node_step_mm(sensor))
    return trace(surface, place, sensor, pose, sensor.planes[line], turn, **kwargs)


def undistorted(camera: Camera, u, v):
    """Rays of pixels by OpenCV's iteration: not the simulator's own inverse."""
    pixels = np.stack([u, v], axis=1)[:, None]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    out = cv2.undistortPoints(pixels, camera.matrix, np.array(camera.distortion), criteria=criteria)
    return np.column_stack([out.reshape(-1, 2), np.ones(len(u))])


def triangulated(sensor, left_u, right_u):
    """Points (n, 3) where a left pixel's ray meets, in the right image, the right stripe; NaN where it does not."""
    rows = np.arange(left_u.size)
    rays = undistorted(sensor.left, np.nan_to_num(left_u, nan=100.0), rows.astype(float))
    seen = np.flatnonzero(np.isfinite(right_u))
    points = np.full((rows.size, 3), np.nan)
    rotation, translation = sensor.right_from_left[:3, :3], sensor.right_from_left[:3, 3]
    for run in np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1):
        if run.size < 20:
            continue
        curve = CubicSpline(run, right_u[run])

        def miss(depth, curve=curve, run=run):
            p = (rays * depth[:, None]) @ rotation.T + translation
            uv = cv2.projectPoints(p, np.zeros(3), np.zeros(3), sensor.right.matrix, np.array(sensor.right.distortion))[
                0
            ]
            u, v = uv.reshape(-1, 2).T
            return u - curve(np.clip(v, run[0], run[-1])), v

        depth = np.full(rows.size, sensor.working_distance_mm)
        for _ in range(20):
            here = miss(depth)[0]
            depth = depth - here * 1e-3 / (miss(depth + 1e-3)[0] - here)
        off, v = miss(depth)
        good = np.isfinite(left_u) & (v > run[0] + 2) & (v < run[-1] - 2) & (abs(off) < 1e-7)
        points[good] = (rays * depth[:, None])[good]
    return points


def distance_um(wheelset, sensor, pose, points, place, turn_rad):
    """Distances (um) of points from the closed form of the true surface; NaN near its corners."""
    surface = wheelset.surface(sensor.kind, sensor.side)
    p = points @ pose[:3, :3].T + pose[:3, 3]
    y, z = p[:, 1] - place.axis_mm[0], p[:, 2] - place.axis_mm[1]
    phi = np.arctan2(z, y) - turn_rad
    lateral = surface.sign * (p[:, 0] - place.shift_mm) / place.growth - surface.base_mm - surface.axial.at(phi)
    radial = np.hypot(y, z) / place.growth - surface.radius_mm - surface.radial.at(phi)
    off = np.full(lateral.size, np.nan)
    if sensor.kind == "wheel":
        profile, s = PROFILES[wheelset.profile], lateral - 70.0
        slope = (nominal_height(profile, s + 1e-6) - nominal_height(profile, s - 1e-6)) / 2e-6
        near_joint = np.min([abs(s - piece.s1) for piece in profile], axis=0) < 0.5
        running = (s > -69.0) & ~near_joint
        off[running] = ((radial - nominal_height(profile, s)) / np.hypot(1.0, slope))[running]
        face = (abs(lateral) < 0.01) & (radial < 8.5)
        off[face] = lateral[face]
    else:
        journal = wheelset.journals[SIDES.index(sensor.side)]
        cylinder, shape = lateral > journal.shape.fillet_mm + 0.5, journal.shape
        off[cylinder] = radial[cylinder] - journal.diameter_mm / 2
        foot = journal.diameter_mm / 2 + shape.fillet_mm + 0.5
        face = (abs(lateral) < 0.01) & (radial > foot) & (radial < shape.collar_diameter_mm / 2 - 1.5)
        off[face] = lateral[face]
    return 1e3 * off


@pytest.mark.parametrize("preset", ["bench", "compact", "wide"])
def test_triangulated_stripes_land_on_the_true_surface(wheelset, preset):
    rig = build_rig(1, preset, "r")
    for sensor in rig.sensors[: len(rig.sensors) // 2 + 1]:
        pose = sensor.rig_from_sensor_at(25.0, rig.expansion_per_k)
        for line in range(len(sensor.planes)):
            stripes = stripes_of(wheelset, sensor, pose, line)
            points = triangulated(sensor, stripes.left_u[1], stripes.right_u[1])
            off = distance_um(wheelset, sensor, pose, points, PLACE, TURN[1])
            assert np.isfinite(off).sum() > 0.5 * np.isfinite(stripes.left_u[1]).sum()
            assert np.nanmax(abs(off)) < 0.1
            assert np.nanmedian(abs(off)) < 1e-3


def test_rows_agree_with_root_finding(wheelset):
    """u at a row, found by bisecting the meridian's closed form through cv2.projectPoints, to 1e-4 px."""
    rig = build_rig(1, "bench", "r")
    sensor = rig.sensor("left_wheel_outer")
    pose = sensor.rig_from_sensor_at(22.0, rig.expansion_per_k)
    stripes = stripes_of(wheelset, sensor, pose)
    surface = wheelset.surface("wheel", "left")
    plane, profile = sensor.planes[0], PROFILES["S1002"]
    normal = pose[:3, :3] @ np.array(plane.normal)
    offset = plane.offset_mm + normal @ pose[:3, 3]
    inverse = np.linalg.inv(pose)
    rvec = cv2.Rodrigues(inverse[:3, :3])[0]

    def pixel(s, turn):
        def point(psi):
            phi = psi - turn
            radius = surface.radius_mm + nominal_height(profile, np.array([s]))[0] + surface.radial.at(np.array(phi))
            x = -(surface.base_mm + s + 70.0 + surface.axial.at(np.array(phi)))
            rho = PLACE.growth * radius
            y, z = PLACE.axis_mm[0] + rho * np.cos(psi), PLACE.axis_mm[1] + rho * np.sin(psi)
            return np.array([PLACE.shift_mm + PLACE.growth * x, y, z])

        psi = brentq(lambda angle: normal @ point(angle) - offset, np.pi / 2 - 0.2, np.pi / 2 + 0.2, xtol=1e-15)
        k, d = sensor.left.matrix, np.array(sensor.left.distortion)
        return cv2.projectPoints(point(psi)[None], rvec, inverse[:3, 3], k, d)[0].ravel()

    for frame, turn in enumerate(TURN):
        for row in (60, 222, 400, 651, 803):
            s = brentq(lambda s, row=row, turn=turn: pixel(s, turn)[1] - row, -40.0, 59.9, xtol=1e-13)
            assert stripes.left_u[frame, row] == pytest.approx(pixel(s, turn)[0], abs=1e-4)


def test_stripes_do_not_depend_on_chunks_of_frames(wheelset):
    sensor = build_rig(1, "bench", "r", rows=256).sensors[0]
    many = stripes_of(wheelset, sensor, sensor.rig_from_sensor, turn=np.linspace(0, 6, 300))
    few = stripes_of(wheelset, sensor, sensor.rig_from_sensor, turn=np.linspace(0, 6, 300)[170:175])
    assert np.array_equal(many.left_u[170:175], few.left_u, equal_nan=True)


def face_mm(points):
    """X (mm) of the left inner face in points (n, 3) of the rig frame."""
    return np.nanmedian(points[:, 0][abs(points[:, 0] + 676.5) < 0.8])


def test_growth_and_shift_have_the_stated_effect():
    """A wheel warmer by 3 K has a radius larger by 11.5e-6 * 3 * 460 mm; a shift along X moves the inner face."""
    wheelset = Wheelset("A")
    rig = build_rig(1, "bench", "r")
    sensor = rig.sensor("left_wheel_inner")

    def found(place):
        pose = sensor.rig_from_sensor
        stripes = stripes_of(wheelset, sensor, pose, place=place, turn=TURN[:1])
        p = triangulated(sensor, stripes.left_u[0], stripes.right_u[0]) @ pose[:3, :3].T + pose[:3, 3]
        p = p[np.isfinite(p[:, 0])]
        rho = np.hypot(p[:, 1], p[:, 2])
        outward, rho = np.array(sorted(zip(-p[:, 0], rho, strict=True))).T
        return CubicSpline(outward[outward > 740.0], rho[outward > 740.0]), face_mm(p)

    growth = 1.0 + 11.5e-6 * 3.0
    cold, face = found(Placement())
    warm, face_warm = found(Placement(growth=growth))
    _, face_shifted = found(Placement(shift_mm=0.7))
    x = 676.5 + 85.0
    assert growth * cold(x) - warm(growth * x) == pytest.approx(0.0, abs=1e-5)
    assert warm(growth * x) - cold(x) == pytest.approx(11.5e-6 * 3.0 * 460.0, abs=1e-3)
    assert face_warm - face == pytest.approx(-11.5e-6 * 3.0 * 676.5, abs=1e-6)
    assert face_shifted - face == pytest.approx(0.7, abs=1e-6)


def test_rig_grows_about_its_origin():
    rig = build_rig(1, "bench", "r", rows=256)
    sensor = rig.sensors[0]
    warm = sensor.rig_from_sensor_at(26.0, rig.expansion_per_k)
    assert warm[:3, 3] == pytest.approx(sensor.rig_from_sensor[:3, 3] * (1 + 11.5e-6 * 6.0), rel=1e-15)
    assert np.array_equal(warm[:3, :3], sensor.rig_from_sensor[:3, :3])


@pytest.mark.parametrize("preset", ["bench", "compact", "wide"])
def test_true_poses_stay_within_the_formats_limits(preset):
    for seed in range(20):
        for sensor in build_rig(seed, preset, "r").sensors:
            delta = np.linalg.inv(sensor.rig_from_sensor_nominal) @ sensor.rig_from_sensor
            angle = np.rad2deg(np.arccos(np.clip((np.trace(delta[:3, :3]) - 1) / 2, -1, 1)))
            assert np.linalg.norm(delta[:3, 3]) < 2.0
            assert angle < 1.0
            for plane in sensor.planes:  # how far from the axis, near the station
                normal = sensor.rig_from_sensor[:3, :3] @ np.array(plane.normal)
                offset = plane.offset_mm + normal @ sensor.rig_from_sensor[:3, 3]
                x = np.array([-60.0, 60.0]) + sensor.rig_from_sensor[0, 3]
                assert np.max(abs(normal[0] * x - offset)) < 4.0


def test_the_lines_of_a_sensor_are_in_order_of_u_and_apart(wheelset):
    rig = build_rig(2, "compact", "r")
    for sensor in rig.sensors:
        if len(sensor.planes) == 2:
            first, second = (stripes_of(wheelset, sensor, sensor.rig_from_sensor, line) for line in range(2))
            assert np.nanmin(second.left_u - first.left_u) > 50.0


def test_coverage_resembles_a_bench(wheelset):
    """Shares of rows with a stripe, as on a rig whose inner sensor loses sight of the flank and the rim's depth."""
    rig = build_rig(1, "bench", "r")
    shares = {}
    for sensor in rig.sensors[:3]:
        stripes = stripes_of(wheelset, sensor, sensor.rig_from_sensor)
        shares[sensor.sensor_id] = float(np.isfinite(stripes.left_u).mean())
    assert 0.7 < shares["left_wheel_inner"] < 0.9
    assert 0.8 < shares["left_wheel_outer"] < 0.95
    assert shares["left_journal"] > 0.9


def test_axial_run_out_moves_the_inner_face_and_hidden_parts_vanish():
    run_out = Harmonics((1,), (0.05,), (0.0,))
    wheelset = Wheelset("A", wheels=(Wheel(axial=run_out), Wheel()))
    sensor = build_rig(1, "bench", "r").sensor("left_wheel_inner")
    pose = sensor.rig_from_sensor
    turn = np.array([np.pi / 2, -np.pi / 2])  # the sensor stands at 90 deg: body angles 0 and 180 deg
    stripes = stripes_of(wheelset, sensor, pose, place=Placement(), turn=turn)
    face = []
    for frame in range(2):
        p = triangulated(sensor, stripes.left_u[frame], stripes.right_u[frame]) @ pose[:3, :3].T + pose[:3, 3]
        face.append(face_mm(p))
    assert face[1] - face[0] == pytest.approx(2 * 0.05, abs=1e-4)  # outward is -X on the left
    hidden = stripes_of(wheelset, sensor, pose, place=Placement(), turn=turn, hidden_parts=(INNER_FACE,))
    lost = np.isfinite(stripes.left_u) & ~np.isfinite(hidden.left_u)
    assert lost.sum(axis=1).min() > 50
    assert np.isfinite(hidden.left_u).sum(axis=1).min() > 500
