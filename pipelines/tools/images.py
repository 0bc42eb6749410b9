"""Images from anyone's folders: reading them, and pairing those of two cameras. Errors name file, finding and remedy."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.quality import ConfigError

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp", ".jp2"})


@dataclass(frozen=True)
class ImagePair:
    """One pose: its name, and the files of both cameras (None where one is missing)."""

    name: str
    left: Path | None
    right: Path | None


def read_grey(path: Path) -> NDArray[Any]:
    """Grey image (rows, columns), 8-bit or 16-bit, as the sensor delivered it: no rotation by EXIF is applied."""
    import cv2

    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        image = cv2.imdecode(data, flags) if len(data) else None
    except cv2.error:
        image = None
    if image is None:
        raise ConfigError(
            f"{path}: not an image that can be read: {len(data):,} bytes, expected PNG, JPEG, TIFF, BMP …"
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise ConfigError(f"{path}: pixels of type {image.dtype}; expected 8-bit or 16-bit grey levels or colours")
    return image


def image_pairs(folder: Path, left: str | None, right: str | None) -> tuple[list[ImagePair], list[str]]:
    """Pairs of images in a folder in natural order, and notes on how they were found.

    Without patterns: names that begin with left and right (in any case), in the folder, in its folders left* and
    right*, or in its only folder that has such images. Names are paired by what the pattern's wildcards stand for; if
    that fits no pair and both cameras have as many images, by their order.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such folder")
    if (left is None) != (right is None):
        raise ConfigError("--left and --right go together: name a pattern for each camera")
    notes: list[str] = []
    base, patterns = folder, (left or "left*", right or "right*")
    found = [_matching(base, pattern) for pattern in patterns]
    if left is None and not all(found):
        found, base, note = _elsewhere(folder, found)
        notes += note
    for side, files, pattern in zip(("left", "right"), found, patterns, strict=True):
        if not files:
            raise ConfigError(
                f"{folder}: no image of the {side} camera matches {pattern!r}; found {_listing(folder)}. "
                "Name the files of each camera by --left GLOB --right GLOB"
            )
    keys = [set(files) for files in found]
    if keys[0] & keys[1]:
        names = sorted(keys[0] | keys[1], key=_natural)
        pairs = [ImagePair(name, found[0].get(name), found[1].get(name)) for name in names]
        return [_named(pair) for pair in pairs], notes
    ordered = [[files[k] for k in sorted(files, key=_natural)] for files in found]
    if len(ordered[0]) != len(ordered[1]):
        raise ConfigError(
            f"{folder}: {len(ordered[0])} left images ({ordered[0][0].name}, …) and {len(ordered[1])} right ones "
            f"({ordered[1][0].name}, …) share no part of their names, so that they cannot be paired. Rename them alike"
        )
    notes.append(f"names share no number: paired in order, {ordered[0][0].name} with {ordered[1][0].name} and so on")
    return [ImagePair(a.stem, a, b) for a, b in zip(*ordered, strict=True)], notes


def _named(pair: ImagePair) -> ImagePair:
    either = pair.left or pair.right
    assert either is not None
    return ImagePair(pair.name.strip(" _-./") or either.stem, pair.left, pair.right)


def _matching(base: Path, pattern: str) -> dict[str, Path]:
    """Images below base that match a pattern, by what its wildcards stand for (without the file's ending)."""
    expression = _expression(pattern)
    found: dict[str, Path] = {}
    deep = "/" in pattern
    for path in sorted(base.rglob("*") if deep else base.iterdir()):
        name = path.relative_to(base).as_posix()
        if path.suffix.lower() not in SUFFIXES or not path.is_file():
            continue
        match = expression.fullmatch(name) or expression.fullmatch(name[: -len(path.suffix)])
        if match:
            key = "/".join(part for part in match.groups() if part is not None)
            found[key[: -len(path.suffix)] if key.lower().endswith(path.suffix.lower()) else key] = path
    return found


def _expression(pattern: str) -> re.Pattern[str]:
    """Regular expression of a glob with a group for each wildcard; letters in any case."""
    text, i = "", 0
    while i < len(pattern):
        c = pattern[i]
        if pattern.startswith("**/", i):
            text, i = text + "(?:(.*)/)?", i + 3
            continue
        if c == "*":
            text += "([^/]*)"
        elif c == "?":
            text += "([^/])"
        elif c == "[" and "]" in pattern[i + 2 :]:
            end = pattern.index("]", i + 2)
            inside = pattern[i + 1 : end].replace("\\", r"\\")
            text, i = text + f"([{'^' + inside[1:] if inside[0] == '!' else inside}])", end
        else:
            text += re.escape(c)
        i += 1
    return re.compile(text, re.IGNORECASE)


def _elsewhere(folder: Path, found: list[dict[str, Path]]) -> tuple[list[dict[str, Path]], Path, list[str]]:
    """Images in folders left* and right*, or in the only folder inside that has left* and right* images."""
    inside = sorted(p for p in folder.iterdir() if p.is_dir())
    sides = [[p for p in inside if p.name.lower().startswith(side)] for side in ("left", "right")]
    if all(len(s) == 1 for s in sides):
        inner = [_matching(s[0], "*") for s in sides]
        if all(inner):
            return inner, folder, [f"images are those of {sides[0][0].name}/ and {sides[1][0].name}/"]
    holding = [p for p in inside if _matching(p, "left*") and _matching(p, "right*")]
    if len(holding) == 1:
        at = holding[0]
        return [_matching(at, "left*"), _matching(at, "right*")], at, [f"images are those of {at}"]
    return found, folder, []


def _listing(folder: Path) -> str:
    names = sorted(p.name + ("/" if p.is_dir() else "") for p in folder.iterdir())
    return (
        "nothing in it"
        if not names
        else ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    )


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Sorting key in which 9 comes before 10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", text) if part]


def common_size(sizes: list[tuple[int, int]]) -> tuple[int, int]:
    """The image size (width, height) that most images of a camera have; of two equally frequent ones, the larger."""
    counts = Counter(sizes)
    if not counts:
        return (1, 1)
    return max(counts, key=lambda size: (counts[size], size[0] * size[1]))
