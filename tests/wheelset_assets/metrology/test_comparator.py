"""The comparator against a model of rig and wheelset that is written out here: values, derivatives, temperature errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from wheelset_assets.metrology import comparator
from wheelset_assets.metrology.comparator import Conditions, Difference, Standing, Tolerances
from wheelset_assets.metrology.uncertainty import combined
from wheelset_assets.simulation.rig import build_rig

STEEL = 11.5e-6
TOLERANCES = Tolerances(0.02, 0.03, 0.3e-6, 0.4e-6, 0.25e-3, 0.01)
STANDING = Standing(2e-3, 6e-4, 1.5e-3, 5e-5, 55.0)


@dataclass(frozen=True)
class Bench:
    """What is reported of one comparison, and the true lengths behind it; all lengths at 20 °C, in mm."""

    size: float = 921.3
    master: float = 920.0
    certified: float = 920.0
    sensor: float = 700.0  # distance of the sensor from the axis, or from the middle for a face
    ws_c: float = 26.0
    rig_c: float = 24.5
    ref_ws_c: float = 21.0
    ref_rig_c: float = 21.5
    ws_per_k: float = 12.1e-6
    master_per_k: float = 11.2e-6
    rig_per_k: float = 11.7e-6

    def conditions(self) -> Conditions:
        return Conditions(
            self.ws_c, self.rig_c, self.ref_ws_c, self.ref_rig_c, self.ws_per_k, self.master_per_k, self.rig_per_k
        )


TRUE = Bench()


def seen(half_size, per_k, ws_c, rig_c, sensor):
    """Where a surface stands in the frame of a sensor that moves with the true rig (its own zero)."""
    return half_size * (1 + per_k * (ws_c - 20)) - sensor * (1 + TRUE.rig_per_k * (rig_c - 20))


def indication(reported: Bench) -> float:
    """Indication of a diameter by eq. 28: K from the reference scan, both with what is reported of the conditions."""
    now = seen(TRUE.size / 2, TRUE.ws_per_k, TRUE.ws_c, TRUE.rig_c, TRUE.sensor)
    then = seen(TRUE.master / 2, TRUE.master_per_k, TRUE.ref_ws_c, TRUE.ref_rig_c, TRUE.sensor)
    master = reported.certified / 2 * (1 + reported.master_per_k * (reported.ref_ws_c - 20))
    k_20 = (master - then) / (1 + reported.rig_per_k * (reported.ref_rig_c - 20))
    return 2 * (k_20 * (1 + reported.rig_per_k * (reported.rig_c - 20)) + now)


def part(lever=TRUE.sensor, **changes) -> Difference:
    return replace(Difference(0.65, 0.4, 2e-4, 1e-4, lever, 0.03, 0.01, 1e-4), **changes)


def value(reported: Bench = TRUE, tolerances: Tolerances = TOLERANCES, parts=None) -> comparator.Value:
    return comparator.compare(
        reported.certified, 0.0015, indication(reported), 3e-4, 4e-4, reported.conditions(), tolerances,
        parts or [part()], 2.0,
    )  # fmt: skip


def contributions(found) -> dict[str, float]:
    return {s.name: s.contribution for s in found.sources}


# --- values and derivatives


def test_the_value_is_the_true_diameter_at_twenty_degrees():
    assert value().value == pytest.approx(TRUE.size, abs=1e-9)


@pytest.mark.parametrize(
    ("source", "reported", "step"),
    [
        ("certificate of the master", "certified", 1e-3),
        ("wheelset temperature", "ws_c", 1e-2),
        ("master temperature", "ref_ws_c", 1e-2),
        ("rig temperature", "rig_c", 1e-2),
        ("rig temperature at the reference", "ref_rig_c", 1e-2),
        ("expansion of the wheelset", "ws_per_k", 1e-8),
        ("expansion of the master", "master_per_k", 1e-8),
        ("expansion of the rig", "rig_per_k", 1e-8),
    ],
)
def test_sensitivities_are_the_models_derivatives(source, reported, step):
    """Central differences of the whole chain, K and all, over what is reported; first order: 1e-3 of itself."""
    up, down = (replace(TRUE, **{reported: getattr(TRUE, reported) + sign * step}) for sign in (1, -1))
    slope = (value(up).value - value(down).value) / (2 * step)
    (found,) = [s for s in value().sources if s.name == source]
    assert abs(found.sensitivity) == pytest.approx(abs(slope), rel=1e-3)
    assert abs(slope) > 0


def test_standard_uncertainties_are_the_tolerances():
    units = {s.name: (s.standard_uncertainty, s.unit) for s in value().sources}
    assert units["certificate of the master"] == (0.0015, "mm")
    assert units["noise of the scan"] == (3e-4, "mm")
    assert units["noise of the reference scan"] == (4e-4, "mm")
    assert units["wheelset temperature"] == units["master temperature"] == (0.02, "K")
    assert units["rig temperature"] == units["rig temperature at the reference"] == (0.03, "K")
    assert units["expansion of the wheelset"] == units["expansion of the master"] == (0.3e-6, "1/K")
    assert units["expansion of the rig"] == (0.4e-6, "1/K")


def test_a_shift_of_the_axis_counts_twice_in_a_diameter_and_not_in_a_distance():
    """One draw in the scan and one in its reference, each seen from one side: 2 sqrt(2) u, by Monte Carlo."""
    random = np.random.default_rng(0)
    shifts = 0.25e-3 * random.standard_normal((2, 20_000))
    claimed = contributions(value())["axis of rotation"]
    assert (2 * (shifts[0] - shifts[1])).std() == pytest.approx(claimed, rel=3.3 / np.sqrt(2 * 20_000))
    distance = comparator.compare(
        1353.0, 1e-3, 1353.1, 1e-4, 1e-4, TRUE.conditions(), TOLERANCES, [part(), part()], 1.0
    )
    assert "axis of rotation" not in contributions(distance)


def test_calibration_counts_with_the_distance_from_the_master():
    """A wheel like the master needs no scale; one that differs by 0.65 mm in radius needs 1.3 mm of it."""
    names = ("calibration: scale along the reading", "sensor pose in unconstrained directions")
    same = contributions(value(parts=[part(displacement_mm=0.0, cross_mm=0.0)]))
    assert [same[n] for n in (*names, "calibration and squareness across the reading")] == [0, 0, 0]
    other = contributions(value())
    assert other[names[0]] == pytest.approx(2 * 2e-4 * 0.65)
    assert other["calibration and squareness across the reading"] == pytest.approx(2 * np.hypot(1e-4, 1e-4) * 0.4)


@pytest.mark.parametrize("tangent", [0.0, 0.03, 0.2])
def test_unconstrained_directions_are_counted_to_their_order(tangent):
    """A sensing direction off by tangent + delta reads D cos(...): the claim is its root mean square."""
    random = np.random.default_rng(1)
    u_angle = 0.01
    delta = u_angle * random.standard_normal(50_000)
    error = 2 * 0.65 * (np.cos(tangent + delta) / np.cos(tangent) - 1)
    rms = np.sqrt((error**2).mean())
    claimed = contributions(value(parts=[part(tangent_rad=tangent)]))["sensor pose in unconstrained directions"]
    assert claimed == pytest.approx(rms, rel=0.03)


def test_two_sides_add_in_quadrature():
    one = contributions(
        comparator.compare(1353.0, 1e-3, 1353.1, 1e-4, 1e-4, TRUE.conditions(), TOLERANCES, [part()], 1.0)
    )
    two = contributions(
        comparator.compare(1353.0, 1e-3, 1353.1, 1e-4, 1e-4, TRUE.conditions(), TOLERANCES, [part(), part()], 1.0)
    )
    for name in ("calibration: scale along the reading", "calibration and squareness across the reading"):
        assert two[name] == pytest.approx(np.sqrt(2) * one[name])
    for name in ("rig temperature", "expansion of the rig"):  # but both sensors stand on one rig
        assert two[name] == pytest.approx(2 * one[name])


def test_the_claimed_uncertainty_is_the_spread_of_the_value_two_sided():
    """Monte Carlo over certificate, four temperatures and three coefficients, through the whole chain."""
    random = np.random.default_rng(2)
    u = {
        "certified": 0.0015, "ws_c": 0.02, "ref_ws_c": 0.02, "rig_c": 0.03, "ref_rig_c": 0.03,
        "ws_per_k": 0.3e-6, "master_per_k": 0.3e-6, "rig_per_k": 0.4e-6,
    }  # fmt: skip
    errors = []
    for _ in range(2000):
        reported = replace(TRUE, **{k: getattr(TRUE, k) + s * random.standard_normal() for k, s in u.items()})
        errors.append(value(reported).value - TRUE.size)
    names = {"certificate of the master", "wheelset temperature", "master temperature", "rig temperature"}
    names |= {"rig temperature at the reference", "expansion of the wheelset", "expansion of the master"}
    claimed = combined([s for s in value().sources if s.name in names | {"expansion of the rig"}])
    assert np.std(errors) == pytest.approx(claimed, rel=3.3 / np.sqrt(2 * 2000))


# --- temperature


def uncompensated_error_um(master, factor, levers, step_k=3.0):
    """Error of the value without compensation: the master itself, scanned again at +step_k, rig and wheelset alike."""
    conditions = Conditions(20 + step_k, 20 + step_k, 20, 20, STEEL, STEEL, STEEL)
    parts = [part(lever=lever) for lever in levers]
    # A perfect comparator indicates the grown master; K has grown with the rig.
    found = comparator.compare(master, 0, master * conditions.growth, 0, 0, conditions, TOLERANCES, parts, factor)
    assert found.value == pytest.approx(master, abs=1e-9)
    return 1e3 * (found.uncompensated - master)


@pytest.mark.parametrize("diameter", [130.0, 920.0])
def test_an_uncompensated_comparator_errs_by_what_its_sensor_moves_beyond_the_surface(diameter):
    """2 (R - r) alpha dT: the same -17.25 um for journal and wheel, with a sensor 250 mm off the surface at +3 K."""
    error = uncompensated_error_um(diameter, 2.0, [diameter / 2 + 250.0])
    assert error == pytest.approx(-2 * 250 * STEEL * 3 * 1e3, abs=0.01)
    assert uncompensated_error_um(diameter, 2.0, [0.0]) == pytest.approx(diameter * STEEL * 3 * 1e3, abs=0.01)


def test_the_bench_rigs_own_geometry_predicts_the_notes_numbers():
    """Wheel and journal about -16 um, inner distance +7, shoulder distance -11 at +3 K (notes on the paper, 9)."""
    rig = build_rig(0, "bench", "bench-1")
    at = {s.sensor_id: s.rig_from_sensor_nominal[:3, 3] for s in rig.sensors}
    expected = {
        ("wheel", 920.0, 2.0): (-16.0, [at["left_wheel_inner"][2]]),
        ("journal", 130.0, 2.0): (-16.0, [at["left_journal"][2]]),
        ("inner", 1353.0, 1.0): (7.0, [-at["left_wheel_inner"][0], at["right_wheel_inner"][0]]),
        ("shoulder", 2180.0, 1.0): (-11.0, [-at["left_journal"][0], at["right_journal"][0]]),
    }
    for (_, size, factor), (noted, levers) in expected.items():
        assert uncompensated_error_um(size, factor, levers) == pytest.approx(noted, abs=1.0)


def test_the_uncompensated_value_is_what_a_comparator_without_thermometers_says():
    """Straight from the model: K at the reference's rig, and the master taken at its certified size."""
    now = seen(TRUE.size / 2, TRUE.ws_per_k, TRUE.ws_c, TRUE.rig_c, TRUE.sensor)
    then = seen(TRUE.master / 2, TRUE.master_per_k, TRUE.ref_ws_c, TRUE.ref_rig_c, TRUE.sensor)
    naive = TRUE.certified + 2 * (now - then)
    # The comparator divides by the master's growth, 1.1e-5 of a few millimetres' difference: nanometres.
    assert value().uncompensated == pytest.approx(naive, abs=2e-4)


