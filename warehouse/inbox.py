"""The inbox: lists, verifies and reads scan bundles of format 1. Refuses with file, key and expectation; never writes.

Everything that comes from outside is bounded and checked here, before a stage sees it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path, PurePosixPath

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.parquet as pq
from pydantic import ValidationError

from warehouse import place
from warehouse.bounds import is_passing, with_retries
from warehouse.store import sha256_file
from wheelset_assets.bundle import IDENTIFIER, RESERVED, CalibrationHeader, Rig, ScanHeader, explain
from wheelset_assets.quality import ConfigError, ScanUnusable
from wheelset_assets.stages.raw import Boards, Frames, StripeImages, Stripes, StripeTable

MAX_JSON_BYTES = 64 * 2**20
MAX_PIXELS = 64 * 2**20
MAX_FRAMES = 1_000_000
MAX_CELLS = 2**25
"""Frames times image rows of a sensor's organised grid: 32,768 frames of 1,024 rows."""
IMAGES_AT_ONCE = 32


class BundleRefused(ScanUnusable):
    """A bundle whose JSON is in order though its files are not: `header_json` tells what it claims to be."""

    header_json: str = ""


@dataclass(frozen=True)
class Entry:
    """A bundle folder as the file system shows it; `signature` changes with any file's name, size or time.

    `identifier` is the folder's name, in printable form if it is not UTF-8 (then it is no identifier, and is refused).
    """

    identifier: str
    folder: Path
    signature: str


@dataclass(frozen=True)
class Verified:
    """A bundle whose files are all there with the hashes that its JSON lists."""

    header: ScanHeader | CalibrationHeader
    header_json: str
    header_sha256: str
    files: dict[str, str]

    @property
    def version(self) -> str:
        """Hash over the JSON's hash and every file's."""
        lines = [f"{self.header_sha256}  json", *(f"{sha}  {name}" for name, sha in sorted(self.files.items()))]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()


