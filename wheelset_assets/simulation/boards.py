"""Chessboard images of a calibration: poses that fill the working volume, and exact rendering through the distortion.

Here: pose search, inverse projection of every pixel onto the board with supersampling where a square's edge runs.
Not here: the cameras (`optics`), the calibration's files (`bundle`). Lengths are at the calibration's temperature.
Board frame: origin in the first inner corner, X along the columns of corners, Y along the rows, Z into the board.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ..metrology.rigid import apply, rotation_from_vector, transform
from .optics import Camera
from .rig import Rig, Sensor
from .streams import stream

Array = NDArray[np.float64]
Grey = NDArray[np.float32]
Cells = NDArray[np.int16]

DARK, BRIGHT = 34.0, 205.0
BLUR_PX = 0.6
GREY_NOISE = 1.0
EDGE_PX = 16.0  # distance that the outermost inner corner keeps from the image's edge, at 1024 rows
CANDIDATES, MOST_ATTEMPTS = 30, 400
BLOCK_ROWS = 16  # rows of an image that are rendered at once: what stays in the cache
SAMPLES = 55  # Fibonacci lattice: no two samples of a pixel share a row or a column
# fmt: off
TILTS_DEG = ((0, 0), (26, 8), (-26, -8), (8, 26), (-8, -26), (30, -28), (-30, 28), (20, 20), (-20, -20), (0, 33),
             (0, -33), (35, 0), (-35, 0), (15, -12), (-15, 12))
# fmt: on


@dataclass(frozen=True)
class Board:
    """A chessboard: inner corners (columns, rows) and the side of a square."""

    inner_corners: tuple[int, int]
    square_mm: float

    def corners(self) -> Array:
        """Inner corners (rows * columns, 3) in the board frame, column index fastest; read-only."""
        return _corners(self)


@cache
def _corners(board: Board) -> Array:
    columns, rows = board.inner_corners
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    found = board.square_mm * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(float)
    found.flags.writeable = False
    return found


def board_of(rig: Rig) -> Board:
    """The board that belongs to a rig."""
    return Board(rig.inner_corners, rig.square_mm)


def project_corners(board: Board, sensor: Sensor, left_from_board: Array) -> tuple[Array, Array]:
    """True pixel positions (n, 2) of the inner corners in the left and right image."""
    images = []
    for camera, from_left in ((sensor.left, np.eye(4)), (sensor.right, sensor.right_from_left)):
        p = apply(from_left @ left_from_board, board.corners())
        images.append(np.stack(camera.pixels(p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]), axis=1))
    return images[0], images[1]


def board_poses(board: Board, sensor: Sensor, count: int, seed: int, calibration: int, index: int) -> list[Array]:
    """Poses left_from_board (4, 4): varied tilt, roll and distance; all corners in both images, spread widely."""
    poses: list[Array] = []
    covered = np.zeros((2, 6, 4), int)
    for k in range(count):
        tilt = np.deg2rad(TILTS_DEG[k % len(TILTS_DEG)])
        rng = stream(seed, "board-pose", calibration, index, k)
        best: tuple[float, Array, NDArray[np.intp]] | None = None
        valid = 0
        for attempt in range(MOST_ATTEMPTS):
            shrink = 1.0 - 0.8 * attempt / MOST_ATTEMPTS  # give up extremes bit by bit where the field of view is tight
            pose = _candidate(board, sensor, tilt * shrink, shrink, rng)
            cells = _cells(board, sensor, pose)
            if cells is None:
                continue
            gain = float((1.0 / (1.0 + covered[tuple(cells)])).sum())
            if best is None or gain > best[0]:
                best = gain, pose, cells
            valid += 1
            if valid == CANDIDATES:
                break
        if best is None:
            raise ValueError(f"sensor {sensor.sensor_id}: no board pose {k} lies in both images; use a smaller board")
        poses.append(best[1])
        np.add.at(covered, tuple(best[2]), 1)
    return poses


def _candidate(board: Board, sensor: Sensor, tilt_rad: Array, shrink: float, rng: np.random.Generator) -> Array:
    columns, rows = board.inner_corners
    centre = np.array([columns - 1, rows - 1, 0.0]) * board.square_mm / 2
    wobble = rng.uniform(-1.0, 1.0, 7) * shrink
    spin = np.array([tilt_rad[0] + 0.08 * wobble[0], tilt_rad[1] + 0.08 * wobble[1], 0.12 * wobble[2]])
    distance = sensor.working_distance_mm * (1.03 + 0.08 * wobble[3])
    width, height = sensor.image_size
    # Boards are meant to be seen by both cameras: aim between the two lines of sight at this distance.
    right_axis = sensor.right_from_left[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    right_centre = -sensor.right_from_left[:3, :3].T @ sensor.right_from_left[:3, 3]
    seen_right = right_centre + right_axis * (distance - right_centre[2]) / right_axis[2]
    middle = 0.5 * seen_right + np.array([0.0, 0.0, 0.5 * distance])
    field = distance * np.array([width / sensor.left.fx_px, height / sensor.left.fy_px])
    middle[:2] += 0.24 * field * wobble[4:6]
    turn = rotation_from_vector(spin)
    # An untilted board faces the middle between the two lines of sight.
    half_angle = 0.5 * float(np.arctan2(-right_axis[0], right_axis[2]))
    turn = rotation_from_vector([0.0, -half_angle, 0.0]) @ turn
    return transform(turn, middle - turn @ centre)


def _cells(board: Board, sensor: Sensor, pose: Array) -> NDArray[np.intp] | None:
    """Cells (3, n: camera, row, column of a 6 x 4 grid) that hold corners; None where one is out of sight."""
    width, height = sensor.image_size
    margin = EDGE_PX * height / 1024 + 2.0
    found = []
    for camera, corners in enumerate(project_corners(board, sensor, pose)):
        u, v = corners.T
        if u.min() < margin or v.min() < margin or u.max() > width - 1 - margin or v.max() > height - 1 - margin:
            return None
        found.append(np.stack([np.full(u.size, camera), (v / height * 6).astype(int), (u / width * 4).astype(int)]))
    return np.concatenate(found, axis=1)


@dataclass(frozen=True)
class PixelRays:
    """Normalised coordinates seen at the corners of all pixels, (height + 1, width + 1): once for each camera."""

    x: Array
    y: Array


def pixel_rays(camera: Camera) -> PixelRays:
    """Exact rays of the pixel corners, at u = -0.5 ... width - 0.5."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    blocks = [slice(k, k + BLOCK_ROWS) for k in range(0, height + 1, BLOCK_ROWS)]
    x, y = zip(*(camera.rays(u[rows], v[rows]) for rows in blocks), strict=True)
    return PixelRays(np.concatenate(x), np.concatenate(y))


