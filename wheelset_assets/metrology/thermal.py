"""The temperature model of the scan-bundle format: rig and wheelset grow apart from each other, from 20 °C.

A sensor moves as a rigid body: the translation of its true pose is multiplied by the rig's growth. The wheelset grows
alike in all directions about its own centre. Certificates, reviews and results hold at 20 °C (ISO 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

STANDARD_TEMPERATURE_C = 20.0
Array = NDArray[Any]


def growth(expansion_per_k: float, temperature_c: float) -> float:
    """Length at temperature_c over the length at 20 °C."""
    return 1.0 + expansion_per_k * (temperature_c - STANDARD_TEMPERATURE_C)


def grown_pose(rig_from_sensor: Array, growth_ratio: float) -> Array:
    """Pose (4, 4) whose translation is multiplied by growth_ratio."""
    pose = np.array(rig_from_sensor, float)
    pose[:3, 3] *= growth_ratio
    return pose
