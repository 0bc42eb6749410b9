"""Fifty of the rigs of `python -m benchmarks.coverage`, which takes a thousand."""

from __future__ import annotations

from benchmarks.coverage import study


def test_the_joint_region_covers_the_truth_as_often_as_it_says():
    found = study(50, workers=1)
    assert found["covered_p"] > 0.001, found
    assert found["pose_covered_p"] > 0.001, found
    assert 0.8 < found["mean_square"] < 1.2
