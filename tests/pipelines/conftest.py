"""A small simulated campaign, processed once, for the tests of the whole program."""

from __future__ import annotations

import pytest
from small_campaign import FAULTS, Campaign, run, simulated


@pytest.fixture(scope="session")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """Two days, two wheelsets, two repeats; four scans spoiled."""
    base = tmp_path_factory.mktemp("campaign")
    faults = simulated(base / "inbox", faults=FAULTS)
    summary = run(base / "inbox", base / "warehouse")
    return Campaign(base / "inbox", base / "warehouse", faults, summary)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """Two days of one wheelset, 16 frames x 128 rows, one scan refused and one failed: for what only moves data about."""
    base = tmp_path_factory.mktemp("tiny")
    faults = simulated(base / "inbox", wheelsets=1, frames=16, rows=128, faults=("wrong-hash", "empty-stripes"))
    return Campaign(base / "inbox", base / "warehouse", faults, run(base / "inbox", base / "warehouse"))
