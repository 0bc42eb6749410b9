"""Mutations of scan bundles, for the fuzzer: each spoils a copy of a good bundle in one way, chosen by a seed.

Here: what is done to files, JSON, names and values. Not here: what must come of it (`fuzz`). A mutation gets the scan's
folder and a random generator; it may rename the folder, and returns what it did, for people. `sealed` kinds write the
hashes anew afterwards, as a rig with that fault would; the others leave them stale.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

Random = np.random.Generator


@dataclass(frozen=True)
class Mutation:
    """One kind. `payload`: it touches files alone and seals them, so that values must stay, be flagged or be refused."""

    kind: str
    strike: Callable[[Path, Random], str]
    sealed: bool = False
    payload: bool = False


def seal(folder: Path) -> None:
    """Hashes of all files of a bundle, as they are now, into its JSON."""
    path = folder / "scan.json"
    content = json.loads(path.read_text())
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p != path]
    content["files"] = {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    _replace(path, json.dumps(content).encode())


# --- bytes -------------------------------------------------------------------------------------------------------


def _file(folder: Path, random: Random) -> Path:
    return _pick(sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "scan.json"), random)


def _pick(items: Any, random: Random) -> Any:
    return items[int(random.integers(len(items)))]


def _replace(path: Path, data: bytes) -> None:
    """New bytes under a name; the old ones may be shared with the good bundle by a hard link."""
    path.unlink()
    path.write_bytes(data)


def flip_bits(folder: Path, random: Random) -> str:
    """One to eight bits of a file turned over."""
    path = _file(folder, random)
    data = bytearray(path.read_bytes())
    for _ in range(int(random.integers(1, 9))):
        data[int(random.integers(len(data)))] ^= 1 << int(random.integers(8))
    _replace(path, bytes(data))
    return f"bits of {path.name}"


def flip_footer(folder: Path, random: Random) -> str:
    """Bits of a Parquet file's footer, where its types and sizes stand."""
    path = _file(folder, random)
    data = bytearray(path.read_bytes())
    length = min(struct.unpack("<I", data[-8:-4])[0], len(data) - 8)
    for _ in range(int(random.integers(1, 4))):
        data[len(data) - 8 - 1 - int(random.integers(max(length, 1)))] ^= 1 << int(random.integers(8))
    _replace(path, bytes(data))
    return f"footer of {path.name}"


def truncate(folder: Path, random: Random) -> str:
    """A file cut off, perhaps to nothing."""
    path = _file(folder, random)
    data = path.read_bytes()
    kept = int(random.integers(len(data))) if random.random() < 0.8 else 0
    _replace(path, data[:kept])
    return f"{path.name} cut to {kept} bytes"


def zero_block(folder: Path, random: Random) -> str:
    """A block of a file zeroed, as by a lost disk page."""
    path = _file(folder, random)
    data = bytearray(path.read_bytes())
    start = int(random.integers(len(data)))
    end = min(len(data), start + int(random.integers(1, 4097)))
    data[start:end] = bytes(end - start)
    _replace(path, bytes(data))
    return f"{path.name}: bytes {start} to {end} zeroed"


def append(folder: Path, random: Random) -> str:
    """Rubbish after the end of a file."""
    path = _file(folder, random)
    _replace(path, path.read_bytes() + random.bytes(int(random.integers(1, 2000))))
    return f"rubbish after {path.name}"


def other_content(folder: Path, random: Random) -> str:
    """Something that is no Parquet file under a Parquet file's name."""
    path = _file(folder, random)
    kinds = {"nothing": b"", "text": b"PAR1 or not", "json": b"{}", "noise": random.bytes(5000), "magic": b"PAR1PAR1"}
    name = _pick(sorted(kinds), random)
    _replace(path, kinds[name])
    return f"{path.name} holds {name}"


def swap_files(folder: Path, random: Random) -> str:
    """Two sensors' files under each other's names."""
    files = sorted((folder / "stripes").glob("*.parquet"))
    a, b = (files[i] for i in random.choice(len(files), 2, replace=False))
    first, second = a.read_bytes(), b.read_bytes()
    _replace(a, second)
    _replace(b, first)
    return f"{a.name} and {b.name} swapped"


