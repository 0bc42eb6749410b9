"""The accuracy of the rig's registration against true poses, on a few scans; `benchmarks.registration_rig` does 300."""

from __future__ import annotations

import numpy as np

from benchmarks import registration_rig as bench


def test_sixteen_rigs_are_registered_within_what_is_claimed_and_not_suspiciously_below():
    found = [f for seed in range(16) for f in bench.one_scan(seed, rows=256, frames=32)]
    assert len(found) == 16
    assert all(f["row"]["method"] == "icp" and f["row"]["n_constrained"] == 3 for f in found)
    # The nominal poses alone are off by tenths of a millimetre and more.
    assert np.median([f["nominal_off_um"] for f in found]) > 200
    for line in bench.summarise(found):
        # Root mean square of 16 pulls: 1 +- 0.18; what the silent directions leave comes on top.
        assert 0.5 < line["rms_pull"] < 1.8, line
        assert abs(line["bias"]) < 4 * line["rms"] / 4


def test_the_planar_fit_finds_a_known_motion():
    random = np.random.default_rng(0)
    a = random.normal(size=(20, 2)) * 30
    b = bench._moved((0.01, np.array([0.2, -0.1])), a)
    turn, shift = bench._planar_fit(a, b)
    assert np.allclose([turn, *shift], [0.01, 0.2, -0.1])
    about = a.mean(axis=0)
    _, there = bench._planar_fit(a, b, about=about)
    assert np.allclose(there, b.mean(axis=0) - about)
