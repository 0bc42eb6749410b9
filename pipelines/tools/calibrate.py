"""`wheelset tool calibrate`: stereo calibration of any folder of image pairs, with the figures that judge it."""

from __future__ import annotations

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.options import ConfigOption, JsonOption, print_json
from pipelines.tools import tool_app
from pipelines.tools.images import ImagePair, common_size, image_pairs, read_grey
from wheelset_assets.quality import AlgorithmFailed, ConfigError

if TYPE_CHECKING:
    from wheelset_assets.config import CalibrationConfig
    from wheelset_assets.metrology.adjustment import BoardPose
    from wheelset_assets.metrology.boards import CalibrationBoard, SeenBoard
    from wheelset_assets.metrology.calibration import StereoCalibration

REFUSED = 3
Size = tuple[int, int]


@tool_app.command()
def calibrate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with image pairs left* and right*")],
    inner_corners: Annotated[
        str, typer.Option("--inner-corners", metavar="CxR", help="Inner corners of the board, squares − 1: 9x6")
    ],
    square_mm: Annotated[float, typer.Option("--square-mm", help="Side of a square in mm")],
    left: Annotated[
        str | None, typer.Option("--left", metavar="GLOB", help="Images of the left camera, below DIR")
    ] = None,
    right: Annotated[
        str | None, typer.Option("--right", metavar="GLOB", help="Images of the right camera, below DIR")
    ] = None,
    charuco: Annotated[bool, typer.Option("--charuco", help="The board is a ChArUco board")] = False,
    marker_mm: Annotated[float | None, typer.Option("--marker-mm", help="Side of a marker in mm (ChArUco)")] = None,
    dictionary: Annotated[
        str | None, typer.Option("--dictionary", help="OpenCV's name of the markers' dictionary, such as DICT_5X5_100")
    ] = None,
    legacy_pattern: Annotated[
        bool, typer.Option("--legacy-pattern", help="ChArUco board as OpenCV drew it before 4.6")
    ] = False,
    min_poses: Annotated[
        int | None,
        typer.Option("--min-poses", min=3, help="Fewer usable poses refuse [default: 5]", show_default=False),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Draw residual vectors and coverage into this PNG, SVG or PDF")
    ] = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """Stereo calibration of a folder of image pairs, chessboard or ChArUco, with covariance and hold-out error.

    Pairs are `left*` and `right*` with the same remainder of the name, or --left and --right. A pose that cannot be used
    is listed with its reason. Exit code 3: no calibration, and why.
    """
    from wheelset_assets.config import load_config

    knobs = load_config(config).calibration
    if min_poses is not None:
        knobs = knobs.model_copy(update={"min_poses": min_poses})
    board = _board(inner_corners, square_mm, charuco, marker_mm, dictionary, legacy_pattern)
    pairs, notes = image_pairs(folder, left, right)
    poses, sizes, more = _see(pairs, board, knobs, quiet=as_json)
    notes += more
    try:
        found = _calibrated(poses, board, sizes, knobs)
    except AlgorithmFailed as failure:
        notes += _hints(pairs, poses, board)
        return _refuse(folder, poses, str(failure), notes, as_json)
    notes += _doubts(found, knobs)
    document = describe(found, len(pairs), sizes) | {"notes": notes}
    if picture is not None:
        from pipelines.tools.calibration_picture import draw

        draw(found, poses, sizes, picture)
    if as_json:
        print_json(document)
    else:
        _show(document, picture)
    return 0


def _board(
    corners: str, square_mm: float, charuco: bool, marker_mm: float | None, dictionary: str | None, legacy: bool
) -> CalibrationBoard:
    from wheelset_assets.metrology.boards import CalibrationBoard

    try:
        columns, rows = (int(n) for n in corners.lower().replace("×", "x").split("x"))
    except ValueError:
        raise ConfigError(f"--inner-corners {corners!r}: expected columns x rows, such as 9x6") from None
    if min(columns, rows) < 3 or max(columns, rows) > 200:
        raise ConfigError(f"--inner-corners {corners!r}: expected 3 to 200 corners along each side")
    if not (square_mm > 0 and math.isfinite(square_mm)):
        raise ConfigError(f"--square-mm {square_mm:g}: expected a length above 0")
    if charuco and (marker_mm is None or dictionary is None):
        raise ConfigError("--charuco needs --marker-mm and --dictionary (such as DICT_5X5_100)")
    if not charuco and (marker_mm is not None or dictionary is not None):
        raise ConfigError("--marker-mm and --dictionary belong to a ChArUco board: add --charuco")
    return CalibrationBoard((columns, rows), square_mm, marker_mm, dictionary, legacy)


