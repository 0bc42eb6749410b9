"""Values only. `limits/` holds example limits with their sources (`warehouse.limits` reads them); `profiles/`
nominal wheel profiles as data, one file each; their closed forms live elsewhere.

Columns `s_mm` (lateral, 0 on the datum circle 70 mm from the inner face, positive to the field side) and `z_mm` (radial,
0 at s = 0). S1002: EN 13715 / UIC 510-2, h 28, e 32.5. LMA: CRH2, CRH380A, CR400AF. CONE20, CONE40: the flange of S1002
down its flank of 70 degrees, an arc of 13 mm, then a cone of 1:20 or 1:40 through the datum circle, for trials.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LIMITS = Path(__file__).resolve().parent / "limits"
PROFILES = Path(__file__).resolve().parent / "profiles"


def profile_names() -> tuple[str, ...]:
    """Names of the nominal profiles at hand."""
    return tuple(sorted(path.stem for path in PROFILES.glob("*.csv")))


def nominal_profile(name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(s_mm, z_mm) of a nominal profile, in steps of 0.25 mm; KeyError names those that there are."""
    if name not in profile_names():
        raise KeyError(f"no nominal profile {name!r}; there are {', '.join(profile_names())}")
    import numpy as np

    s, z = np.loadtxt(PROFILES / f"{name}.csv", delimiter=",", skiprows=1, unpack=True)
    return s, z
