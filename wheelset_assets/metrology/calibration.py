"""Stereo calibration from board corners: choice of poses and of the lens model, and the figures that judge the result.

OpenCV finds starting values; the adjustment is ours (`adjustment`), because it must give the covariance of all
parameters together. Boards are found in images by `boards`. No files are read here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.adjustment import (
    LENS_MODELS,
    Adjustment,
    BoardPose,
    Start,
    adjust,
    fit_boards,
    rotations_from_vectors,
)
from wheelset_assets.metrology.boards import board_points_mm, detect_corners, reconcile_order
from wheelset_assets.metrology.triangulation import Camera, StereoSensor
from wheelset_assets.quality import AlgorithmFailed

__all__ = [
    "LENS_MODELS",
    "Adjustment",
    "BoardPose",
    "PoseReport",
    "StereoCalibration",
    "board_points_mm",
    "calibrate_stereo",
    "detect_corners",
    "reconcile_order",
]

Array = NDArray[Any]

HOLDOUT_FOLDS = 12
SUSPECT_RATIO = 1.5
"""A pose whose residuals exceed the median pose's by this factor is judged by the fit over the others."""
HARM_SIGMAS = 3.0
FLOOR_PX = 0.02
"""Residuals below this are taken as equal: no pose stands out among perfect ones."""


@dataclass(frozen=True)
class PoseReport:
    """What became of one pose. `holdout_rms_px` is its RMS against a fit that did not use it."""

    name: str
    used: bool
    reason: str | None
    left_rms_px: float | None = None
    right_rms_px: float | None = None
    holdout_rms_px: float | None = None
    tilt_deg: float | None = None
    distance_mm: float | None = None


@dataclass(frozen=True)
class StereoCalibration:
    """A calibrated sensor with the figures by which it is judged."""

    adjustment: Adjustment
    poses: tuple[PoseReport, ...]
    left_rms_px: float
    right_rms_px: float
    stereo_rms_px: float
    holdout_rms_px: float
    epipolar_rms_px: float
    coverage_ratio: float
    right_coverage_ratio: float
    max_tilt_deg: float
    depth_range_mm: tuple[float, float] = field(default=(0.0, 0.0))
    square_edge_mm: tuple[float, float] = field(default=(float("nan"), float("nan")))
    """Mean and standard deviation of the squares' edges, triangulated corner by corner."""
    rival_model: str | None = None
    rival_holdout_rms_px: float | None = None
    """The lens model that the chosen one was tried against, and its hold-out RMS."""


def calibrate_stereo(
    poses: list[BoardPose],
    board_mm: Array,
    image_size: tuple[int, int],
    *,
    min_poses: int,
    min_tilt_deg: float,
    max_pose_rms_ratio: float,
    max_tilt_deg: float = 90.0,
    right_image_size: tuple[int, int] | None = None,
) -> StereoCalibration:
    """Joint calibration of two cameras over board poses; the lens model is chosen by evidence (`_choose_model`).

    board_mm (n, 3); image sizes (width, height) in px, of the right camera if it differs. Poses without corners in
    either camera are reported with their reason; a pose that is seen too obliquely or does not agree with the fit over
    the others is left out. Raises AlgorithmFailed if fewer than min_poses remain or no board is tilted by min_tilt_deg.
    """
    sizes = (image_size, right_image_size or image_size)
    usable = [pose for pose in poses if pose.left_px is not None and pose.right_px is not None]
    if len(usable) < min_poses:
        raise AlgorithmFailed("too few board poses seen by both cameras", found=len(usable), required=min_poses)
    reasons: dict[str, str] = {}
    start = _starting_values(usable, board_mm, sizes)
    usable, start = _without_oblique_poses(usable, start, max_tilt_deg, min_poses, reasons)
    usable, fits = _without_outlying_poses(usable, board_mm, start, min_poses, max_pose_rms_ratio, reasons)
    best, holdout, rival, rival_squares = _choose_model(usable, board_mm, fits, sizes)
    tilts, distances = _board_geometry(best, board_mm)
    if tilts.max() < min_tilt_deg:
        raise AlgorithmFailed(
            "no board is tilted enough to tell focal length from distance",
            max_tilt_deg=float(tilts.max()),
            required_deg=min_tilt_deg,
        )
    rms = _pose_rms(best)
    kept = {
        pose.name: PoseReport(
            pose.name,
            True,
            None,
            float(rms[i, 0]),
            float(rms[i, 1]),
            float(np.sqrt(holdout[i].mean())) if len(holdout[i]) else None,
            float(tilts[i]),
            float(distances[i]),
        )
        for i, pose in enumerate(usable)
    }
    reports = tuple(
        kept.get(pose.name) or PoseReport(pose.name, False, reasons.get(pose.name) or pose.reason or "not used")
        for pose in poses
    )
    squares = (best.residuals_px**2).sum(axis=3)
    depths = _board_depths(best, board_mm)
    every = np.concatenate(holdout)
    return StereoCalibration(
        best,
        reports,
        left_rms_px=float(np.sqrt(np.nanmean(squares[:, 0]))),
        right_rms_px=float(np.sqrt(np.nanmean(squares[:, 1]))),
        stereo_rms_px=float(np.sqrt(np.nanmean(squares))),
        holdout_rms_px=float(np.sqrt(every.mean())) if len(every) else float("nan"),
        epipolar_rms_px=_epipolar_rms(usable, best.sensor),
        coverage_ratio=_coverage(usable, "left_px", sizes[0]),
        right_coverage_ratio=_coverage(usable, "right_px", sizes[1]),
        max_tilt_deg=float(tilts.max()),
        depth_range_mm=(float(depths.min()), float(depths.max())),
        square_edge_mm=_square_edges(usable, board_mm, best.sensor),
        rival_model=rival.model if rival else None,
        rival_holdout_rms_px=float(np.sqrt(np.concatenate(rival_squares).mean())) if rival_squares else None,
    )


