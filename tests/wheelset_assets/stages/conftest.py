"""The small world, its reference scan and one production scan: made once for all tests of the stages."""

from __future__ import annotations

import pytest
from small_world import SEED, Scan, World

from wheelset_assets.simulation.wheelset import draw_wheelset


@pytest.fixture(scope="session")
def world() -> World:
    return World()


@pytest.fixture(scope="session")
def product(world) -> Scan:
    """A production scan against the reference, with its wheelset."""
    wheelset = draw_wheelset(SEED, 0, "WS-000", "S1002")
    scan = world.scan(wheelset, 1)
    stripes = scan.tables.stripes
    scan.tables = world.process(scan, world.reference)
    scan.tables.stripes, scan.tables.wheelset = stripes, wheelset
    return scan
