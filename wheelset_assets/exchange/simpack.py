"""SIMPACK wheel profiles (.prw): a header, then `spline.begin … point.begin` with lateral and height, in mm.

Comment lines begin with `!`. Units factors convert to metres; `inversion` reverses the order of points.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.quality import ConfigError

Array = NDArray[np.float64]


def write(s_mm: Array, z_mm: Array, comment: str = "") -> str:
    """Text of a .prw file: y = s to the field side, z positive downward into the wheel as vehicle dynamics has it."""
    told = " ".join(comment.split())
    lines = [
        "header.begin",
        "  version  = 1",
        "  type     = 0",
        "header.end",
        "spline.begin",
        "  approx.smooth  = 0.0",
        f"  comment        = '{told.replace(chr(39), ' ')}'",
        "  units.len      = 'mm'",
        "  units.ang      = 'rad'",
        "  units.len.f    = 1000.0",
        "  units.ang.f    = 1.0",
        "  mirror.y       = 0",
        "  mirror.z       = 0",
        "  inversion      = 0",
        "  point.begin",
        *(f"    {s:.6f}  {-z:.6f}  1.0" for s, z in zip(s_mm, z_mm, strict=True)),
        "  point.end",
        "spline.end",
    ]
    return "\n".join(lines) + "\n"


def read(text: str, name: str = "profile") -> tuple[Array, Array]:
    """`s_mm`, `z_mm` of a .prw file, with its units, mirrors and inversion applied; ConfigError if it holds no points."""
    body = re.search(r"point\.begin(.*?)point\.end", text, re.DOTALL)
    if not body:
        raise ConfigError(f"{name}: no point.begin … point.end")
    options = dict(re.findall(r"^\s*([\w.]+)\s*=\s*'?([^'\n!]*?)'?\s*(?:!.*)?$", text[: body.start()], re.MULTILINE))
    rows = [line.split("!")[0].split() for line in body.group(1).splitlines()]
    try:
        points = np.array([[float(row[0]), float(row[1])] for row in rows if len(row) >= 2])
        factor = 1000.0 / float(options.get("units.len.f", 1000.0))
    except ValueError as error:
        raise ConfigError(f"{name}: a point or factor is no number: {error}") from error
    if len(points) < 3:
        raise ConfigError(f"{name}: {len(points)} points; a profile needs three")
    y, z = points.T * factor
    y = -y if options.get("mirror.y", "0").strip() == "1" else y
    z = -z if options.get("mirror.z", "0").strip() == "1" else z
    order = np.argsort(y, kind="stable")
    return y[order], -z[order]