def frames_as_stripes(folder: Path, random: Random) -> str:
    """The encoder's table under a sensor's name, or the other way round."""
    stripes = _pick(sorted((folder / "stripes").glob("*.parquet")), random)
    frames = folder / "frames.parquet"
    source, target = (frames, stripes) if random.random() < 0.5 else (stripes, frames)
    _replace(target, source.read_bytes())
    return f"{source.name} under the name {target.name}"


# --- values ------------------------------------------------------------------------------------------------------


def _stripes(folder: Path, random: Random) -> tuple[Path, pa.Table]:
    path = _pick(sorted((folder / "stripes").glob("*.parquet")), random)
    return path, pq.read_table(path)


def _write(path: Path, table: pa.Table) -> None:
    path.unlink()
    pq.write_table(table, path)


def _centres(table: pa.Table, name: str) -> np.ndarray:
    column = table[name].combine_chunks()
    return np.array(column.flatten()).reshape(len(column), -1)


def _with_centres(table: pa.Table, name: str, values: np.ndarray) -> pa.Table:
    flat = pa.array(np.ascontiguousarray(values, np.float32).ravel())
    return table.set_column(
        table.schema.get_field_index(name), name, pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    )


def odd_values(folder: Path, random: Random) -> str:
    """NaN, infinities, huge or tiny numbers among the centres: single ones, whole frames, or all of a camera."""
    path, table = _stripes(folder, random)
    name = _pick(["left_u", "right_u"], random)
    values = _centres(table, name).copy()
    odd = _pick([np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0, -1.0, 3.4e38, 1e-40], random)
    share = _pick([0.001, 0.05, 0.5, 1.0], random)
    where = random.random(values.shape) < share if random.random() < 0.5 else random.random((len(values), 1)) < share
    values[np.broadcast_to(where, values.shape)] = odd
    _write(path, _with_centres(table, name, values))
    return f"{path.name}: {odd} in {share:.1%} of {name}"


def value_bits(folder: Path, random: Random) -> str:
    """Bits of single centres turned over, exponents and signs too."""
    path, table = _stripes(folder, random)
    name = _pick(["left_u", "right_u"], random)
    values = _centres(table, name).astype(np.float32)
    n = int(_pick([1, 10, 200], random))
    at = random.integers(values.size, size=n)
    bits = values.reshape(-1).view(np.uint32)
    np.bitwise_xor.at(bits, at, np.uint32(1) << random.integers(32, size=n).astype(np.uint32))
    _write(path, _with_centres(table, name, values))
    return f"{path.name}: a bit of {n} values of {name}"


def swap_cameras(folder: Path, random: Random) -> str:
    """Left and right camera exchanged."""
    path, table = _stripes(folder, random)
    left, right = _centres(table, "left_u"), _centres(table, "right_u")
    _write(path, _with_centres(_with_centres(table, "left_u", right), "right_u", left))
    return f"{path.name}: cameras exchanged"


def shuffle_frames(folder: Path, random: Random) -> str:
    """One camera's frames in another order than the other's."""
    path, table = _stripes(folder, random)
    name = _pick(["left_u", "right_u"], random)
    values = _centres(table, name)
    _write(path, _with_centres(table, name, values[random.permutation(len(values))]))
    return f"{path.name}: frames of {name} shuffled"


def few_frames(folder: Path, random: Random) -> str:
    """Most frames of a sensor, or a run of them, missing: allowed, and to be told."""
    path, table = _stripes(folder, random)
    kept = int(random.integers(0, table.num_rows))
    start = int(random.integers(0, table.num_rows - kept + 1))
    _write(path, table.slice(start, kept))
    return f"{path.name}: {kept} of {table.num_rows} rows kept"


