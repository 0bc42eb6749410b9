"""Object storage as DuckDB reads it: what was asked of the store once is not asked again while the connection lives.

The files that the catalog names never change, and DuckDB opens each of them for every view that rests on it: without
this, building the catalog of a small warehouse took 1,500 requests.
"""

from __future__ import annotations

import io
import threading
from collections import OrderedDict
from typing import Any

from fsspec import AbstractFileSystem

WHOLE_BYTES = 8 * 2**20
"""Objects up to this size are fetched whole; of larger ones, the ranges that are read."""
KEPT_BYTES = 256 * 2**20


class ReadOnce(AbstractFileSystem):
    """Read-only view of what lies below `base` (bucket/prefix) in an S3 filesystem, with a memory."""

    protocol = ("s3", "s3a")
    cachable = False

    def __init__(self, inner: Any, base: str) -> None:
        super().__init__()
        self.inner, self.base = inner, base
        self._lock = threading.RLock()  # DuckDB reads from several threads
        self._facts: dict[str, dict[str, Any]] = {}
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._size = 0

    def _within(self, path: str) -> str:
        name = str(self._strip_protocol(path))
        if not f"{name}/".startswith(f"{self.base}/") or ".." in name.split("/"):
            raise PermissionError(f"{path}: outside of the warehouse")
        return name

    def info(self, path: str, **_: Any) -> dict[str, Any]:
        """Facts of an object, asked once."""
        name = self._within(path)
        with self._lock:
            if name not in self._facts:
                self._facts[name] = self.inner.info(name)
            return self._facts[name]

    def ls(self, path: str, detail: bool = True, **options: Any) -> Any:
        """A listing, for patterns in ad-hoc queries."""
        return self.inner.ls(self._within(path), detail=detail, **options)

    def created(self, path: str) -> Any:
        """When an object was written."""
        return self.info(path)["LastModified"]

    def modified(self, path: str) -> Any:
        """The same: objects are never changed."""
        return self.info(path)["LastModified"]

    def _open(self, path: str, mode: str = "rb", **_: Any) -> Any:
        if mode != "rb":
            raise PermissionError(f"{path}: read-only")
        name = self._within(path)
        facts = self.info(name)
        if facts["size"] > WHOLE_BYTES:
            return self.inner.open(name, "rb")
        return io.BytesIO(self._whole(name))

    def _whole(self, name: str) -> bytes:
        with self._lock:
            if name not in self._kept:
                self._kept[name] = self.inner.cat_file(name)
                self._size += len(self._kept[name])
                while self._size > KEPT_BYTES:
                    self._size -= len(self._kept.popitem(last=False)[1])
            else:
                self._kept.move_to_end(name)
            return self._kept[name]
