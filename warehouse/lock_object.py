"""One writer at a time on object storage: an object that is written only if it is as the writer knows it.

The holder renews it every few seconds. If it has been silent for EXPIRY_SECONDS, by the clock of the store at both ends,
the next run takes the lock over, again by a conditional write, so that only one of two can. A run that was suspended and
lost its lock meanwhile finds out at its next write to the ledger, which is conditional too.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
import uuid
from contextlib import suppress
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

from warehouse import place
from wheelset_assets.quality import ConfigError

BEAT_SECONDS = 15.0
EXPIRY_SECONDS = 90.0
POLL_SECONDS = 0.5


class ObjectLock:
    """Lock in the object `path`, renewed by a thread of its own while it is held."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._etag: str | None = None
        self._token = uuid.uuid4().hex
        self._beats = 0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def acquire(self, wait_seconds: float = 0.0) -> None:
        """Take the lock, waiting so long for it; ConfigError names the holder if another run keeps it."""
        deadline = time.monotonic() + wait_seconds
        while True:
            holder, etag, age = self._look()
            if holder is None or holder.get("released") or age >= EXPIRY_SECONDS:
                try:
                    self._etag = place.put(self.path, self._mark(), etag)
                    break
                except place.Changed:  # somebody else was quicker
                    holder, _, age = self._look()
            if time.monotonic() >= deadline:
                raise ConfigError(self._taken_by(holder or {}, age))
            time.sleep(POLL_SECONDS)
        self._check_store()
        self._stop.clear()
        self._thread = threading.Thread(target=self._renew, name="wheelset-lock", daemon=True)
        self._thread.start()

    def _taken_by(self, holder: dict[str, Any], age: float) -> str:
        return (
            f"{self.path.parent}: another run (process {holder.get('process', 'unknown')} on {holder.get('host', 'unknown')}, "
            f"last heard of {age:.0f} s ago) is writing to this warehouse; wait for it to end; "
            f"if it died, its lock lapses {EXPIRY_SECONDS:.0f} s after it was last heard of"
        )

    def _check_store(self) -> None:
        """A store that takes no notice of conditions would let two runs in: refuse it."""
        try:
            place.put(self.path, b"", None)
        except place.Changed:
            return
        place.put(self.path, self._mark(released=True))
        raise ConfigError(
            f"{self.path.parent}: this object storage does not heed conditional writes (If-None-Match), without which two runs "
            "could write at once; AWS S3, MinIO and Ceph do in their current versions"
        )

    def taken(self) -> bool:
        """Whether a run holds the lock at this moment."""
        holder, _, age = self._look()
        return holder is not None and not holder.get("released") and age < EXPIRY_SECONDS

    def release(self) -> None:
        """Give the lock back."""
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join()
        self._thread = None
        with suppress(place.Changed):  # if it was taken over, it is not ours to give back
            place.put(self.path, self._mark(released=True), self._etag)

    def _mark(self, released: bool = False) -> bytes:
        self._beats += 1
        return place.as_json_bytes(
            {
                "token": self._token,
                "host": socket.gethostname(),
                "process": os.getpid(),
                "beat": self._beats,
                "released": released,
            }
        )

    def _look(self) -> tuple[dict[str, Any] | None, str | None, float]:
        """Holder, ETag and age in seconds by the store's clock; (None, None, 0) if nobody ever held it."""
        bucket, _, name = place.key(self.path).partition("/")
        try:
            head = place.filesystem(self.path).call_s3("head_object", Bucket=bucket, Key=name)
            text = place.filesystem(self.path).cat_file(place.key(self.path))
        except FileNotFoundError:
            return None, None, 0.0
        said = head.get("ResponseMetadata", {}).get("HTTPHeaders", {}).get("date")
        now = parsedate_to_datetime(said) if said else datetime.now(UTC)
        try:
            holder = json.loads(text)
        except ValueError:
            holder = {}
        return holder if isinstance(holder, dict) else {}, head["ETag"], (now - head["LastModified"]).total_seconds()

    def _renew(self) -> None:
        while not self._stop.wait(BEAT_SECONDS):
            try:
                self._etag = place.put(self.path, self._mark(), self._etag)
            except place.Changed:
                with suppress(Exception):
                    holder, etag, _ = self._look()
                    if holder is not None and holder.get("token") == self._token:
                        self._etag = etag  # the store took our last beat, and its answer was lost
                        continue
                    return  # taken over; the ledger's conditional writes stop this run
            except Exception:  # the network is away for a moment: the next beat may come through
                continue
