"""Stages 1 and 2: calibration of sensors from rendered boards, triangulation of stripes, and what refuses them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import chi2
from small_world import CONFIG, FRAMES, POSES, ROWS, SEED, audited, one

from wheelset_assets import stages
from wheelset_assets.bundle import CalibrationHeader, Rig
from wheelset_assets.metrology import rigid
from wheelset_assets.quality import AlgorithmFailed, ScanUnusable
from wheelset_assets.simulation.boards import board_of, board_poses, pixel_rays, render
from wheelset_assets.simulation.images import render_frames
from wheelset_assets.simulation.noise import NoiseModel
from wheelset_assets.simulation.profiles import PROFILES, nominal_height
from wheelset_assets.simulation.rig import build_rig
from wheelset_assets.simulation.schedule import Conditions
from wheelset_assets.stages.capture import GRID_MM, quantised, rounded_um, stereo_sensors
from wheelset_assets.stages.raw import Boards, StripeImages, StripeTable

NAME = "left_wheel_inner"

# --- stage 1


def test_every_sensor_is_calibrated(world):
    for row in world.calibrated.calibrations.to_pylist():
        assert row["state"] == "usable"
        assert row["reason"] is None
        true = world.true.sensor(row["sensor_id"])
        assert row["baseline_mm"] == pytest.approx(np.linalg.norm(true.right_from_left[:3, 3]), rel=1e-3)
        assert row["n_poses"] == POSES
        assert row["stereo_rms_px"] < 0.03
        n = len(row["parameter_names"])
        assert len(row["covariance"]) == n * n
        assert len(row["depth_range_mm"]) == 2


def test_the_pose_between_the_cameras_two_sided():
    """Rendered boards of 256 x 512 px, two sensors: six parameters each under their claimed covariance."""
    true = build_rig(SEED, "bench", "bench-1", 512)
    board, total, number = board_of(true), 0.0, 0
    images = {}
    for index, sensor in enumerate(true.sensors[:2]):
        rays = [pixel_rays(c) for c in (sensor.left, sensor.right)]
        images[sensor.sensor_id] = []
        for k, pose in enumerate(board_poses(board, sensor, 9, SEED, 0, index)):
            random = np.random.default_rng([SEED, 3, index, k])
            right = render(board, sensor.right_from_left @ pose, rays[1], random)
            images[sensor.sensor_id].append((f"{k:03d}", render(board, pose, rays[0], random), right))
    square = {"type": "chessboard", "inner_corners": true.inner_corners, "square_mm": true.square_mm}
    header = CalibrationHeader.model_validate(
        {
            "format": "wheelset-calibration/1", "calibration_id": "cal-2", "rig_id": "bench-1", "files": {},
            "captured_at": "2025-03-30T06:00:00+08:00", "temperature_c": {"rig": 21.0}, "board": square,
        }
    )  # fmt: skip
    boards = Boards(header, tuple(images), lambda name: iter(images[name]))
    rig = Rig.model_validate(true.declaration())
    made = audited(stages.CALIBRATION, stages.CALIBRATION.run(boards=boards, rig=rig, config=CONFIG.calibration))
    for row in made.calibrations.to_pylist():
        names = row["parameter_names"]
        covariance = np.reshape(row["covariance"], (len(names), len(names)))[-6:, -6:]
        assert names[-6:] == ["rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"]
        found, truth = np.reshape(row["right_from_left"], (4, 4)), true.sensor(row["sensor_id"]).right_from_left
        turn = rigid.vector_from_rotation(found[:3, :3]) - rigid.vector_from_rotation(truth[:3, :3])
        error = np.concatenate([turn, found[:3, 3] - truth[:3, 3]])
        scale = np.sqrt(np.diag(covariance))
        total += (error / scale) @ np.linalg.solve(covariance / np.outer(scale, scale), error / scale)
        number += 6
    # Chi-square of twelve at p = 0.001; corners of rendered images are a little correlated within a board: 1.5 times.
    low, high = chi2.ppf([0.0005, 0.9995], number)
    assert low < total < 1.5 * high


def test_poses_are_listed_with_what_became_of_them(world):
    poses = world.calibrated.calibration_poses
    assert poses.num_rows == 6 * POSES
    for row in world.calibrated.calibrations.to_pylist():
        used = [p for p in poses.to_pylist() if p["sensor_id"] == row["sensor_id"] and p["used"]]
        assert len(used) == row["n_poses_used"]
        assert all(p["reason"] is None and p["left_rms_px"] < 0.1 for p in used)


def test_a_sensor_without_enough_images_is_a_row_with_its_reason(world):
    blind = [
        (name, left, None) if k > 2 else (name, left, right) for k, (name, left, right) in enumerate(world.images[NAME])
    ]
    made = world.calibrate({NAME: blind})
    row = one(made.calibrations, sensor_id=NAME)
    assert (row["state"], row["n_poses_used"]) == ("refused", 0)
    assert "too few board poses" in row["reason"]
    reasons = [p["reason"] for p in made.calibration_poses.to_pylist()]
    assert reasons == ["calibration refused"] * 3 + ["the right image is missing"] * (POSES - 3)
    assert stereo_sensors(made.calibrations) == {}


def test_images_of_another_size_and_without_a_board_are_named(world):
    _, left, right = world.images[NAME][0]
    odd = [("000", left[:-2], right), ("001", left, np.full_like(right, 90)), *world.images[NAME][2:]]
    made = world.calibrate({NAME: odd})
    assert f"{ROWS - 2} pixels, the rig says" in one(made.calibration_poses, pose="000")["reason"]
    assert one(made.calibration_poses, pose="001")["reason"] == "the board was not found in the right image"
    assert one(made.calibrations, sensor_id=NAME)["n_poses_used"] == POSES - 2


def test_sixteen_bit_images_give_the_same_calibration(world):
    deep = [
        (name, left.astype(np.uint16) << 8, right.astype(np.uint16) << 8) for name, left, right in world.images[NAME]
    ]
    found = one(world.calibrate({NAME: deep}).calibrations, sensor_id=NAME)
    assert found == one(world.calibrated.calibrations, sensor_id=NAME)


def test_a_sensor_that_the_rig_does_not_have_is_refused(world):
    made = world.calibrate({"unknown": []})
    assert "has no sensor unknown" in one(made.calibrations, sensor_id="unknown")["reason"]


@pytest.mark.parametrize(
    ("board", "message"),
    [
        ({"type": "charuco"}, r"board\.marker_mm"),
        ({"type": "charuco", "marker_mm": 1.0}, r"board\.dictionary"),
        ({"type": "charuco", "marker_mm": 1.0, "dictionary": "DICT_9X9"}, r"DICT_9X9.*DICT_5X5_100"),
        ({"type": "charuco", "marker_mm": 1e3, "dictionary": "DICT_5X5_100"}, r"marker_mm.*less than square_mm"),
    ],
)
def test_charuco_boards_that_are_not_fully_described_refuse_the_bundle(world, board, message):
    header = world.calibration.model_copy(update={"board": world.calibration.board.model_copy(update=board)})
    with pytest.raises(ScanUnusable, match=message):
        world.calibrate({NAME: world.images[NAME]}, header=header)


def test_corners_are_stored_with_the_residuals_that_the_figures_tell_of(world):
    corners = world.calibrated.calibration_corners
    columns, rows = world.calibration.board.inner_corners
    assert corners.num_rows == sum(
        2 * columns * rows * row["n_poses_used"] for row in world.calibrated.calibrations.to_pylist()
    )
    row = one(world.calibrated.calibrations, sensor_id=NAME)
    mine = [c for c in corners.to_pylist() if c["sensor_id"] == NAME]
    squares = [c["residual_u_px"] ** 2 + c["residual_v_px"] ** 2 for c in mine]
    assert np.sqrt(np.mean(squares)) == pytest.approx(row["stereo_rms_px"], rel=1e-9)


def test_cameras_come_back_from_their_table(world):
    sensors = stereo_sensors(world.calibrated.calibrations)
    assert set(sensors) == set(world.ids)
    row = one(world.calibrated.calibrations, sensor_id=NAME)
    sensor = sensors[NAME]
    assert [sensor.left.matrix[0, 0], sensor.left.matrix[1, 1], *sensor.left.matrix[:2, 2]] == row["left_camera"]
    assert sensor.right.distortion.tolist() == row["right_distortion"]
    assert rigid.transform(sensor.rotation, sensor.translation_mm).ravel().tolist() == row["right_from_left"]


# --- stage 2


@pytest.fixture(scope="module")
def clean(world):
    """A scan of the master without any noise."""
    return world.scan(world.master, 50, noise=NoiseModel.none(), frames=12)


@pytest.mark.parametrize("method", ["disparity", "least_squares"])
def test_points_of_a_noiseless_scan_lie_on_the_true_profile(world, method):
    """With the true cameras and poses: profile, diameter and temperatures of both to a micrometre, at 256 rows."""
    round_ = tuple(replace(w, radial=type(w.radial)(), axial=type(w.axial)()) for w in world.master.wheels)
    master = replace(world.master, wheels=round_)
    conditions = Conditions(23.0, 26.0, 23.0, 26.0, 0.3, (0.0, 0.0), 0.0, 0.0)
    scan = world.scan(master, 52, conditions=conditions, noise=NoiseModel.none(), frames=3)
    for name in ("left_wheel_inner", "left_wheel_outer"):
        stripes = {name: scan.tables.stripes[name]}
        cloud = world.triangulate(
            scan, stripes=stripes, calibrations=world.true_calibrations(), method=method
        ).triangulated_clouds
        points = np.column_stack([cloud[f"{axis}_mm"].to_numpy() for axis in "xyz"]).astype(float)
        pose = world.true.sensor(name).rig_from_sensor_at(23.0, world.true.expansion_per_k)
        x, y, z = rigid.apply(pose, points).T
        growth = 1 + 11.5e-6 * 6
        lateral = (0.3 - x) / growth - master.inner_distance_mm / 2 + master.offset_mm
        height = np.hypot(y, z) / growth - master.wheels[0].diameter_mm / 2
        # From the flange's root outwards; there the stripe bends most and linear interpolation shows.
        seen = (lateral > 42) & (lateral < 128)
        error = height - nominal_height(PROFILES["S1002"], lateral - 70)
        assert seen.sum() > 100
        assert np.abs(error[seen]).max() < 1e-3
        assert np.abs(error[seen]).mean() < 2e-4


def test_both_methods_store_the_same_points(world, clean):
    clouds = [world.triangulate(clean, method=m).triangulated_clouds for m in ("disparity", "least_squares")]
    assert (
        clouds[0]
        .select(["sensor_id", "line", "frame", "row"])
        .equals(clouds[1].select(["sensor_id", "line", "frame", "row"]))
    )
    for axis in "xyz":
        a, b = (c[f"{axis}_mm"].to_numpy() for c in clouds)
        assert np.abs(a - b).max() <= 2 * GRID_MM  # nanometres apart, rounded to 0.12 um


def test_uncertainty_of_a_point_is_the_scatter_of_its_noise(world):
    """Scans of a still wheelset: the spread along the line of sight against u_depth_um, two-sided."""
    noise = replace(NoiseModel.none(), white_px=0.05)
    round_master = replace(
        world.master,
        wheels=tuple(replace(w, radial=type(w.radial)(), axial=type(w.axial)()) for w in world.master.wheels),
    )
    scan = world.scan(round_master, 51, noise=noise, frames=60)
    made = world.triangulate(scan, stripes={NAME: scan.tables.stripes[NAME]})
    cloud = made.triangulated_clouds
    row, frame = cloud["row"].to_numpy(), cloud["frame"].to_numpy()
    grid = np.full((60, ROWS, 4), np.nan)
    grid[frame, row] = np.column_stack([*(cloud[f"{a}_mm"].to_numpy() for a in "xyz"), cloud["u_depth_um"].to_numpy()])
    full = np.isfinite(grid[..., 0]).all(axis=0)
    depth = np.linalg.norm(grid[:, full, :3], axis=2)
    claimed = np.nanmean(grid[:, full, 3], axis=0) * 1e-3
    share = depth.var(axis=0, ddof=1) / claimed**2
    assert full.sum() > 100
    assert np.mean(share) == pytest.approx(1.0, abs=0.12)
    found = one(made.stripe_statistics, sensor_id=NAME)
    assert found["centre_noise_px"] == pytest.approx(0.05, rel=0.05)
    assert found["noise_correlation_rows"] == pytest.approx(1.0, abs=0.15)


def test_statistics_count_frames_centres_and_points(world, product):
    for name in world.ids:
        row = one(product.tables.stripe_statistics, sensor_id=name)
        (stripe,) = product.tables.stripes[name]
        assert row["n_frames"] == FRAMES
        width = world.true.sensor(name).image_size[0]
        assert row["n_centres_left"] == ((stripe.left_u_px >= -0.5) & (stripe.left_u_px <= width - 0.5)).sum()
        assert row["n_points"] == (np.array(product.tables.triangulated_clouds["sensor_id"].to_pylist()) == name).sum()
        assert 0.8 < row["n_points"] / row["n_centres_left"] <= 1


def test_the_laser_planes_are_the_true_ones(world, product):
    """With the true cameras, from noisy stripes: to hundredths of a millimetre and of a degree."""
    for name in world.ids:
        stripes = {name: product.tables.stripes[name]}
        made = world.triangulate(product, stripes=stripes, calibrations=world.true_calibrations())
        row = one(made.stripe_statistics, sensor_id=name, line=0)
        true = world.true.sensor(name).planes[0]
        found, normal = np.array(row["plane_normal"]), np.array(true.normal)
        assert np.linalg.norm(np.cross(found, normal)) < np.radians(0.05)
        assert abs(np.array(row["plane_centre_mm"]) @ normal - true.offset_mm) < 0.03
        assert row["n_off_plane"] < 0.02 * row["n_points"]


def test_mismatches_off_the_plane_are_left_out_and_counted(world, clean):
    (stripe,) = clean.tables.stripes[NAME]
    wrong = stripe.right_u_px.copy()
    random = np.random.default_rng(3)
    frame, row = random.integers(0, len(wrong), 60), random.integers(0, ROWS, 60)
    wrong[frame, row] += 3.5  # under the step that breaks a stripe
    made = world.triangulate(clean, stripes={NAME: [replace(stripe, right_u_px=wrong)]})
    whole = world.triangulate(clean, stripes={NAME: [stripe]})
    assert one(whole.stripe_statistics, sensor_id=NAME)["n_off_plane"] == 0
    counted = one(made.stripe_statistics, sensor_id=NAME)["n_off_plane"]
    assert 0 < counted <= 120
    lost = whole.triangulated_clouds.num_rows - made.triangulated_clouds.num_rows
    assert lost >= counted


def test_frames_of_other_instants_or_damaged_are_left_out_and_counted_and_no_others(world, product):
    for name in world.ids:
        row = one(product.tables.stripe_statistics, sensor_id=name)
        assert row["n_frames_out_of_step"] == 0
        assert 0.6 < row["frame_pull"] < 1.5
    (stripe,) = product.tables.stripes[NAME]
    rolled = replace(stripe, left_u_px=np.roll(stripe.left_u_px, FRAMES // 2, axis=0))
    late = one(world.triangulate(product, stripes={NAME: [rolled]}).stripe_statistics, sensor_id=NAME)
    good = one(product.tables.stripe_statistics, sensor_id=NAME)
    assert late["frame_pull"] > 1.4 * good["frame_pull"]
    damaged = stripe.right_u_px.copy()
    damaged[[4, 9, 31]] -= 0.2
    made = world.triangulate(product, stripes={NAME: [replace(stripe, right_u_px=damaged)]})
    assert one(made.stripe_statistics, sensor_id=NAME)["n_frames_out_of_step"] == 3
    assert set(range(FRAMES)) - set(made.triangulated_clouds["frame"].to_pylist()) == {4, 9, 31}


def test_frames_keep_their_numbers_when_some_are_missing(world, product):
    (stripe,) = product.tables.stripes[NAME]
    kept = np.array([3, 7, 8, 20, 41])
    part = StripeTable(0, kept.astype(np.int32), stripe.left_u_px[kept], stripe.right_u_px[kept])
    cloud = world.triangulate(product, stripes={NAME: [part]}).triangulated_clouds
    assert sorted(set(cloud["frame"].to_pylist())) == kept.tolist()


def test_one_centre_far_outside_the_image_refuses_nothing(world, product):
    (stripe,) = product.tables.stripes[NAME]
    wild = stripe.left_u_px.copy()
    wild[4, 100], wild[5, 120] = 80_000.0, -5_000.0
    made = world.triangulate(product, stripes={NAME: [replace(stripe, left_u_px=wild)]})
    whole = world.triangulate(product, stripes={NAME: [stripe]})
    assert whole.triangulated_clouds.num_rows - made.triangulated_clouds.num_rows <= 2


def test_a_sensor_without_calibration_is_counted_and_the_others_measured(world, product):
    partly = world.calibrated.calibrations.filter(
        pa.compute.not_equal(world.calibrated.calibrations["sensor_id"].cast(pa.string()), NAME)
    )
    two = {k: product.tables.stripes[k] for k in (NAME, "left_journal")}
    made = world.triangulate(product, stripes=two, calibrations=partly)
    assert one(made.stripe_statistics, sensor_id=NAME)["n_points"] == 0
    assert set(made.triangulated_clouds["sensor_id"].to_pylist()) == {"left_journal"}


def test_refusals_of_a_whole_scan_name_their_reason(world, product):
    stripes = {NAME: product.tables.stripes[NAME]}
    with pytest.raises(AlgorithmFailed, match="the calibration has no sensor"):
        world.triangulate(product, calibrations=world.calibrated.calibrations.slice(0, 0))
    other = SimpleNamespace(header=product.header.model_copy(update={"rig_id": "other"}), tables=product.tables)
    with pytest.raises(AlgorithmFailed, match="is of rig bench-1, the scan of rig other"):
        world.triangulate(other, stripes=stripes)
    with pytest.raises(AlgorithmFailed, match="too old"):
        world.triangulate(product, stripes=stripes, refuse_calibration_age_days=5.0)
    refused = world.calibrate({NAME: []}).calibrations
    with pytest.raises(AlgorithmFailed, match=f"{NAME}: too few board poses"):
        world.triangulate(product, stripes=stripes, calibrations=refused)
    (stripe,) = stripes[NAME]
    empty = replace(stripe, left_u_px=stripe.left_u_px * np.nan)
    with pytest.raises(AlgorithmFailed, match="no point could be triangulated: the stripes are empty"):
        world.triangulate(product, stripes={NAME: [empty]})


# --- raw images


def images_of(lines, size, seed=0, sigma=1.6):
    """Blocks of rendered frames (left, right) of some laser lines."""
    sides = []
    for k, side in enumerate(("left_u_px", "right_u_px")):
        random = np.random.default_rng([seed, k])
        sides.append(np.stack(list(render_frames([getattr(line, side) for line in lines], size, sigma, random))))
    numbers = np.arange(len(sides[0]), dtype=np.int32)

    def blocks():
        for part in np.array_split(numbers, 3):
            yield part, sides[0][part], sides[1][part]

    return StripeImages(len(lines), blocks)


def test_raw_images_give_the_points_of_their_stripes(world, clean):
    """Rendered frames, centres of gravity: points within some hundredths of a pixel of those from exact centres."""
    (stripe,) = clean.tables.stripes[NAME]
    size = world.true.sensor(NAME).image_size
    clouds = {}
    for kind, loaded in (("exact", [stripe]), ("images", images_of([stripe], size))):
        cloud = world.triangulate(clean, stripes={NAME: loaded}).triangulated_clouds
        grid = np.full((12, ROWS), np.nan)
        grid[cloud["frame"].to_numpy(), cloud["row"].to_numpy()] = cloud["z_mm"].to_numpy()
        clouds[kind] = grid
    both = np.isfinite(clouds["exact"]) & np.isfinite(clouds["images"])
    assert both.sum() > 0.9 * np.isfinite(clouds["exact"]).sum()
    difference = (clouds["images"] - clouds["exact"])[both]
    # At f = 500 px a pixel is 1.0 mm of depth here; 0.03 px of grey noise and slanting stripes.
    assert np.median(np.abs(difference)) < 0.05
    assert abs(np.median(difference)) < 0.01


def test_two_lines_in_one_image_are_told_apart(world, clean):
    """Two stripes 25 px apart; line 0 is the one of smaller u, also where only one of them is seen."""
    (stripe,) = clean.tables.stripes[NAME]
    shift = 25.0
    second = StripeTable(1, stripe.frame, stripe.left_u_px + shift, stripe.right_u_px + shift)
    hidden = StripeTable(0, stripe.frame, stripe.left_u_px.copy(), stripe.right_u_px.copy())
    gone = np.zeros(ROWS, bool)
    gone[100:130] = True
    hidden.left_u_px[:, gone], hidden.right_u_px[:, gone] = np.nan, np.nan
    size = (world.true.sensor(NAME).image_size[0] + 40, ROWS)
    made = world.triangulate(clean, stripes={NAME: images_of([hidden, second], size)})
    cloud = made.triangulated_clouds
    line, row = cloud["line"].to_numpy(), cloud["row"].to_numpy()
    assert set(line) == {0, 1}
    alone = np.isin(row, np.flatnonzero(gone)[3:-3])
    assert (line[alone] == 1).mean() > 0.98


# --- stored numbers


def test_stored_coordinates_are_rounded_to_an_eighth_of_a_micrometre():
    values = np.random.default_rng(0).uniform(-400, 400, 1000)
    stored = quantised(values)
    assert stored.dtype == np.float32
    assert np.abs(stored - values).max() <= GRID_MM / 2 + 400 * 2.0**-24
    assert np.array_equal(stored / GRID_MM, np.rint(stored / GRID_MM))


def test_stored_uncertainties_are_never_zero():
    assert rounded_um(np.array([0.0, 0.1, 0.3, 12.13])).tolist() == [0.25, 0.25, 0.25, 12.25]
