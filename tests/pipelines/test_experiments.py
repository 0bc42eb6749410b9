"""`wheelset experiment …`: each prints ours beside the paper's, and writes Parquet and a figure."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipelines.experiments import experiment_app, ways
from pipelines.experiments.ablation import summarised
from pipelines.experiments.output import simulated_profile
from wheelset_assets.config import RegistrationConfig
from wheelset_assets.quality import ConfigError


def call(*arguments):
    """Exit code and standard output."""
    result = CliRunner().invoke(experiment_app, [str(a) for a in arguments], standalone_mode=False)
    if result.exception:
        raise result.exception
    return result.return_value, result.stdout


@pytest.mark.parametrize("kind", ["png", "svg"])
def test_every_row_of_table_2_is_recovered_to_a_tenth_of_a_pixel(tmp_path, kind):
    code, text = call("translation", "--json", "--out", tmp_path, "--figure", kind)
    found = json.loads(text)
    assert code == 0
    assert len(found["rows"]) == 5
    for row in found["rows"]:
        assert row["error_um"] <= 100 / row["rho"]
        assert row["x_px"] == pytest.approx(row["shift_x_mm"] * row["rho"], abs=0.1)
    assert pq.read_table(tmp_path / "translation.parquet").num_rows == 5
    assert (tmp_path / f"translation.{kind}").stat().st_size > 2000


def test_rotations_are_recovered_over_both_of_the_papers_ranges(tmp_path):
    code, text = call("rotation", "--json", "--every", 4, "--out", tmp_path)
    found = json.loads(text)
    assert code == 0
    assert [s["n"] for s in found["summary"]] == [19, 23]
    for part in found["summary"]:
        assert -0.01 < part["min_deg"] < 0 < part["max_deg"] < 0.01
    assert pq.read_table(tmp_path / "rotation.parquet").num_rows == 42


def test_the_table_for_people_shows_the_papers_values(tmp_path):
    _, text = call("translation", "--out", tmp_path)
    assert "30, 50" in text
    assert "misprint" in text
    assert "5 of 5 rows" in text


def a_measured_scan(tiny):
    """Name of a production scan of the small campaign that no fault has struck."""
    names = sorted(p.name for p in (tiny.inbox / "scans").iterdir() if "ref" not in p.name)
    return next(name for name in names if name not in tiny.faults.values())


def test_depth_at_a_place_of_a_stored_scan_stands_beside_the_papers(tmp_path, tiny):
    scan = ("--scan", a_measured_scan(tiny), "--warehouse", tiny.warehouse)
    _, text = call("depth", *scan, "--at-mm", -20, "--json", "--out", tmp_path)
    found = json.loads(text)
    rows = {r["filter"]: r for r in found["rows"]}
    assert found["paper_range_mm"] == 0.03187
    assert rows["none"]["at_mm"] == pytest.approx(-20, abs=1.5)
    for row in rows.values():
        assert row["n"] <= 16
        assert row["range_mm"] * 1e3 > row["standard_deviation_um"] > 0
    _, shown = call("depth", *scan, "--out", tmp_path)
    assert "0.03187" in shown
    assert "71.6318" in shown


def test_smoothing_of_a_stored_scan_finds_the_noise_that_is_claimed(tmp_path, tiny):
    scan = ("--scan", a_measured_scan(tiny), "--warehouse", tiny.warehouse)
    _, text = call("smoothing", *scan, "--json", "--out", tmp_path)
    rows = {row["filter"]: row for row in json.loads(text)["rows"]}
    assert rows["none"]["noise_factor"] == rows["none"]["claimed_factor"] == 1
    for kind in (
        "mean",
        "gaussian",
        "quadratic",
    ):  # rows are a millimetre apart: what is left of the course over the turn adds a little
        assert rows[kind]["claimed_factor"] - 0.03 < rows[kind]["noise_factor"] < rows[kind]["claimed_factor"] + 0.1
        assert rows[kind]["points_lost"] == 0
    assert (tmp_path / "smoothing.png").stat().st_size > 10_000


def test_an_unknown_sensor_is_named_with_those_there_are(tmp_path, tiny):
    with pytest.raises(ConfigError, match="no sensor front; it has left_journal"):
        call(
            "depth",
            "--scan",
            a_measured_scan(tiny),
            "--warehouse",
            tiny.warehouse,
            "--sensor",
            "front",
            "--out",
            tmp_path,
        )


def test_an_ablation_is_summarised_by_way_and_quantity_against_the_default():
    def row(way, error_um, **given):
        return {"varied": "filter", "way": way, "quantity": "qr", "value": 7 + error_um * 1e-3, "truth": 7.0, "u": 0.002,
                "flags": []} | given  # fmt: skip

    errors = [row("quadratic", e) for e in (-2.0, 0.0, 2.0)] + [row("none", e) for e in (2.0, 4.0, 6.0)]
    errors += [row("none", 900.0, flags=["not_detected"]), row("none", 0.0, value=None), row("none", 1.0, truth=None)]
    default, other = summarised(errors)
    assert (default["bias_um"], default["spread_um"], default["p95_ratio"]) == pytest.approx((0.0, 2.0, 1.0))
    assert (other["n"], other["refused"]) == (3, 1)
    assert (other["bias_um"], other["spread_um"]) == pytest.approx((4.0, 2.0))
    assert other["p95_ratio"] == pytest.approx(5.8 / 2.0)
    assert other["median_expanded_um"] == pytest.approx(4.0)


def test_ways_in_the_plane_find_a_known_motion():
    """Two views of a nominal profile, one turned and shifted: each way but the nominal one brings it back."""
    curve = simulated_profile()[100:700]
    truth = ways._about(curve.mean(axis=0), 0.004, np.array([0.3, -0.2]))
    station = SimpleNamespace(curves={("a", 0): ways._moved(np.linalg.inv(truth), curve), ("b", 0): curve})
    config = RegistrationConfig()
    # Nearest points hold each other along the profile: sixty rounds of point to point leave a tenth of a millimetre.
    for way, limit_mm in ((ways._point_to_line, 0.002), (ways._point_to_point, 0.2), (ways._frequency, 0.05)):
        found = way(station, ("a", 0), ("b", 0), {}, config)
        left = ways._moved(found, station.curves["a", 0]) - curve
        assert np.abs(left).max() < limit_mm, way.__name__
    assert np.array_equal(ways._nominal(station), np.eye(3))
