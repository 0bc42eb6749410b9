"""Stages 1 and 2, between tables and arrays: calibration of the sensors, and triangulation of their stripes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from wheelset_assets import tables
from wheelset_assets.config import CalibrationConfig, TriangulationConfig
from wheelset_assets.metrology import rigid
from wheelset_assets.metrology import triangulation as tri
from wheelset_assets.metrology.adjustment import BoardPose
from wheelset_assets.metrology.boards import CalibrationBoard, pair_order, see_board
from wheelset_assets.metrology.calibration import StereoCalibration, calibrate_stereo
from wheelset_assets.metrology.epipolar import EpipolarResidual, epipolar_residual
from wheelset_assets.metrology.laser_plane import LaserPlane, fit_laser_plane, off_plane
from wheelset_assets.metrology.stripe_noise import stripe_noise
from wheelset_assets.metrology.stripes import extract_centres, second_line, tell_lines_apart
from wheelset_assets.metrology.synchrony import frame_offsets
from wheelset_assets.quality import AlgorithmFailed, ConfigError, ScanUnusable
from wheelset_assets.stages.raw import Boards, Rig, ScanHeader, StripeImages, Stripes, StripeTable

GRID_MM = 2.0**-13
"""Stored coordinates are rounded to 0.12 um: far below the noise, and their zero bits compress away."""


IN_STEP: dict[str, Any] = {"n_frames_out_of_step": 0, "frame_scatter_um": None, "frame_pull": None}
"""What is said of a sensor's frames where nothing is known of them."""


def run_calibrations(*, boards: Boards, rig: Rig, config: CalibrationConfig) -> Mapping[str, pa.Table]:
    """Stage 1: one row a sensor; a sensor that cannot be calibrated is a row with its reason."""
    rows, pose_rows, corner_rows = [], [], [tables.CALIBRATION_CORNERS.empty()]
    header = boards.header
    board = _board(boards)
    sizes = {sensor.sensor_id: sensor.image_size for sensor in rig.sensors}
    for sensor_id in boards.sensor_ids:
        size = sizes.get(sensor_id, (1, 1))
        poses = _poses(boards, board, sensor_id, size, config)
        base = {
            "calibration_id": header.calibration_id,
            "rig_id": header.rig_id,
            "sensor_id": sensor_id,
            "captured_at": header.captured_at,
            "valid_from": header.valid_from,
            "valid_until": header.valid_until,
            "rig_temperature_c": header.temperature_c.rig,
            "image_width_px": size[0],
            "image_height_px": size[1],
            "n_poses": len(poses),
        }
        try:
            if sensor_id not in sizes:
                raise AlgorithmFailed(f"rig {rig.rig_id} has no sensor {sensor_id}")
            found = calibrate_stereo(
                poses,
                board.points_mm,
                size,
                min_poses=config.min_poses,
                min_tilt_deg=config.min_tilt_deg,
                max_tilt_deg=config.max_tilt_deg,
                max_pose_rms_ratio=config.max_pose_rms_ratio,
            )
            if found.stereo_rms_px > config.max_rms_px:
                raise AlgorithmFailed(
                    "the boards do not fit any lens model",
                    stereo_rms_px=found.stereo_rms_px,
                    limit_px=config.max_rms_px,
                )
            rows.append(base | calibration_row(found))
            reports = [vars(p) for p in found.poses]
            corner_rows.append(_corners(header.calibration_id, sensor_id, poses, found))
        except AlgorithmFailed as failure:
            rows.append(base | _refused_row(str(failure)))
            reports = [
                {
                    "name": p.name,
                    "used": False,
                    "reason": p.reason or "calibration refused",
                    "left_rms_px": None,
                    "right_rms_px": None,
                    "holdout_rms_px": None,
                    "tilt_deg": None,
                    "distance_mm": None,
                }
                for p in poses
            ]
        for report in reports:
            pose_rows.append(
                {
                    "calibration_id": header.calibration_id,
                    "sensor_id": sensor_id,
                    "pose": report["name"],
                    **{k: v for k, v in report.items() if k != "name"},
                }
            )
    return {
        "calibrations": tables.CALIBRATIONS.from_rows(rows),
        "calibration_poses": tables.CALIBRATION_POSES.from_rows(pose_rows),
        "calibration_corners": pa.concat_tables(corner_rows).unify_dictionaries().combine_chunks(),
    }


