"""Places in object storage, against a real server: names, conditional writes, staging, the inbox, the ledger, the lock."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pytest
from fake_inbox import inbox_of
from s3_server import BUCKET

from warehouse import lock_object, place, store
from warehouse.inbox import Inbox
from warehouse.lineage import Ledger, Record
from warehouse.lock import WarehouseLock
from warehouse.place_files import ReadOnce
from wheelset_assets.declare import Column, Table
from wheelset_assets.quality import ConfigError, ScanUnusable, WheelsetError

NUMBERS = Table("numbers", 1, "Numbers", key=("n",), layout="day", columns=(Column("n", "int64", "Number"),))


@pytest.fixture
def root(prefix: str) -> Path:
    """A prefix of the test's own, as a place."""
    return place.place(prefix)


def upload(folder: Path, to: Path) -> Path:
    """Copy a folder to object storage."""
    place.filesystem(to).put(f"{folder}/", place.key(to), recursive=True)
    return to


# --- places ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["s3://", "s3://bucket", "s3://bucket/", "s3://bucket/a/../b", "s3://bucket/a//b"])
def test_a_bucket_alone_or_a_way_out_of_it_is_no_place(text: str) -> None:
    with pytest.raises(ConfigError, match="expected s3://BUCKET/PREFIX"):
        place.place(text)


def test_folders_stay_folders() -> None:
    assert place.place("some/folder") == Path("some/folder")
    assert not place.is_remote(place.place("s3:/one-slash"))


@pytest.mark.parametrize("missing", ["s3fs", "upath"])
def test_without_the_extra(monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ConfigError, match=r'pip install "wheelset\[cluster\]"'):
        place.place("s3://bucket/prefix")


def test_no_bucket_and_no_server_are_told(s3: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match="there is no bucket nowhere-at-all"):
        place.check(place.place("s3://nowhere-at-all/prefix"))
    assert place.check(place.place(f"s3://{BUCKET}/prefix"))
    code = "from warehouse import place; place.check(place.place('s3://b/p'))"
    nobody = {**s3, "AWS_ENDPOINT_URL": "http://127.0.0.1:9", "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", code], env=nobody, capture_output=True, text=True)
    assert "ConfigError: s3://b/p: object storage does not answer" in done.stderr
    assert "AWS_ENDPOINT_URL" in done.stderr