def _see(
    pairs: list[ImagePair], board: CalibrationBoard, knobs: CalibrationConfig, quiet: bool
) -> tuple[list[BoardPose], tuple[Size, Size], list[str]]:
    """Boards in all images, the size of each camera's images, and notes."""
    import cv2

    from pipelines.progress import Bars

    paths = [path for pair in pairs for path in (pair.left, pair.right)]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with Bars(quiet=quiet and not sys.stderr.isatty()) as bars, ThreadPoolExecutor() as pool:
            found = []
            for path, seen in zip(paths, pool.map(lambda p: _look(p, board, knobs), paths), strict=True):
                found.append(seen)
                bars("boards", path.name if path else "", len(found), len(paths))
            notes = []
            if board.is_charuco and not any(seen.px is not None for seen, _ in found):
                other = replace(board, legacy_pattern=not board.legacy_pattern)
                again = list(pool.map(lambda p: _look(p, other, knobs), paths))
                if any(seen.px is not None for seen, _ in again):
                    found, kind = again, "legacy" if other.legacy_pattern else "current"
                    notes.append(
                        f"the board is of OpenCV's {kind} ChArUco pattern, not as was said: it was read as such"
                    )
    finally:
        cv2.setNumThreads(threads)
    return *_poses(pairs, found, board), notes


def _look(path: Path | None, board: CalibrationBoard, knobs: CalibrationConfig) -> tuple[SeenBoard, Size | None]:
    from wheelset_assets.metrology.boards import SeenBoard, see_board

    if path is None:
        return SeenBoard(None, "the image is missing"), None
    try:
        image = read_grey(path)
    except ConfigError as error:  # one bad file among many is one pose less
        return SeenBoard(None, str(error)), None
    seen = see_board(image, board, max_blur_ratio=knobs.max_blur_ratio, max_saturated_ratio=knobs.max_saturated_ratio)
    return seen, (image.shape[1], image.shape[0])


def _poses(
    pairs: list[ImagePair], found: list[tuple[SeenBoard, Size | None]], board: CalibrationBoard
) -> tuple[list[BoardPose], tuple[Size, Size]]:
    from wheelset_assets.metrology.adjustment import BoardPose
    from wheelset_assets.metrology.boards import pair_order

    sides = (found[0::2], found[1::2])
    sizes = [common_size([size for _, size in side if size is not None]) for side in sides]
    poses = []
    for pair, *views in zip(pairs, *sides, strict=True):
        px, reasons = [], []
        for (seen, size), usual, side in zip(views, sizes, ("left", "right"), strict=True):
            reason = seen.reason
            if size is not None and size != usual:
                reason = f"{size[0]} x {size[1]} pixels, the camera's other images have {usual[0]} x {usual[1]}"
            px.append(None if reason else seen.px)
            reasons += [f"{side}: {reason}"] if reason else []
        if px[0] is not None and px[1] is not None:
            px[1] = pair_order(px[0], px[1], board)
        poses.append(BoardPose(pair.name, px[0], px[1], "; ".join(reasons) or None))
    return poses, (sizes[0], sizes[1])


def _calibrated(
    poses: list[BoardPose], board: CalibrationBoard, sizes: tuple[Size, Size], knobs: CalibrationConfig
) -> StereoCalibration:
    from wheelset_assets.metrology.calibration import calibrate_stereo

    return calibrate_stereo(
        poses,
        board.points_mm,
        sizes[0],
        right_image_size=sizes[1],
        min_poses=knobs.min_poses,
        min_tilt_deg=knobs.min_tilt_deg,
        max_tilt_deg=knobs.max_tilt_deg,
        max_pose_rms_ratio=knobs.max_pose_rms_ratio,
    )


