"""Calibration boards in images: chessboards and ChArUco boards, whole or partly hidden, with reasons for refusing a view.

Corners come back as (n, 2) in px, columns running fastest, NaN where hidden. No files are read here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.corners import WINDOW_SHARE, RefinedCorners, refine_corners
from wheelset_assets.quality import ConfigError

Array = NDArray[Any]

MAX_BLUR_PX = 6.0
"""Wider edges do not fit into the windows in which corners are refined, however large the squares are."""
MIN_CORNERS = 8
"""Fewer corners of a partly hidden board do not fix its pose well."""


@dataclass(frozen=True)
class CalibrationBoard:
    """A board: inner corners (columns, rows) and square; a ChArUco board has markers of an OpenCV dictionary too."""

    inner_corners: tuple[int, int]
    square_mm: float
    marker_mm: float | None = None
    dictionary: str | None = None
    legacy_pattern: bool = False

    def __post_init__(self) -> None:
        if (self.marker_mm is None) != (self.dictionary is None):
            raise ConfigError("a ChArUco board needs both the marker's side (marker_mm) and its dictionary")
        if self.marker_mm is not None and not 0 < self.marker_mm < self.square_mm:
            raise ConfigError(f"marker_mm {self.marker_mm:g}: expected less than square_mm {self.square_mm:g}")
        if self.dictionary is not None:
            dictionary_of(self.dictionary)

    @property
    def is_charuco(self) -> bool:
        """Whether the board carries markers."""
        return self.dictionary is not None

    @property
    def points_mm(self) -> Array:
        """Corners (n, 3) in mm, columns running fastest, z = 0."""
        return board_points_mm(self.inner_corners, self.square_mm)


@dataclass(frozen=True)
class SeenBoard:
    """A board in one image: corners (n, 2) in px or None, or why it cannot be used; figures of its picture."""

    px: Array | None
    reason: str | None
    blur_px: float | None = None
    saturated_ratio: float | None = None


def board_points_mm(inner_corners: tuple[int, int], square_mm: float) -> Array:
    """Corners of the board (n, 3) in mm, columns running fastest, z = 0."""
    columns, rows = inner_corners
    points = np.zeros((columns * rows, 3))
    points[:, :2] = np.mgrid[0:columns, 0:rows].T.reshape(-1, 2) * square_mm
    return points


def dictionary_of(name: str) -> Any:
    """OpenCV's predefined dictionary of this name; ConfigError names those that exist."""
    import cv2

    known = [n for n in dir(cv2.aruco) if n.startswith("DICT_")]
    if name not in known:
        raise ConfigError(f"dictionary {name!r}: expected one of {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def grey_8_bit(image: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit grey image from an 8-bit or 16-bit one; of 16 bits those eight are kept that the picture reaches into."""
    if image.dtype == np.uint8:
        return image
    bits = max(int(image.max()).bit_length(), 8)
    return (image >> (bits - 8)).astype(np.uint8)


def see_board(
    image: NDArray[Any], board: CalibrationBoard, *, max_blur_ratio: float, max_saturated_ratio: float
) -> SeenBoard:
    """Find and judge the board in one image.

    max_blur_ratio: blur of the edges as a share of the corners' spacing; max_saturated_ratio: share of full-scale
    pixels about the corners, of which the white squares alone make one half.
    """
    found = detect(grey_8_bit(image), board)
    if found is None:
        return SeenBoard(None, "the board was not found")
    seen = np.asarray(np.isfinite(found.px).all(axis=1))
    if seen.sum() < MIN_CORNERS and seen.sum() < len(seen):
        return SeenBoard(None, f"only {int(seen.sum())} corners of the board are seen, {MIN_CORNERS} are needed")
    if np.linalg.matrix_rank(board.points_mm[seen, :2] - board.points_mm[seen, :2].mean(axis=0)) < 2:
        return SeenBoard(None, "the corners that are seen lie on one line")
    if not np.isfinite(found.blur_px).any():  # squares too small or at the image's edge: nothing to judge by
        return SeenBoard(found.px, None)
    blur, saturated = float(np.nanmedian(found.blur_px)), float(np.nanmean(found.saturated_ratio))
    spacing = _spacing_px(found.px, board.inner_corners)
    reason = None
    if blur > min(max_blur_ratio * spacing, MAX_BLUR_PX):
        reason = f"blurred: edges are {blur:.1f} px wide, squares {spacing:.0f} px"
    elif saturated > max_saturated_ratio:
        reason = f"saturated: {100 * saturated:.0f} % of the pixels about the corners are at full scale"
    return SeenBoard(None if reason else found.px, reason, blur, saturated)


def _spacing_px(px: Array, inner_corners: tuple[int, int]) -> float:
    grid = px.reshape(inner_corners[1], inner_corners[0], 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)]
    return float(min(np.nanmedian(s) if np.isfinite(s).any() else np.inf for s in steps))


