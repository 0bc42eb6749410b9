"""Random streams of the simulator: one independent generator for each (seed, purpose, indices).

Nothing here depends on how many scans are asked for: scan 7 of a campaign of 10 equals scan 7 of a campaign of 100.
Draws themselves live with what they describe (rig, wheelset, noise); no physics here.
"""

from __future__ import annotations

import numpy as np

# The numbers are part of the file format of a seed: append, never renumber.
PURPOSES = {
    "rig": 1,
    "optics": 2,
    "laser": 3,
    "wheelset": 4,
    "master": 5,
    "certificate": 6,
    "cmm": 7,
    "calibration": 8,
    "board-pose": 9,
    "board-noise": 10,
    "day": 11,
    "conditions": 12,
    "thermometer": 13,
    "encoder": 14,
    "stripe": 15,
    "image": 16,
    "fault": 17,
    "journal-centre": 18,
}


def stream(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """Generator for one purpose; `indices` (for instance day, wheelset, repeat, sensor, camera) tell streams apart."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(PURPOSES[purpose], *indices)))


def in_ball(rng: np.random.Generator, radius: float) -> np.ndarray:
    """A point (3,) uniform in the ball of the given radius."""
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction) * radius * rng.uniform() ** (1 / 3)
