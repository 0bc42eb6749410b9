"""MiniProf wheel profiles (.whl): `key=value` lines, an empty line, then columns as `ColumnDef` names them.

In a MiniProf wheel file X runs across the wheel and Y downward into it as seen by the instrument; of the variants in use
this module writes X = s, Y = −z (flange at negative Y) and reads both signs by where the flange is. Header values Sh, Sd
and qR are recomputed from the points and compared, because copied headers are common.
Format: the open text form as found in public files; keys are kept in order and unknown ones returned untouched.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.quality import ConfigError

Array = NDArray[np.float64]

HEADER_QUANTITIES = {"Sh": "flange_height_mm", "Sd": "flange_thickness_mm", "qR": "qr_mm"}


@dataclass(frozen=True)
class MiniProfProfile:
    """A profile with its header; `s_mm` ascending."""

    s_mm: Array
    z_mm: Array
    header: dict[str, str] = field(default_factory=dict)


def read(text: str, name: str = "profile") -> MiniProfProfile:
    """Profile from the text of a .whl file; ConfigError names the line of what is wrong."""
    lines = text.replace("\r", "").split("\n")
    header: dict[str, str] = {}
    start = 0
    for number, line in enumerate(lines):
        key, mark, value = line.partition("=")
        if mark:
            header[key.strip()] = value.strip().strip('"')
        elif line.strip() and _numbers(line) is not None:
            start = number
            break
    else:
        raise ConfigError(f"{name}: no points; expected lines key=value, then columns of numbers")
    columns = [column.strip() for column in header.get("ColumnDef", "X,Y").split(",")]
    if "X" not in columns or "Y" not in columns:
        raise ConfigError(f"{name}: ColumnDef {header.get('ColumnDef')!r}: expected X and Y among the columns")
    points: list[tuple[float, float]] = []
    for number, line in enumerate(lines[start:], start=start + 1):
        if not line.strip():
            if points:
                break
            continue
        found = _numbers(line)
        if found is None or len(found) < len(columns):
            raise ConfigError(
                f"{name}, line {number}: expected {len(columns)} numbers ({', '.join(columns)}); found {line!r}"
            )
        points.append((found[columns.index("X")], found[columns.index("Y")]))
    if len(points) < 3:
        raise ConfigError(f"{name}: {len(points)} points; a profile needs three")
    x, y = np.array(points).T
    z = y if _flange_up(x, y) else -y
    order = np.argsort(x, kind="stable")
    s, z = x[order], z[order]
    if s[int(np.argmax(z))] > np.mean(s):  # the flange lies on the side of the back face
        s, z = -s[::-1], z[::-1]
    return MiniProfProfile(s, z, header)


def _numbers(line: str) -> list[float] | None:
    try:
        return [float(part) for part in line.replace(",", " ").replace(";", " ").split()]
    except ValueError:
        return None


def _flange_up(x: Array, y: Array) -> bool:
    """Whether the flange, the part farthest from the median height, points to positive y."""
    middle = float(np.median(y))
    return float(np.max(y)) - middle > middle - float(np.min(y))


def write(profile: MiniProfProfile) -> str:
    """Text of a .whl file; Sh, Sd and qR in the header are those of the points, other keys are kept."""
    measured = header_values(profile.s_mm, profile.z_mm)
    header = {
        key: value for key, value in profile.header.items() if key not in (*HEADER_QUANTITIES, "ColumnDef", "XYPoints")
    }
    header |= {key: f"{value:.4f}" for key, value in measured.items() if value is not None}
    header |= {"XYPoints": str(profile.s_mm.size), "ColumnDef": "X,Y"}
    lines = [f"{key}={value}" for key, value in header.items()] + [""]
    lines += [f"{s:.6f} {-z:.6f}" for s, z in zip(profile.s_mm, profile.z_mm, strict=True)]
    return "\r\n".join(lines) + "\r\n"


def header_values(s_mm: Array, z_mm: Array) -> dict[str, float | None]:
    """Sh, Sd and qR in mm of a profile whose back face lies at s = −70; None where the points do not reach.

    Sh: highest point over the tread at s = 0. Sd: flank 10 mm above the tread, from the back face. qR: lateral distance on
    the flank between 2 mm below the top and 10 mm above the tread.
    """
    tread = float(np.interp(0.0, s_mm, z_mm)) if s_mm[0] <= 0 <= s_mm[-1] else None
    if tread is None:
        return dict.fromkeys(HEADER_QUANTITIES)
    top = int(np.argmax(z_mm))
    flank_s, flank_z = s_mm[top:], z_mm[top:]
    height = float(z_mm[top]) - tread
    low = _crossing(flank_s, flank_z, tread + 10.0)
    high = _crossing(flank_s, flank_z, float(z_mm[top]) - 2.0)
    return {
        "Sh": height,
        "Sd": None if low is None else low + 70.0,
        "qR": None if low is None or high is None else low - high,
    }


def _crossing(s_mm: Array, z_mm: Array, level_mm: float) -> float | None:
    """First place along the falling flank where the profile crosses a level, linear between points."""
    below = np.flatnonzero(z_mm < level_mm)
    if below.size == 0 or below[0] == 0:
        return None
    i = int(below[0])
    share = (z_mm[i - 1] - level_mm) / (z_mm[i - 1] - z_mm[i])
    return float(s_mm[i - 1] + share * (s_mm[i] - s_mm[i - 1]))


def disagreements(profile: MiniProfProfile, tolerance_mm: float = 0.05) -> list[str]:
    """Header values that the points do not bear out by more than a tolerance, in words."""
    told = []
    for key, value in header_values(profile.s_mm, profile.z_mm).items():
        if key in profile.header and value is not None:
            stated = _numbers(profile.header[key])
            if stated and abs(stated[0] - value) > tolerance_mm:
                told.append(f"{key}: the header says {stated[0]:.3f} mm, the points {value:.3f} mm")
    return told