def _without_oblique_poses(
    poses: list[BoardPose], start: Start, max_tilt_deg: float, min_poses: int, reasons: dict[str, str]
) -> tuple[list[BoardPose], Start]:
    normals = rotations_from_vectors(start.boards[:, :3])[:, :, 2]
    sight = start.boards[:, 3:] / np.linalg.norm(start.boards[:, 3:], axis=1, keepdims=True)
    tilts = np.degrees(np.arccos(np.clip(np.abs((normals * sight).sum(axis=1)), 0, 1)))
    kept = np.flatnonzero(tilts <= max_tilt_deg)
    if len(kept) < min_poses:
        raise AlgorithmFailed(
            "too few board poses are left without those seen too obliquely",
            found=len(kept),
            required=min_poses,
            max_tilt_deg=max_tilt_deg,
        )
    for i in np.flatnonzero(tilts > max_tilt_deg):
        reasons[poses[i].name] = f"too oblique: {tilts[i]:.0f} degrees from facing the camera"
    return [poses[i] for i in kept], replace(start, boards=start.boards[kept])


def _without_outlying_poses(
    poses: list[BoardPose], board_mm: Array, start: Start, min_poses: int, max_ratio: float, reasons: dict[str, str]
) -> tuple[list[BoardPose], list[Adjustment]]:
    """The poses that agree and their fits by all lens models, best first; worst pose first, min_poses are kept.

    A bad pose bends the fit towards itself and raises all residuals, so it is judged by the fit over the others.
    """
    fits = _all_models(poses, board_mm, start)
    while len(poses) > min_poses:
        best = fits[0]
        rms = np.nanmax(_pose_rms(best), axis=1)
        worst = int(rms.argmax())
        if rms[worst] <= SUSPECT_RATIO * float(np.median(rms)):
            break
        rest = [pose for i, pose in enumerate(poses) if i != worst]
        clean = _all_models(rest, board_mm, _without(best, worst))
        _, residuals = fit_boards([poses[worst]], board_mm, clean[0].sensor, best.boards[worst : worst + 1])
        alone = float(np.sqrt(np.nanmax(np.nanmean((residuals**2).sum(axis=3), axis=2))))
        if alone <= max_ratio * max(float(np.median(np.nanmax(_pose_rms(clean[0]), axis=1))), FLOOR_PX):
            break
        reasons[poses[worst].name] = f"residual {alone:.3f} px stands out from the fit over the other poses"
        poses, fits = rest, clean
    return poses, fits


