"""Q-DAS ASCII transfer format (AQDEF, .dfq): measurements by characteristic, for a plant's statistics.

Written: K0100 number of characteristics; K1001/K1002 part; K2001/K2002 characteristic, K2022 decimals, K2110/K2111
limits, K2142 unit; then values K0001 with time K0004 (day.month.year/hour:minute:second) and K0014 serial number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime


@dataclass(frozen=True)
class Characteristic:
    """One characteristic with its values, times and serial numbers, in the order of measuring; limits in its unit."""

    name: str
    unit: str
    values: Sequence[float | None]
    times: Sequence[datetime]
    serials: Sequence[str]
    limit_min: float | None = None
    limit_max: float | None = None
    decimals: int = 5


INVALID = 256
"""Attribute K0002 of a value that could not be measured."""


def write(
    part_number: str, part_name: str, characteristics: Sequence[Characteristic], facts: Mapping[str, str] | None = None
) -> str:
    """Text of a .dfq file. Values are written one characteristic after the other, each with its own number behind the key."""
    lines = [f"K0100 {len(characteristics)}", f"K1001/1 {_plain(part_number)}", f"K1002/1 {_plain(part_name)}"]
    lines += [f"{key} {_plain(value)}" for key, value in (facts or {}).items()]
    for number, one in enumerate(characteristics, start=1):
        lines += [
            f"K2001/{number} {number}",
            f"K2002/{number} {_plain(one.name)}",
            f"K2004/{number} 0",
            f"K2022/{number} {one.decimals}",
            f"K2142/{number} {_plain(one.unit)}",
        ]
        lines += [f"K2110/{number} {one.limit_min:.{one.decimals}f}"] if one.limit_min is not None else []
        lines += [f"K2111/{number} {one.limit_max:.{one.decimals}f}"] if one.limit_max is not None else []
    for number, one in enumerate(characteristics, start=1):
        for value, time, serial in zip(one.values, one.times, one.serials, strict=True):
            shown = f"{value:.{one.decimals}f}" if value is not None else "0"
            lines.append(f"K0001/{number} {shown}")
            lines += [f"K0002/{number} {INVALID}"] if value is None else []
            lines.append(f"K0004/{number} {time.astimezone(UTC):%d.%m.%Y/%H:%M:%S}")
            lines.append(f"K0014/{number} {_plain(serial)}")
    return "\r\n".join(lines) + "\r\n"


def _plain(text: str) -> str:
    """One line without control characters, as the format has no escapes."""
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()