def odd_frames(folder: Path, random: Random) -> str:
    """Encoder table with gaps, repeats, falling, absurd or missing angles."""
    path = folder / "frames.parquet"
    table = pq.read_table(path)
    frame, angle = np.array(table["frame"]), np.array(table["angle_deg"])
    k = int(random.integers(len(angle)))
    changes: dict[str, Callable[[], tuple[Any, Any]]] = {
        "NaN": lambda: (frame, np.where(np.arange(len(angle)) == k, np.nan, angle)),
        "infinite": lambda: (frame, np.where(np.arange(len(angle)) == k, np.inf, angle)),
        "falling": lambda: (frame, angle[::-1]),
        "tenfold": lambda: (frame, angle * 10),
        "a tenth": lambda: (frame, angle * 0.1),
        "1e300": lambda: (frame, angle + np.where(np.arange(len(angle)) >= k, 1e300, 0)),
        "repeated": lambda: (frame, np.repeat(angle[:1], len(angle))),
        "shorter": lambda: (frame[:k], angle[:k]),
        "jump": lambda: (frame, angle + np.where(np.arange(len(angle)) >= k, 1e-3, 0)),
        "frame numbers from one": lambda: (frame + 1, angle),
        "none": lambda: (frame[:0], angle[:0]),
    }
    name = _pick(sorted(changes), random)
    frame, angle = changes[name]()
    path.unlink()
    pq.write_table(pa.table({"frame": pa.array(frame, pa.int32()), "angle_deg": pa.array(angle, pa.float64())}), path)
    return f"angles: {name}"


def odd_types(folder: Path, random: Random) -> str:
    """A column of another type, missing, doubled, null, or of lists of other lengths."""
    path, table = _stripes(folder, random)
    name = _pick(["frame", "line", "left_u", "right_u"], random)
    at, n = table.schema.get_field_index(name), table.num_rows
    columns: dict[str, Callable[[], pa.Array]] = {
        "text": lambda: pa.array(["7"] * n),
        "bool": lambda: pa.array([True] * n),
        "null": lambda: pa.nulls(n, table.schema.field(name).type),
        "negative": lambda: pa.array([-5] * n, pa.int32()),
        "huge": lambda: pa.array([2**31 - 1] * n, pa.int32()),
        "structs": lambda: pa.array([{"a": 1.0}] * n),
        "dates": lambda: pa.array([0] * n, pa.date32()),
        "ragged lists": lambda: pa.array([[1.0] * (i % 5) for i in range(n)], pa.list_(pa.float32())),
        "lists of text": lambda: pa.array([["x"]] * n),
        "lists of lists": lambda: pa.array([[[1.0]]] * n),
        "decimals": lambda: pa.array([1] * n).cast(pa.decimal128(20, 2)),
        "empty lists": lambda: pa.array([[]] * n, pa.list_(pa.float32())),
    }
    kind = _pick([*sorted(columns), "missing", "doubled"], random)
    if kind == "missing":
        table = table.drop_columns([name])
    elif kind == "doubled":
        table = table.append_column(name, table[name])
    else:
        table = table.set_column(at, name, columns[kind]())
    _write(path, table)
    return f"{path.name}: {name} {kind}"


def absurd_size(folder: Path, random: Random) -> str:
    """Small files that claim or unpack to very much."""
    path = _pick(sorted((folder / "stripes").glob("*.parquet")), random)
    kind = _pick(["rows", "lists", "frames", "image", "columns"], random)
    if kind == "rows":  # a million rows of one short list, a few kilobytes on disk
        n = 1_000_000
        column = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(n * 16, np.float32)), 16)
        table = pa.table(
            {"frame": pa.array(np.zeros(n, np.int32)), "line": pa.array(np.zeros(n, np.int8))}
            | {"left_u": column, "right_u": column}
        )
        _write_small(path, table)
    elif kind == "lists":
        column = pa.array([[0.0] * 2_000_000], pa.list_(pa.float32()))
        one = {"frame": pa.array([0], pa.int32()), "line": pa.array([0], pa.int8())}
        _write_small(path, pa.table(one | {"left_u": column, "right_u": column}))
    elif kind == "frames":
        n = 3_000_000
        table = pa.table({"frame": pa.array(np.arange(n, dtype=np.int32)), "angle_deg": np.linspace(0, 360, n)})
        _write_small(folder / "frames.parquet", table)
    elif kind == "columns":
        table = pq.read_table(path)
        extra = {f"x{i}": pa.array(np.zeros(table.num_rows, np.int8)) for i in range(2000)}
        _write_small(path, pa.table({c: table[c] for c in table.column_names} | extra))
    else:
        place = folder / "images" / path.stem
        path.unlink()
        for side in ("left", "right"):
            (place / side).mkdir(parents=True)
            (place / side / "000000.png").write_bytes(png(60_000, 60_000))
    return f"{path.name}: absurd {kind}"


