"""A small simulated campaign, processed once, for the tests of the whole program."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from filelock import FileLock
from small_campaign import FAULTS, Campaign, run, simulated

from warehouse import catalog


@pytest.fixture(scope="session")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """Two days, two wheelsets, two repeats; four scans spoiled. Made as a user's are, by two worker processes."""

    def make(base: Path) -> Campaign:
        faults = simulated(base / "inbox", faults=FAULTS)
        return Campaign(base / "inbox", base / "warehouse", faults, run(base / "inbox", base / "warehouse", workers=2))

    return _once("campaign", make, tmp_path_factory)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """Two days of one wheelset, 16 frames x 128 rows, one scan refused and one failed: for what only moves data about."""

    def make(base: Path) -> Campaign:
        faults = simulated(base / "inbox", wheelsets=1, frames=16, rows=128, faults=("wrong-hash", "empty-stripes"))
        return Campaign(base / "inbox", base / "warehouse", faults, run(base / "inbox", base / "warehouse"))

    return _once("tiny", make, tmp_path_factory)


def _once(name: str, make: Callable[[Path], Campaign], factory: pytest.TempPathFactory) -> Campaign:
    """Made by the first of the test processes that asks for it; each works on a copy of its own."""
    own = factory.mktemp(name)
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return make(own)
    shared = factory.getbasetemp().parent / f"shared-{name}"
    told = shared / "told.json"
    with FileLock(f"{shared}.lock"):
        if not told.exists():
            shutil.rmtree(shared, ignore_errors=True)  # of a process that could not finish it
            made = make(shared)
            told.write_text(json.dumps([made.faults, made.summary]))
    shutil.copytree(shared, own, dirs_exist_ok=True)
    catalog.connect(own / "warehouse").close()  # its views name files, those of the copy from now on
    return Campaign(own / "inbox", own / "warehouse", *json.loads(told.read_text()))
