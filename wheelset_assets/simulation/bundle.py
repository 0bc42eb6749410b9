"""Files of the bundle format, written deterministically: Parquet, PNG, JSON with hashes, published by rename.

Here: how each kind of file is written. Not here: what is in it (`campaign`), and deliberate damage (`faults`).
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from .stripes import Stripes

Array = NDArray[np.float64]


def sha256(path: Path) -> str:
    """Hash of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def file_hashes(folder: Path) -> dict[str, str]:
    """{relative path: sha256} of every file under a folder, in order of path."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): sha256(p) for p in files}


def write_frames(path: Path, angle_deg: Array) -> None:
    """frames.parquet: frame numbers and reported angles (deg)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = np.arange(angle_deg.size, dtype=np.int32)
    pq.write_table(pa.table({"frame": frame, "angle_deg": angle_deg}), path, compression="zstd")


def write_stripes(path: Path, lines: Sequence[Stripes], keep: NDArray[np.bool_] | None = None) -> None:
    """stripes/<sensor_id>.parquet: rows ordered by frame, then line; `keep` (frames,) leaves frames out."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frames, rows = lines[0].left_u.shape
    kept = np.arange(frames) if keep is None else np.flatnonzero(keep)
    columns: dict[str, pa.Array] = {
        "frame": pa.array(np.repeat(kept, len(lines)).astype(np.int32)),
        "line": pa.array(np.tile(np.arange(len(lines)), kept.size).astype(np.int8)),
    }
    for name in ("left_u", "right_u"):
        values = np.stack([getattr(line, name)[kept] for line in lines], axis=1).astype(np.float32)
        columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), rows)
    # A dictionary of noise only costs time; zstd still finds the exponents after the bytes are split.
    pq.write_table(
        pa.table(columns),
        path,
        compression="zstd",
        compression_level=1,
        use_dictionary=False,
        use_byte_stream_split=["left_u.list.element", "right_u.list.element"],
        write_statistics=False,
    )


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """An 8-bit grey PNG."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise OSError(f"cannot encode {path}")
    path.write_bytes(data.tobytes())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """A JSON file, written beside and renamed into place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.part")
    beside.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    os.replace(beside, path)


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """A CSV file with a header."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")


def publish(staged: Path, final: Path, json_name: str, content: Mapping[str, Any] | bytes) -> None:
    """Move a finished folder to its place, then write its JSON (or bytes) by rename: the mark of completeness."""
    if final.exists():
        shutil.rmtree(final)
    final.parent.mkdir(parents=True, exist_ok=True)
    os.replace(staged, final)
    if isinstance(content, bytes):
        beside = final / f".{json_name}.part"
        beside.write_bytes(content)
        os.replace(beside, final / json_name)
    else:
        write_json(final / json_name, content)
