"""Accuracy of the registration of a station's sensors against their true poses, over many simulated rigs and scans.

`python -m benchmarks.registration_rig --scans 300`. Every scan has its own rig (poses off nominal by up to 2 mm and 1
degree), temperature, wheelset and noise; the cameras are the true ones, so that the registration alone is judged.

What is judged, the placement in the meridian: where does the registered station put the points that the source sensor
saw, against the points that the target saw? Each sensor's true pose says where on the true meridian (along the axle,
distance from the true axis of rotation) its points lie. The registered station's meridian, laid on the true one by the
target's own points (a motion in the plane: the station's squaring is another stage's work), must put the source's
points there. What is left is fitted with a lateral shift, a radial shift and a rotation, by what lies across the surface:
along it a meridian slides over itself. A difference of the two
*three-dimensional* relative poses would ask for more than a stripe can tell: a turn of the target about the radial
direction, up to 1 degree and unknown, acts on the millimetres between both laser planes. It is printed beside.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

Array = np.ndarray[Any, Any]


def one_scan(
    seed: int, *, rows: int = 512, frames: int = 60, preset: str = "bench", config: Any = None
) -> list[dict[str, Any]]:
    """Errors and claimed uncertainties of every pair of views of the left wheel station in one simulated scan."""
    from wheelset_assets import bundle
    from wheelset_assets.config import Config
    from wheelset_assets.simulation.noise import NoiseModel, add_noise
    from wheelset_assets.simulation.rig import build_rig
    from wheelset_assets.simulation.scan import perfect_stripes
    from wheelset_assets.simulation.schedule import Conditions
    from wheelset_assets.simulation.wheelset import draw_wheelset
    from wheelset_assets.stages import raw
    from wheelset_assets.stages.capture import run_triangulated_clouds
    from wheelset_assets.stages.cloud import run_filtered_clouds
    from wheelset_assets.stages.pose import run_features, run_registrations, standing

    config = config or Config()
    random = np.random.default_rng([seed, 99])
    true = build_rig(seed, preset, f"{preset}-1", rows)
    declared = true.declaration()
    rig = bundle.Rig.model_validate(declared)
    rig_c, wheelset_c = 22 + random.uniform(-4, 4), 22 + random.uniform(-4, 4)
    axis = tuple(2.5e-4 * random.uniform(-1, 1, 2))
    conditions = Conditions(
        rig_c, wheelset_c, rig_c, wheelset_c, random.uniform(-0.5, 0.5), axis, 0.0, random.uniform(0, 360)
    )
    wheelset = draw_wheelset(seed, 1, "W", ("S1002", "LMA")[seed % 2])
    angle = np.arange(frames) * 360.0 / frames
    noise = replace(NoiseModel(), gaps_per_frame=0.02)
    stripes, calibrations = {}, []
    for sensor in true.sensors:
        if not sensor.sensor_id.startswith("left_wheel"):
            continue
        lines = perfect_stripes(wheelset, true, sensor, conditions, angle + conditions.body_zero_deg)
        seen = [add_noise(line, noise, sensor.image_size[0], random) for line in lines]
        index = np.arange(frames, dtype=np.int32)
        stripes[sensor.sensor_id] = [raw.StripeTable(k, index, s.left_u, s.right_u) for k, s in enumerate(seen)]
        calibrations.append(_calibration(sensor, rig.rig_id))
    header = bundle.ScanHeader.model_validate(
        {
            "format": "wheelset-scan/1", "scan_id": f"s{seed}", "rig_id": rig.rig_id, "calibration_id": "c",
            "captured_at": "2025-04-05T09:00:00+08:00", "purpose": "production",
            "wheelset": {"wheelset_id": "W", "type": "CRH3"},
            "temperature_c": {"wheelset": wheelset_c, "rig": rig_c}, "files": {},
        }
    )  # fmt: skip
    triangulated = run_triangulated_clouds(
        stripes=raw.Stripes(tuple(stripes), lambda name: stripes[name]),
        calibrations=pa.Table.from_pylist(calibrations),
        scan=header,
        config=config.triangulation,
    )
    filtered = run_filtered_clouds(**triangulated, config=config.filtering)["filtered_clouds"]
    common: dict[str, Any] = {"stripe_statistics": triangulated["stripe_statistics"], "rig": rig, "scan": header}
    features = run_features(filtered_clouds=filtered, **common, config=config.features)["features"]
    made = run_registrations(filtered_clouds=filtered, features=features, **common, config=config.registration)
    overlap = made["fused_profiles"].to_pylist()
    before = {name: pose for (name, line), pose in standing(rig, rig_c, common["stripe_statistics"]).poses.items()}
    found = []
    for row in made["registrations"].to_pylist():
        if row["method"] == "single":
            continue
        found.append({"seed": seed, "row": row} | _errors(row, true, rig_c, before, filtered, overlap))
    return found


def _calibration(sensor: Any, rig_id: str) -> dict[str, Any]:
    """What the triangulation needs of a calibration: the true cameras."""
    row: dict[str, Any] = {"sensor_id": sensor.sensor_id, "state": "usable", "reason": None, "rig_id": rig_id}
    row |= {"calibration_id": "c", "captured_at": datetime(2025, 4, 1, tzinfo=UTC)}
    row |= {"image_width_px": sensor.image_size[0], "image_height_px": sensor.image_size[1]}
    for side, camera in (("left", sensor.left), ("right", sensor.right)):
        row[f"{side}_camera"] = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
        row[f"{side}_distortion"] = list(camera.distortion)
    return row | {"right_from_left": sensor.right_from_left.ravel().tolist()}


def _points(cloud: pa.Table, sensor: str, line: int, rows: set[int]) -> Array:
    """Mean points (n, 3) of the given image rows, sensor frame."""
    of_view = pc.and_(pc.equal(cloud["sensor_id"], sensor), pc.equal(cloud["line"], line))
    view = cloud.select(["row", "x_mm", "y_mm", "z_mm"]).filter(of_view)
    wanted = np.zeros(max(rows) + 1, bool)
    wanted[list(rows)] = True
    row = view["row"].to_numpy()
    member = np.flatnonzero((row < wanted.size) & wanted[np.minimum(row, wanted.size - 1)])
    total = [np.bincount(row[member], view[f"{a}_mm"].to_numpy()[member].astype(float)) for a in "xyz"]
    count = np.bincount(row[member])
    return np.stack([t[count > 0] / count[count > 0] for t in total], axis=1)


def _errors(
    row: dict[str, Any],
    true: Any,
    rig_c: float,
    before: dict[str, Array],
    cloud: pa.Table,
    overlap: list[dict[str, Any]],
) -> dict[str, Any]:
    from benchmarks.truth import pose

    source, target = row["source_sensor_id"], row["target_sensor_id"]
    actual = {name: true.sensor(name).rig_from_sensor_at(rig_c, true.expansion_per_k) for name in (source, target)}
    relative = pose([row[k] for k in ("qw", "qx", "qy", "qz")], [row[k] for k in ("tx_mm", "ty_mm", "tz_mm")])
    seen = {}
    for name, line in ((source, row["source_line"]), (target, row["target_line"])):
        rows = {
            p["row"] for p in overlap if (p["sensor_id"], p["line"]) == (name, line) and p["residual_um"] is not None
        }
        seen[name, line] = _points(cloud, name, line, rows)
    p_source, p_target = seen[source, row["source_line"]], seen[target, row["target_line"]]
    target_truth, truth = _meridian(actual[target], p_target), _meridian(actual[source], p_source)
    station = _fit_across(_meridian(before[target], p_target), target_truth, _normals(target_truth))
    placed = _moved(station, _meridian(before[target] @ relative, p_source))
    about = truth.mean(axis=0)
    turn, shift = _fit_across(truth - about, placed - about, _normals(truth))
    off = np.linalg.inv(actual[target]) @ actual[source]
    apart = actual[target][:3, :3] @ (
        (relative[:3, :3] - off[:3, :3]) @ p_source.mean(axis=0) + relative[:3, 3] - off[:3, 3]
    )
    outward = (actual[source] @ np.append(p_source.mean(axis=0), 1))[1:3]
    unregistered = _moved(station, _meridian(before[source], p_source)) - truth
    return {
        "lateral_um": 1e3 * float(shift[0]),
        "radial_um": 1e3 * float(shift[1]),
        "meridian_deg": float(np.degrees(turn)),
        "lateral_3d_um": 1e3 * float(apart[0]),
        "radial_3d_um": 1e3 * float(apart[1:] @ outward / np.linalg.norm(outward)),
        "nominal_off_um": 1e3 * float(np.abs(unregistered).max()),
    }


def _meridian(rig_from_sensor: Array, points: Array) -> Array:
    p = points @ rig_from_sensor[:3, :3].T + rig_from_sensor[:3, 3]
    return np.column_stack([p[:, 0], np.hypot(p[:, 1], p[:, 2])])


def _normals(meridian: Array, reach: int = 6) -> Array:
    """Unit normals (n, 2) of a meridian (n, 2) in the order of its rows, over a few neighbours."""
    at = np.arange(len(meridian))
    along = meridian[np.minimum(at + reach, at[-1])] - meridian[np.maximum(at - reach, 0)]
    along /= np.linalg.norm(along, axis=1)[:, None]
    return np.column_stack([-along[:, 1], along[:, 0]])


def _fit_across(a: Array, b: Array, normals: Array) -> tuple[float, Array]:
    """Rotation (rad) about the origin and shift that bring a (n, 2) onto b, by the distances along the normals (n, 2) alone.

    Along the surface a meridian slides over itself, which no stripe can tell; only what is across it counts.
    """
    motion: tuple[float, Array] = (0.0, np.zeros(2))
    for _ in range(5):
        moved = _moved(motion, a)
        away = np.einsum("nk,nk->n", normals, b - moved)
        turned = normals[:, 1] * moved[:, 0] - normals[:, 0] * moved[:, 1]
        step = np.linalg.lstsq(np.column_stack([turned, normals]), away, rcond=None)[0]
        shift = _moved((step[0], np.zeros(2)), motion[1][None])[0] + step[1:]
        motion = (motion[0] + float(step[0]), shift)
    return motion


def _moved(motion: tuple[float, Array], points: Array) -> Array:
    c, s = np.cos(motion[0]), np.sin(motion[0])
    return points @ np.array([[c, s], [-s, c]]) + motion[1]


DIRECTIONS = (("lateral_um", "u_lateral_um"), ("radial_um", "u_radial_um"), ("meridian_deg", "u_meridian_deg"))
LIMITS = {"lateral_um": 2.0, "radial_um": 2.0, "meridian_deg": 0.002}


def summarise(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """By direction: share within the limit, percentiles, bias, and the root mean square pull."""
    lines = []
    for error, claimed in DIRECTIONS:
        e = np.array([f[error] for f in found])
        u = np.array([f["row"][claimed] for f in found])
        lines.append(
            {
                "direction": error,
                "n": len(e),
                "limit": LIMITS[error],
                "share_within": float((np.abs(e) <= LIMITS[error]).mean()),
                "p95": float(np.percentile(np.abs(e), 95)),
                "rms": float(np.sqrt((e**2).mean())),
                "bias": float(e.mean()),
                "median_u": float(np.median(u)),
                "rms_pull": float(np.sqrt(((e / u) ** 2).mean())),
            }
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--frames", type=int, default=120, help="images a turn: the noise falls with their root")
    parser.add_argument("--rows", type=int, default=1024)
    parser.add_argument("--preset", default="bench")
    parser.add_argument("--seed", type=int, default=0, help="of the first rig; the others follow")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    trial = partial(one_scan, rows=options.rows, frames=options.frames, preset=options.preset)
    found, failed = [], 0
    # A worker that ends early would hang a plain pool; this one says so.
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        seeds = range(options.seed, options.seed + options.scans)
        for done, pairs in enumerate(pool.map(trial, seeds), start=1):
            registered = [one for one in pairs if one["row"]["method"] == "icp"]
            found += registered
            failed += len(pairs) - len(registered)
            if done % 20 == 0:
                print(f"{done} scans", file=sys.stderr)
    lines = summarise(found)
    constrained = np.bincount([f["row"]["n_constrained"] for f in found], minlength=7).tolist()
    document = {
        "scans": options.scans,
        "pairs": len(found),
        "not_registered": failed,
        "n_constrained": constrained,
        "directions": lines,
    }
    document["lateral_3d_p95_um"] = float(np.percentile(np.abs([f["lateral_3d_um"] for f in found]), 95))
    document["radial_3d_p95_um"] = float(np.percentile(np.abs([f["radial_3d_um"] for f in found]), 95))
    if options.json:
        document["each"] = [
            {"seed": f["seed"]} | {error: f[error] for error, _ in DIRECTIONS} | {u: f["row"][u] for _, u in DIRECTIONS}
            for f in found
        ]
        print(json.dumps(document, indent=2))
        return
    print(
        f"{len(found)} pairs of {options.scans} scans, {failed} not registered; pairs by n_constrained: {constrained}"
    )
    for line in lines:
        print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in line.items()))
    print(
        f"3-D relative pose, 95 %: lateral {document['lateral_3d_p95_um']:.1f} um, radial {document['radial_3d_p95_um']:.1f} um"
    )


if __name__ == "__main__":
    main()
