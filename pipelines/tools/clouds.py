"""Point clouds from files of any origin: PLY, PCD, XYZ and other text, E57, Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.quality import ConfigError

Array = NDArray[Any]

TEXT = {".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzn", ".xyzrgb"}
KINDS = "PLY, PCD, XYZ (text, three columns first), E57, Parquet (x, y, z or x_mm, y_mm, z_mm)"


def read_cloud(path: Path) -> Array:
    """Finite points (n, 3) of a file, in its own unit of length, without exact repeats. Raises ConfigError with the remedy."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    kind = path.suffix.lower()
    if kind not in _READERS:
        raise ConfigError(f"{path}: a cloud of kind {kind or '(none)'} is not known; known are {KINDS}")
    try:
        points = np.asarray(_READERS[kind](path), float)
    except (OSError, ValueError, RuntimeError, KeyError, ArithmeticError) as error:
        raise ConfigError(f"{path}: not readable as {kind[1:].upper()}: {error}") from error
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise ConfigError(f"{path}: holds no point with three finite coordinates")
    _, first = np.unique(points, axis=0, return_index=True)
    return points[np.sort(first)]


def _open3d(path: Path) -> Array:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        return np.asarray(open3d.io.read_point_cloud(path).points)


def _text(path: Path) -> Array:
    """Three columns first, parted by blanks, commas or semicolons; lines that begin with no number are left out."""
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        fields = line.replace(",", " ").replace(";", " ").split()[:3]
        try:
            rows.append([float(f) for f in fields])
        except ValueError:
            continue
    whole = [r for r in rows if len(r) == 3]
    if not whole:
        raise ValueError("no line begins with three numbers")
    return np.array(whole)


def _e57(path: Path) -> Array:
    """All scans of the file in its common frame."""
    import pye57

    file = pye57.E57(str(path))
    scans = [file.read_scan(k, ignore_missing_fields=True, transform=True) for k in range(file.scan_count)]
    parts = [np.column_stack([s[f"cartesian{axis}"] for axis in "XYZ"]) for s in scans]
    if not parts:
        raise ValueError("it holds no scan")
    return np.concatenate(parts)


def _parquet(path: Path) -> Array:
    import pyarrow.parquet as pq

    names = pq.read_schema(path).names
    for wanted in (("x", "y", "z"), ("x_mm", "y_mm", "z_mm"), ("X", "Y", "Z")):
        if set(wanted) <= set(names):
            table = pq.read_table(path, columns=list(wanted))
            return np.column_stack([table[c].to_numpy(zero_copy_only=False).astype(float) for c in wanted])
    raise ValueError(f"no columns x, y, z or x_mm, y_mm, z_mm among {', '.join(names)}")


_READERS = {
    ".ply": _open3d,
    ".pcd": _open3d,
    ".e57": _e57,
    ".parquet": _parquet,
    **dict.fromkeys(TEXT, _text),
}


def read_pose(path: Path) -> Array:
    """A rigid transform (4, 4) from a text file of four rows of four numbers. Raises ConfigError."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    try:
        numbers = [float(f) for f in path.read_text(encoding="utf-8").replace(",", " ").split()]
    except ValueError as error:
        raise ConfigError(f"{path}: {error}; expected four rows of four numbers, target_from_source") from error
    if len(numbers) != 16:
        raise ConfigError(f"{path}: {len(numbers)} numbers; expected four rows of four, target_from_source")
    pose = np.array(numbers).reshape(4, 4)
    if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-9):
        raise ConfigError(f"{path}: the last row is {pose[3].tolist()}; expected 0 0 0 1 (points are columns)")
    u, _, vt = np.linalg.svd(pose[:3, :3])
    nearest = u @ vt
    if np.abs(nearest - pose[:3, :3]).max() > 1e-3 or np.linalg.det(nearest) < 0:
        raise ConfigError(f"{path}: its upper left 3 x 3 is no rotation (is there a scale or a reflection in it?)")
    pose[:3, :3] = nearest
    return pose
