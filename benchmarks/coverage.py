"""Coverage of calibrations: how often the joint 95 % region of intrinsics and pose holds the truth.

`python -m benchmarks.coverage [--rigs 1000] [--json]`. Each rig is another one: cameras, lenses, poses and corners are
drawn anew and projected here, by OpenCV alone. The rate must be consistent with 95 %: two-sided binomial, p > 0.001.
"""

from __future__ import annotations

import argparse
import json
import os
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

SIZE, CORNERS, SQUARE_MM = (640, 800), (7, 10), 9.0
SIGMA_PX, LEVEL = 0.05, 0.95


def trial(seed: int) -> dict[str, Any]:
    """One rig: squared Mahalanobis distance of the estimate from the truth, its degrees of freedom, and the model."""
    import cv2
    from scipy.spatial.transform import Rotation
    from scipy.stats import chi2

    from wheelset_assets.metrology import calibration as cal

    cv2.setNumThreads(1)
    random = np.random.default_rng([2026, seed])
    board = cal.board_points_mm(CORNERS, SQUARE_MM)
    matrices, lenses = [], []
    for _ in range(2):
        f = 1500 * (1 + random.uniform(-0.2, 0.2))
        aspect = 1 + random.uniform(-1e-3, 1e-3)
        c = np.array(SIZE) / 2 + random.uniform(-10, 10, 2)
        matrices.append(np.array([[f, 0, c[0]], [0, f * aspect, c[1]], [0, 0, 1.0]]))
        lenses.append(np.array([random.uniform(-0.15, 0.02), random.uniform(-0.2, 0.2),
                                *random.uniform(-1e-3, 1e-3, 2), random.uniform(-0.1, 0.1)]))  # fmt: skip
    depth = 265 * matrices[0][0, 0] / 1800
    toe = random.uniform(8, 20)
    rotation = Rotation.from_euler("xyz", [*random.uniform(-0.5, 0.5, 1), -toe, *random.uniform(-0.5, 0.5, 1)],
                                   degrees=True).as_matrix().T  # fmt: skip
    translation = -rotation @ np.array(
        [depth * np.tan(np.radians(toe)), *random.uniform(-2, 2, 1), random.uniform(-5, 8)]
    )
    poses = []
    for k in range(9):
        tilt = random.uniform(-30, 30, 2)
        turn = Rotation.from_euler("xyz", [*tilt, random.uniform(-8, 8)], degrees=True).as_matrix()
        place = np.array([*random.uniform(-12, 12, 2), depth * (1 + random.uniform(-0.08, 0.08))]) - turn @ board.mean(
            axis=0
        )
        views = []
        for (r, t), m, d in zip(((np.eye(3), np.zeros(3)), (rotation, translation)), matrices, lenses, strict=True):
            points = (board @ turn.T + place) @ r.T + t
            px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), m, d)[0].reshape(-1, 2)
            views.append(px + SIGMA_PX * random.standard_normal(px.shape))
        poses.append(cal.BoardPose(f"{k:03d}", views[0], views[1]))
    found = cal.calibrate_stereo(poses, board, SIZE, min_poses=5, min_tilt_deg=8.0, max_pose_rms_ratio=4.0).adjustment
    s = found.sensor
    estimate, truth = (_named(*values) for values in (
        ((s.left.matrix, s.right.matrix), (s.left.distortion, s.right.distortion), s.rotation, s.translation_mm),
        (matrices, lenses, rotation, translation)))  # fmt: skip
    error = np.array([estimate[name] - truth[name] for name in found.parameter_names])
    scale = np.sqrt(np.diag(found.covariance))
    distance = float((error / scale) @ np.linalg.solve(found.covariance / np.outer(scale, scale), error / scale))
    pose = slice(-6, None)
    own = float(error[pose] @ np.linalg.solve(found.covariance[pose, pose], error[pose]))
    return {
        "seed": seed,
        "model": found.model,
        "covered": bool(distance <= chi2.ppf(LEVEL, len(error))),
        "pose_covered": bool(own <= chi2.ppf(LEVEL, 6)),
        "mean_square": distance / len(error),
    }


def _named(matrices: Any, lenses: Any, rotation: Any, translation: Any) -> dict[str, float]:
    from scipy.spatial.transform import Rotation

    values: dict[str, float] = {}
    for side, m, lens in zip(("left", "right"), matrices, lenses, strict=True):
        values |= {f"{side}_f": m[0, 0], f"{side}_fx": m[0, 0], f"{side}_fy": m[1, 1]}
        values |= {f"{side}_cx": m[0, 2], f"{side}_cy": m[1, 2]}
        values |= {f"{side}_{k}": v for k, v in zip(("k1", "k2", "p1", "p2", "k3"), lens, strict=True)}
    vector = Rotation.from_matrix(rotation).as_rotvec()
    values |= dict(zip(("rx_rad", "ry_rad", "rz_rad"), vector, strict=True))
    return values | dict(zip(("tx_mm", "ty_mm", "tz_mm"), translation, strict=True))


def study(rigs: int, workers: int) -> dict[str, Any]:
    """Coverage over that many rigs, with the p-value against 95 %."""
    from scipy.stats import binomtest

    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            found = list(pool.map(trial, range(rigs), chunksize=8))
    else:
        found = [trial(seed) for seed in range(rigs)]
    document: dict[str, Any] = {"rigs": rigs, "level": LEVEL}
    for name in ("covered", "pose_covered"):
        count = sum(f[name] for f in found)
        document[name] = count / rigs
        document[f"{name}_p"] = float(binomtest(count, rigs, LEVEL).pvalue)
    models = [f["model"] for f in found]
    document["models"] = {model: models.count(model) for model in sorted(set(models))}
    document["mean_square"] = float(np.mean([f["mean_square"] for f in found]))
    return document


def main() -> None:
    """Print the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    options = parser.parse_args()
    found = study(options.rigs, options.workers)
    if options.json:
        print(json.dumps(found, indent=2))
        return
    print(f"{found['rigs']} rigs, corners with {SIGMA_PX} px noise")
    print(f"intrinsics and pose  {100 * found['covered']:.1f} % within the 95 % region (p = {found['covered_p']:.3f})")
    print(f"pose alone           {100 * found['pose_covered']:.1f} % (p = {found['pose_covered_p']:.3f})")
    print(f"mean squared pull    {found['mean_square']:.3f}")
    for model, count in found["models"].items():
        print(f"  {model}: {count}")


if __name__ == "__main__":
    main()