def test_light_commands_import_nothing_of_it() -> None:
    """`--help` and `status` of a folder must not pay for other machines."""
    code = (
        "import sys, pipelines.cli, pipelines.settings, warehouse.planner, warehouse.night\n"
        "heavy = {'dagster', 'distributed', 'dask', 's3fs', 'fsspec', 'upath', 'botocore', 'rerun', 'open3d'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.stdout.strip() == "[]", done.stderr


# --- writing -----------------------------------------------------------------------------------------------------


def test_conditional_writes(root: Path) -> None:
    target = root / "object"
    assert place.get(target) == (None, None)
    first = place.put(target, b"1", None)
    assert place.get(target) == (b"1", first)
    with pytest.raises(place.Changed):
        place.put(target, b"2", None)
    with pytest.raises(place.Changed):
        place.put(root / "absent", b"2", first)
    second = place.put(target, b"2", first)
    with pytest.raises(place.Changed):
        place.put(target, b"3", first)
    assert place.get(target) == (b"2", second)
    assert place.put(target, b"2", first) == second, "a repeated write whose answer was lost"
    place.put(target, b"4")
    assert place.get(target)[0] == b"4"


def test_a_table_has_the_same_name_here_and_there(root: Path, tmp_path: Path) -> None:
    data = pa.table({"n": pa.array(range(1000), pa.int64())}, schema=NUMBERS.schema)
    here = store.write_table(tmp_path, NUMBERS, data, "2025-01-01", None)
    there = store.write_table(root, NUMBERS, data, "2025-01-01", None)
    assert here == there
    assert store.read_table(root, there[0], ["n"]).equals(data)
    assert store.sha256_file(root / there[0])[: store.VERSION_DIGITS] == there[1]
    assert store.files_of(root, NUMBERS) == store.files_of(tmp_path, NUMBERS) == {there[0]}


@pytest.mark.parametrize("remote", [False, True])
def test_nothing_lands_if_the_block_fails(root: Path, tmp_path: Path, remote: bool) -> None:
    target = (root if remote else tmp_path) / "file"
    with pytest.raises(ZeroDivisionError), place.landing(target) as local:
        _ = local.write_bytes(b"half") // 0
    assert not target.exists()
    assert list(tmp_path.iterdir()) == []
    with place.landing(target) as local:
        local.write_bytes(b"whole")
    assert target.read_bytes() == b"whole"


def test_what_was_read_once_is_not_asked_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root / "small").write_bytes(b"small")
    inner, asked = place.filesystem(root), []
    monkeypatch.setattr("warehouse.place_files.WHOLE_BYTES", 100)
    monkeypatch.setattr("warehouse.place_files.KEPT_BYTES", 120)
    monkeypatch.setattr(inner, "cat_file", lambda name, real=inner.cat_file: asked.append(name) or real(name))
    files = ReadOnce(inner, place.key(root))
    for _ in range(3):
        assert files.open(str(root / "small"), "rb").read() == b"small"
    assert len(asked) == 1
    (root / "large").write_bytes(b"x" * 101)
    assert files.open(str(root / "large"), "rb").read() == b"x" * 101
    assert len(asked) == 1, "read in ranges"
    for name in ("a", "b"):
        (root / name).write_bytes(b"y" * 60)
        files.open(str(root / name), "rb").read()
    files.open(str(root / "small"), "rb").read()
    assert len(asked) == 4, "the oldest was given up"
    with pytest.raises(PermissionError):
        files.open(str(root / "small"), "wb")
    for outside in (f"{root}/../x", f"{root}-other/x", f"{root.parent}/x"):
        with pytest.raises(PermissionError, match="outside"):
            files.open(outside, "rb")


# --- the inbox ---------------------------------------------------------------------------------------------------


def test_an_inbox_says_what_the_folder_says(root: Path, tmp_path: Path) -> None:
    here = Inbox(inbox_of(tmp_path / "inbox"))
    there = Inbox(upload(here.root, root / "inbox"))
    assert [e.identifier for e in there.scans()] == [e.identifier for e in here.scans()]
    assert [e.identifier for e in there.calibrations()] == [e.identifier for e in here.calibrations()]
    assert {n: (r[0], r[1]) for n, r in there.rigs.items()} == {n: (r[0], r[1]) for n, r in here.rigs.items()}
    for ours, theirs in zip(here.scans(), there.scans(), strict=True):
        assert there.verify_scan(theirs) == here.verify_scan(ours)
    for ours, theirs in zip(here.calibrations(), there.calibrations(), strict=True):
        assert there.verify_calibration(theirs) == here.verify_calibration(ours)


def test_a_changed_or_incomplete_bundle_shows(root: Path, tmp_path: Path) -> None:
    at = upload(inbox_of(tmp_path / "inbox"), root / "inbox")
    before = {e.identifier: e.signature for e in Inbox(at).scans()}
    assert {e.identifier: e.signature for e in Inbox(at).scans()} == before
    first, second, *_ = sorted(before)
    (at / "scans" / first / "frames.parquet").write_bytes(b"other")
    (at / "scans" / second / "scan.json").unlink()
    after = {e.identifier: e.signature for e in Inbox(at).scans()}
    assert second not in after, "its JSON comes last: without it the bundle is not complete"
    assert after[first] != before[first]
    entry = next(e for e in Inbox(at).scans() if e.identifier == first)
    with pytest.raises(ScanUnusable, match=rf"scans/{first}/frames.parquet: sha256 is"):
        Inbox(at).verify_scan(entry)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("../../escaped", "not in plain relative form"),
        ("a\\b", "not in plain relative form"),
        ("frames.parquet/x", "lies below 'frames.parquet'"),
        ("extra.bin", "not listed"),
    ],
)
def test_hostile_names_of_objects_are_refused(root: Path, tmp_path: Path, name: str, says: str) -> None:
    at = upload(inbox_of(tmp_path / "inbox"), root / "inbox")
    scan = Inbox(at).scans()[0].identifier
    bucket, _, base = place.key(at).partition("/")
    key = f"{base}/scans/{scan}/{name}"
    place.filesystem(at).call_s3("put_object", Bucket=bucket, Key=key, Body=b"x")
    inbox = Inbox(at)
    with pytest.raises(ScanUnusable, match=says):
        inbox.verify_scan(next(e for e in inbox.scans() if e.identifier == scan))
    assert not list(tmp_path.rglob("escaped"))