def _board(boards: Boards) -> CalibrationBoard:
    declared = boards.header.board
    charuco = declared.type == "charuco"
    if charuco and (declared.marker_mm is None or declared.dictionary is None):
        missing = "marker_mm" if declared.marker_mm is None else "dictionary"
        raise ScanUnusable(f"calibration.json: key board.{missing}: a ChArUco board needs it; it is missing")
    try:
        return CalibrationBoard(
            declared.inner_corners,
            declared.square_mm,
            declared.marker_mm if charuco else None,
            declared.dictionary if charuco else None,
            declared.legacy_pattern,
        )
    except ConfigError as error:
        raise ScanUnusable(f"calibration.json: key board: {error}") from error


def _poses(
    boards: Boards, board: CalibrationBoard, sensor_id: str, size: tuple[int, int], config: CalibrationConfig
) -> list[BoardPose]:
    poses = []
    for name, left, right in boards.load(sensor_id):
        found: list[np.ndarray | None] = []
        reason = None
        for side, image in (("left", left), ("right", right)):
            px = why = None
            if image is None:
                why = f"the {side} image is missing"
            elif (image.shape[1], image.shape[0]) != size:
                why = f"the {side} image has {image.shape[1]} x {image.shape[0]} pixels, the rig says {size[0]} x {size[1]}"
            else:
                seen = see_board(
                    image,
                    board,
                    max_blur_ratio=config.max_blur_ratio,
                    max_saturated_ratio=config.max_saturated_ratio,
                )
                px, why = seen.px, f"{seen.reason} in the {side} image" if seen.reason else None
            found.append(px)
            reason = reason or why
        left_px, right_px = found
        if left_px is not None and right_px is not None:
            right_px = pair_order(left_px, right_px, board)
        poses.append(BoardPose(name, left_px, right_px, reason))
    return poses


def _corners(calibration_id: str, sensor_id: str, poses: list[BoardPose], found: StereoCalibration) -> pa.Table:
    """Corners of the poses that were used, with their residuals: projection less observation."""
    used = [pose for pose, report in zip(poses, found.poses, strict=True) if report.used]
    residuals = found.adjustment.residuals_px
    observed = np.stack([np.stack([np.asarray(p.left_px), np.asarray(p.right_px)]) for p in used])
    pose, camera, corner = np.nonzero(np.isfinite(residuals).all(axis=3))
    columns = {
        "calibration_id": np.full(len(pose), calibration_id, object),
        "sensor_id": np.full(len(pose), sensor_id, object),
        "pose": np.array([p.name for p in used], object)[pose],
        "camera": np.array(["left", "right"], object)[camera],
        "corner": corner.astype(np.int32),
    }
    for i, axis in enumerate("uv"):
        columns[f"{axis}_px"] = observed[pose, camera, corner, i]
        columns[f"residual_{axis}_px"] = residuals[pose, camera, corner, i]
    return tables.CALIBRATION_CORNERS.from_columns(columns)


def calibration_row(found: StereoCalibration) -> dict[str, Any]:
    """Columns of `calibrations` that a fit fills."""
    sensor = found.adjustment.sensor
    camera = lambda c: [c.matrix[0, 0], c.matrix[1, 1], c.matrix[0, 2], c.matrix[1, 2]]  # noqa: E731
    right_from_left = rigid.transform(sensor.rotation, sensor.translation_mm)
    return {
        "state": "usable",
        "reason": None,
        "n_poses_used": sum(p.used for p in found.poses),
        "left_rms_px": found.left_rms_px,
        "right_rms_px": found.right_rms_px,
        "stereo_rms_px": found.stereo_rms_px,
        "holdout_rms_px": _number(found.holdout_rms_px),
        "epipolar_rms_px": _number(found.epipolar_rms_px),
        "baseline_mm": float(np.linalg.norm(sensor.translation_mm)),
        "distortion_model": found.adjustment.model,
        "left_camera": camera(sensor.left),
        "left_distortion": list(sensor.left.distortion),
        "right_camera": camera(sensor.right),
        "right_distortion": list(sensor.right.distortion),
        "right_from_left": list(right_from_left.ravel()),
        "parameter_names": list(found.adjustment.parameter_names),
        "covariance": list(found.adjustment.covariance.ravel()),
        "depth_range_mm": list(found.depth_range_mm),
        "coverage_ratio": found.coverage_ratio,
        "right_coverage_ratio": found.right_coverage_ratio,
        "rival_model": found.rival_model,
        "rival_holdout_rms_px": _number(found.rival_holdout_rms_px),
        "square_edge_mean_mm": _number(found.square_edge_mm[0]),
        "square_edge_standard_deviation_mm": _number(found.square_edge_mm[1]),
        "max_tilt_deg": found.max_tilt_deg,
    }


