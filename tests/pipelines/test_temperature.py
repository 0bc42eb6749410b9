"""What the temperature does to a comparator, predicted from the rig's own geometry, occurs; compensated, it goes.

A diameter errs by 2 (R - r) alpha dT if nothing is compensated, r being how far out the sensor stands; a distance
by (L - l) alpha dT, l being the distance between the two sensors along the axle; so where rig and wheelset warm alike.
"""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.experiments.virtual import SERIES, World
from wheelset_assets.simulation.schedule import Conditions
from wheelset_assets.simulation.wheelset import draw_wheelset

ALPHA_PER_K = 11.5e-6
QUANTITIES = (
    ("journal_diameter", "left"),
    ("journal_diameter", "right"),
    ("wheel_diameter", "left"),
    ("wheel_diameter", "right"),
    ("inner_distance", "both"),
    ("shoulder_distance", "both"),
)


@pytest.fixture(scope="module")
def world() -> World:
    return World(SERIES["exact"], 77, 256, 48, "S1002")


def drift_mm(world: World, quantity: str, side: str, true_mm: float, wheelset_k: float, rig_k: float) -> float:
    """Error of an uncompensated value, from the places of the sensors that the stations' others are registered to.

    wheelset_k, rig_k: how much warmer they are than master and rig were in the reference scan.
    """
    kind = "journal" if quantity in ("journal_diameter", "shoulder_distance") else "wheel"
    first = {
        station: next(s for s in world.true.sensors if s.station == station).rig_from_sensor_nominal
        for station in (f"left_{kind}", f"right_{kind}")
    }
    if side == "both":
        apart = first[f"right_{kind}"][0, 3] - first[f"left_{kind}"][0, 3]
        return ALPHA_PER_K * (true_mm * wheelset_k - apart * rig_k)
    place, sight = first[f"{side}_{kind}"][1:3, 3], first[f"{side}_{kind}"][1:3, 2]
    radius = true_mm / 2
    sight = sight / np.linalg.norm(sight)
    along = -(place @ sight) - np.sqrt((place @ sight) ** 2 - place @ place + radius**2)
    outward = (place + along * sight) / radius  # where the middle of the sensor's view meets the surface
    return 2 * ALPHA_PER_K * (radius * wheelset_k - float(outward @ place) * rig_k)


@pytest.mark.parametrize("step_k", [-3.0, 3.0])
def test_uncompensated_values_drift_as_the_rig_predicts_and_compensated_ones_do_not(world: World, step_k: float):
    wheelset = draw_wheelset(3, 1, "W", "S1002")
    truth = wheelset.truths()
    t = world.reference_c + step_k
    conditions = Conditions(t, t, t, t, 0.2, (0.0, 0.0), 0.0, 10.0)
    seen = world.see_under(conditions, wheelset, np.random.default_rng(1))
    measured = world.process(seen, world.reference, world.config)["measurements"].to_pylist()
    rows = {(r["quantity"], r["side"]): r for r in measured}
    before, now = world.master.header.temperature_c, seen.header.temperature_c
    steps_k = (now.wheelset - before.wheelset, now.rig - before.rig)
    assert np.abs(np.array(steps_k) - step_k).max() < 0.2
    for key in QUANTITIES:
        row, expected = rows[key], drift_mm(world, *key, truth[key], *steps_k)
        assert abs(expected) > 0.005, "a drift that could not be seen would prove nothing"
        # The same readings with and without: noise cancels. The true poses are not the nominal ones.
        assert row["value_uncompensated"] - row["value"] == pytest.approx(expected, rel=0.05), key
        assert abs(row["value"] - truth[key]) < row["expanded_uncertainty"], key
        assert abs(row["value_uncompensated"] - expected - truth[key]) < row["expanded_uncertainty"] + 0.001, key