class Inbox:
    """A folder in the scan-bundle format."""

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            raise ConfigError(f"{root}: there is no such folder; name the inbox by --inbox or WHEELSET_INBOX")
        if not (root / "scans").is_dir() and not (root / "rigs").is_dir():
            raise ConfigError(
                f"{root}: not an inbox: it has neither a folder scans/ nor rigs/ (see the scan-bundle format)"
            )
        self.root = root.resolve()
        self._listed: dict[str, dict[str, dict]] = {}
        self._unread_rigs: set[str] = set()

    def scans(self) -> list[Entry]:
        """Complete scan bundles (those whose scan.json is there), by name."""
        return self._entries("scans", "scan.json")

    def calibrations(self) -> list[Entry]:
        """Complete calibration bundles, by name."""
        return self._entries("calibrations", "calibration.json")

    def _entries(self, kind: str, header: str) -> list[Entry]:
        base = self.root / kind
        if place.is_remote(base):
            return self._object_entries(kind, header)
        if not base.is_dir():
            return []
        try:
            with os.scandir(base) as found:
                folders = sorted(item.name for item in found if item.is_dir() and not item.name.startswith("."))
        except OSError as error:
            raise ConfigError(f"{base}: cannot be read: {error.strerror}") from error
        return [
            Entry(printable(name), base / name, _signature(base / name))
            for name in folders
            if os.path.lexists(base / name / header)
        ]

    def _object_entries(self, kind: str, header: str) -> list[Entry]:
        """Entries of an inbox in object storage; the signature changes with any object's name, size, ETag or time."""
        bundles: dict[str, dict[str, dict]] = {}
        for name, facts in self._listing(kind).items():
            folder, _, file = name.partition("/")
            if file and not folder.startswith("."):
                bundles.setdefault(folder, {})[file] = facts
        return [
            Entry(printable(folder), self.root / kind / folder, _object_signature(files))
            for folder, files in sorted(bundles.items())
            if header in files
        ]

    def _listing(self, kind: str) -> dict[str, dict]:
        """Objects of a folder, listed once: a listing of a thousand bundles takes as many requests as there are files / 1000."""
        if kind not in self._listed:
            self._listed[kind] = place.objects(self.root / kind)
        return self._listed[kind]

    @cached_property
    def rigs(self) -> dict[str, tuple[Rig | None, str, str | None]]:
        """Rigs by file name: (rig or None, sha256 of its file, why it cannot be used)."""
        found: dict[str, tuple[Rig | None, str, str | None]] = {}
        for path in sorted((self.root / "rigs").glob("*.json")) if (self.root / "rigs").is_dir() else []:
            try:
                text, sha = with_retries(partial(read_json_text, path, f"rigs/{path.name}"))
                rig = Rig.model_validate_json(text)
                if rig.rig_id != path.stem:
                    raise ScanUnusable(
                        f"rigs/{path.name}: key rig_id: expected {path.stem!r}, the file's name; found {rig.rig_id!r}"
                    )
                found[path.stem] = (rig, sha, None)
            except ValidationError as error:
                found[path.stem] = (None, sha256_file(path), explain(error, f"rigs/{path.name}"))
            except ScanUnusable as error:
                found[path.stem] = (None, "", str(error))
            except OSError as error:
                found[path.stem] = (None, "", f"rigs/{path.name}: cannot be read: {error.strerror}")
                if is_passing(error):
                    self._unread_rigs.add(path.stem)
        return found

    @property
    def unread_rigs(self) -> set[str]:
        """Rigs whose file did not answer, though nothing speaks against it."""
        return self._unread_rigs if self.rigs else set()

    def reviews(self) -> list[Path]:
        """Review files of independent instruments."""
        return sorted((self.root / "cmm").glob("*.csv")) if (self.root / "cmm").is_dir() else []

    def verify_scan(self, entry: Entry) -> Verified:
        """Header and hashes of a scan bundle; ScanUnusable if anything is amiss."""
        with _staged(entry) as local:
            verified = _verify(local, "scan.json", ScanHeader, "scan_id")
        name = f"scans/{entry.identifier}"
        try:
            if "frames.parquet" not in verified.files:
                raise BundleRefused(f"{name}/scan.json: key files: expected frames.parquet among the files")
            for file in verified.files:
                _check_scan_path(name, file)
        except BundleRefused as error:
            error.header_json = verified.header_json
            raise
        return verified

    def verify_calibration(self, entry: Entry) -> Verified:
        """Header and hashes of a calibration bundle; ScanUnusable if anything is amiss."""
        with _staged(entry) as local:
            return _verify(local, "calibration.json", CalibrationHeader, "calibration_id")