def _number(value: float | None) -> float | None:
    return None if value is None or np.isnan(value) else float(value)


def _refused_row(reason: str) -> dict[str, Any]:
    written = {
        "calibration_id",
        "rig_id",
        "sensor_id",
        "captured_at",
        "valid_from",
        "valid_until",
        "rig_temperature_c",
        "image_width_px",
        "image_height_px",
        "n_poses",
    }
    empty = {column.name: None for column in tables.CALIBRATIONS.columns if column.name not in written}
    return empty | {"state": "refused", "reason": reason, "n_poses_used": 0}


def stereo_sensors(calibrations: pa.Table) -> dict[str, tri.StereoSensor]:
    """Usable sensors of a table of calibrations, by sensor_id."""
    sensors = {}
    for row in calibrations.to_pylist():
        if row["state"] == "usable":
            cameras = []
            for side in ("left", "right"):
                fx, fy, cx, cy = row[f"{side}_camera"]
                cameras.append(
                    tri.Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(row[f"{side}_distortion"]))
                )
            pose = np.array(row["right_from_left"]).reshape(4, 4)
            sensors[row["sensor_id"]] = tri.StereoSensor(cameras[0], cameras[1], pose[:3, :3], pose[:3, 3])
    return sensors


def parameter_covariances(calibrations: pa.Table) -> dict[str, tuple[tri.StereoSensor, tuple[str, ...], np.ndarray]]:
    """Usable sensors, with the names of their parameters and the covariance of these, by sensor_id."""
    sensors, found = stereo_sensors(calibrations), {}
    for row in calibrations.to_pylist():
        if row["sensor_id"] in sensors:
            names = tuple(row["parameter_names"])
            covariance = np.array(row["covariance"]).reshape(len(names), len(names))
            found[row["sensor_id"]] = (sensors[row["sensor_id"]], names, covariance)
    return found


def run_triangulated_clouds(
    *, stripes: Stripes, calibrations: pa.Table, scan: ScanHeader, config: TriangulationConfig
) -> Mapping[str, pa.Table]:
    """Stage 2: points of every sensor that has stripes and a usable calibration."""
    _check_calibration(calibrations, scan, config)
    sensors = stereo_sensors(calibrations)
    reasons = {
        row["sensor_id"]: row["reason"] for row in calibrations.select(["sensor_id", "state", "reason"]).to_pylist()
    }
    sizes = {
        row["sensor_id"]: (row["image_width_px"], row["image_height_px"])
        for row in calibrations.select(["sensor_id", "image_width_px", "image_height_px"]).to_pylist()
    }
    clouds, statistics = [], []
    for sensor_id in stripes.sensor_ids:
        if sensor_id not in sensors:
            statistics.append(
                _statistics(sensor_id, 0, None, None, None, None, 0)
                | _plane_row(None, 0)
                | _epipolar_row(None, 1.0)
                | IN_STEP
            )
            continue
        rectification = tri.rectify(sensors[sensor_id])
        for stripe in _centres(stripes.load(sensor_id), config):
            cloud, row = _triangulate(
                sensor_id, sensors[sensor_id], rectification, stripe, sizes.get(sensor_id), config
            )
            clouds.append(cloud)
            statistics.append(row)
    cloud = (
        pa.concat_tables(clouds).unify_dictionaries().combine_chunks() if clouds else tables.TRIANGULATED_CLOUDS.empty()
    )
    if cloud.num_rows == 0:
        refused = [f"{s}: {reasons.get(s) or 'not in the calibration'}" for s in stripes.sensor_ids if s not in sensors]
        raise AlgorithmFailed(
            "no point could be triangulated: "
            + ("; ".join(refused) if refused else "the stripes are empty or do not match")
        )
    return {
        "triangulated_clouds": cloud,
        "stripe_statistics": tables.STRIPE_STATISTICS.from_rows([{"scan_id": "", **row} for row in statistics]),
    }