def _hints(pairs: list[ImagePair], poses: list[BoardPose], board: CalibrationBoard) -> list[str]:
    """What may be wrong if hardly any board was found: squares counted instead of inner corners."""
    from wheelset_assets.metrology.boards import detect_corners, grey_8_bit

    if board.is_charuco:
        return ["is it the right --dictionary, and are --inner-corners the squares less one along each side?"]
    if any(p.left_px is not None for p in poses):
        return []
    columns, rows = board.inner_corners
    try:
        image = next((grey_8_bit(read_grey(pair.left)) for pair in pairs if pair.left), None)
    except ConfigError:
        return []
    for other in ((columns - 1, rows - 1), (columns + 1, rows + 1)):
        if image is not None and min(other) >= 3 and detect_corners(image, other) is not None:
            return [f"the board has {other[0]}x{other[1]} inner corners (inner corners are squares less one): "
                    f"try --inner-corners {other[0]}x{other[1]}"]  # fmt: skip
    return []


def _doubts(found: StereoCalibration, knobs: CalibrationConfig) -> list[str]:
    """What a careful reader should know of a calibration that was made."""
    doubts = []
    if found.stereo_rms_px > knobs.max_rms_px:
        doubts.append(
            f"not to be trusted: stereo RMS {found.stereo_rms_px:.3f} px is above {knobs.max_rms_px:g} px; a scan would be "
            "refused with it"
        )
    if found.holdout_rms_px > 1.5 * found.stereo_rms_px:
        doubts.append("poses that were left out fit much worse than those used: take more poses, spread over the image")
    for side, ratio in (("left", found.coverage_ratio), ("right", found.right_coverage_ratio)):
        if ratio < 0.4:
            doubts.append(f"corners cover {100 * ratio:.0f} % of the {side} image: distortion outside is extrapolated")
    return doubts


def describe(found: StereoCalibration, n_poses: int, sizes: tuple[Size, Size]) -> dict[str, Any]:
    """A calibration as a JSON document; not-a-number becomes null."""
    import numpy as np

    from wheelset_assets.metrology.rigid import transform, vector_from_rotation

    fit, s = found.adjustment, found.adjustment.sensor
    u = dict(zip(fit.parameter_names, np.sqrt(np.diag(fit.covariance)).tolist(), strict=True))
    number = lambda x: None if x is None or not math.isfinite(x) else float(x)  # noqa: E731
    return {
        "n_poses": n_poses,
        "n_poses_used": sum(p.used for p in found.poses),
        "left_rms_px": found.left_rms_px,
        "right_rms_px": found.right_rms_px,
        "stereo_rms_px": found.stereo_rms_px,
        "holdout_rms_px": number(found.holdout_rms_px),
        "epipolar_rms_px": number(found.epipolar_rms_px),
        "left_camera_matrix": s.left.matrix.tolist(),
        "right_camera_matrix": s.right.matrix.tolist(),
        "left_distortion": s.left.distortion.tolist(),
        "right_distortion": s.right.distortion.tolist(),
        "right_from_left": transform(s.rotation, s.translation_mm).tolist(),
        "rotation_vector_rad": vector_from_rotation(s.rotation).tolist(),
        "translation_mm": s.translation_mm.tolist(),
        "baseline_mm": float(np.linalg.norm(s.translation_mm)),
        "standard_uncertainties": u,
        "parameter_names": list(fit.parameter_names),
        "covariance": fit.covariance.tolist(),
        "distortion_model": fit.model,
        "rival_model": found.rival_model,
        "rival_holdout_rms_px": number(found.rival_holdout_rms_px),
        "left_image_size": list(sizes[0]),
        "right_image_size": list(sizes[1]),
        "left_coverage_ratio": found.coverage_ratio,
        "right_coverage_ratio": found.right_coverage_ratio,
        "depth_range_mm": list(found.depth_range_mm),
        "max_tilt_deg": found.max_tilt_deg,
        "square_edge_mean_mm": number(found.square_edge_mm[0]),
        "square_edge_standard_deviation_mm": number(found.square_edge_mm[1]),
        "poses": [vars(p) for p in found.poses],
    }


