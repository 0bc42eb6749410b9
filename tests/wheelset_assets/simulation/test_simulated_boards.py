"""Rendered boards: corners where the true projection says, varied poses, both images full of corners."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from wheelset_assets.simulation.boards import board_of, board_poses, pixel_rays, project_corners, render
from wheelset_assets.simulation.rig import build_rig
from wheelset_assets.simulation.streams import stream


def detected(image, board, true):
    """Corners (n, 2) as OpenCV's sector-based detector finds them, told nothing, in the order of the true ones."""
    found, corners = cv2.findChessboardCornersSB(image, board.inner_corners, flags=cv2.CALIB_CB_ACCURACY)
    assert found
    corners = corners.reshape(-1, 2)
    nearest = np.linalg.norm(corners[None] - true[:, None], axis=2).argmin(axis=1)
    assert len(set(nearest)) == len(true)
    return corners[nearest]


@pytest.mark.parametrize("preset", ["bench", "compact"])
def test_rendered_corners_lie_where_they_are_projected(preset):
    rig = build_rig(4, preset, "r")
    board, sensor = board_of(rig), rig.sensors[0]
    pose = board_poses(board, sensor, 2, 4, 0, 0)[1]
    truths = project_corners(board, sensor, pose)
    cameras = ((sensor.left, pose), (sensor.right, sensor.right_from_left @ pose))
    for k, ((camera, camera_from_board), true) in enumerate(zip(cameras, truths, strict=True)):
        image = render(board, camera_from_board, pixel_rays(camera), stream(4, "board-noise", k))
        off = detected(image, board, true) - true
        assert np.median(np.hypot(*off.T)) < 0.05
        assert off.std(axis=0).max() < 0.05
        assert abs(off.mean(axis=0)).max() < 0.02  # the detector itself is off by +0.01 px, on analytic images too
        assert np.hypot(*off.T).max() < 0.15


def test_true_corners_agree_with_opencv():
    rig = build_rig(4, "bench", "r", rows=512)
    board, sensor = board_of(rig), rig.sensors[2]
    pose = sensor.right_from_left @ board_poses(board, sensor, 3, 4, 0, 2)[2]
    rvec = cv2.Rodrigues(pose[:3, :3])[0]
    camera = sensor.right
    expected = cv2.projectPoints(board.corners(), rvec, pose[:3, 3], camera.matrix, np.array(camera.distortion))[0]
    _, right = project_corners(board, sensor, np.linalg.inv(sensor.right_from_left) @ pose)
    assert right == pytest.approx(expected.reshape(-1, 2), abs=1e-6)


def test_rays_invert_the_projection():
    camera = build_rig(4, "bench", "r").sensors[0].left
    u, v = np.meshgrid(np.linspace(-20.0, 530.0, 30), np.linspace(-20.0, 1040.0, 30))
    assert np.stack(camera.pixels(*camera.rays(u, v))) == pytest.approx(np.stack([u, v]), abs=1e-9)


@pytest.mark.parametrize(("preset", "rows"), [("bench", 0), ("compact", 0), ("wide", 0), ("bench", 256), ("wide", 300)])
def test_poses_fill_both_images_and_tilt_about_both_axes(preset, rows):
    rig = build_rig(5, preset, "r", rows)
    board = board_of(rig)
    for index, sensor in enumerate(rig.sensors):
        poses = board_poses(board, sensor, 12, 5, 0, index)
        normals = np.array([pose[:3, 2] for pose in poses])
        assert np.all(np.ptp(normals[:, :2], axis=0) > 0.5)
        width, height = sensor.image_size
        for camera in range(2):
            corners = np.concatenate([project_corners(board, sensor, pose)[camera] for pose in poses])
            assert corners.min() > 2
            assert np.all(corners.max(axis=0) < [width - 3, height - 3])
            assert np.all(np.ptp(corners, axis=0) > [0.75 * width, 0.8 * height])


def test_small_images_get_a_coarse_board():
    fine, coarse = build_rig(1, "bench", "r", 512), build_rig(1, "bench", "r", 256)
    assert fine.inner_corners == (6, 11)
    assert coarse.inner_corners == (4, 7)
    assert coarse.sensors[0].image_size == (128, 256)
