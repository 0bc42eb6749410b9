"""Reviews of independent instruments, and certificates: read from cmm/*.csv, kept in the warehouse, shown as one table."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import stat
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from warehouse import place, store
from wheelset_assets.bundle import ScanHeader
from wheelset_assets.quality import ConfigError

MAX_REVIEW_BYTES = 64 * 2**20


def _no_review(path: Path) -> str | None:
    """Why a file is not even opened: a pipe would never end, and a link may lead anywhere; None if it is a plain file."""
    if place.is_remote(path):
        return None
    try:
        status = os.lstat(path)
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if not stat.S_ISREG(status.st_mode):
        return "expected a plain file, neither link nor pipe"
    if status.st_size > MAX_REVIEW_BYTES:
        return f"{status.st_size} bytes; expected at most {MAX_REVIEW_BYTES}"
    return None


def reviews_fingerprint(reviews: list[Path]) -> str:
    """Changes with the names and contents of the review files."""
    lines = []
    for path in reviews:
        if why := _no_review(path):
            lines.append(f"{path.name} {why}")
            continue
        try:
            lines.append(f"{path.name} {store.sha256_file(path)}")
        except OSError as error:
            lines.append(f"{path.name} {error.strerror}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def known_fingerprint(root: Path) -> str:
    """Fingerprint of the review files that the last run saw."""
    path = root / "_catalog" / "reviews.json"
    stored = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return str(stored.get("fingerprint")) if stored else reviews_fingerprint([])


def store_reviews(root: Path, reviews: list[Path]) -> None:
    """Copy the inbox's reviews, so that a moved warehouse keeps them; a file that cannot be read keeps its reason."""
    rows, troubles = [], []
    for path in reviews:
        try:
            rows += read_review(path)
        except ConfigError as error:
            troubles.append(str(error))
    data = [{**row, "measured_at": row["measured_at"].isoformat()} for row in rows]
    store.write_bytes(
        root / "_catalog" / "reviews.json",
        json.dumps(
            {"fingerprint": reviews_fingerprint(reviews), "reviews": data, "troubles": troubles}, indent=1
        ).encode(),
    )


def review_troubles(root: Path) -> list[str]:
    """Why review files of the last run could not be read; none of their rows is in reference_values."""
    path = root / "_catalog" / "reviews.json"
    troubles = json.loads(path.read_text(encoding="utf-8"))["troubles"] if path.exists() else []
    return [f"review left out: {trouble}" for trouble in troubles]


def read_review(path: Path) -> list[dict[str, Any]]:
    """Rows of a review file; ConfigError names file, line, column and expectation."""
    wanted = ("wheelset_id", "quantity", "side", "value_mm", "expanded_uncertainty_mm", "measured_at")
    rows = []
    if why := _no_review(path):
        raise ConfigError(f"cmm/{path.name}: {why}")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            if missing := [c for c in wanted if c not in (reader.fieldnames or [])]:
                raise ConfigError(f"cmm/{path.name}: column {missing[0]} is missing")
            for row in reader:
                rows.append(_review_row(path, reader.line_num, row))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"cmm/{path.name}: cannot be read: {error}") from error
    return rows


def _review_row(path: Path, line: int, row: dict[str, str]) -> dict[str, Any]:
    def wrong(column: str, expected: str) -> ConfigError:
        return ConfigError(f"cmm/{path.name}: line {line}: column {column}: expected {expected}; found {row[column]!r}")

    for column in ("wheelset_id", "quantity"):
        if not row[column]:
            raise wrong(column, "a name")
    if row["side"] not in ("left", "right", "both"):
        raise wrong("side", "left, right or both")
    numbers = {}
    for column, smallest in (("value_mm", -math.inf), ("expanded_uncertainty_mm", 0.0)):
        try:
            numbers[column] = float(row[column])
        except (TypeError, ValueError):
            raise wrong(column, "a number") from None
        if not math.isfinite(numbers[column]) or numbers[column] < smallest:
            raise wrong(column, "a finite number" + (", not negative" if smallest == 0 else ""))
    try:
        measured_at = datetime.fromisoformat(row["measured_at"])
        measured_at.astimezone(UTC)
    except (TypeError, ValueError, OverflowError):
        measured_at = None
    if measured_at is None or measured_at.tzinfo is None:
        raise wrong("measured_at", "a time with an offset")
    return {
        "wheelset_id": row["wheelset_id"],
        "quantity": row["quantity"],
        "side": row["side"],
        **numbers,
        "measured_at": measured_at,
        "instrument": row.get("instrument") or None,
        "source": "cmm",
        "origin": f"cmm/{path.name}",
    }


def stored_reviews(root: Path) -> list[dict[str, Any]]:
    """The reviews that the last run kept, as rows of `reference_values`."""
    path = root / "_catalog" / "reviews.json"
    rows = json.loads(path.read_text(encoding="utf-8"))["reviews"] if path.exists() else []
    return [{**row, "measured_at": datetime.fromisoformat(row["measured_at"])} for row in rows]


def certificate_rows(header: ScanHeader) -> list[dict[str, Any]]:
    """The certificate of a reference scan's master wheelset, as rows of `reference_values`."""
    return [
        {
            "wheelset_id": header.wheelset.wheelset_id,
            "quantity": c.quantity,
            "side": c.side,
            "value_mm": c.value_mm,
            "expanded_uncertainty_mm": c.expanded_uncertainty_mm,
            "measured_at": header.captured_at,
            "instrument": None,
            "source": "certificate",
            "origin": header.scan_id,
        }
        for c in header.certificate
    ]