def _check_calibration(calibrations: pa.Table, scan: ScanHeader, config: TriangulationConfig) -> None:
    """Raises AlgorithmFailed if the calibration is not this rig's or too old to be believed."""
    if calibrations.num_rows == 0:
        raise AlgorithmFailed("the calibration has no sensor")
    first = calibrations.select(["calibration_id", "rig_id", "captured_at"]).slice(0, 1).to_pylist()[0]
    if first["rig_id"] != scan.rig_id:
        raise AlgorithmFailed(
            f"calibration {first['calibration_id']} is of rig {first['rig_id']}, the scan of rig {scan.rig_id}"
        )
    age_days = (scan.captured_at - first["captured_at"]).total_seconds() / 86400.0
    if age_days > config.refuse_calibration_age_days:
        raise AlgorithmFailed(
            f"calibration {first['calibration_id']} is too old",
            age_days=round(age_days, 1),
            limit_days=config.refuse_calibration_age_days,
        )


def _centres(loaded: list[StripeTable] | StripeImages, config: TriangulationConfig) -> list[StripeTable]:
    """Stripe tables as delivered, or extracted from images block by block."""
    if isinstance(loaded, list):
        return loaded
    found: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {line: [] for line in range(loaded.laser_lines)}
    how = (config.stripe_method, config.stripe_min_contrast, config.stripe_window_px)
    for frame, left, right in loaded.blocks():
        sides = []
        for images in (left, right):
            first = extract_centres(images, *how)
            lines = [first.u_px]
            if loaded.laser_lines == 2:
                other = extract_centres(second_line(images, first, config.stripe_window_px), *how)
                lines = list(tell_lines_apart(first.u_px, other.u_px))
            sides.append(lines)
        for line in found:
            found[line].append((frame, sides[0][line], sides[1][line]))
    return [
        StripeTable(
            line,
            np.concatenate([b[0] for b in blocks]),
            np.concatenate([b[1] for b in blocks]),
            np.concatenate([b[2] for b in blocks]),
        )
        for line, blocks in found.items()
        if blocks
    ]


def _triangulate(
    sensor_id: str,
    sensor: tri.StereoSensor,
    rectification: tri.Rectification,
    stripe: StripeTable,
    sensor_size: tuple[int, int] | None,
    config: TriangulationConfig,
) -> tuple[pa.Table, dict[str, Any]]:
    noise = [stripe_noise(u) for u in (stripe.left_u_px, stripe.right_u_px)]
    known = [n for n in noise if n is not None]
    sigma = float(np.sqrt(np.mean([n.sigma_px**2 for n in known]))) if known else float("nan")
    length = float(np.mean([n.correlation_rows for n in known])) if known else None
    neighbour = float(np.mean([n.neighbour_correlation for n in known])) if known else 0.0
    # Without repeats to estimate the noise from, a tenth of a pixel is assumed rather than nothing claimed.
    shared_px = sigma if np.isfinite(sigma) and sigma > 0 else 0.1
    own_px = [n.sigma_px if n is not None and n.sigma_px > 0 else shared_px for n in noise]
    scales = tri.rectified_scales(sensor, rectification, stripe.left_u_px, stripe.right_u_px)
    u_left, u_right = (px * scale for px, scale in zip(own_px, scales, strict=True))
    matched = tri.match_stripes(sensor, rectification, stripe.left_u_px, stripe.right_u_px, config.max_step_px)
    if config.method == "least_squares":
        points = tri.triangulate_least_squares(sensor, rectification, matched)
    else:
        points = tri.triangulate_disparity(rectification, matched)
    with np.errstate(invalid="ignore"):
        good = (
            np.isfinite(points[..., 2])
            & (points[..., 2] > config.min_depth_mm)
            & (points[..., 2] < config.max_depth_mm)
        )
    u_mm = tri.depth_uncertainty(rectification, matched, u_left, u_right, neighbour)
    plane = fit_laser_plane(points[good])
    n_off_plane, in_step = 0, IN_STEP
    if plane is not None:
        seen_with = (rectification, matched, u_left, u_right, plane.normal)
        across_mm = tri.off_plane_uncertainty(*seen_with, neighbour)
        wrong = off_plane(plane, points[good], across_mm[good], config.mismatch_sigmas, config.mismatch_floor_mm)
        n_off_plane = int(wrong.sum())
        good[good] = ~wrong
        # A frame's mean keeps what rows share: to it, the mean of two neighbouring rows is as noisy as one.
        across_mm = tri.off_plane_uncertainty(*seen_with, 1.0)
        late, in_step = _frames_out_of_step(plane, points, good, across_mm, length or 1.0, config)
        good[late] = False
        if config.method == "optimal":
            fifth = (plane.normal, plane.distance_mm, max(plane.rms_mm, 1e-3))
            points = tri.triangulate_optimal(rectification, matched, u_left, u_right, fifth, neighbour)
    frame_index, row = np.nonzero(good)
    xyz = points[good]
    cloud = tables.TRIANGULATED_CLOUDS.from_columns(
        {
            "sensor_id": pa.DictionaryArray.from_arrays(np.zeros(len(row), np.int32), [sensor_id]),
            "line": np.full(len(row), stripe.line, np.int8),
            "frame": stripe.frame[frame_index],
            "row": row.astype(np.int16),
            **{f"{axis}_mm": quantised(xyz[:, i]) for i, axis in enumerate("xyz")},
            "u_depth_um": rounded_um(u_mm[good] * 1e3),
        }
    )
    statistics = _statistics(sensor_id, stripe.line, stripe, sensor_size, sigma if known else None, length, len(row))
    residual = epipolar_residual(matched, good) if plane is not None else None
    focal_px = float(sensor.right.matrix[1, 1])
    statistics |= _plane_row(plane, n_off_plane) | _epipolar_row(residual, focal_px)
    return cloud, statistics | in_step