def printable(name: str) -> str:
    """A file's name as text that can be stored and shown, also if its bytes are not UTF-8."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def _signature(folder: Path) -> str:
    digest = hashlib.sha256()
    if folder.is_symlink():
        return f"link {folder.lstat().st_mtime_ns}"
    stack = [""]
    while stack:
        relative = stack.pop()
        try:
            with os.scandir(folder / relative) as items:
                for item in sorted(items, key=lambda i: i.name):
                    name = f"{relative}{item.name}"
                    if item.is_dir(follow_symlinks=False):
                        stack.append(name + "/")
                    else:
                        status = item.stat(follow_symlinks=False)
                        digest.update(os.fsencode(f"{name}\0{status.st_size}\0{status.st_mtime_ns}\n"))
        except OSError as error:  # gone or locked since it was listed; the verification says so
            digest.update(os.fsencode(f"{relative}\0{error.errno}\n"))
    return digest.hexdigest()[:16]


def _object_signature(files: dict[str, dict]) -> str:
    digest = hashlib.sha256()
    for name, facts in sorted(files.items()):
        digest.update(f"{name}\0{facts.get('size')}\0{facts.get('ETag')}\0{facts.get('LastModified')}\n".encode())
    return digest.hexdigest()[:16]


@contextmanager
def _staged(entry: Entry) -> Iterator[Entry]:
    """The entry with its folder on this machine. A name that is no identifier is left where it is: it will be refused."""
    if not _is_identifier(entry.identifier):
        yield entry
        return
    try:
        with place.staged(entry.folder) as folder:
            yield replace(entry, folder=folder)
    except place.BadName as error:
        raise ScanUnusable(f"{entry.folder.parent.name}/{entry.identifier}: {error}") from error


def _is_identifier(name: str) -> bool:
    return bool(IDENTIFIER.fullmatch(name)) and name.split(".")[0].lower() not in RESERVED


def read_json_text(path: Path, shown: str) -> tuple[str, str]:
    """Text of a JSON object and sha256 of its file; ScanUnusable if it is no plain file, too large, or no such JSON."""
    if path.is_symlink() or not path.is_file():
        raise ScanUnusable(f"{shown}: expected a plain file")
    if path.stat().st_size > MAX_JSON_BYTES:
        raise ScanUnusable(f"{shown}: {path.stat().st_size} bytes; expected at most {MAX_JSON_BYTES}")
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
        if not isinstance(json.loads(text), dict):
            raise ScanUnusable(f"{shown}: expected a JSON object")
    except (ValueError, RecursionError) as error:
        raise ScanUnusable(f"{shown}: not readable as JSON: {error}") from error
    return text, hashlib.sha256(data).hexdigest()


def _verify(entry: Entry, header_name: str, model: type[ScanHeader] | type[CalibrationHeader], key: str) -> Verified:
    shown = f"{entry.folder.parent.name}/{entry.identifier}"
    if entry.folder.is_symlink():
        raise ScanUnusable(f"{shown}: the folder is a link; expected a plain folder")
    if not _is_identifier(entry.identifier):
        raise ScanUnusable(f"{shown}: folder name: expected an identifier [A-Za-z0-9][A-Za-z0-9._-]{{0,63}}")
    text, sha = read_json_text(entry.folder / header_name, f"{shown}/{header_name}")
    try:
        header = model.model_validate_json(text)
    except ValidationError as error:
        raise ScanUnusable(explain(error, f"{shown}/{header_name}")) from error
    if getattr(header, key) != entry.identifier:
        raise ScanUnusable(
            f"{shown}/{header_name}: key {key}: expected {entry.identifier!r}, the folder's name; found {getattr(header, key)!r}"
        )
    try:
        return Verified(header, text, sha, _verify_files(entry.folder, shown, header_name, header.files))
    except BundleRefused as error:
        error.header_json = text
        raise


def _verify_files(folder: Path, shown: str, header_name: str, listed: dict[str, str]) -> dict[str, str]:
    folded: dict[str, str] = {}
    for name in listed:
        if why := _leaves(name):
            raise BundleRefused(f"{shown}/{header_name}: key files: path {name!r} {why}")
        if other := folded.get(name.casefold()):
            raise BundleRefused(
                f"{shown}/{header_name}: key files: {other!r} and {name!r} differ in letter case alone; "
                "many file systems hold one of them"
            )
        folded[name.casefold()] = name
    if header_name in listed:
        raise BundleRefused(f"{shown}/{header_name}: key files: expected every file but {header_name} itself")
    present = _files_below(folder, shown) - {header_name}
    if missing := sorted(set(listed) - present):
        raise BundleRefused(f"{shown}: file {missing[0]} is missing, though {header_name} lists it" + _more(missing))
    if unlisted := sorted(present - set(listed)):
        name = printable(unlisted[0])
        raise BundleRefused(f"{shown}: file {name} is not listed in {header_name}: key files" + _more(unlisted))
    found = {}
    for name, expected in listed.items():
        try:
            found[name] = sha256_file(folder / name)
        except OSError as error:
            if is_passing(error):
                raise
            refused = BundleRefused(f"{shown}/{name}: cannot be read: {error.strerror}")
            refused.may_pass = True  # neither size nor time of a file changes with its permissions
            raise refused from error
        if found[name] != expected.lower():
            raise BundleRefused(f"{shown}/{name}: sha256 is {found[name][:12]}…, {header_name} lists {expected[:12]}…")
    return found


@lru_cache(maxsize=1024)
def _leaves(name: str) -> str | None:
    """Why a listed path is no plain path within its folder, on this or another operating system; None if it is one."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name or str(path) != name or not path.parts:
        return "leaves the bundle or is not in plain relative form"
    for part in path.parts:
        if part.split(".")[0].lower() in RESERVED:
            return "names a device of Windows"
        if part.endswith((".", " ")) or any(ord(c) < 32 for c in part):
            return "ends in a dot or space, or holds a control character: another name on Windows"
    return None


