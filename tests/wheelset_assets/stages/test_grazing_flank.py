"""A flank that is seen at a grazing angle bends strongly in the image: its points must still lie in the laser plane."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.metrology import triangulation as tri
from wheelset_assets.simulation.rig import build_rig
from wheelset_assets.simulation.scan import perfect_stripes
from wheelset_assets.simulation.schedule import Conditions
from wheelset_assets.simulation.wheelset import draw_wheelset

FRAMES = 16


def off_plane_um(seed):
    """Distances (n,) of the points of an inner wheel sensor's perfect stripes from the true laser plane."""
    rig = build_rig(seed, "bench", "r", 512)
    sensor = next(s for s in rig.sensors if s.sensor_id == "left_wheel_inner")
    conditions = Conditions(20, 20, 20, 20, 0.1, (0.0, 0.0), 0.0, 10.0)
    wheelset = draw_wheelset(seed, 1, "W", ("S1002", "LMA")[seed % 2])
    stripe = perfect_stripes(wheelset, rig, sensor, conditions, np.arange(FRAMES) * 360.0 / FRAMES)[0]
    cameras = [
        tri.Camera(np.array([[c.fx_px, 0, c.cx_px], [0, c.fy_px, c.cy_px], [0, 0, 1.0]]), np.array(c.distortion))
        for c in (sensor.left, sensor.right)
    ]
    pose = np.array(sensor.right_from_left)
    stereo = tri.StereoSensor(cameras[0], cameras[1], pose[:3, :3], pose[:3, 3])
    rectification = tri.rectify(stereo)
    points = tri.triangulate_disparity(
        rectification, tri.match_stripes(stereo, rectification, stripe.left_u, stripe.right_u, 4.0)
    )
    plane = sensor.planes[0]
    distance = 1e3 * (points @ np.array(plane.normal) - plane.offset_mm)
    return distance[np.isfinite(distance)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_bent_stripes_are_triangulated_without_their_sagitta(seed, monkeypatch):
    found = off_plane_um(seed)
    monkeypatch.setattr(tri, "_bend", lambda u, step: np.zeros(u.shape[1]))
    chord = off_plane_um(seed)
    assert len(found) == len(chord)
    assert np.percentile(np.abs(chord), 95) > 0.1
    assert np.percentile(np.abs(found), 95) < 0.02
    assert np.sqrt(np.mean(found**2)) < 0.4 * np.sqrt(np.mean(chord**2))


def test_the_bend_is_the_second_difference_and_stops_at_gaps_and_jumps():
    row = np.arange(12.0)
    stripe = np.tile(3.0 + 0.5 * row + 0.04 * row**2, (5, 1)) + np.arange(5)[:, None]  # frames that are shifted
    assert tri._bend(stripe, 4.0)[1:-2] == pytest.approx(0.04)
    assert tri._bend(stripe, 4.0)[-1] == 0.0
    stripe[:, 6] = np.nan
    known = tri._bend(stripe, 4.0)
    assert known[[1, 2, 3, 8, 9]] == pytest.approx(0.04)
    assert known[[5, 6]] == pytest.approx(0.0)
    stripe[:, 6:] += 100.0
    assert tri._bend(stripe, 4.0)[[5, 6]] == pytest.approx(0.0)
