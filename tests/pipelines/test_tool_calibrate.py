"""`wheelset tool calibrate`: real pairs, a rendered ChArUco board, folders as people have them, and what is refused."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from pipelines.cli import app
from pipelines.tools.images import image_pairs
from wheelset_assets.quality import ConfigError

SIZE = (480, 400)
MATRIX = np.array([[620.0, 0, 236.0], [0, 620.0, 204.0], [0, 0, 1]])
ROTATION = Rotation.from_euler("xyz", [0.3, -12, 0.5], degrees=True).as_matrix().T
TRANSLATION = -ROTATION @ np.array([90.0, 1, 4])
SQUARES, SQUARE_MM, MARKER_MM = (9, 8), 16.0, 12.0
TILTS_DEG = [(0, 0), (25, 8), (-25, -8), (8, 28), (-8, -28), (20, -20), (-20, 20)]


def calibrate(*arguments):
    command = ["tool", "calibrate", *map(str, arguments)]
    return CliRunner().invoke(app, command, catch_exceptions=False, standalone_mode=False)


def document(*arguments):
    done = calibrate(*arguments, "--json")
    assert done.return_value == 0, done.output
    return json.loads(done.stdout)


# --- real pairs


@pytest.fixture(scope="module")
def real(shared_data):
    return document(shared_data / "opencv-stereo", "--inner-corners", "9x6", "--square-mm", 30)


def test_all_thirteen_real_pairs_beat_the_best_hand_set_window(real):
    assert (real["n_poses"], real["n_poses_used"]) == (13, 13)
    assert 0.1 < real["stereo_rms_px"] <= 0.201
    assert real["stereo_rms_px"] < real["holdout_rms_px"] <= 0.22
    assert abs(real["square_edge_mean_mm"] - 30) <= 0.05


def test_the_real_pose_is_the_published_one(real):
    pose = np.array(real["right_from_left"])
    assert np.all(np.abs(pose[:3, 3] - [-99.802, 1.124, 0.050]) <= [0.14, 0.11, 0.50])
    vector = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    assert np.all(np.abs(vector - [0.00669, 0.00452, -0.00350]) <= [0.0027, 0.0031, 0.0003])
    # Published uncertainties are three standard deviations; ours are single ones.
    for axis, three_sigma in zip("xyz", (0.14, 0.11, 0.50), strict=True):
        assert 0.4 < real["standard_uncertainties"][f"t{axis}_mm"] / (three_sigma / 3) < 2.5


def test_text_and_picture_say_the_same(shared_data, tmp_path):
    picture = tmp_path / "calibration.png"
    folder = shared_data / "opencv-stereo" / "images"
    done = calibrate(folder, "--inner-corners", "9x6", "--square-mm", 30, "--picture", picture)
    assert done.return_value == 0
    assert "13 of 13" in done.stdout
    assert "hold-out RMS" in done.stdout
    assert cv2.imread(str(picture)).shape[1] > 1000


# --- a ChArUco board


def charuco_views(folder, *, legacy=False, hide=True):
    """Pairs of a rendered board, some of it outside the image or covered; both cameras without distortion."""
    made = cv2.aruco.CharucoBoard(
        SQUARES, SQUARE_MM, MARKER_MM, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    )
    made.setLegacyPattern(legacy)
    fine, pixels_a_mm = 3, 12
    texture = made.generateImage(tuple(int(n * SQUARE_MM * pixels_a_mm) for n in SQUARES), marginSize=0)
    texture = np.where(texture > 128, 205, 35).astype(np.uint8)
    random = np.random.default_rng(5)
    for k, tilt in enumerate(TILTS_DEG):
        turn = Rotation.from_euler("xyz", [*tilt, random.uniform(-8, 8)], degrees=True).as_matrix()
        middle = np.array([*(np.array(SQUARES) * SQUARE_MM / 2), 0])
        place = np.array([random.uniform(-10, 40), random.uniform(-15, 15), random.uniform(270, 310)])
        place[0] += 70 * (k == 3 and hide)
        place = place - turn @ middle
        for side, r, t in (("left", turn, place), ("right", ROTATION @ turn, ROTATION @ place + TRANSLATION)):
            image_from_texture = MATRIX @ np.column_stack([r[:, 0], r[:, 1], t])
            image_from_texture = image_from_texture @ np.diag([1 / pixels_a_mm, 1 / pixels_a_mm, 1])
            half = lambda s: np.array([[1, 0, s], [0, 1, s], [0, 0, 1.0]])  # noqa: E731
            warp = half(-0.5) @ np.diag([fine, fine, 1]) @ half(0.5) @ image_from_texture @ half(0.5)
            size = (SIZE[0] * fine, SIZE[1] * fine)
            big = cv2.warpPerspective(texture, warp, size, flags=cv2.INTER_AREA, borderValue=190).astype(float)
            grey = big.reshape(SIZE[1], fine, SIZE[0], fine).mean(axis=(1, 3))
            grey = cv2.GaussianBlur(grey, (0, 0), 0.7) + random.standard_normal(grey.shape)
            if k == 5 and side == "left" and hide:
                grey[140:260, 180:320] = 120
            cv2.imwrite(str(folder / f"{side}{k}.png"), np.clip(np.rint(grey), 0, 255).astype(np.uint8))


CHARUCO = ("--inner-corners", "8x7", "--square-mm", SQUARE_MM, "--charuco", "--marker-mm", MARKER_MM,
           "--dictionary", "DICT_5X5_100")  # fmt: skip


@pytest.fixture(scope="module")
def charuco(tmp_path_factory):
    folder = tmp_path_factory.mktemp("charuco")
    charuco_views(folder)
    return folder


def test_a_partly_hidden_charuco_board_is_used_as_far_as_it_is_seen(charuco):
    found = document(charuco, *CHARUCO)
    assert (found["n_poses"], found["n_poses_used"]) == (7, 7)
    assert found["stereo_rms_px"] < 0.06
    u = found["standard_uncertainties"]
    error = np.array(found["right_from_left"])[:3, 3] - TRANSLATION
    # Corners of a rendered board err a little alike within a pose: four standard uncertainties instead of three.
    assert np.all(np.abs(error) < 4 * np.array([u[f"t{a}_mm"] for a in "xyz"]) + 1e-3)


def test_an_older_charuco_pattern_is_recognised(tmp_path):
    charuco_views(tmp_path, legacy=True, hide=False)
    found = document(tmp_path, *CHARUCO)
    assert found["n_poses_used"] == 7
    assert any("legacy" in note for note in found["notes"])
    assert np.allclose(np.array(found["right_from_left"])[:3, 3], TRANSLATION, atol=0.1)


# --- folders as people have them


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")


def names(pairs):
    return [(p.name, p.left.name if p.left else None, p.right.name if p.right else None) for p in pairs]


def test_pairs_by_the_rest_of_their_names_in_natural_order(tmp_path):
    touch(tmp_path, "left2.png", "left10.png", "Right10.PNG", "right2.jpg", "left_intrinsics.yml", "right3.png")
    pairs, _ = image_pairs(tmp_path, None, None)
    assert names(pairs) == [
        ("2", "left2.png", "right2.jpg"),
        ("3", None, "right3.png"),
        ("10", "left10.png", "Right10.PNG"),
    ]


def test_pairs_by_patterns_and_in_folders(tmp_path):
    touch(tmp_path, "cam0/a1.png", "cam0/a2.png", "cam1/b1.png", "cam1/b2.png")
    pairs, _ = image_pairs(tmp_path, "cam0/a*.png", "cam1/b*.png")
    assert [n for n, _, _ in names(pairs)] == ["1", "2"]
    inside = tmp_path / "sides"
    touch(inside, "left/x1.png", "left/x2.png", "right/x1.png", "right/x2.png")
    assert names(image_pairs(inside, None, None)[0])[0] == ("x1", "x1.png", "x1.png")


def test_names_without_a_common_part_are_paired_in_order_and_said_so(tmp_path):
    touch(tmp_path, "left_a.png", "left_b.png", "right_1.png", "right_2.png")
    pairs, notes = image_pairs(tmp_path, None, None)
    assert names(pairs) == [("left_a", "left_a.png", "right_1.png"), ("left_b", "left_b.png", "right_2.png")]
    assert "in order" in notes[0]
    touch(tmp_path, "right_3.png")
    with pytest.raises(ConfigError, match=r"2 left images.*3 right ones"):
        image_pairs(tmp_path, None, None)


def test_a_folder_without_such_images_is_told_with_what_is_in_it(tmp_path):
    touch(tmp_path, "camera_a.png")
    with pytest.raises(ConfigError, match=r"left.*camera_a\.png.*--left GLOB"):
        image_pairs(tmp_path, None, None)


# --- what is refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--inner-corners", "9", "--square-mm", 30), "9x6"),
        (("--inner-corners", "9x6", "--square-mm", 0), "above 0"),
        (("--inner-corners", "9x6", "--square-mm", 30, "--charuco"), "--marker-mm"),
        (("--inner-corners", "9x6", "--square-mm", 30, "--marker-mm", 20), "--charuco"),
        (("--inner-corners", "9x6", "--square-mm", 30, "--left", "a*"), "go together"),
    ],
)
def test_wrong_usage_is_told(tmp_path, options, message):
    touch(tmp_path, "left1.png", "right1.png")
    with pytest.raises(ConfigError, match=message):
        calibrate(tmp_path, *options)


def test_a_file_that_is_no_image_is_named(tmp_path):
    touch(tmp_path, "left1.png", "right1.png")
    done = calibrate(tmp_path, "--inner-corners", "9x6", "--square-mm", 30)
    assert done.return_value == 3
    assert "left1.png: not an image that can be read: 0 bytes" in done.stderr


def test_squares_counted_instead_of_corners_are_recognised(shared_data, tmp_path):
    for name in ("left05.jpg", "right05.jpg"):
        shutil.copy(shared_data / "opencv-stereo" / "images" / name, tmp_path)
    done = calibrate(tmp_path, "--inner-corners", "10x7", "--square-mm", 30, "--json")
    assert done.return_value == 3
    refused = json.loads(done.stdout)
    assert refused["n_poses_used"] == 0
    assert "too few board poses" in refused["reason"]
    assert any("--inner-corners 9x6" in note for note in refused["notes"])


def test_bad_images_are_listed_with_their_reason(shared_data, tmp_path):
    """One blurred, one of another size, one overexposed, one without partner, among real pairs."""
    for path in (shared_data / "opencv-stereo" / "images").glob("*.jpg"):
        shutil.copy(path, tmp_path)
    blurred = cv2.GaussianBlur(cv2.imread(str(tmp_path / "left05.jpg"), 0), (0, 0), 7)
    cv2.imwrite(str(tmp_path / "left05.jpg"), blurred)
    small = cv2.resize(cv2.imread(str(tmp_path / "right06.jpg"), 0), (320, 240))
    cv2.imwrite(str(tmp_path / "right06.jpg"), small)
    bright = cv2.imread(str(tmp_path / "left12.jpg"), 0).astype(float)
    cv2.imwrite(
        str(tmp_path / "left12.jpg"), np.clip(cv2.GaussianBlur(bright, (0, 0), 2.5) * 4.5, 0, 255).astype(np.uint8)
    )
    (tmp_path / "right14.jpg").unlink()
    found = document(tmp_path, "--inner-corners", "9x6", "--square-mm", 30)
    reasons = {p["name"]: p["reason"] for p in found["poses"] if not p["used"]}
    assert set(reasons) == {"05", "06", "12", "14"}
    assert reasons["05"].startswith("left: blurred")
    assert "320 x 240" in reasons["06"]
    assert "saturated" in reasons["12"] or "not found" in reasons["12"]
    assert reasons["14"] == "right: the image is missing"
    assert found["stereo_rms_px"] < 0.21
