"""Drift watch on simulated rigs: false alarms on sensors that stand still, and alarms on those that do not.

`python -m benchmarks.drift --scans 240`. Rigs have calibrations of their own, made from noisy corners; scans have their
own wheelset (up to 20 mm from the master's diameter), temperatures, place, turn, gaps and outliers. Then, in scans of
their own, the right camera of each sensor is turned about one of its axes by `CAMERA_DEG`, or its laser about one of the
sensor's axes through the emitter by `LASER_DEG`, after the reference scan. Only stage 2 and the watch itself run.
"""

from __future__ import annotations

import argparse
import json
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

CAMERA_DEG, LASER_DEG = 0.02, 0.1
CHANGES = tuple(f"{what} about {axis}" for what in ("camera", "laser") for axis in "xyz")


def rig_trial(
    number: int,
    *,
    scans: int,
    presets: tuple[str, ...] = ("bench", "compact", "wide"),
    rows: int = 512,
    frames: int = 60,
) -> list[dict[str, Any]]:
    """Flags of each station over `scans` untouched scans of one rig, and over one scan for each of CHANGES."""
    from pipelines.experiments.virtual import SERIES, World
    from wheelset_assets.simulation.wheelset import draw_wheelset
    from wheelset_assets.stages.drift import drift_flags

    profile = ("S1002", "LMA")[number % 2]
    preset = presets[number % len(presets)]
    world = World(SERIES["realistic"], 90_000 + 1000 * number, rows, frames, profile, preset)
    rng = np.random.default_rng([number, 77])
    found = []
    for index, change in enumerate((*["none"] * scans, *CHANGES)):
        wheelset = draw_wheelset(number + 7, index, "W", profile)
        size = float(rng.uniform(-19.0, 19.0))
        one, two = (replace(wheel, diameter_mm=wheel.diameter_mm + size) for wheel in wheelset.wheels)
        rig = replace(world.true, sensors=tuple(changed(sensor, change) for sensor in world.true.sensors))
        seen = world.see(
            replace(wheelset, wheels=(one, two)),
            rng,
            gap_deg=40.0 if index % 5 == 1 else 0.0,
            outliers=index % 5 == 2,
            rig=rig,
        )
        then = world.master.tables["stripe_statistics"]
        flags = drift_flags(world.rig, seen.tables["stripe_statistics"], then, world.config.measurement)
        found += [
            {
                "preset": preset,
                "change": change,
                "station": s.station,
                "flags": flags[s.station].names() if s.station in flags else [],
            }
            for s in world.rig.stations
        ]
    return found


def changed(sensor: Any, change: str) -> Any:
    """A simulated sensor whose right camera, or whose lasers, turned as CHANGES names it."""
    from wheelset_assets.metrology.rigid import rotation_from_vector, transform

    if change == "none":
        return sensor
    what, axis = change.split(" about ")
    degrees = CAMERA_DEG if what == "camera" else LASER_DEG
    turn = rotation_from_vector(np.radians(degrees) * np.eye(3)["xyz".index(axis)])
    if what == "camera":
        return replace(sensor, right_from_left=transform(turn, np.zeros(3)) @ sensor.right_from_left)
    planes = []
    for plane in sensor.planes:
        normal, emitter = np.array(plane.normal), np.array(plane.emitter_mm)
        turned = turn @ normal
        planes.append(
            replace(plane, normal=tuple(turned), offset_mm=float(plane.offset_mm + (turned - normal) @ emitter))
        )
    return replace(sensor, planes=tuple(planes))


def study(rigs: int, scans_a_rig: int, workers: int, **size: Any) -> dict[str, Any]:
    """Untouched scans with a flag of the watch, and stations that were flagged, by change."""
    trial = partial(rig_trial, scans=scans_a_rig, **size)
    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            found = [row for rows in pool.map(trial, range(rigs)) for row in rows]
    else:
        found = [row for number in range(rigs) for row in trial(number)]
    stations = {change: [r for r in found if r["change"] == change] for change in ("none", *CHANGES)}
    return {
        "untouched_scans": rigs * scans_a_rig,
        "untouched_stations": len(stations["none"]),
        "false_alarms": [r for r in stations["none"] if r["flags"]],
        "changes": {
            change: {
                "stations": len(stations[change]),
                "flagged": sum(bool(r["flags"]) for r in stations[change]),
                **{f: sum(f in r["flags"] for r in stations[change]) for f in ("cameras_moved", "laser_plane_moved")},
                "missed": [f"{r['preset']} {r['station']}" for r in stations[change] if not r["flags"]],
            }
            for change in CHANGES
        },
    }


def main() -> None:
    """Print the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=240, help="untouched scans in all")
    parser.add_argument("--scans-a-rig", type=int, default=8)
    parser.add_argument("--rows", type=int, default=512)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    options = parser.parse_args()
    rigs = -(-options.scans // options.scans_a_rig)
    found = study(rigs, options.scans_a_rig, options.workers, rows=options.rows, frames=options.frames)
    if options.json:
        print(json.dumps(found, indent=2))
        return
    print(f"{found['untouched_scans']} untouched scans on {rigs} rigs: {len(found['false_alarms'])} stations flagged")
    for row in found["false_alarms"]:
        print(f"  {row['preset']} {row['station']}: {', '.join(row['flags'])}")
    print(f"turned after the reference scan, cameras by {CAMERA_DEG} degrees, lasers by {LASER_DEG}:")
    for change, row in found["changes"].items():
        print(
            f"  {change}: {row['flagged']} of {row['stations']} stations flagged"
            f" (cameras_moved {row['cameras_moved']}, laser_plane_moved {row['laser_plane_moved']})"
            + (f"; missed {', '.join(row['missed'])}" if row["missed"] else "")
        )


if __name__ == "__main__":
    main()