# --- quantities without a zero


def test_absolute_quantities_shrink_to_twenty_degrees_and_carry_their_budget():
    conditions = TRUE.conditions()
    found = comparator.absolute(28.05, 4e-4, conditions, TOLERANCES, STANDING)
    assert found.value == pytest.approx(28.05 / (1 + 12.1e-6 * 6), abs=1e-12)
    c = contributions(found)
    assert c["noise of the scan"] == 4e-4
    assert c["registration of the sensors"] == 6e-4
    assert c["calibration of the sensors"] == 2e-3
    assert c["squareness to the axle"] == pytest.approx(5e-5 * 55)
    assert c["sensing plane beside the axle"] == 1.5e-3
    for name, reported, step in (
        ("wheelset temperature", "wheelset_c", 0.01),
        ("expansion of the wheelset", "wheelset_per_k", 1e-8),
    ):
        up, down = (
            comparator.absolute(
                28.05, 0, replace(conditions, **{reported: getattr(conditions, reported) + sign * step}),
                TOLERANCES, STANDING,
            ).value
            for sign in (1, -1)
        )  # fmt: skip
        (source,) = [s for s in found.sources if s.name == name]
        assert abs(source.sensitivity) == pytest.approx(abs(up - down) / (2 * step), rel=1e-3)
