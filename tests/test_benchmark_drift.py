"""The drift watch on a few rigs; `python -m benchmarks.drift` takes 240 untouched scans."""

from __future__ import annotations

from benchmarks.drift import CHANGES, study


def test_sensors_that_stand_still_are_not_flagged_and_those_that_turned_are():
    found = study(3, 2, workers=1, rows=512, frames=40)
    assert found["untouched_stations"] == 24
    assert found["false_alarms"] == []
    for change in CHANGES:
        assert found["changes"][change]["missed"] == [], change
    # A camera about its rows shows in the epipolar residual, a laser never does.
    assert found["changes"]["camera about x"]["cameras_moved"] == 12
    for axis in "xyz":
        assert found["changes"][f"laser about {axis}"]["cameras_moved"] == 0
