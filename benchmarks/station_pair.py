"""Features and registration of one wheel station, two sensors of a million points each, beside the same by others.

`python -m benchmarks.station_pair [--frames 1000 --rows 1024]`: simulates a scan, filters it with `max_rows` so high that
no row is thinned, then times stages 4 and 5 of the left wheel station; and ICP of the two unrolled clouds from the
nominal poses by Open3D (point to plane) and small_gicp (generalised), at one voxel size and one largest distance. Errors
are in the three directions that a stripe can tell, against the true poses.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import truth
from benchmarks.data import prepared

VOXEL_MM, REACH_MM = 1.0, 2.0
THREADS = 2


def pair(root: Path, frames: int, rows: int) -> dict[str, Any]:
    """Filtered clouds of the left wheel's two sensors, the rig, the scan's header, angles, true and nominal poses."""
    import pyarrow as pa
    import pyarrow.compute as pc

    from warehouse.inbox import Inbox, ScanReader, read_frames
    from wheelset_assets.bundle import ScanHeader
    from wheelset_assets.config import Config
    from wheelset_assets.stages import FILTERING, TRIANGULATION

    data = prepared(root, frames, rows, 12)
    inbox = Inbox(data.inbox)
    rig, _, _ = inbox.rigs[data.rig_id]
    assert rig is not None
    header = ScanHeader.model_validate_json((data.bundle / "scan.json").read_text())
    angle = read_frames(data.bundle).angle_deg
    reader = ScanReader(data.bundle, list(header.files), rig, len(angle))
    config = Config()
    tables = TRIANGULATION.run(
        stripes=reader.stripes(), calibrations=_calibrations(data), scan=header, config=config.triangulation
    )
    names = [s.sensor_id for s in rig.station_sensors("left_wheel")]
    cloud = tables["triangulated_clouds"]
    cloud = cloud.filter(pc.is_in(cloud["sensor_id"].cast(pa.string()), pa.array(names)))
    whole = config.filtering.model_copy(update={"max_rows": 100_000})
    filtered = FILTERING.run(triangulated_clouds=cloud, stripe_statistics=tables["stripe_statistics"], config=whole)[
        "filtered_clouds"
    ]
    truth_rig = data.truth_rig
    return {
        "cloud": filtered, "statistics": tables["stripe_statistics"], "rig": rig, "scan": header, "angle": angle,
        "names": names, "config": config,
        "true": truth.true_poses(truth_rig, data.scan_id), "nominal": truth.nominal_poses(truth_rig),
    }  # fmt: skip


def _calibrations(data: Any) -> Any:
    """Rows with the true cameras: the stage before is not what is timed here."""
    import pyarrow as pa

    rows = []
    for sensor in data.truth_rig["rig"]["sensors"]:
        row: dict[str, Any] = {"sensor_id": sensor["sensor_id"], "state": "usable", "reason": None}
        row |= {"rig_id": data.rig_id, "calibration_id": data.calibration_id}
        row["captured_at"] = datetime(2025, 4, 1, tzinfo=UTC)
        for side in ("left", "right"):
            camera = sensor[side]
            row[f"{side}_camera"] = [camera[k] for k in ("fx_px", "fy_px", "cx_px", "cy_px")]
            row[f"{side}_distortion"] = list(camera["distortion"])
        row["image_width_px"], row["image_height_px"] = sensor["left"]["image_size"]
        rows.append(row | {"right_from_left": np.array(sensor["right_from_left"]).ravel().tolist()})
    return pa.Table.from_pylist(rows)


def ours(made: dict[str, Any]) -> tuple[float, float, np.ndarray, int, float]:
    """Seconds of features and of registration, target_from_source, constrained directions, processor seconds of both."""
    from wheelset_assets.stages import FEATURES, REGISTRATION

    common = {"stripe_statistics": made["statistics"], "rig": made["rig"], "scan": made["scan"]}
    started, used = time.perf_counter(), time.process_time()
    features = FEATURES.run(filtered_clouds=made["cloud"], **common, config=made["config"].features)["features"]
    between = time.perf_counter()
    rows = REGISTRATION.run(
        filtered_clouds=made["cloud"], features=features, **common, config=made["config"].registration
    )["registrations"].to_pylist()
    ended, used = time.perf_counter(), time.process_time() - used
    row = next(r for r in rows if r["source_sensor_id"] != r["target_sensor_id"])
    pose = truth.pose([row[k] for k in ("qw", "qx", "qy", "qz")], [row[f"t{a}_mm"] for a in "xyz"])
    return between - started, ended - between, pose, row["n_constrained"], used


def unrolled(made: dict[str, Any], name: str) -> np.ndarray:
    """Points (n, 3) of a sensor in the rig's frame at its nominal pose, each frame turned back by its angle."""
    cloud = made["cloud"]
    member = np.array(cloud["sensor_id"].to_pylist(), object) == name
    points = np.column_stack([cloud[f"{a}_mm"].to_numpy()[member] for a in "xyz"]).astype(float)
    pose = made["nominal"][name]
    points = points @ pose[:3, :3].T + pose[:3, 3]
    a = -np.radians(made["angle"][cloud["frame"].to_numpy()[member]])
    y, z = points[:, 1].copy(), points[:, 2].copy()
    points[:, 1], points[:, 2] = np.cos(a) * y - np.sin(a) * z, np.sin(a) * y + np.cos(a) * z
    return points