def render(board: Board, camera_from_board: Array, rays: PixelRays, rng: np.random.Generator) -> NDArray[np.uint8]:
    """8-bit image (height, width) of a board on a bright ground: optical blur, uneven light, grey noise."""
    import cv2

    # Board plane from ray, up to scale: the homography of the board, inverted.
    from_ray: Array = np.linalg.inv(camera_from_board[:3, [0, 1, 3]]).astype(float)
    height, width = rays.x.shape[0] - 1, rays.x.shape[1] - 1
    image, edge = np.empty((height, width), np.float32), np.empty((height, width), bool)
    for start in range(0, height, BLOCK_ROWS):
        of_pixels, of_corners = slice(start, start + BLOCK_ROWS), slice(start, start + BLOCK_ROWS + 1)
        a, b = _cell(board, *_on_plane(from_ray, rays.x[of_corners], rays.y[of_corners]))
        image[of_pixels] = _colour(board, a[:-1, :-1], b[:-1, :-1])
        edge[of_pixels] = _on_edge(board, a, b)
    rows, columns = np.nonzero(edge)
    image[rows, columns] = _supersampled(board, from_ray, rays, rows, columns)
    fall = rng.uniform(-0.04, 0.04, 2)  # light falls off by a few per cent across the field
    light = 1.0 + fall[0] * np.linspace(-1, 1, height)[:, None] + fall[1] * np.linspace(-1, 1, width)
    image = cv2.GaussianBlur(image * light, (0, 0), BLUR_PX)
    image += GREY_NOISE * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _on_plane(from_ray: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Homogeneous coordinates in the board's plane: linear in the rays."""
    one, two, three = (r[0] * x + r[1] * y + r[2] for r in from_ray)
    return one, two, three


def _cell(board: Board, one: Array, two: Array, three: Array) -> tuple[Cells, Cells]:
    """Whole squares of positions, from the outer corner of the first; beyond two squares off the board any such number."""
    columns, rows = board.inner_corners
    scale = 1.0 / (three * board.square_mm)
    return (
        np.floor(np.clip(one * scale + 1.0, -2.0, columns + 3.0)).astype(np.int16),
        np.floor(np.clip(two * scale + 1.0, -2.0, rows + 3.0)).astype(np.int16),
    )


def _colour(board: Board, a: Cells, b: Cells) -> Grey:
    columns, rows = board.inner_corners
    dark = ((a + b) & 1 == 0) & (a >= 0) & (b >= 0) & (a < columns + 1) & (b < rows + 1)
    return np.where(dark, np.float32(DARK), np.float32(BRIGHT))


def _on_edge(board: Board, a: Cells, b: Cells) -> NDArray[np.bool_]:
    """Pixels (height, width) on and near the board whose corners (height + 1, width + 1) lie in different squares."""
    columns, rows = board.inner_corners
    cell = a * np.int16(64) + b
    here, a, b = cell[:-1, :-1], a[:-1, :-1], b[:-1, :-1]
    near = (a >= -1) & (b >= -1) & (a < columns + 2) & (b < rows + 2)
    return near & ((cell[1:, 1:] != here) | (cell[1:, :-1] != here) | (cell[:-1, 1:] != here))


def _supersampled(
    board: Board, from_ray: Array, rays: PixelRays, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> Grey:
    """Mean colour of the given pixels; rays inside a pixel are bilinear in its corners' (error < 1e-5 px)."""
    k = np.arange(SAMPLES)
    s, t = (k + 0.5) / SAMPLES, ((34 * k) % SAMPLES + 0.5) / SAMPLES
    weights = np.stack([(1 - t) * (1 - s), (1 - t) * s, t * (1 - s), t * s])
    out = np.empty(rows.size, np.float32)
    for start in range(0, rows.size, 2048):  # blocks that stay in the cache
        r, c = rows[start : start + 2048, None] + (0, 0, 1, 1), columns[start : start + 2048, None] + (0, 1, 0, 1)
        inside = [corner @ weights for corner in _on_plane(from_ray, rays.x[r, c], rays.y[r, c])]
        out[start : start + 2048] = _colour(board, *_cell(board, *inside)).mean(axis=1)
    return out