def _files_below(folder: Path, shown: str) -> set[str]:
    """Relative names of all files of a bundle; anything but plain files and folders refuses it (a pipe would never end)."""
    present: set[str] = set()
    below = [""]
    while below:
        here = below.pop()
        with os.scandir(os.path.join(folder, here)) as entries:
            for entry in entries:
                relative = here + entry.name
                if entry.is_symlink():
                    raise BundleRefused(f"{shown}: {printable(relative)} is a link; expected plain files")
                if entry.is_file(follow_symlinks=False):
                    present.add(relative)
                elif entry.is_dir(follow_symlinks=False):
                    below.append(f"{relative}/")
                else:
                    raise BundleRefused(f"{shown}: {printable(relative)} is a device or pipe; expected plain files")
    return present


def _more(names: list[str]) -> str:
    return f" (and {len(names) - 1} more)" if len(names) > 1 else ""


def _check_scan_path(shown: str, file: str) -> None:
    parts = PurePosixPath(file).parts
    good = (
        file == "frames.parquet"
        or (len(parts) == 2 and parts[0] == "stripes" and parts[1].endswith(".parquet"))
        or (len(parts) == 4 and parts[0] == "images" and parts[2] in ("left", "right") and parts[3].endswith(".png"))
        or parts[0] not in ("stripes", "images")
    )
    if not good:
        raise BundleRefused(
            f"{shown}/{file}: expected stripes/<sensor_id>.parquet or images/<sensor_id>/<left|right>/<frame>.png"
        )


def _parquet(path: Path, shown: str, columns: dict[str, str], max_values: int) -> pa.Table:
    """Columns of a Parquet file after a look at its footer; ScanUnusable if it is damaged, too large or of other types."""
    try:
        file = pq.ParquetFile(path)
        missing = [name for name in columns if name not in file.schema_arrow.names]
        if missing:
            raise ScanUnusable(f"{shown}: column {missing[0]} is missing; expected {columns[missing[0]]}")
        if twice := [name for name in columns if file.schema_arrow.names.count(name) > 1]:
            raise ScanUnusable(f"{shown}: column {twice[0]} is there more than once")
        groups = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
        chunks = [group.column(c) for group in groups for c in range(file.metadata.num_columns)]
        total = sum(chunk.num_values for chunk in chunks if chunk.path_in_schema.split(".")[0] in columns)
        if total > max_values:
            raise ScanUnusable(f"{shown}: {total} values; expected at most {max_values}")
        return file.read(columns=list(columns))
    except (ScanUnusable, MemoryError):  # want of memory says nothing of the file
        raise
    except (pa.ArrowException, OSError, ValueError) as error:
        if is_passing(error):
            raise
        raise ScanUnusable(f"{shown}: not readable as Parquet: {str(error).splitlines()[0][:160]}") from error


def read_frames(folder: Path) -> Frames:
    """Encoder table of a scan: frames 0, 1, … without gaps, strictly increasing angles."""
    shown = f"scans/{folder.name}/frames.parquet"
    table = _parquet(folder / "frames.parquet", shown, {"frame": "int32", "angle_deg": "float64"}, 2 * MAX_FRAMES)
    for name, good in (("frame", pa.types.is_integer), ("angle_deg", pa.types.is_floating)):
        if not good(table[name].type):
            expected = {"frame": "int32", "angle_deg": "float64"}[name]
            raise ScanUnusable(f"{shown}: column {name}: expected {expected}; found {table[name].type}")
    frame = table["frame"].to_numpy()
    angle = table["angle_deg"].cast(pa.float64()).to_numpy()
    if table["frame"].null_count or not np.array_equal(frame, np.arange(len(frame))) or len(frame) == 0:
        raise ScanUnusable(f"{shown}: column frame: expected 0, 1, 2, … without gaps")
    if not np.isfinite(angle).all() or (np.diff(angle) <= 0).any():
        raise ScanUnusable(f"{shown}: column angle_deg: expected finite, strictly increasing angles")
    return Frames(angle)