def by_open3d(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Point-to-plane ICP of Open3D on thinned clouds, from where they are."""
    import open3d as o3d

    clouds = []
    for points in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(VOXEL_MM)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=3 * VOXEL_MM, max_nn=30))
        clouds.append(cloud)
    found = o3d.pipelines.registration.registration_icp(
        clouds[0], clouds[1], REACH_MM, np.eye(4), o3d.pipelines.registration.TransformationEstimationPointToPlane()
    )
    return np.array(found.transformation)


def by_small_gicp(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Generalised ICP of small_gicp on thinned clouds, from where they are."""
    import small_gicp

    found = small_gicp.align(
        target, source, downsampling_resolution=VOXEL_MM, max_correspondence_distance=REACH_MM, num_threads=THREADS
    )
    return np.array(found.T_target_source)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--rows", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--data", type=Path, help="where the simulated scan is kept between runs")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", str(THREADS))
    with tempfile.TemporaryDirectory(prefix="wheelset-pair-") as name:
        made = pair(options.data or Path(name), options.frames, options.rows)
    target, source = made["names"][:2]
    cloud = made["cloud"]
    member = np.array(cloud["sensor_id"].to_pylist(), object) == source
    at = np.array([cloud[f"{a}_mm"].to_numpy()[member].mean() for a in "xyz"])
    back = np.linalg.inv(made["nominal"][target])
    lines: list[dict[str, Any]] = []

    def judged(method: str, seconds: list[float], pose: np.ndarray, **more: Any) -> None:
        error = truth.registration_error(pose, source, target, at, made["true"])
        kept = {k: error[k] for k in ("lateral_um", "radial_um", "meridian_deg")}
        lines.append({"method": method, "seconds": sorted(seconds)[len(seconds) // 2]} | kept | more)

    runs = [ours(made) for _ in range(options.repeats)]
    middle = sorted(runs, key=lambda r: r[0] + r[1])[len(runs) // 2]
    judged(
        "wheelset: features, registration", [r[0] + r[1] for r in runs], runs[0][2],
        features_seconds=middle[0], registration_seconds=middle[1], n_constrained=runs[0][3],
        processor_seconds=min(r[4] for r in runs),
    )  # fmt: skip
    clouds = unrolled(made, source), unrolled(made, target)
    peers: list[tuple[str, Callable[..., np.ndarray]]] = [
        ("Open3D: ICP, point to plane", by_open3d),
        ("small_gicp: generalised ICP", by_small_gicp),
    ]
    for method, peer in peers:
        started = time.perf_counter()
        motion = peer(*clouds)
        judged(method, [time.perf_counter() - started], back @ motion @ made["nominal"][source])
    judged("nominal pose", [0.0], back @ made["nominal"][source])
    found = {"points": [len(c) for c in clouds], "voxel_mm": VOXEL_MM, "reach_mm": REACH_MM, "methods": lines}
    if options.json:
        print(json.dumps(found, indent=1))
        return 0
    print(f"{found['points'][0]:,} and {found['points'][1]:,} points; peers from the nominal poses, without features")
    print(f"{'':34} {'s':>7} {'lateral um':>11} {'radial um':>10} {'meridian deg':>13}")
    for line in lines:
        print(
            f"{line['method']:34} {line['seconds']:7.2f} {line['lateral_um']:11.1f} {line['radial_um']:10.1f} "
            f"{line['meridian_deg']:13.4f}"
        )
    print(
        f"wheelset's: {middle[0]:.2f} s features, {middle[1]:.2f} s registration, "
        f"{min(r[4] for r in runs):.2f} s of processor time, {runs[0][3]} directions constrained"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