def test_a_name_that_is_no_identifier_is_refused_unseen(root: Path, tmp_path: Path) -> None:
    at = upload(inbox_of(tmp_path / "inbox"), root / "inbox")
    bucket, _, base = place.key(at).partition("/")
    for name in ("..", "con", "ä b"):
        place.filesystem(at).call_s3("put_object", Bucket=bucket, Key=f"{base}/scans/{name}/scan.json", Body=b"{}")
    inbox = Inbox(at)
    bad = [e for e in inbox.scans() if e.identifier in ("con", "ä b")]
    assert len(bad) == 2
    for entry in bad:
        with pytest.raises(ScanUnusable, match="expected an identifier"):
            inbox.verify_scan(entry)


# --- one writer --------------------------------------------------------------------------------------------------


def test_the_ledger_is_not_overwritten_by_a_run_that_lost_its_lock(root: Path) -> None:
    def put(ledger: Ledger, unit: str) -> None:
        ledger.day("2025-01-01").put(Record(unit, unit, "bundle", "ok", None, "f", "1", "", ()))

    one, two = Ledger(root), Ledger(root)
    put(one, "a")
    put(two, "b")
    one.save("2025-01-01")
    with pytest.raises(WheelsetError, match="this one's lock has lapsed"):
        two.save("2025-01-01")
    put(one, "c")
    one.save("2025-01-01")
    again = Ledger(root)
    assert again.days() == ["2025-01-01"]
    assert {unit for unit, _ in again.day("2025-01-01").current} == {"a", "c"}


def test_the_lock_keeps_others_out_until_it_is_given_back(root: Path) -> None:
    first, second = WarehouseLock(root), WarehouseLock(root)
    assert not first.taken()
    first.acquire()
    assert second.taken()
    with pytest.raises(ConfigError, match=r"another run \(process \d+ on .*last heard of \d+ s ago"):
        second.acquire(0.6)
    first.release()
    first.release()
    assert not second.taken()
    second.acquire()
    with pytest.raises(ConfigError):
        first.acquire()
    second.release()


def test_a_silent_holder_loses_the_lock_and_a_living_one_does_not(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock_object, "EXPIRY_SECONDS", 3.0)
    dead = WarehouseLock(root)
    dead.acquire()  # its next beat would come after 15 s
    monkeypatch.setattr(lock_object, "BEAT_SECONDS", 0.3)
    heir, third = WarehouseLock(root), WarehouseLock(root)
    heir.acquire(20)
    time.sleep(4.5)
    with pytest.raises(ConfigError, match="another run"):
        third.acquire()
    dead.release()
    assert third.taken(), "the dead one comes back to life and gives nothing back that is not its own"
    heir.release()
    third.acquire()
    third.release()


def test_of_two_heirs_one_wins(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both saw the lock lapsed; the second write comes too late."""
    monkeypatch.setattr(lock_object, "EXPIRY_SECONDS", 0.0)
    WarehouseLock(root).acquire()
    second = lock_object.ObjectLock(root / "_lock")
    lapsed = second._look()
    WarehouseLock(root).acquire()
    monkeypatch.setattr(lock_object, "EXPIRY_SECONDS", 90.0)
    looks = iter([lapsed])
    monkeypatch.setattr(second, "_look", lambda real=second._look: next(looks, None) or real())
    with pytest.raises(ConfigError, match="another run"):
        second.acquire()


def test_a_store_that_does_not_heed_conditions_is_refused(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = place.put
    monkeypatch.setattr(place, "put", lambda target, data, replacing=place.ANY: real(target, data))
    lock = WarehouseLock(root)
    with pytest.raises(ConfigError, match="does not heed conditional writes"):
        lock.acquire()
    assert not lock.taken()