def _refuse(folder: Path, poses: list[BoardPose], reason: str, notes: list[str], as_json: bool) -> int:
    listed = [{"name": p.name, "used": False, "reason": p.reason or "not reached"} for p in poses]
    if as_json:
        print_json({"n_poses": len(poses), "n_poses_used": 0, "reason": reason, "notes": notes, "poses": listed})
    print(f"wheelset: {folder}: no calibration: {reason}", file=sys.stderr)
    for pose in listed if not as_json else []:
        print(f"  {pose['name']}: {pose['reason']}", file=sys.stderr)
    for note in notes:
        print(f"  hint: {note}", file=sys.stderr)
    return REFUSED


def _show(d: dict[str, Any], picture: Path | None) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table("pose", "left RMS px", "right RMS px", "hold-out px", "tilt deg", "distance mm", "", box=None)
    figure = lambda x, digits: "" if x is None else f"{x:.{digits}f}"  # noqa: E731
    for p in d["poses"]:
        table.add_row(
            p["name"],
            figure(p["left_rms_px"], 3),
            figure(p["right_rms_px"], 3),
            figure(p["holdout_rms_px"], 3),
            figure(p["tilt_deg"], 1),
            figure(p["distance_mm"], 0),
            "" if p["used"] else f"[yellow]not used: {p['reason']}",
        )
    console.print(table)
    u, t, r = d["standard_uncertainties"], d["translation_mm"], d["rotation_vector_rad"]
    print(f"\nposes used      {d['n_poses_used']} of {d['n_poses']}")
    print(
        f"RMS             left {d['left_rms_px']:.3f}, right {d['right_rms_px']:.3f}, stereo {d['stereo_rms_px']:.3f} px"
    )
    held = "too few poses" if d["holdout_rms_px"] is None else f"{d['holdout_rms_px']:.3f} px"
    print(f"hold-out RMS    {held}, epipolar RMS {figure(d['epipolar_rms_px'], 3)} px")
    against = f", tried against {d['rival_model']}" if d["rival_model"] else ""
    other = "" if d["rival_holdout_rms_px"] is None else f" (hold-out {d['rival_holdout_rms_px']:.4f} px)"
    print(f"lens model      {d['distortion_model']}{against}{other}")
    for side in ("left", "right"):
        m = d[f"{side}_camera_matrix"]
        f_u = u.get(f"{side}_f", u.get(f"{side}_fx"))
        lens = " ".join(f"{k:+.4g}" for k in d[f"{side}_distortion"])
        print(
            f"{side + ' camera':<15} fx {m[0][0]:.2f}, fy {m[1][1]:.2f} ({f_u:.2f}), cx {m[0][2]:.2f} ({u[f'{side}_cx']:.2f}), "
            f"cy {m[1][2]:.2f} ({u[f'{side}_cy']:.2f}) px; k1 k2 p1 p2 k3 {lens}"
        )
    print(
        "translation     " + ", ".join(f"{v:.3f} ({u[f't{a}_mm']:.3f})" for a, v in zip("xyz", t, strict=True)) + " mm"
    )
    print(
        "rotation vector "
        + ", ".join(f"{v:.5f} ({u[f'r{a}_rad']:.5f})" for a, v in zip("xyz", r, strict=True))
        + " rad"
    )
    print("                (standard uncertainties, k = 1, in brackets)")
    if d["square_edge_mean_mm"] is not None:
        print(
            f"squares' edges  {d['square_edge_mean_mm']:.4f} mm mean, "
            f"{d['square_edge_standard_deviation_mm']:.4f} mm standard deviation, triangulated"
        )
    near, far = d["depth_range_mm"]
    print(
        f"coverage        {100 * d['left_coverage_ratio']:.0f} % of the left image, {100 * d['right_coverage_ratio']:.0f} % of the "
        f"right; depth {near:.0f} to {far:.0f} mm; tilt up to {d['max_tilt_deg']:.0f} degrees"
    )
    for note in d["notes"]:
        console.print(f"note: {note}", style="yellow", markup=False)
    if picture is not None:
        print(f"picture         {picture}")
