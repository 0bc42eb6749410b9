"""Nominal wheel profiles as data: the warehouse's own `profiles/NAME.csv`, else the shipped library in `configs/profiles`.

Two columns with a header, `s_mm` (lateral, 0 on the datum circle 70 mm from the inner face, positive to the field side)
and `z_mm` (radial, 0 at s = 0), from the inner face outward.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np

from configs import PROFILES, profile_names
from wheelset_assets.metrology.reading import Nominal
from wheelset_assets.quality import ConfigError

FOLDER = "profiles"
DATUM_MM = 70.0
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def _file(root: Path, name: str | None) -> Path | None:
    """File of a profile; None if there is none of this name."""
    if name is None or not _NAME.fullmatch(name):
        return None
    return next((p for p in (root / FOLDER / f"{name}.csv", PROFILES / f"{name}.csv") if p.is_file()), None)


def known(root: Path) -> list[str]:
    """Names of the profiles at hand."""
    return sorted({*profile_names(), *(p.stem for p in (root / FOLDER).glob("*.csv"))})


def version(root: Path, name: str | None) -> str:
    """Changes with the contents of the profile's file, or with its absence."""
    path = _file(root, name)
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path else "none"


def nominal(root: Path, name: str | None) -> Nominal | str:
    """The profile, or why there is none. A file that is no profile is a reason too: it must not sink a night."""
    path = _file(root, name)
    if path is None:
        at_hand = ", ".join(known(root))
        if name is None:
            return f"the bundle names no nominal profile; there are {at_hand}"
        return f"no nominal profile {name!r}; there are {at_hand}, and {root.name}/{FOLDER}/{name}.csv would be another"
    try:
        return read_profile(path)
    except ConfigError as error:
        return str(error)


def read_profile(path: Path) -> Nominal:
    """Profile of a CSV file; ConfigError names the file and what was expected."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = [part.strip() for part in file.readline().split(",")]
            if header != ["s_mm", "z_mm"]:
                raise ConfigError(f"{path}: expected the header s_mm,z_mm; found {','.join(header)!r}")
            data = np.loadtxt(file, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not a profile of two numeric columns: {error}") from error
    if data.shape[0] < 20 or data.shape[1] != 2 or not np.isfinite(data).all():
        raise ConfigError(f"{path}: expected 20 points or more of two finite numbers; found {data.shape}")
    return Nominal(path.stem, data[:, 0] + DATUM_MM, data[:, 1])
