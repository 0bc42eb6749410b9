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


def test_the_fit_across_the_surface_finds_a_known_motion_and_ignores_what_slides():
    random = np.random.default_rng(0)
    angle = np.linspace(0.2, 2.4, 60)
    a = 30 * np.column_stack([np.cos(angle), 0.6 * np.sin(angle)])
    b = bench._moved((0.01, np.array([0.2, -0.1])), a)
    normals = bench._normals(b, reach=1)
    along = np.column_stack([normals[:, 1], -normals[:, 0]])
    slid = b + 0.05 * random.normal(size=(60, 1)) * along
    for there in (b, slid):
        turn, shift = bench._fit_across(a, there, normals)
        assert np.allclose([turn, *shift], [0.01, 0.2, -0.1], atol=1e-9)
