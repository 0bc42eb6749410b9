"""Stripe centres: bias, scatter against the Cramér–Rao bound and claimed uncertainty over width and noise; throughput.

`python -m benchmarks.stripes [--json]`. Stripes are rendered here, by the integral of a Gaussian over each pixel.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

PEAK, GROUND = 180.0, 20.0
WIDTHS_PX = (1.0, 1.5, 2.0, 2.5, 3.0)
SNRS = (5, 10, 20, 50, 100)
FRAMES, ROWS, COLUMNS = 12, 600, 256


def render(centre: np.ndarray, sigma: float, noise: float, columns: int, seed: int) -> np.ndarray:
    """8-bit frames (frames, rows, columns) of stripes at centre (frames, rows)."""
    from scipy.special import erf

    edge = np.arange(columns + 1) - 0.5
    total = 0.5 * erf((edge - centre[..., None]) / (np.sqrt(2) * sigma))
    grey = GROUND + PEAK * sigma * np.sqrt(2 * np.pi) * np.diff(total, axis=-1)
    grey += noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def bound_px(sigma: float, noise: float) -> float:
    """Cramér–Rao bound of one row's centre: Fisher information of the rendered profile, summed over its pixels and
    averaged over the phase of a pixel; white noise, with 1/12 for rounding."""
    from scipy.special import erf

    x = np.arange(-40, 41)
    information = []
    for phase in np.linspace(0, 1, 16, endpoint=False):
        edges = np.concatenate([x - 0.5, [x[-1] + 0.5]]) - phase
        step = 1e-4
        profiles = [
            np.diff(0.5 * erf((edges - d) / (np.sqrt(2) * sigma))) * sigma * np.sqrt(2 * np.pi) for d in (-step, step)
        ]
        slope = PEAK * (profiles[1] - profiles[0]) / (2 * step)
        information.append((slope**2).sum())
    return float(np.sqrt((noise**2 + 1 / 12) / np.mean(information)))


def study() -> list[dict[str, Any]]:
    """One row for each method, width and signal-to-noise ratio (peak over grey noise)."""
    from wheelset_assets.metrology.stripes import METHODS, extract_centres

    rows = []
    for sigma in WIDTHS_PX:
        for snr in SNRS:
            noise = PEAK / snr
            phase = np.random.default_rng(7).uniform(0, 1, (FRAMES, 1))
            truth = 70 + 0.17 * np.arange(ROWS) + phase  # straight, so that a method may smooth along it
            frames = render(truth, sigma, noise, COLUMNS, seed=8)
            for method in METHODS:
                found = extract_centres(frames, method, 12.0)
                seen = np.isfinite(found.u_px)
                error = (found.u_px - truth)[seen]
                phases = np.floor(8 * (truth[seen] % 1)).astype(int)
                rows.append(
                    {
                        "method": method,
                        "width_px": sigma,
                        "snr": snr,
                        "found_ratio": float(seen.mean()),
                        "bias_px": float(error.mean()),
                        "largest_phase_bias_px": float(max(abs(error[phases == k].mean()) for k in range(8))),
                        "scatter_px": float(error.std()),
                        "bound_px": bound_px(sigma, noise),
                        "ratio_to_bound": float(error.std() / bound_px(sigma, noise)),
                        "pull": float((error / found.sigma_px[seen]).std()),
                    }
                )
    return rows


def throughput(workers: int, pairs: int = 64) -> dict[str, float]:
    """Image pairs a second (512 x 1024, decoded, in memory) of each method on that many threads."""
    import cv2

    from wheelset_assets.metrology.stripes import METHODS, extract_centres

    cv2.setNumThreads(1)
    centre = 150 + 120 * np.linspace(0, 1, 1024)[None] ** 2 + np.zeros((8, 1))
    one = np.concatenate([render(centre, 1.8, 2.0, 512, seed=k) for k in range(2)])
    blocks = [one] * (2 * pairs // len(one))
    found = {}
    for method in METHODS:
        best = np.inf
        with ThreadPoolExecutor(workers) as pool:
            for _ in range(3):
                start = time.perf_counter()
                list(pool.map(lambda block: extract_centres(block, method, 12.0), blocks))  # noqa: B023
                best = min(best, time.perf_counter() - start)
        found[method] = pairs / best
    return found


def main() -> None:
    """Print the study, and the throughput."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1), help="threads of the throughput")
    options = parser.parse_args()
    rows, speed = study(), throughput(options.workers)
    if options.json:
        print(json.dumps({"study": rows, "pairs_per_second": speed, "workers": options.workers}, indent=2))
        return
    print("method    width   SNR   bias px  by phase  scatter/bound  pull")
    for r in rows:
        print(
            f"{r['method']:<9} {r['width_px']:5.1f} {r['snr']:5d}  {r['bias_px']:+.4f}    {r['largest_phase_bias_px']:.4f}"
            f"          {r['ratio_to_bound']:5.2f}  {r['pull']:.2f}"
        )
    print("\nsteger smooths along the stripe, so that it may fall below the bound of one row.")
    for method, pairs in speed.items():
        print(f"{method:<9} {pairs:6.0f} image pairs of 512 x 1024 a second on {options.workers} threads")


if __name__ == "__main__":
    main()
