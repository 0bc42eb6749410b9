"""Every way in which a bundle can break the format is refused, and the message names file, key and expectation."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
from fake_inbox import (
    FRAMES,
    HEIGHT,
    SENSOR,
    WIDTH,
    lists,
    seal,
    write_calibration,
    write_frames,
    write_rig,
    write_scan,
    write_stripes,
)

from warehouse.inbox import BundleRefused, Inbox, ScanReader, read_boards, read_frames, read_image
from wheelset_assets.bundle import ScanHeader
from wheelset_assets.quality import ConfigError, ScanUnusable

TIME = "2025-04-05T09:00:00+08:00"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_rig(tmp_path)
    write_calibration(tmp_path)
    write_scan(tmp_path, "s-1", TIME)
    return tmp_path


def verify(root: Path, name: str = "s-1") -> ScanHeader:
    inbox = Inbox(root)
    entry = next(e for e in inbox.scans() if e.identifier == name)
    header = inbox.verify_scan(entry).header
    assert isinstance(header, ScanHeader)
    return header


def refused(root: Path, name: str = "s-1") -> str:
    with pytest.raises(ScanUnusable) as caught:
        verify(root, name)
    return str(caught.value)


def read(root: Path, name: str = "s-1") -> list:
    """Everything that the first stage would read of a scan: tables, or blocks of images."""
    folder = root / "scans" / name
    rig = Inbox(root).rigs["rig-1"][0]
    assert rig is not None
    frames = read_frames(folder)
    files = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file() and p.name != "scan.json"]
    stripes = ScanReader(folder, files, rig, len(frames.angle_deg)).stripes()
    loaded = [stripes.load(sensor) for sensor in stripes.sensor_ids]
    return [item if isinstance(item, list) else list(item.blocks()) for item in loaded]


def unreadable(root: Path) -> str:
    verify(root)  # hashes and names are in order
    with pytest.raises(ScanUnusable) as caught:
        read(root)
    return str(caught.value)


def test_a_good_bundle_is_read(root: Path) -> None:
    header = verify(root)
    assert header.acquired_on.isoformat() == "2025-04-05"
    (((table,),)) = (read(root)[0],)
    assert table.left_u_px.shape == (FRAMES, HEIGHT)


# --- the JSON ----------------------------------------------------------------------------------------------------

VALUES: list[tuple[str, dict, tuple[str, ...]]] = [
    ("naive time", {"captured_at": "2025-04-05T09:00:00"}, ("captured_at", "offset")),
    ("date only", {"captured_at": "2025-04-05"}, ("captured_at", "offset")),
    ("seconds since 1970", {"captured_at": 1743814800}, ("captured_at", "ISO 8601")),
    ("the same as text", {"captured_at": "1743814800"}, ("captured_at", "ISO 8601")),
    ("before the year 1", {"captured_at": "0001-01-01T00:00:00+14:00"}, ("captured_at", "years 1 to 9999")),
    ("after the year 9999", {"captured_at": "9999-12-31T23:00:00-12:00"}, ("captured_at", "years 1 to 9999")),
    ("number as text", {"temperature_c": {"wheelset": "20", "rig": 20}}, ("temperature_c.wheelset", "number")),
    ("truth for a number", {"temperature_c": {"wheelset": True, "rig": 20}}, ("temperature_c.wheelset", "number")),
    ("no temperature", {"temperature_c": {"rig": 20}}, ("temperature_c.wheelset", "missing")),
    ("null temperature", {"temperature_c": {"wheelset": None, "rig": 20}}, ("temperature_c.wheelset", "number")),
    ("unknown purpose", {"purpose": "test"}, ("purpose", "production")),
    ("other format", {"format": "wheelset-scan/2"}, ("format", "wheelset-scan/1")),
    ("wheelset as text", {"wheelset": "WS-1"}, ("wheelset", "WS-1")),
    ("hostile rig", {"rig_id": "../rig"}, ("rig_id", "../rig")),
    ("hostile calibration", {"calibration_id": "a/b"}, ("calibration_id", "a/b")),
    ("identifier with a newline", {"rig_id": "rig-1\n"}, ("rig_id",)),
    ("identifier of 65 letters", {"rig_id": "r" * 65}, ("rig_id",)),
    ("name of another scan", {"scan_id": "s-2"}, ("scan_id", "'s-1'", "'s-2'")),
    (
        "negative expansion",
        {"wheelset": {"wheelset_id": "w", "type": "t", "expansion_per_k": -1}},
        ("expansion_per_k",),
    ),
    ("files as a list", {"files": ["frames.parquet"]}, ("files",)),
    ("no hash", {"files": {"frames.parquet": "0"}}, ("files.frames.parquet",)),
]


@pytest.mark.parametrize(("changes", "words"), [v[1:] for v in VALUES], ids=[v[0] for v in VALUES])
def test_malformed_values_are_named(root: Path, changes: dict, words: tuple[str, ...]) -> None:
    seal(root / "scans" / "s-1", **changes)
    message = refused(root)
    assert "scans/s-1/scan.json" in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    "key",
    ["format", "scan_id", "rig_id", "calibration_id", "captured_at", "purpose", "wheelset", "temperature_c", "files"],
)
def test_missing_required_keys_are_named(root: Path, key: str) -> None:
    path = root / "scans" / "s-1" / "scan.json"
    content = json.loads(path.read_text())
    del content[key]
    path.write_text(json.dumps(content))
    assert refused(root) == f"scans/s-1/scan.json: required key {key} is missing"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "not readable as JSON"),
        (b"{", "not readable as JSON"),
        (b"[1, 2]", "expected a JSON object"),
        (b"null", "expected a JSON object"),
        (b"[" * 200_000, "not readable as JSON"),
        (b'{"a": ' * 100_000 + b"1" + b"}" * 100_000, "not readable as JSON"),
        (b'{"a": "\xff"}', "not readable as JSON"),
        ('{"a": 1}'.encode("utf-16"), "not readable as JSON"),
        (b"\x00" * 100, "not readable as JSON"),
        (b'{"scan_id": "\\ud800"}', "scan.json"),
    ],
)
def test_json_that_is_none(root: Path, data: bytes, words: str) -> None:
    (root / "scans" / "s-1" / "scan.json").write_bytes(data)
    assert words in refused(root)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_temperature_that_is_no_number(root: Path, value: str) -> None:
    path = root / "scans" / "s-1" / "scan.json"
    path.write_text(path.read_text().replace('"wheelset": 20.0', f'"wheelset": {value}'))
    assert "temperature_c.wheelset" in refused(root)


def test_json_too_large_is_not_read(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warehouse.inbox.MAX_JSON_BYTES", 100)
    assert "expected at most 100" in refused(root)


def test_unknown_keys_marks_and_nulls_of_optional_keys_are_accepted(root: Path) -> None:
    path = seal(
        root / "scans" / "s-1",
        comment=None,
        certificate=None,
        reference_scan_id=None,
        axle=3,
        weather={"rain": [1, {"mm": 2}]},
        wheelset={"wheelset_id": "WS-1", "type": "t", "profile": None, "expansion_per_k": None, "colour": "red"},
    )
    text = (path / "scan.json").read_bytes()
    (path / "scan.json").write_bytes(b"\xef\xbb\xbf" + text)
    header = verify(root)
    assert header.certificate == []
    assert header.axle == "3"
    assert header.wheelset.expansion_per_k == 11.5e-6
    assert header.model_extra == {"weather": {"rain": [1, {"mm": 2}]}}


# --- the files ---------------------------------------------------------------------------------------------------


def _missing(folder: Path) -> None:
    (folder / "frames.parquet").unlink()


def _unlisted(folder: Path) -> None:
    (folder / "stripes" / "notes.txt").write_text("hello")


def _other_bytes(folder: Path) -> None:
    (folder / "frames.parquet").write_bytes(b"PAR1")


def _link(folder: Path) -> None:
    target = folder / "stripes" / f"{SENSOR}.parquet"
    target.rename(folder.parent.parent / "elsewhere.parquet")
    target.symlink_to(folder.parent.parent / "elsewhere.parquet")


def _linked_folder(folder: Path) -> None:
    (folder / "stripes").rename(folder.parent.parent / "stripes")
    (folder / "stripes").symlink_to(folder.parent.parent / "stripes", target_is_directory=True)


def _dangling(folder: Path) -> None:
    (folder / "more").symlink_to(folder / "nothing")


def _pipe(folder: Path) -> None:
    os.mkfifo(folder / "more")


def _linked_json(folder: Path) -> None:
    (folder / "scan.json").rename(folder.parent.parent / "scan.json")
    (folder / "scan.json").symlink_to(folder.parent.parent / "scan.json")


def _json_folder(folder: Path) -> None:
    (folder / "scan.json").unlink()
    (folder / "scan.json").mkdir()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_missing, ("frames.parquet", "missing", "scan.json lists it")),
        (_unlisted, ("stripes/notes.txt", "not listed in scan.json", "key files")),
        (_other_bytes, ("s-1/frames.parquet", "sha256")),
        (_link, (f"stripes/{SENSOR}.parquet", "link", "plain files")),
        (_linked_folder, ("stripes", "link")),
        (_dangling, ("more", "link")),
        (_pipe, ("more", "pipe", "plain files")),
        (_linked_json, ("scan.json", "plain file")),
        (_json_folder, ("scan.json", "plain file")),
    ],
)
def test_files_that_do_not_match_the_list(root: Path, spoil: Callable[[Path], None], words: tuple[str, ...]) -> None:
    spoil(root / "scans" / "s-1")
    message = refused(root)
    for word in ("scans/s-1", *words):
        assert word in message


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../s-2/frames.parquet",
        "a/../../b",
        "stripes/con.parquet",
        "stripes/NUL",
        "stripes/a.",
        "stripes/a ",
        "stripes/a\nb.parquet",
        "C:/x",
        "C:\\x",
        "a\\b",
        "\\\\host\\x",
        "./a",
        "a//b",
        "",
        ".",
        "a/",
    ],
)
def test_paths_that_leave_the_bundle(root: Path, name: str) -> None:
    folder = root / "scans" / "s-1"
    content = json.loads((folder / "scan.json").read_text())
    (folder / "scan.json").write_text(json.dumps(content | {"files": content["files"] | {name: "0" * 64}}))
    message = refused(root)
    assert "scans/s-1/scan.json: key files: path" in message
    assert repr(name) in message


def test_names_that_many_file_systems_take_for_one(root: Path) -> None:
    folder = root / "scans" / "s-1"
    content = json.loads((folder / "scan.json").read_text())
    content["files"]["STRIPES" + f"/{SENSOR}.parquet"] = "0" * 64
    (folder / "scan.json").write_text(json.dumps(content))
    assert "differ in letter case alone" in refused(root)


def test_the_json_does_not_list_itself(root: Path) -> None:
    folder = root / "scans" / "s-1"
    content = json.loads((folder / "scan.json").read_text())
    (folder / "scan.json").write_text(json.dumps(content | {"files": content["files"] | {"scan.json": "0" * 64}}))
    assert "every file but scan.json itself" in refused(root)


def test_centres_that_are_no_number_in_any_form_are_unseen(root: Path) -> None:
    """A signalling NaN, as spoilt bits make it, warns where it is cast; warnings are errors here."""
    folder = root / "scans" / "s-1"
    u = np.tile(np.linspace(5, 30, HEIGHT, dtype=np.float32), (FRAMES, 1))
    u.view(np.uint32)[0, :3] = (0x7F800001, 0x7FC00000, 0x7F800000)  # signalling, quiet, infinite
    write_stripes(folder, left_u=lists(u))
    seal(folder)
    (((table,),)) = (read(root)[0],)
    assert np.isnan(table.left_u_px[0, :3]).all()
    assert np.isnan(table.left_u_px).sum() == 3


def test_a_bundle_of_frames_alone_is_none_but_stripes_may_lack(root: Path) -> None:
    folder = root / "scans" / "s-1"
    (folder / "stripes" / f"{SENSOR}.parquet").unlink()
    seal(folder)
    verify(root)
    assert read(root) == []
    (folder / "frames.parquet").unlink()
    (folder / "notes.txt").write_text("x")
    seal(folder)
    assert "expected frames.parquet among the files" in refused(root)


@pytest.mark.parametrize(
    "name",
    ["stripes/x.csv", "stripes/a/b.parquet", "images/a.png", "images/s/top/000000.png", "images/s/left/000000.jpg"],
)
def test_files_in_the_wrong_place(root: Path, name: str) -> None:
    path = root / "scans" / "s-1" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x")
    seal(root / "scans" / "s-1")
    assert f"scans/s-1/{name}: expected stripes/<sensor_id>.parquet" in refused(root)


def test_hashes_may_be_written_in_capitals(root: Path) -> None:
    folder = root / "scans" / "s-1"
    content = json.loads((folder / "scan.json").read_text())
    files = {name: sha.upper() for name, sha in content["files"].items()}
    (folder / "scan.json").write_text(json.dumps(content | {"files": files}))
    assert verify(root)


def test_a_refusal_for_its_files_keeps_the_readable_json(root: Path) -> None:
    _missing(root / "scans" / "s-1")
    inbox = Inbox(root)
    with pytest.raises(BundleRefused) as caught:
        inbox.verify_scan(inbox.scans()[0])
    assert ScanHeader.model_validate_json(caught.value.header_json).scan_id == "s-1"


# --- folders -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a b", "-x", "a@b", "x" * 65, "nul", "COM1.x", "ö"])
def test_folder_names_that_are_no_identifier(root: Path, name: str) -> None:
    (root / "scans" / "s-1").rename(root / "scans" / name)
    assert f"scans/{name}: folder name" in refused(root, name)


def test_folder_name_that_is_not_utf_8(root: Path) -> None:
    os.rename(root / "scans" / "s-1", os.fsencode(root / "scans") + b"/s-\xff")
    assert "folder name" in refused(root, "s-\\xff")


def test_file_name_that_is_not_utf_8(root: Path) -> None:
    with open(os.fsencode(root / "scans" / "s-1") + b"/\xff", "wb"):
        pass
    message = refused(root)
    assert "file \\xff is not listed" in message
    message.encode()


def test_a_linked_bundle_is_refused_not_overlooked(root: Path) -> None:
    (root / "scans" / "s-2").symlink_to(root / "scans" / "s-1", target_is_directory=True)
    assert "link" in refused(root, "s-2")


def test_what_is_no_complete_bundle_is_ignored(root: Path) -> None:
    (root / "scans" / "s-2").mkdir()
    (root / "scans" / "s-2" / "frames.parquet").write_bytes(b"still copying")
    (root / "scans" / ".s-3").mkdir()
    (root / "scans" / ".s-3" / "scan.json").write_text("{}")
    (root / "scans" / "notes.txt").write_text("x")
    assert [e.identifier for e in Inbox(root).scans()] == ["s-1"]


def test_the_signature_follows_names_sizes_and_times(root: Path) -> None:
    def signature() -> str:
        return Inbox(root).scans()[0].signature

    folder = root / "scans" / "s-1"
    seen = {signature()}
    os.utime(folder / "frames.parquet", ns=(1, 1))
    seen.add(signature())
    (folder / "stripes" / "x").write_bytes(b"")
    seen.add(signature())
    (folder / "stripes" / "x").write_bytes(b"1")
    seen.add(signature())
    assert len(seen) == 4
    assert signature() == signature()


def test_a_folder_that_vanishes_while_it_is_listed_does_not_stop_the_run(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = Inbox(root).scans()[0]
    import shutil

    shutil.rmtree(entry.folder)
    with pytest.raises((ScanUnusable, OSError)):
        Inbox(root).verify_scan(entry)


def test_not_an_inbox(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such folder"):
        Inbox(tmp_path / "nothing")
    with pytest.raises(ConfigError, match="neither a folder scans/ nor rigs/"):
        Inbox(tmp_path)


# --- frames ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "angle", "words"),
    [
        ([0, 1, 3], [0.0, 1.0, 2.0], "column frame: expected 0, 1, 2"),
        ([1, 2, 3], [0.0, 1.0, 2.0], "column frame: expected 0, 1, 2"),
        ([0, 2, 1], [0.0, 1.0, 2.0], "column frame: expected 0, 1, 2"),
        ([], [], "column frame: expected 0, 1, 2"),
        ([0, 1, 2], [0.0, 1.0, 1.0], "column angle_deg: expected finite, strictly increasing"),
        ([0, 1, 2], [0.0, 2.0, 1.0], "column angle_deg: expected finite, strictly increasing"),
        ([0, 1, 2], [0.0, float("nan"), 2.0], "column angle_deg"),
        ([0, 1, 2], [0.0, 1.0, float("inf")], "column angle_deg"),
        ([0, 1, 2], [0.0, None, 2.0], "column angle_deg"),
        ([0, None, 2], [0.0, 1.0, 2.0], "column frame"),
        ([0, 1, 2], ["0", "1", "2"], "column angle_deg: expected float64; found string"),
        ([0, 1, 2], [0, 1, 2], "column angle_deg: expected float64; found int64"),
    ],
)
def test_frames_out_of_order(root: Path, frame: list, angle: list, words: str) -> None:
    folder = root / "scans" / "s-1"
    kind = pa.float64() if not angle else None
    columns = {"frame": pa.array(frame, pa.int32()), "angle_deg": pa.array(angle, kind)}
    import pyarrow.parquet as pq

    pq.write_table(pa.table(columns), folder / "frames.parquet")
    seal(folder)
    message = unreadable(root)
    assert words in message
    assert "scans/s-1/frames.parquet" in message


def test_frames_as_decimals_or_text(root: Path) -> None:
    folder = root / "scans" / "s-1"
    write_frames(folder, range(3), [0.0, 1.0, 2.0], pa.float64())
    seal(folder)
    assert "column frame: expected int32; found double" in unreadable(root)


def test_frames_without_a_column_with_one_twice_or_no_parquet(root: Path) -> None:
    import pyarrow.parquet as pq

    folder = root / "scans" / "s-1"
    pq.write_table(pa.table({"frame": pa.array([0], pa.int32())}), folder / "frames.parquet")
    seal(folder)
    assert "column angle_deg is missing; expected float64" in unreadable(root)
    twice = pa.Table.from_arrays([pa.array([0], pa.int32())] * 2 + [pa.array([0.0])], ["frame", "frame", "angle_deg"])
    pq.write_table(twice, folder / "frames.parquet")
    seal(folder)
    assert "column frame is there more than once" in unreadable(root)
    (folder / "frames.parquet").write_bytes(b"PAR1 no PAR1")
    seal(folder)
    assert "frames.parquet: not readable as Parquet" in unreadable(root)
    (folder / "frames.parquet").write_bytes(b"")
    seal(folder)
    assert "frames.parquet: not readable as Parquet" in unreadable(root)


# --- stripes -----------------------------------------------------------------------------------------------------

GOOD = np.full((FRAMES, HEIGHT), 7, np.float32)
STRIPES: list[tuple[str, dict, tuple[str, ...]]] = [
    ("no column", {"left_u": None}, ("left_u is missing", "list")),
    ("negative frame", {"frame": pa.array([-1, 1, 2, 3], pa.int32())}, ("column frame", "expected 0 to 3")),
    ("frame too high", {"frame": pa.array([0, 1, 2, 9], pa.int32())}, ("column frame", "expected 0 to 3", "9")),
    ("frame twice", {"frame": pa.array([0, 1, 1, 2], pa.int32())}, ("column frame", "twice for line 0")),
    ("second line", {"line": pa.array([0, 0, 0, 1], pa.int8())}, ("column line", "expected 0 to 0")),
    ("null frame", {"frame": pa.array([0, 1, 2, None], pa.int32())}, ("column frame", "without nulls")),
    ("frame as text", {"frame": pa.array(list("0123"))}, ("column frame", "whole numbers")),
    ("line as float", {"line": pa.array([0.0] * 4)}, ("column line", "whole numbers")),
    ("centres as numbers", {"left_u": pa.array([1.0] * 4)}, ("column left_u", "list of float32")),
    ("centres as whole numbers", {"right_u": pa.array([[1] * HEIGHT] * 4)}, ("column right_u", "list of float32")),
    ("rows too few", {"left_u": lists(GOOD[:, :-1])}, ("column left_u", f"expected {HEIGHT} values a row")),
    ("rows of any number", {"left_u": pa.array([[1.0]] * 4)}, ("column left_u", f"expected {HEIGHT} values a row")),
    ("null row", {"left_u": pa.array([None, *[[1.0] * HEIGHT] * 3])}, ("column left_u", "no nulls")),
]


@pytest.mark.parametrize(("columns", "words"), [v[1:] for v in STRIPES], ids=[v[0] for v in STRIPES])
def test_stripes_that_break_the_format(root: Path, columns: dict, words: tuple[str, ...]) -> None:
    write_stripes(root / "scans" / "s-1", **columns)
    seal(root / "scans" / "s-1")
    message = unreadable(root)
    for word in (f"scans/s-1/stripes/{SENSOR}.parquet", *words):
        assert word in message


def test_centres_outside_the_image_and_nulls_are_none_seen(root: Path) -> None:
    left = GOOD.astype(object)
    left[0, :6] = [-0.5, WIDTH - 0.5, 1e30, float("-inf"), float("nan"), None]
    kind = pa.list_(pa.float32(), HEIGHT)
    write_stripes(root / "scans" / "s-1", left_u=pa.array(left.tolist(), kind), left_peak=pa.array([[1] * HEIGHT] * 4))
    table = read(root)[0][0]
    assert np.isnan(table.left_u_px[0, :6]).all()
    assert np.isfinite(table.left_u_px).sum() == FRAMES * HEIGHT - 6


def test_rows_in_any_order_missing_frames_wide_numbers_and_plain_lists_are_read(root: Path) -> None:
    left = np.arange(3)[:, None] + np.zeros((3, HEIGHT), np.float32)
    write_stripes(
        root / "scans" / "s-1",
        frame=pa.array([3, 0, 2], pa.int64()),
        line=pa.array([0] * 3, pa.int32()),
        left_u=pa.array(left.tolist(), pa.large_list(pa.float64())),
        right_u=lists(left),
    )
    table = read(root)[0][0]
    assert table.frame.tolist() == [0, 2, 3]
    assert table.left_u_px[:, 0].tolist() == [1.0, 2.0, 0.0]


def test_sensor_that_the_rig_does_not_have(root: Path) -> None:
    write_stripes(root / "scans" / "s-1", "other")
    seal(root / "scans" / "s-1")
    assert "sensor 'other' is not in rig rig-1" in unreadable(root)


def test_more_values_than_the_scan_can_hold_are_not_read(root: Path) -> None:
    """A few kilobytes that unpack to millions of rows."""
    n = 500_000
    many = {
        "frame": pa.array(np.zeros(n, np.int32)),
        "line": pa.array(np.zeros(n, np.int8)),
        "left_u": lists(np.zeros((n, 1))),
        "right_u": lists(np.zeros((n, 1))),
    }
    path = write_stripes(root / "scans" / "s-1", **many)
    assert path.stat().st_size < 50_000
    seal(root / "scans" / "s-1")
    assert "2000000 values; expected at most 10000" in unreadable(root)


def test_a_turn_of_more_frames_than_the_grid_can_hold(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warehouse.inbox.MAX_CELLS", 3 * HEIGHT)
    assert "4 frames; expected at most 3" in unreadable(root)


# --- images ------------------------------------------------------------------------------------------------------


def write_images(
    root: Path, image: np.ndarray | bytes, sides: tuple[str, ...] = ("left", "right"), frame: str = "000000"
) -> None:
    folder = root / "scans" / "s-1"
    (folder / "stripes" / f"{SENSOR}.parquet").unlink(missing_ok=True)
    for side in sides:
        path = folder / "images" / SENSOR / side / f"{frame}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(image if isinstance(image, bytes) else cv2.imencode(".png", image)[1].tobytes())
    seal(folder)


GREY = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
PNG = cv2.imencode(".png", GREY)[1].tobytes()


def test_images_of_8_and_16_bit_are_read(root: Path) -> None:
    write_images(root, GREY)
    ((number, left, right),) = read(root)[0]
    assert number.tolist() == [0]
    assert np.array_equal(left[0], GREY)
    assert np.array_equal(right[0], GREY)
    write_images(root, GREY.astype(np.uint16) * 257)
    assert read(root)[0][0][1].dtype == np.uint16


def test_colour_is_turned_to_grey(root: Path) -> None:
    write_images(root, np.dstack([GREY] * 3))
    assert np.array_equal(read(root)[0][0][1][0], GREY)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (GREY[:, :-1], f"{WIDTH - 1} x {HEIGHT} pixels; the rig says {WIDTH} x {HEIGHT}"),
        (PNG[: len(PNG) // 2], "not readable"),
        (PNG[:40], "not readable"),
        (PNG[:200] + b"\x00" * 8 + PNG[208:], "not readable"),
        (b"", "expected a PNG image"),
        (b"GIF89a", "expected a PNG image"),
        (PNG[:16] + b"\x7f\xff\xff\xff" * 2 + PNG[24:], "expected at most"),
    ],
)
def test_images_that_are_none(root: Path, image: np.ndarray | bytes, words: str) -> None:
    write_images(root, image)
    message = unreadable(root)
    assert words in message
    assert f"scans/s-1/images/{SENSOR}/left/000000.png" in message


def test_image_of_one_camera_only(root: Path) -> None:
    write_images(root, GREY)
    write_images(root, GREY, ("left",), "000002")
    assert f"images/{SENSOR}: frame 000002 has an image of one camera only" in unreadable(root)


@pytest.mark.parametrize("frame", ["000004", "1", "00000a", "0000001", "٠٠٠٠٠٠"])
def test_image_that_is_no_frame(root: Path, frame: str) -> None:
    write_images(root, GREY, frame=frame)
    assert f"{frame}.png: expected a frame number of six digits below {FRAMES}" in unreadable(root)


def test_stripes_and_images_of_one_sensor(root: Path) -> None:
    write_images(root, GREY)
    write_stripes(root / "scans" / "s-1")
    seal(root / "scans" / "s-1")
    assert f"sensor {SENSOR} has both stripes and images" in unreadable(root)


def test_image_that_has_gone_is_no_bug(tmp_path: Path) -> None:
    with pytest.raises(ScanUnusable, match=r"x\.png: cannot be read: No such file"):
        read_image(tmp_path / "nothing.png", "x.png")


# --- rigs, calibrations, reviews ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rig_id": "rig-2"}, ("rigs/rig-1.json", "rig_id", "'rig-1'")),
        ({"sensors": []}, ("sensors",)),
        ({"expansion_per_k": float("nan")}, ("expansion_per_k",)),
        ({"stations": [{"station": "left_wheel", "kind": "axle", "side": "left"}]}, ("stations.0.kind", "wheel")),
    ],
)
def test_rig_that_cannot_be_used_says_why(tmp_path: Path, changes: dict, words: tuple[str, ...]) -> None:
    path = write_rig(tmp_path)
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    rig, _, why = Inbox(tmp_path).rigs["rig-1"]
    assert rig is None
    assert why is not None
    for word in words:
        assert word in why


def test_rig_pose_that_is_not_rigid_or_of_an_unknown_station(tmp_path: Path) -> None:
    path = write_rig(tmp_path)
    content = json.loads(path.read_text())
    content["sensors"][0]["T_rig_sensor"][0][0] = 2.0
    path.write_text(json.dumps(content))
    assert "rigid transform" in str(Inbox(tmp_path).rigs["rig-1"][2])
    content["sensors"][0] |= {"T_rig_sensor": np.eye(4).tolist(), "station": "x"}
    path.write_text(json.dumps(content))
    assert "station 'x' is not among the stations" in str(Inbox(tmp_path).rigs["rig-1"][2])


def test_calibrations_are_verified_like_scans(root: Path) -> None:
    inbox = Inbox(root)
    (entry,) = inbox.calibrations()
    verified = inbox.verify_calibration(entry)
    boards = read_boards(entry.folder, verified.header, list(verified.files))  # type: ignore[arg-type]
    assert boards.sensor_ids == (SENSOR,)
    with pytest.raises(ScanUnusable, match=r"calibrations/cal-1/boards/.*not readable"):
        list(boards.load(SENSOR))
    seal(entry.folder, "calibration.json", calibration_id="cal-2")
    with pytest.raises(ScanUnusable, match="key calibration_id: expected 'cal-1'"):
        inbox.verify_calibration(entry)
    seal(entry.folder, "calibration.json", calibration_id="cal-1", board={"type": "circles"})
    with pytest.raises(ScanUnusable, match=r"calibration\.json: key board\.type"):
        inbox.verify_calibration(entry)
    (entry.folder / "more.png").write_bytes(b"")
    with pytest.raises(ScanUnusable):
        inbox.verify_calibration(entry)