def _frames_out_of_step(
    plane: LaserPlane,
    points: np.ndarray,
    good: np.ndarray,
    u_across_mm: np.ndarray,
    correlation_rows: float,
    config: TriangulationConfig,
) -> tuple[np.ndarray, dict[str, Any]]:
    """Frames (frames,) whose two cameras did not see the same instant: their rays meet off the laser plane, all alike.

    And what is said of them in the statistics.
    """
    found = frame_offsets(plane, points, good, u_across_mm, correlation_rows)
    if found is None:
        return np.zeros(len(points), bool), IN_STEP
    late = found.off(config.out_of_step_sigmas, config.out_of_step_floor_um * 1e-3)
    said = {"n_frames_out_of_step": int(late.sum())}
    if (scatter := found.scatter()) is None:
        return late, IN_STEP | said
    return late, said | {"frame_scatter_um": 1e3 * scatter[0], "frame_pull": scatter[1]}


def _plane_row(plane: LaserPlane | None, n_off_plane: int) -> dict[str, Any]:
    if plane is None:
        empty = ("normal", "distance_mm", "centre_mm", "extent_mm", "direction", "rms_um")
        return {f"plane_{name}": None for name in empty} | {"n_off_plane": 0}
    return {
        "plane_normal": plane.normal.tolist(),
        "plane_distance_mm": plane.distance_mm,
        "plane_centre_mm": plane.centre_mm.tolist(),
        "plane_extent_mm": list(plane.extent_mm),
        "plane_direction": plane.direction.tolist(),
        "plane_rms_um": plane.rms_mm * 1e3,
        "n_off_plane": n_off_plane,
    }


def _epipolar_row(found: EpipolarResidual | None, focal_px: float) -> dict[str, float | None]:
    return {
        "epipolar_residual_px": found.offset * focal_px if found else None,
        "u_epipolar_residual_px": found.u_offset * focal_px if found else None,
    }


def quantised(values_mm: np.ndarray) -> np.ndarray:
    """Coordinates as float32, rounded to GRID_MM."""
    return (np.rint(values_mm / GRID_MM) * GRID_MM).astype(np.float32)


def rounded_um(values_um: np.ndarray) -> np.ndarray:
    """Uncertainties as float32, rounded to 1/4 um: they are known to a few per cent at best."""
    return (np.maximum(np.rint(values_um * 4), 1) / 4).astype(np.float32)


def _statistics(
    sensor_id: str,
    line: int,
    stripe: StripeTable | None,
    size: tuple[int, int] | None,
    sigma: float | None,
    length: float | None,
    n_points: int,
) -> dict[str, Any]:
    inside = (
        [_inside(u, size) for u in (stripe.left_u_px, stripe.right_u_px)] if stripe else [np.zeros((0, 0), bool)] * 2
    )
    return {
        "sensor_id": sensor_id,
        "line": line,
        "n_frames": int(inside[0].any(axis=1).sum()) if inside[0].size else 0,
        "n_centres_left": int(inside[0].sum()),
        "n_centres_right": int(inside[1].sum()),
        "n_points": n_points,
        "centre_noise_px": sigma,
        "noise_correlation_rows": length,
    }


def _inside(u_px: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """Which centres (frames, rows) were seen inside the image."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(u_px) if size is None else (u_px >= -0.5) & (u_px <= size[0] - 0.5)