def _choose_model(
    poses: list[BoardPose], board_mm: Array, fits: list[Adjustment], sizes: tuple[tuple[int, int], tuple[int, int]]
) -> tuple[Adjustment, list[Array], Adjustment | None, list[Array]]:
    """The fit that is taken with its hold-out squares, and the one that it was tried against with its own.

    Two models stand against each other: the best by Akaike's criterion, and the richest one that is one-to-one over
    both images. The richer is taken unless it predicts left-out poses worse, by more than HARM_SIGMAS standard errors.
    Criteria that punish every parameter leave out terms as small as their own uncertainty; their error is then in no
    covariance (of joint 95 % regions over rigs with full lenses, such a choice covered the truth in 8 to 57 %), while a
    term that is not needed costs a little width and nothing of the truth.
    """
    possible = [fit for fit in fits if _is_one_to_one(fit.sensor, sizes)] or fits
    lean, rich = possible[0], max(possible, key=lambda fit: len(fit.parameter_names))
    if lean is rich:
        return rich, _holdout_squares(poses, board_mm, rich), None, []
    squares = [_holdout_squares(poses, board_mm, fit) for fit in (rich, lean)]
    harm = np.array([a.sum() - b.sum() for a, b in zip(*squares, strict=True)])
    if np.isfinite(harm).all() and harm.mean() > HARM_SIGMAS * harm.std(ddof=1) / np.sqrt(len(harm)):
        return lean, squares[1], rich, squares[0]
    return rich, squares[0], lean, squares[1]


def _is_one_to_one(sensor: StereoSensor, sizes: tuple[tuple[int, int], tuple[int, int]]) -> bool:
    """Whether no radius of either image is folded by its lens: the distorted radius grows out to the farthest corner."""
    for camera, (width, height) in zip((sensor.left, sensor.right), sizes, strict=True):
        m, (k1, k2, _, _, k3) = camera.matrix, camera.distortion
        x = max(m[0, 2], width - m[0, 2]) / m[0, 0]
        y = max(m[1, 2], height - m[1, 2]) / m[1, 1]
        r = np.linspace(0, 1.5 * np.hypot(x, y), 400)
        distorted = r * (1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3)))
        reached = distorted >= np.hypot(x, y)
        end = int(reached.argmax()) if reached.any() else len(r) - 1
        if not reached.any() or (np.diff(distorted[: end + 1]) <= 0).any():
            return False
    return True


def _without(fit: Adjustment, pose: int) -> Start:
    return _start_of(fit, [i for i in range(len(fit.boards)) if i != pose])


def _start_of(fit: Adjustment, poses: list[int]) -> Start:
    s = fit.sensor
    return Start(s.left, s.right, s.rotation, s.translation_mm, fit.boards[poses])


def _all_models(poses: list[BoardPose], board_mm: Array, start: Start) -> list[Adjustment]:
    """Fits of every lens model, the best supported first. Each starts from the one before, so that most steps are few."""
    fits = []
    for model in LENS_MODELS:
        fits.append(adjust(poses, board_mm, model, start))
        start = _start_of(fits[-1], list(range(len(poses))))
    return sorted(fits, key=lambda fit: fit.information_criterion)


def _starting_values(poses: list[BoardPose], board_mm: Array, sizes: tuple[tuple[int, int], tuple[int, int]]) -> Start:
    """Each camera alone by OpenCV (one radial coefficient), and the pose between them as most boards have it."""
    import cv2

    flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    found = []
    for side, size in zip(("left_px", "right_px"), sizes, strict=True):
        corners, points = [], []
        for pose in poses:
            px = np.asarray(getattr(pose, side), np.float32)
            seen = np.isfinite(px).all(axis=1)
            corners.append(px[seen])
            points.append(board_mm[seen].astype(np.float32))
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)  # more of them add up in any order, and no two runs would give the same bytes
        try:
            _, matrix, distortion, rotations, translations = cv2.calibrateCamera(
                points, corners, size, None, None, flags=flags
            )
        except cv2.error as error:
            raise AlgorithmFailed(
                f"the boards give no starting values for the {side[:-3]} camera: {str(error).strip()}"
            ) from error
        finally:
            cv2.setNumThreads(threads)
        boards = np.array([np.r_[r.ravel(), t.ravel()] for r, t in zip(rotations, translations, strict=True)])
        found.append((Camera(matrix, distortion.ravel()[:5]), boards))
    (left, left_boards), (right, right_boards) = found
    turns = [rotations_from_vectors(boards[:, :3]) for boards in (left_boards, right_boards)]
    between = turns[1] @ np.swapaxes(turns[0], 1, 2)
    rotation = between[int(_middle(between))]
    translation = np.median(right_boards[:, 3:] - left_boards[:, 3:] @ rotation.T, axis=0)
    return Start(left, right, rotation, translation, left_boards)


def _middle(rotations: Array) -> int:
    """Index of the rotation (n, 3, 3) that is nearest to the others: one bad pose does not turn it."""
    traces = np.einsum("aij,bij->ab", rotations, rotations)
    return int(np.median(traces, axis=1).argmax())