def _write_small(path: Path, table: pa.Table) -> None:
    path.unlink()
    pq.write_table(table, path, compression="zstd", use_dictionary=True)


def png(width: int, height: int) -> bytes:
    """A PNG of any size in a few bytes: its header claims it, its data are a handful of zeros."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(bytes(10_000), 9))
        + chunk(b"IEND", b"")
    )


# --- JSON --------------------------------------------------------------------------------------------------------

HOSTILE: tuple[Any, ...] = (
    None, True, 0, -1, 1e308, -1e308, 10**400, float("nan"), float("inf"), "", " ", "NaN", "x" * 100_000, "\x00", "\ud800",
    "../../../../tmp/evil", "/etc/passwd", "C:\\evil", "\\\\host\\share", "con", "a" * 65, "é", "a/b", "a\nb",
    "'; DROP TABLE measurements; --", "<script>alert(1)</script>", "{{ 7 * 7 }}", "%s%n", [], {}, [[]], {"a": {"a": {}}},
    [None] * 1000, "9999-12-31T23:59:59-23:59", "0001-01-01T00:00:00+23:59", "2025-02-30T00:00:00+00:00", "1743811200",
    "2025-04-05T08:00:00", "2025-04-05", 1743811200,
)  # fmt: skip


def _paths(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [at] if at else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        found += _paths(inner, (*at, key))
    return found


def hostile_json(folder: Path, random: Random) -> str:
    """A value of scan.json replaced by something hostile, removed, or a key added."""
    path = folder / "scan.json"
    content = json.loads(path.read_text())
    where = _pick(_paths(content), random)
    target = content
    for key in where[:-1]:
        target = target[key]
    what = "removed"
    if random.random() < 0.15:
        del target[where[-1]]
    elif random.random() < 0.1 and isinstance(target, dict):
        target[str(_pick([v for v in HOSTILE if isinstance(v, str)], random))[:200]] = target.pop(where[-1])
        what = "renamed"
    else:
        value = _pick(HOSTILE, random)
        target[where[-1]], what = value, f"set to {str(value)[:40]!r}"
    _replace(path, json.dumps(content, ensure_ascii=True).encode())
    return f"scan.json {'.'.join(map(str, where))} {what}"


def broken_json(folder: Path, random: Random) -> str:
    """scan.json with its bytes turned over or cut, nested without end, of another encoding, or no object."""
    path = folder / "scan.json"
    good = path.read_bytes()
    flipped = bytearray(good)
    for _ in range(int(random.integers(1, 6))):
        flipped[int(random.integers(len(good)))] ^= 1 << int(random.integers(8))
    cases = {
        "flipped": bytes(flipped),
        "cut": good[: int(random.integers(len(good)))],
        "nested": b"[" * 200_000,
        "nested objects": b'{"a":' * 100_000,
        "utf-16": good.decode().encode("utf-16"),
        "bom": b"\xef\xbb\xbf" + good,
        "array": b"[1, 2]",
        "number": b"7",
        "empty": b"",
        "NaN": good.replace(b"20", b"NaN", 1),
        "twice": good + good,
        "long number": b'{"format": ' + b"9" * 100_000 + b"}",
        "nul": good + b"\x00",
        "doubled key": good.rstrip()[:-1] + b', "scan_id": "../evil"}',
        "comment": b"// x\n" + good,
    }
    name = _pick(sorted(cases), random)
    _replace(path, cases[name])
    return f"scan.json {name}"


# --- names and file system -----------------------------------------------------------------------------------------

FILE_NAMES = (
    "../../evil.parquet", "/tmp/evil.parquet", "..\\..\\evil.parquet", "C:evil.parquet", "stripes//a.parquet", "./frames.parquet",
    "stripes/../frames.parquet", "stripes/con.parquet", "stripes/left_wheel_inner.PARQUET", "STRIPES/left_wheel_inner.parquet",
    "images/x/left/000000.png", "images/../../x.png", "stripes/é.parquet", "stripes/a\nb.parquet", "scan.json", "",
    "stripes/" + "a" * 300 + ".parquet", "stripes/-rf.parquet", "stripes/$(id).parquet", "stripes/'.parquet",
)  # fmt: skip


def hostile_list(folder: Path, random: Random) -> str:
    """A path in `files` that leaves the folder, or is not what the format knows."""
    path = folder / "scan.json"
    content = json.loads(path.read_text())
    name = _pick(FILE_NAMES, random)
    old = _pick(sorted(content["files"]), random)
    digest = content["files"].pop(old) if random.random() < 0.5 else content["files"][old]
    content["files"][name] = digest
    _replace(path, json.dumps(content).encode())
    return f"files: {name!r} listed"


def hostile_file(folder: Path, random: Random) -> str:
    """A file under an odd name, with its right hash."""
    names = [n for n in FILE_NAMES if ".." not in n and n and not n.startswith("/") and len(n) < 200]
    name = _pick([n for n in names if n != "scan.json" and n != "./frames.parquet"], random)
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    target.write_bytes(_file(folder, random).read_bytes())
    return f"file {name!r}"


FOLDER_NAMES = (
    b"a" * 65, b"con", b"COM1.x", b"-rf", b"a b", b"\xff\xfe", b"a\nb", "é".encode(), b"..a", b"a;b", b"$(id)", b"%2e%2e",
    b"a'b", b'a"b', b"<b>", b"a@b", b"scan=1", b"a" * 200,
)  # fmt: skip


def hostile_folder(folder: Path, random: Random) -> str:
    """The bundle under a folder name that is no identifier, its JSON saying the same where it can."""
    name = _pick(FOLDER_NAMES, random)
    content = json.loads((folder / "scan.json").read_text())
    if random.random() < 0.7:
        content["scan_id"] = os.fsdecode(name).encode("utf-8", "replace").decode()
        _replace(folder / "scan.json", json.dumps(content).encode())
    folder.rename(folder.parent / os.fsdecode(name))
    return f"folder {name!r}"


def odd_file(folder: Path, random: Random) -> str:
    """A link, a pipe, a folder or nothing in a file's place, or a further file."""
    path = _file(folder, random)
    kind = _pick(["link out", "link to twin", "pipe", "folder", "gone", "further", "link loop", "json link"], random)
    if kind == "json link":
        twin = folder / "twin.json"
        (folder / "scan.json").rename(twin)
        (folder / "scan.json").symlink_to(twin.name)
    elif kind == "further":
        (folder / "leftover.txt").write_text("x")
    else:
        path.unlink()
        if kind == "link out":
            path.symlink_to("/etc/hostname")
        elif kind == "link to twin":
            path.symlink_to(_file(folder, random))
        elif kind == "link loop":
            path.symlink_to(path.name)
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
    return f"{path.name}: {kind}"


