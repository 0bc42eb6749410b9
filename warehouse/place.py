"""Where a warehouse or an inbox may rest: a folder, or a prefix in object storage that speaks the S3 protocol.

A place is a `pathlib.Path`, or an object of fsspec's path library that answers to the same methods. Here is the little in
which they differ: objects appear whole or not at all, have no folders, and are locked by conditional writes. Whoever goes
through `store`, `Ledger` and `Inbox` need not know which one he has.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, cast

from wheelset_assets.quality import ConfigError, WheelsetError

SCHEME = "s3://"
ANY = object()
"""Put whatever is there."""


class BadName(WheelsetError):
    """An object whose name would leave its folder, or cannot be a file's."""


class Changed(WheelsetError):
    """An object is no longer what the writer believed it to be."""


def place(text: str | Path) -> Path:
    """A folder, or for `s3://bucket/prefix` a prefix of a bucket; ConfigError if the extra for it is not installed."""
    if not str(text).startswith(SCHEME):
        return Path(text)
    bucket, _, prefix = str(text).removeprefix(SCHEME).strip("/").partition("/")
    if not bucket or not prefix or any(part in ("", ".", "..") for part in prefix.split("/")):
        raise ConfigError(f"{text}: expected s3://BUCKET/PREFIX")
    try:
        import s3fs  # noqa: F401
        from upath import UPath
    except ImportError as error:
        raise ConfigError(f'{text}: object storage needs the extra cluster: pip install "wheelset[cluster]"') from error
    # Listings must be fresh: other machines write to the same prefix.
    return cast(Path, UPath(f"{SCHEME}{bucket}/{prefix}", use_listings_cache=False))


def is_remote(path: Path) -> bool:
    """Whether a place is object storage."""
    return not isinstance(path, Path)


def filesystem(path: Path) -> Any:
    """The fsspec filesystem of a remote place."""
    return cast(Any, path).fs


def key(path: Path) -> str:
    """A remote place in the filesystem's own terms: bucket/prefix."""
    return cast(str, cast(Any, path).path)


def check(path: Path) -> Path:
    """The place itself; ConfigError if object storage does not answer, with what it says."""
    if is_remote(path):
        bucket, _, prefix = key(path).partition("/")
        try:
            filesystem(path).call_s3("list_objects_v2", Bucket=bucket, Prefix=f"{prefix}/", MaxKeys=1)
        except FileNotFoundError as error:
            raise ConfigError(f"{path}: there is no bucket {bucket}") from error
        except Exception as error:  # the libraries below have a dozen kinds: credentials, names, certificates, routes
            raise ConfigError(
                f"{path}: object storage does not answer: {error or type(error).__name__}; it reads AWS_ACCESS_KEY_ID, "
                "AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL and the files of the AWS command line"
            ) from error
    return path


def make_folder(path: Path) -> None:
    """Make a folder and those above it; object storage has none."""
    if not is_remote(path):
        path.mkdir(parents=True, exist_ok=True)


def scratch() -> tempfile.TemporaryDirectory[str]:
    """A folder for files on the way to or from object storage; WHEELSET_SCRATCH says on which disk."""
    return tempfile.TemporaryDirectory(prefix="wheelset-", dir=os.environ.get("WHEELSET_SCRATCH") or None)


def objects(path: Path) -> dict[str, dict[str, Any]]:
    """Facts (size, ETag, LastModified, …) of every object below a remote place, by relative name, in one listing."""
    base = key(path) + "/"
    found = filesystem(path).find(key(path), detail=True)
    return {name.removeprefix(base): facts for name, facts in found.items() if name.startswith(base)}


def put(target: Path, data: bytes, replacing: Any = ANY) -> str:
    """Write an object, all at once; returns its ETag.

    `replacing`: ETag of what is replaced, or None if nothing may be there; Changed if it is otherwise. A write that
    succeeded though its answer was lost, and was then repeated, counts as a success.
    """
    bucket, _, name = key(target).partition("/")
    condition = {} if replacing is ANY else {"IfNoneMatch": "*"} if replacing is None else {"IfMatch": replacing}
    try:
        answer = filesystem(target).call_s3("put_object", Bucket=bucket, Key=name, Body=data, **condition)
    except OSError as error:
        if not condition or not _is_refusal(error):
            raise
        now, etag = get(target)
        if now != data or etag is None:
            raise Changed(f"{target}: another writer was there first") from error
        return etag
    return cast(str, answer["ETag"])


def _is_refusal(error: OSError) -> bool:
    answer = getattr(error.__cause__ or error, "response", {})
    code = answer.get("Error", {}).get("Code", "")
    return isinstance(error, FileExistsError | FileNotFoundError) or code in (
        "PreconditionFailed",
        "ConditionalRequestConflict",
    )


def get(path: Path) -> tuple[bytes | None, str | None]:
    """Contents and ETag of an object, (None, None) if there is none.

    The ETag is asked for first: if a writer comes between, a later conditional write fails, and nothing is lost.
    """
    try:
        etag = filesystem(path).info(key(path))["ETag"]
        return filesystem(path).cat_file(key(path)), etag
    except FileNotFoundError:
        return None, None


def put_file(local: Path, target: Path) -> None:
    """Bring a finished local file to its place: renamed there, or sent, so that nobody sees half of it."""
    if is_remote(target):
        filesystem(target).put_file(str(local), key(target))
    else:
        os.replace(local, target)


@contextmanager
def landing(target: Path) -> Iterator[Path]:
    """A local file to be written, which is brought to `target` if the block ends well, and removed if not."""
    if is_remote(target):
        with scratch() as temporary:
            yield Path(temporary) / target.name
            put_file(Path(temporary) / target.name, target)
        return
    local = target.with_name(f".tmp-{os.getpid()}-{target.name}")
    try:
        yield local
        put_file(local, target)
    finally:
        local.unlink(missing_ok=True)


def fetch(path: Path, local: Path) -> None:
    """Copy an object to a local file."""
    local.parent.mkdir(parents=True, exist_ok=True)
    filesystem(path).get_file(key(path), str(local))


@contextmanager
def staged(folder: Path, names: Iterable[str] | None = None) -> Iterator[Path]:
    """A folder as one on this machine: itself, or a copy in scratch for as long as it is needed.

    The copy has the folder's and its parent's names, and all of its objects or those in `names`; BadName if one cannot
    be there.
    """
    if not is_remote(folder):
        yield folder
        return
    with scratch() as temporary:
        local = Path(temporary) / folder.parent.name / folder.name
        local.mkdir(parents=True)
        chosen = sorted(objects(folder) if names is None else names)
        for name in chosen:
            _check_name(name, set(chosen))
        filesystem(folder).get([f"{key(folder)}/{name}" for name in chosen], [str(local / name) for name in chosen])
        yield local


def _check_name(name: str, all_names: set[str]) -> None:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name or str(path) != name or not path.parts:
        raise BadName(f"object {name!r} is not in plain relative form")
    if above := [str(p) for p in path.parents if str(p) in all_names]:
        raise BadName(f"object {name!r} lies below {above[0]!r}, which is an object too")


def cache_folder(path: Path) -> Path:
    """A folder on this machine for what is kept of a remote place between commands."""
    import hashlib

    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "wheelset" / hashlib.sha256(str(path).encode()).hexdigest()[:16]


def as_json_bytes(document: dict[str, Any]) -> bytes:
    """A small document as it is stored."""
    return json.dumps(document, sort_keys=True).encode()
