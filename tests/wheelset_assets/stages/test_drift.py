"""The watch over a sensor's two cameras seeing the same instants, on rows of the statistics."""

from __future__ import annotations

import numpy as np
import pytest

from wheelset_assets.config import MeasurementConfig
from wheelset_assets.quality import Flag
from wheelset_assets.stages.drift import drift_flags


@pytest.mark.parametrize(
    ("frames", "late", "pull", "flagged"),
    [
        (1000, 0, 1.0, False),
        (1000, 20, 1.0, False),
        (1000, 21, 1.0, True),
        (1000, 0, 1.24, False),
        (1000, 0, 1.26, True),
        (32, 0, 1.55, False),  # the mean square of 32 frames varies by a quarter
        (32, 0, 1.65, True),
        (32, 0, None, False),
    ],
)
def test_frames_out_of_step_flag_their_station_and_no_other(product, world, frames, late, pull, flagged):
    statistics = product.tables.stripe_statistics
    name = world.ids[0]
    given = {
        "n_frames": frames,
        "n_frames_out_of_step": late,
        "frame_pull": pull,
        "frame_scatter_um": pull and 2 * pull,
    }
    uneven = {"frame_pull": 9.0, "frame_scatter_um": 0.49}
    rows = [row | (given if row["sensor_id"] == name else uneven) for row in statistics.to_pylist()]
    found = drift_flags(world.rig, statistics.from_pylist(rows, statistics.schema), None, MeasurementConfig())
    station = next(s.station for s in world.rig.sensors if s.sensor_id == name)
    marked = {s for s, flags in found.items() if flags & Flag.CAMERAS_OUT_OF_STEP}
    assert marked == ({station} if flagged else set())


def test_frames_of_a_good_scan_scatter_about_their_plane_by_their_noise(product):
    """Both rays' noise, its correlation along the rows and the lens are in the claim; six sensors of 48 frames, two-sided."""
    rows = product.tables.stripe_statistics.to_pylist()
    freedom = sum(row["n_frames"] - 1 for row in rows)
    square = np.mean([row["frame_pull"] ** 2 for row in rows])
    assert freedom > 200
    assert abs(square - 1.0) < 3.3 * np.sqrt(2.0 / freedom), square