class ScanReader:
    """Reads the stripes of one verified scan, sensor by sensor, checked against its rig."""

    def __init__(self, folder: Path, files: list[str], rig: Rig, n_frames: int) -> None:
        self.folder, self.rig, self.n_frames = folder, rig, n_frames
        self.sensors = {s.sensor_id: s for s in rig.sensors}
        tables = {PurePosixPath(f).stem for f in files if f.startswith("stripes/")}
        images: dict[str, dict[str, dict[int, str]]] = {}
        for file in files:
            if file.startswith("images/"):
                _, sensor, side, name = PurePosixPath(file).parts
                images.setdefault(sensor, {"left": {}, "right": {}})[side][self._frame_number(file, name)] = file
        self.tables, self.images = tables, images
        for sensor in sorted(tables | set(images)):
            if sensor not in self.sensors:
                raise ScanUnusable(f"scans/{folder.name}: sensor {sensor!r} is not in rig {rig.rig_id}")
            height = self.sensors[sensor].image_size[1]
            if n_frames * height > MAX_CELLS:
                raise ScanUnusable(
                    f"scans/{folder.name}/frames.parquet: {n_frames} frames; expected at most {MAX_CELLS // height} "
                    f"of the {height} rows of sensor {sensor}"
                )
            if sensor in tables and sensor in images:
                raise ScanUnusable(
                    f"scans/{folder.name}: sensor {sensor} has both stripes and images; expected one of them"
                )

    def _frame_number(self, file: str, name: str) -> int:
        stem = name.removesuffix(".png")
        if not (stem.isascii() and stem.isdigit() and len(stem) == 6) or int(stem) >= self.n_frames:
            raise ScanUnusable(
                f"scans/{self.folder.name}/{file}: expected a frame number of six digits below {self.n_frames}"
            )
        return int(stem)

    def stripes(self) -> Stripes:
        """The scan's stripes in the rig's order of sensors."""
        present = tuple(
            s.sensor_id for s in self.rig.sensors if s.sensor_id in self.tables or s.sensor_id in self.images
        )
        return Stripes(present, self.load)

    def load(self, sensor_id: str) -> list[StripeTable] | StripeImages:
        """Stripe tables of one sensor by laser line, or its images."""
        if sensor_id in self.images:
            return self._images(sensor_id)
        sensor = self.sensors[sensor_id]
        shown = f"scans/{self.folder.name}/stripes/{sensor_id}.parquet"
        wanted = {
            "frame": "int32",
            "line": "int8",
            "left_u": "fixed-size list of float32",
            "right_u": "fixed-size list of float32",
        }
        at_most = 2 * (self.n_frames + 1) * sensor.laser_lines * (sensor.image_size[1] + 1)
        table = _parquet(self.folder / "stripes" / f"{sensor_id}.parquet", shown, wanted, max(2 * at_most, 10_000))
        frame, line = (self._integers(table, name, shown) for name in ("frame", "line"))
        if len(frame) and (frame.min() < 0 or frame.max() >= self.n_frames):
            raise ScanUnusable(
                f"{shown}: column frame: expected 0 to {self.n_frames - 1}; found {frame.min()} to {frame.max()}"
            )
        if len(line) and (line.min() < 0 or line.max() >= sensor.laser_lines):
            raise ScanUnusable(
                f"{shown}: column line: expected 0 to {sensor.laser_lines - 1}; found {line.min()} to {line.max()}"
            )
        width, height = sensor.image_size
        sides = [_centres(table, name, height, width, shown) for name in ("left_u", "right_u")]
        result = []
        for number in range(sensor.laser_lines):
            member = np.flatnonzero(line == number)
            member = member[np.argsort(frame[member], kind="stable")]
            if len(np.unique(frame[member])) != len(member):
                raise ScanUnusable(f"{shown}: column frame: a frame occurs twice for line {number}")
            if len(member):
                result.append(StripeTable(number, frame[member].astype(np.int32), sides[0][member], sides[1][member]))
        return result

    @staticmethod
    def _integers(table: pa.Table, name: str, shown: str) -> np.ndarray:
        if not pa.types.is_integer(table[name].type) or table[name].null_count:
            raise ScanUnusable(
                f"{shown}: column {name}: expected whole numbers without nulls; found {table[name].type}"
            )
        return table[name].to_numpy()

    def _images(self, sensor_id: str) -> StripeImages:
        left, right = self.images[sensor_id]["left"], self.images[sensor_id]["right"]
        if set(left) != set(right):
            odd = min(set(left) ^ set(right))
            raise ScanUnusable(
                f"scans/{self.folder.name}/images/{sensor_id}: frame {odd:06d} has an image of one camera only"
            )
        numbers = sorted(left)
        size = self.sensors[sensor_id].image_size

        def blocks() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
            for start in range(0, len(numbers), IMAGES_AT_ONCE):
                chosen = numbers[start : start + IMAGES_AT_ONCE]
                stacks = [
                    np.stack(
                        [read_image(self.folder / side[n], f"scans/{self.folder.name}/{side[n]}", size) for n in chosen]
                    )
                    for side in (left, right)
                ]
                yield np.array(chosen, np.int32), stacks[0], stacks[1]

        return StripeImages(self.sensors[sensor_id].laser_lines, blocks)