def detect(image: NDArray[np.uint8], board: CalibrationBoard) -> RefinedCorners | None:
    """Refined corners of a board in an 8-bit image, None if none is seen."""
    return _detect_charuco(image, board) if board.is_charuco else _detect_chessboard(image, board.inner_corners)


def detect_corners(image: NDArray[np.uint8], inner_corners: tuple[int, int]) -> Array | None:
    """Corners (n, 2) in px of a chessboard, None if no board is seen."""
    found = _detect_chessboard(image, inner_corners)
    return None if found is None else found.px


def _detect_chessboard(image: NDArray[np.uint8], inner_corners: tuple[int, int]) -> RefinedCorners | None:
    """By the sector-based detector (Duda and Frese 2018), else by the classical one; then each corner refined in a
    window that follows the squares' size, and numbered from the same end of the board where its colours tell which."""
    import cv2

    if min(inner_corners) < 3:  # the least that OpenCV's detectors know
        return None
    corners = None
    attempts = [
        (0.5, 0),
        (1.0, 0),
        (1.0, cv2.CALIB_CB_NORMALIZE_IMAGE),
        (1.0, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY),
        (2.0, cv2.CALIB_CB_NORMALIZE_IMAGE),  # squares of a few pixels
    ]
    for scale, flags in attempts:  # from the quickest to the most thorough; the refinement makes them equal
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        picture = image if scale == 1.0 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=how)
        found, corners = cv2.findChessboardCornersSB(picture, inner_corners, flags=flags)
        if found:
            corners = (np.asarray(corners, float) + 0.5) / scale - 0.5
            break
    else:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(image, inner_corners, flags=flags)
    if not found:
        return None
    refined = refine_corners(image, np.asarray(corners, float).reshape(-1, 2), inner_corners)
    return _from_the_dark_end(refined, inner_corners)


def _from_the_dark_end(found: RefinedCorners, inner_corners: tuple[int, int]) -> RefinedCorners:
    """Numbered so that the first inner corner has a dark square towards the others, if the board's two ends differ.

    They do if one number of corners is odd and the other even: half a turn then swaps the colours.
    """
    columns, rows = inner_corners
    if (columns + rows) % 2 == 0:
        return found
    parity = 1 - 2 * (np.add.outer(np.arange(rows), np.arange(columns)) % 2).ravel()
    vote = float(np.nansum(found.sign * parity))
    if vote >= 0:
        return found
    return RefinedCorners(found.px[::-1], found.blur_px[::-1], found.sign[::-1], found.saturated_ratio[::-1])


def charuco_board(board: CalibrationBoard) -> Any:
    """The board as OpenCV knows it; squares are one more than inner corners."""
    import cv2

    columns, rows = board.inner_corners
    assert board.dictionary is not None
    assert board.marker_mm is not None
    made = cv2.aruco.CharucoBoard(
        (columns + 1, rows + 1), board.square_mm, board.marker_mm, dictionary_of(board.dictionary)
    )
    made.setLegacyPattern(board.legacy_pattern)
    return made


def _detect_charuco(image: NDArray[np.uint8], board: CalibrationBoard) -> RefinedCorners | None:
    """Corners next to markers that were read; hidden ones stay NaN. The window keeps clear of the markers."""
    import cv2

    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(image)
    if ids is None or len(ids) < 4:
        return None
    px = np.full((board.inner_corners[0] * board.inner_corners[1], 2), np.nan)
    px[np.asarray(ids).ravel()] = np.asarray(corners, float).reshape(-1, 2)
    assert board.marker_mm is not None
    # A marker's own corner lies on the diagonal of its square, sqrt(2) farther away than its margin is wide.
    share = min(WINDOW_SHARE, 0.5 * (1 - board.marker_mm / board.square_mm) * 1.25)
    return refine_corners(image, px, board.inner_corners, share)


def reconcile_order(left_px: Array, right_px: Array) -> Array:
    """Right corners in the left's order: a detector may number a board from its other end in the second camera.

    Both cameras stand the same way up within some tens of degrees, so the true order is the one whose image vectors
    from first to last corner agree best. A partly hidden board is numbered by its markers and is left alone.
    """
    if not (np.isfinite(left_px).all() and np.isfinite(right_px).all()):
        return right_px
    reference = left_px - left_px.mean(axis=0)
    candidates = (right_px, right_px[::-1])
    return max(candidates, key=lambda c: float((reference * (c - c.mean(axis=0))).sum()))


def pair_order(left_px: Array, right_px: Array, board: CalibrationBoard) -> Array:
    """Right corners in the left's order, by what the board itself tells if it can (markers, or ends that differ)."""
    columns, rows = board.inner_corners
    if board.is_charuco or (columns + rows) % 2:
        return right_px
    if columns != rows:
        return reconcile_order(left_px, right_px)
    grid = right_px.reshape(rows, columns, 2)
    reference = left_px - left_px.mean(axis=0)
    turns = [np.rot90(grid, k).reshape(-1, 2) for k in range(4)]
    return max(turns, key=lambda c: float((reference * (c - c.mean(axis=0))).sum()))
