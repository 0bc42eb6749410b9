"""Parquet layout of the warehouse: names, atomic writes, hashes, column-projected reads. No decision is taken here.

    <table>/day=<day>/scan_id=<unit>/<version>.parquet     one file a scan (clouds, features)
    <table>/day=<day>/<version>.parquet                    one file a day (light tables)
    <table>/calibration_id=<id>/<version>.parquet          one file a calibration
    <table>/<version>.parquet                              one file for the fleet

A file is named by the hash of its bytes and never changes; the ledger says which one is current. So a reader sees
either the old state or the new one, and a crash leaves at worst a file that nobody names. In object storage the names
are the same, and an object appears whole or not at all.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from warehouse import place
from wheelset_assets.declare import Table
from wheelset_assets.tables import TABLES

VERSION_DIGITS = 16
SMALL_BYTES = 2**20
"""Up to so many bytes, a table is written by way of memory, and its file need not be read to be hashed."""
SMALL_ROWS = 100_000
"""Up to so many rows, a table is read sooner by one thread than shared out to several."""


def sha256_file(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def table_hash(table: pa.Table) -> str:
    """Content hash of an Arrow table: names and values, whatever its chunks, offsets, or bytes under its nulls."""
    sink = pa.BufferOutputStream()
    pq.write_table(
        table.combine_chunks(),
        sink,
        compression="none",
        use_dictionary=False,
        store_schema=False,
        write_statistics=False,
    )
    return hashlib.sha256(memoryview(sink.getvalue())).hexdigest()[:VERSION_DIGITS]


def folder(root: Path, table: Table, day: str | None, key: str | None) -> Path:
    """Folder of a table's file for a day and unit, a day, a calibration, or the fleet."""
    base = root / table.name
    if table.layout == "scan":
        return base / f"day={day}" / f"scan_id={key}"
    if table.layout == "day":
        return base / f"day={day}"
    if table.layout == "calibration":
        return base / f"calibration_id={key}"
    return base


def write_table(
    root: Path, table: Table, data: pa.Table, day: str | None, key: str | None, *, flushed: bool = True
) -> tuple[str, str, int]:
    """Write data atomically under the hash of its bytes; returns (path relative to root, version, size in bytes).

    flushed: on disk when this returns; else `flush_all` must follow before anything names the file.
    Single floats are split by bytes before compression: their exponents and high mantissas repeat, their noise does not.
    """
    within = folder(root, table, day, key)
    if place.is_remote(root):
        sink = pa.BufferOutputStream()
        pq.write_table(data, sink, **_encoding(table))
        content = sink.getvalue()
        version = hashlib.sha256(memoryview(content)).hexdigest()[:VERSION_DIGITS]
        target = within / f"{version}.parquet"
        place.put(target, content.to_pybytes())
        return target.relative_to(root).as_posix(), version, content.size
    _make_folder(within, flushed=flushed and table.layout != "scan", above=flushed)
    temporary = within / f".tmp-{os.getpid()}-{table.name}.parquet"
    if data.nbytes <= SMALL_BYTES:
        sink = pa.BufferOutputStream()
        pq.write_table(data, sink, **_encoding(table))
        content = memoryview(sink.getvalue())
        digest = hashlib.sha256(content).hexdigest()
        temporary.write_bytes(content)
    else:
        pq.write_table(data, temporary, **_encoding(table))
        digest = sha256_file(temporary)
    size = temporary.stat().st_size
    version = digest[:VERSION_DIGITS]
    target = within / f"{version}.parquet"
    publish(temporary, target, flushed)
    return target.relative_to(root).as_posix(), version, size


@cache
def _syncfs() -> Callable[[int], int] | None:
    """The system's call that flushes a file system, where it has one (Linux)."""
    try:
        return ctypes.CDLL(None, use_errno=True).syncfs
    except (AttributeError, OSError, TypeError):
        return None