def _centres(table: pa.Table, name: str, height: int, width: int, shown: str) -> np.ndarray:
    """Centres (rows of the table, image rows) as float64; those outside the image become NaN: they are reflections."""
    column = table[name].combine_chunks()
    kind = column.type
    if not (
        pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)
    ) or not pa.types.is_floating(kind.value_type):
        raise ScanUnusable(f"{shown}: column {name}: expected a fixed-size list of float32; found {kind}")
    if column.null_count:
        raise ScanUnusable(f"{shown}: column {name}: expected no nulls")
    with np.errstate(invalid="ignore"):  # spoilt bits can be a signalling NaN
        values = column.flatten().to_numpy(zero_copy_only=False).astype(np.float64)
    lengths = (
        np.unique(pa.compute.list_value_length(column).to_numpy(zero_copy_only=False))
        if len(column)
        else np.array([height])
    )
    if not np.array_equal(lengths, [height]):
        raise ScanUnusable(
            f"{shown}: column {name}: expected {height} values a row, one for each image row; found {lengths.tolist()[:3]}"
        )
    values = values.reshape(-1, height)
    with np.errstate(invalid="ignore"):
        values[~((values >= 0) & (values <= width - 1))] = np.nan
    return values


def read_image(path: Path, shown: str, size: tuple[int, int] | None = None) -> np.ndarray:
    """A grey image (rows, columns), 8 or 16 bit; bounded before it is decoded; ScanUnusable if it is damaged."""
    import cv2

    try:
        with path.open("rb") as file:
            head = file.read(33)
    except OSError as error:
        raise ScanUnusable(f"{shown}: cannot be read: {error.strerror}") from error
    if head[:8] == b"\x89PNG\r\n\x1a\n" and head[12:16] == b"IHDR":
        width, height = int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
        if width * height > MAX_PIXELS:
            raise ScanUnusable(f"{shown}: {width} x {height} pixels; expected at most {MAX_PIXELS} in all")
        if size is not None and (width, height) != tuple(size):
            raise ScanUnusable(f"{shown}: {width} x {height} pixels; the rig says {size[0]} x {size[1]}")
    elif size is not None:
        raise ScanUnusable(f"{shown}: expected a PNG image")
    image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise ScanUnusable(f"{shown}: not readable as an 8-bit or 16-bit grey image")
    return image


def read_boards(folder: Path, header: CalibrationHeader, files: list[str]) -> Boards:
    """Board images of a calibration, by sensor; an image that one camera lacks is None."""
    poses: dict[str, dict[str, dict[str, str]]] = {}
    for file in files:
        parts = PurePosixPath(file).parts
        if len(parts) == 4 and parts[0] == "boards" and parts[2] in ("left", "right"):
            poses.setdefault(parts[1], {}).setdefault(PurePosixPath(parts[3]).stem, {})[parts[2]] = file

    def load(sensor_id: str) -> Iterator[tuple[str, np.ndarray | None, np.ndarray | None]]:
        for pose, sides in sorted(poses[sensor_id].items()):
            images = [
                read_image(folder / sides[s], f"calibrations/{folder.name}/{sides[s]}") if s in sides else None
                for s in ("left", "right")
            ]
            yield pose, images[0], images[1]

    return Boards(header, tuple(sorted(poses)), load)
