"""Triangulation of whole stripe tables, beside `cv2.triangulatePoints` in a loop over frames, in one run.

`python -m benchmarks.triangulation [--json]`: matching along epipolar lines, points, and the noise part of their
uncertainty for frames of 1,024 rows; the peer gets rectified partners for nothing and states no uncertainty.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

FRAMES, ROWS, BLOCK = 1000, 1024, 250


def main() -> None:
    """Print points a second of both."""
    import cv2

    from wheelset_assets.metrology import triangulation as tri

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1), help="threads")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    sensor = _sensor(tri)
    left, right = _stripes(sensor, tri)
    found = tri.rectify(sensor)

    def ours(part: slice) -> int:
        matched = tri.match_stripes(sensor, found, left[part], right[part], 4.0)
        points = tri.triangulate_disparity(found, matched)
        u = tri.depth_uncertainty(found, matched, 0.05 / 1800, 0.05 / 1800)
        return int((np.isfinite(points[..., 2]) & np.isfinite(u)).sum())

    matched = tri.match_stripes(sensor, found, left, right, 4.0)
    ideal = [tri.rotate_image(r.T, x, matched.y) for r, x in (
        (found.rectified_from_left, matched.x_left), (found.rectified_from_right, matched.x_right))]  # fmt: skip
    projections = np.eye(3, 4), np.column_stack([sensor.rotation, sensor.translation_mm])

    def peer(part: slice) -> int:
        count = 0
        for k in range(part.start, part.stop):
            rays = [np.stack([x[k], y[k]]) for x, y in ideal]
            good = np.isfinite(rays[0][0]) & np.isfinite(rays[1][0])
            p = cv2.triangulatePoints(*projections, rays[0][:, good], rays[1][:, good])
            count += (p[:3] / p[3]).shape[1]
        return count

    rates = {name: _rate(work, options.workers) for name, work in (("wheelset", ours), ("cv2.triangulatePoints", peer))}
    document = {"points_per_second": rates, "ratio": rates["wheelset"] / rates["cv2.triangulatePoints"],
                "frames": FRAMES, "rows": ROWS, "workers": options.workers}  # fmt: skip
    if options.json:
        print(json.dumps(document, indent=2))
        return
    for name, rate in rates.items():
        print(f"{name:<22} {rate / 1e6:6.2f} million points a second on {options.workers} threads")
    print(f"ratio                  {document['ratio']:6.2f}")


def _rate(work: Callable[[slice], int], workers: int) -> float:
    parts = [slice(k, k + BLOCK) for k in range(0, FRAMES, BLOCK)]
    best = 0.0
    with ThreadPoolExecutor(workers) as pool:
        for _ in range(3):
            start = time.perf_counter()
            count = sum(pool.map(work, parts))
            best = max(best, count / (time.perf_counter() - start))
    return best


def _sensor(tri):  # type: ignore[no-untyped-def]
    from scipy.spatial.transform import Rotation

    lens = np.array([-0.09, 0.08, 3e-4, -2e-4, -0.02])
    cameras = [tri.Camera(np.array([[1800.0, 0, c], [0, 1800.0, 510], [0, 0, 1]]), lens) for c in (255.0, 262.0)]
    rotation = Rotation.from_euler("xyz", [0.3, -17, 0.5], degrees=True).as_matrix().T
    return tri.StereoSensor(cameras[0], cameras[1], rotation, -rotation @ np.array([80.0, 1, 5]))


def _stripes(sensor, tri):  # type: ignore[no-untyped-def]
    """Stripes of a slowly waving surface in a laser plane, (frames, rows) in both images, by projection."""
    y = np.linspace(-78, 78, 4000)
    turn = np.linspace(0, 2 * np.pi, FRAMES, endpoint=False)[:, None]
    z = 265 + 9 * np.sin(y / 17) + 0.2 * np.cos(turn)
    points = np.stack([0.15 * (z - 265) + 40, np.broadcast_to(y, z.shape), z], axis=-1)
    images = []
    for camera, p in (
        (sensor.left, points),
        (sensor.right, points @ sensor.rotation.T + sensor.translation_mm),
    ):
        u, v = tri.distort(camera, p[..., 0] / p[..., 2], p[..., 1] / p[..., 2])
        images.append(np.stack([np.interp(np.arange(ROWS), a, b, np.nan, np.nan) for a, b in zip(v, u, strict=True)]))
    random = np.random.default_rng(1)
    return tuple(image + 0.05 * random.standard_normal(image.shape) for image in images)


if __name__ == "__main__":
    main()