def _pose_rms(adjustment: Adjustment) -> Array:
    return np.sqrt(np.nanmean((adjustment.residuals_px**2).sum(axis=3), axis=2))


def _board_geometry(adjustment: Adjustment, board_mm: Array) -> tuple[Array, Array]:
    turns = rotations_from_vectors(adjustment.boards[:, :3])
    tilts = np.degrees(np.arccos(np.clip(np.abs(turns[:, 2, 2]), 0, 1)))
    return tilts, np.linalg.norm(turns @ board_mm.mean(axis=0) + adjustment.boards[:, 3:], axis=1)


def _board_depths(adjustment: Adjustment, board_mm: Array) -> Array:
    turns = rotations_from_vectors(adjustment.boards[:, :3])
    return ((board_mm @ np.swapaxes(turns, 1, 2)) + adjustment.boards[:, None, 3:])[..., 2].ravel()


def _coverage(poses: list[BoardPose], side: str, image_size: tuple[int, int]) -> float:
    corners = np.concatenate([np.asarray(getattr(pose, side)) for pose in poses])
    corners = corners[np.isfinite(corners).all(axis=1)]
    cells = np.floor(corners / np.array(image_size) * 8).astype(int)
    inside = ((cells >= 0) & (cells < 8)).all(axis=1)
    return len(np.unique(cells[inside] @ np.array([8, 1]))) / 64.0


def _both_seen(poses: list[BoardPose]) -> tuple[Array, Array, Array]:
    """Left and right corners (poses, corners, 2), and where both are seen."""
    left = np.stack([np.asarray(p.left_px) for p in poses])
    right = np.stack([np.asarray(p.right_px) for p in poses])
    return left, right, np.isfinite(left).all(axis=2) & np.isfinite(right).all(axis=2)


def _epipolar_rms(poses: list[BoardPose], sensor: StereoSensor) -> float:
    """RMS distance in px of right corners from the epipolar lines of their left partners, on undistorted images."""
    from wheelset_assets.metrology.rigid import skew
    from wheelset_assets.metrology.triangulation import undistort

    left, right, both = _both_seen(poses)
    if not both.any():
        return float("nan")
    xl, xr = (
        np.column_stack([*undistort(camera, *px[both].T), np.ones(both.sum())])
        for camera, px in ((sensor.left, left), (sensor.right, right))
    )
    lines = xl @ (skew(sensor.translation_mm) @ sensor.rotation).T
    distance = (lines * xr).sum(axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    return float(np.sqrt((distance**2).mean()) * sensor.right.matrix[0, 0])


def _square_edges(poses: list[BoardPose], board_mm: Array, sensor: StereoSensor) -> tuple[float, float]:
    """Mean and standard deviation in mm of the squares' edges between triangulated corners: a check by lengths."""
    from wheelset_assets.metrology.triangulation import intersect_rays, undistort

    left, right, both = _both_seen(poses)
    rays = [undistort(camera, px[..., 0], px[..., 1]) for camera, px in ((sensor.left, left), (sensor.right, right))]
    points = np.where(both[..., None], intersect_rays(sensor, *rays[0], *rays[1]), np.nan)
    columns = int(np.unique(board_mm[:, 0]).size)
    grid = points.reshape(len(poses), -1, columns, 3)
    edges = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=3).ravel() for axis in (1, 2)])
    edges = edges[np.isfinite(edges)]
    return (float(edges.mean()), float(edges.std(ddof=1))) if len(edges) > 1 else (float("nan"), float("nan"))


def _holdout_squares(poses: list[BoardPose], board_mm: Array, best: Adjustment) -> list[Array]:
    """Squared residuals of each pose under a fit that did not use it: only the left-out board's own pose is fitted to
    it. One pose at a time, or as many folds as HOLDOUT_FOLDS."""
    folds = min(HOLDOUT_FOLDS, len(poses))
    squares: list[Array] = [np.empty(0)] * len(poses)
    if len(poses) < 5:
        return squares
    for k in range(folds):
        inside = [i for i in range(len(poses)) if i % folds != k]
        outside = [i for i in range(len(poses)) if i % folds == k]
        fit = adjust([poses[i] for i in inside], board_mm, best.model, _start_of(best, inside))
        _, residuals = fit_boards([poses[i] for i in outside], board_mm, fit.sensor, best.boards[outside])
        for i, values in zip(outside, (residuals**2).sum(axis=3).reshape(len(outside), -1), strict=True):
            squares[i] = values[np.isfinite(values)]
    return squares