def can_flush_all(root: Path) -> bool:
    """Whether this machine can flush what its processes wrote to a warehouse in one call."""
    return not place.is_remote(root) and _syncfs() is not None


def flush_all(root: Path) -> None:
    """Flush everything that this machine wrote to the warehouse's file system: one call for thousands of files."""
    call = _syncfs()
    assert call is not None, "ask can_flush_all first"
    handle = os.open(root, os.O_RDONLY)
    try:
        if call(handle) != 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), str(root))
    finally:
        os.close(handle)


def flush_names(root: Path, day: str) -> None:
    """Flush the names of the scans' folders of a day: once for all of them, before the ledger names what is in them."""
    if place.is_remote(root):
        return
    for table in TABLES.values():
        if table.layout == "scan" and (parent := folder(root, table, day, "-").parent).is_dir():
            sync_folder(parent)


def _encoding(table: Table) -> dict:
    singles = [c.name for c in table.columns if c.type == "float32"]
    packed = [c.name for c in table.columns if c.type in ("int16", "int32", "int8") and table.layout == "scan"]
    dictionary = [c.name for c in table.columns if c.type in ("string", "category", "strings")]
    encoding = dict.fromkeys(singles, "BYTE_STREAM_SPLIT") | dict.fromkeys(packed, "DELTA_BINARY_PACKED")
    nested = {"strings": ".list.element"}
    return {
        "compression": "zstd",
        "compression_level": 3,
        "use_dictionary": [name + nested.get(table.column(name).type, "") for name in dictionary] or False,
        "column_encoding": encoding or None,
        "row_group_size": 131_072,
        "store_schema": True,
        "write_statistics": True,
    }


def publish(temporary: Path, target: Path, flushed: bool = True) -> None:
    """Make a finished temporary file visible under its name: flushed to disk, renamed, and the name flushed too, so that
    neither is lost with the power. Not `flushed`, it is only renamed.
    """
    if flushed:
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
    os.replace(temporary, target)
    if flushed:
        sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder's names to disk, where the system can (Windows cannot)."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _make_folder(folder: Path, flushed: bool = True, above: bool = True) -> None:
    """A folder with all above it; its own name is flushed to disk if `flushed`, the new names above it if `above`."""
    if folder.is_dir():
        return
    _make_folder(folder.parent, above, above)
    folder.mkdir(exist_ok=True)
    if flushed:
        sync_folder(folder.parent)


def write_bytes(target: Path, data: bytes) -> None:
    """Write a small file atomically."""
    if place.is_remote(target):
        place.put(target, data)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".tmp-{os.getpid()}-{target.name}")
    temporary.write_bytes(data)
    publish(temporary, target)


def read_table(root: Path, path: str, columns: list[str] | None = None) -> pa.Table:
    """A stored table, or some of its columns; dictionaries come back as dictionaries."""
    source = pa.BufferReader((root / path).read_bytes()) if place.is_remote(root) else root / path
    with pq.ParquetFile(source) as file:  # a third of what a data set of one file costs
        table = file.read(columns=columns, use_threads=file.metadata.num_rows > SMALL_ROWS)
    return table if columns is None else table.select(columns)


def files_of(root: Path, table: Table) -> set[str]:
    """Paths, relative to root, of all files of a table, whether the ledger names them or not."""
    base = root / table.name
    if place.is_remote(root):
        return {f"{table.name}/{name}" for name in place.objects(base) if name.endswith(".parquet")}
    return {p.relative_to(root).as_posix() for p in base.rglob("*.parquet")}


def sweep_temporary(root: Path) -> int:
    """Remove temporary files that a killed run left behind; call it while holding the warehouse's lock."""
    if place.is_remote(root):
        return 0  # an object that was not written to its end does not exist
    walk = os.walk(root)
    stray = [Path(base, name) for base, _, names in walk for name in names if name.startswith(".tmp-")]
    for path in stray:
        path.unlink(missing_ok=True)
    return len(stray)