MUTATIONS: dict[str, Mutation] = {
    m.kind: m
    for m in (
        Mutation("flip-bits", flip_bits, sealed=True, payload=True),
        Mutation("flip-footer", flip_footer, sealed=True, payload=True),
        Mutation("truncate", truncate, sealed=True, payload=True),
        Mutation("zero-block", zero_block, sealed=True, payload=True),
        Mutation("append", append, sealed=True, payload=True),
        Mutation("other-content", other_content, sealed=True, payload=True),
        Mutation("swap-files", swap_files, sealed=True, payload=True),
        Mutation("frames-as-stripes", frames_as_stripes, sealed=True, payload=True),
        Mutation("odd-values", odd_values, sealed=True, payload=True),
        Mutation("value-bits", value_bits, sealed=True, payload=True),
        Mutation("swap-cameras", swap_cameras, sealed=True, payload=True),
        Mutation("shuffle-frames", shuffle_frames, sealed=True, payload=True),
        Mutation("few-frames", few_frames, sealed=True, payload=True),
        Mutation("odd-frames", odd_frames, sealed=True, payload=True),
        Mutation("odd-types", odd_types, sealed=True, payload=True),
        Mutation("absurd-size", absurd_size, sealed=True, payload=True),
        Mutation("unsealed", flip_bits),
        Mutation("hostile-json", hostile_json),
        Mutation("broken-json", broken_json),
        Mutation("hostile-list", hostile_list),
        Mutation("hostile-file", hostile_file, sealed=True),
        Mutation("hostile-folder", hostile_folder),
        Mutation("odd-file", odd_file),
    )
}
