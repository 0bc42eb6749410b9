"""Steps of the peer: stripes to points by OpenCV, clouds to pose and diameter by Open3D, as their tutorials show it.

Each step takes what it needs of the job and of `state` and returns what it adds to the state: plain arrays, so that a
driver can stop one step and go on with the next. Nothing of wheelset's own is used.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

PARAMETERS: dict[str, Any] = {
    "outlier_neighbours": 20,
    "outlier_std_ratio": 2.0,
    "voxel_mm": 1.0,
    "normal_radius_mm": 2.0,
    "normal_max_neighbours": 30,
    "iss": "Open3D's defaults",
    "fpfh_radius_mm": 5.0,
    "fpfh_max_neighbours": 100,
    "ransac_distance_mm": 1.5,
    "ransac_iterations": 100_000,
    "ransac_confidence": 0.999,
    "icp_distance_mm": 0.4,
    "icp_from_nominal_distances_mm": (10.0, 1.0),
    "plane_distance_mm": 0.2,
    "plane_iterations": 1000,
    "circle_mm": 70.0,
    "circle_half_width_mm": 1.0,
}
P = PARAMETERS
State = dict[str, Any]


def cloud_of(points: np.ndarray, normals: np.ndarray | None = None) -> Any:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud


# --- OpenCV: stripes to points ------------------------------------------------------------------------------------


def triangulated(bundle: Path, camera: dict[str, Any], sensor: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) in the left camera's frame and the frame number of each, frame by frame."""
    import cv2

    k1, k2 = (np.array(camera[side]["matrix"], float) for side in ("left", "right"))
    d1, d2 = (np.array(camera[side]["distortion"], float) for side in ("left", "right"))
    rotation, translation = np.array(camera["rotation"]), np.array(camera["translation_mm"]).reshape(3, 1)
    r1, r2, p1, p2 = cv2.stereoRectify(k1, d1, k2, d2, camera["size"], rotation, translation)[:4]
    table = pq.read_table(bundle / "stripes" / f"{sensor}.parquet")
    height = camera["size"][1]
    rows = np.arange(height, dtype=float)
    left, right = (
        np.asarray(table[name].combine_chunks().flatten()).reshape(-1, height) for name in ("left_u", "right_u")
    )
    points, frames = [], []
    for frame, u_left, u_right in zip(table["frame"].to_pylist(), left, right, strict=True):
        a, b = (np.column_stack([u, rows])[(u >= 0) & (u < camera["size"][0])] for u in (u_left, u_right))
        if len(a) < 2 or len(b) < 2:
            continue
        a = cv2.undistortPoints(a.reshape(-1, 1, 2), k1, d1, R=r1, P=p1).reshape(-1, 2)
        b = cv2.undistortPoints(b.reshape(-1, 1, 2), k2, d2, R=r2, P=p2).reshape(-1, 2)
        b = b[np.argsort(b[:, 1])]
        partner = np.interp(a[:, 1], b[:, 1], b[:, 0], left=np.nan, right=np.nan)
        above = np.clip(np.searchsorted(b[:, 1], a[:, 1]), 1, len(b) - 1)
        good = np.isfinite(partner) & (b[above, 1] - b[above - 1, 1] < 3.0)  # nothing across a gap
        if good.any():
            a = a[good]
            found = cv2.triangulatePoints(p1, p2, a.T, np.vstack([partner[good], a[:, 1]]))
            points.append((found[:3] / found[3]).T @ r1)
            frames.append(np.full(len(a), frame))
    return np.concatenate(points), np.concatenate(frames)


def unrolled(bundle: Path, points: np.ndarray, frames: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Sensor points in the turning wheelset's frame: by the nominal pose, then back by the encoder's angle."""
    angle = np.radians(pq.read_table(bundle / "frames.parquet")["angle_deg"].to_numpy())[frames]
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([x, c * y + s * z, c * z - s * y])


def triangulate(job: Any, state: State) -> State:
    made = {name: triangulated(job.bundle, job.cameras[name], name) for name in job.cameras}
    clouds = {name: unrolled(job.bundle, *made[name], job.poses[name]) for name in job.wheel_sensors}
    return {"clouds": clouds, "n_points": sum(len(points) for points, _ in made.values())}


# --- Open3D: clouds to pose and measures --------------------------------------------------------------------------


def cleaned(points: np.ndarray) -> np.ndarray:
    kept = cloud_of(points).remove_statistical_outlier(P["outlier_neighbours"], P["outlier_std_ratio"])[0]
    return np.asarray(kept.points)


def outliers(job: Any, state: State) -> State:
    return {"clean": {name: cleaned(points) for name, points in state["clouds"].items()}}


def downsample(job: Any, state: State) -> State:
    thin = {
        name: np.asarray(cloud_of(points).voxel_down_sample(P["voxel_mm"]).points)
        for name, points in state["clean"].items()
    }
    return {"thin": thin}


def normals(job: Any, state: State) -> State:
    import open3d as o3d

    made = {}
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=P["normal_radius_mm"], max_nn=P["normal_max_neighbours"])
    for name, points in state["thin"].items():
        cloud = cloud_of(points)
        cloud.estimate_normals(search)
        normal = np.asarray(cloud.normals).copy()
        # Towards the sensor, which stands above every point of the turn at the same azimuth about the axle.
        place = job.poses[name][:3, 3]
        outward = points[:, 1:] / np.linalg.norm(points[:, 1:], axis=1, keepdims=True)
        view = np.column_stack([np.full(len(points), place[0]), outward * np.hypot(place[1], place[2])]) - points
        normal[(view * normal).sum(axis=1) < 0] *= -1
        made[name] = normal
    return {"normals": made}


def keypoints(job: Any, state: State) -> State:
    import open3d as o3d

    found = {
        name: np.asarray(o3d.geometry.keypoint.compute_iss_keypoints(cloud_of(p)).points)
        for name, p in state["thin"].items()
    }
    return {"keypoints": found}


def descriptors(job: Any, state: State) -> State:
    import open3d as o3d

    search = o3d.geometry.KDTreeSearchParamHybrid(radius=P["fpfh_radius_mm"], max_nn=P["fpfh_max_neighbours"])
    made = {}
    for name, points in state["thin"].items():
        cloud = cloud_of(points, state["normals"][name])
        every = o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data
        tree = o3d.geometry.KDTreeFlann(cloud)
        index = [tree.search_knn_vector_3d(point, 1)[1][0] for point in state["keypoints"][name]]
        made[name] = np.asarray(every)[:, index]
    return {"fpfh": made}


def ransac(job: Any, state: State) -> State:
    import open3d as o3d

    o3d.utility.random.seed(0)
    reg, poses = o3d.pipelines.registration, {}
    for side, (source, target) in job.pairs.items():
        clouds = [cloud_of(state["keypoints"][name]) for name in (source, target)]
        features = []
        for name in (source, target):
            feature = reg.Feature()
            feature.data = state["fpfh"][name]
            features.append(feature)
        checks = [
            reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            reg.CorrespondenceCheckerBasedOnDistance(P["ransac_distance_mm"]),
        ]
        by = reg.TransformationEstimationPointToPoint(False)
        stop = reg.RANSACConvergenceCriteria(P["ransac_iterations"], P["ransac_confidence"])
        found = reg.registration_ransac_based_on_feature_matching(
            *clouds, *features, True, P["ransac_distance_mm"], by, 3, checks, stop
        )
        poses[side] = found.transformation
    return {"ransac": poses}


def refined(job: Any, state: State, start: dict[str, np.ndarray], distance_mm: float) -> dict[str, np.ndarray]:
    import open3d as o3d

    reg, poses = o3d.pipelines.registration, {}
    for side, (source, target) in job.pairs.items():
        clouds = [cloud_of(state["thin"][name], state["normals"][name]) for name in (source, target)]
        plane = reg.TransformationEstimationPointToPlane()
        poses[side] = reg.registration_icp(*clouds, distance_mm, start[side], plane).transformation
    return poses


def icp(job: Any, state: State) -> State:
    return {"icp": refined(job, state, state["ransac"], P["icp_distance_mm"])}


def icp_from_nominal(job: Any, state: State) -> State:
    motion = {side: np.eye(4) for side in job.pairs}
    for distance_mm in P["icp_from_nominal_distances_mm"]:  # wide enough for the tolerances first, then fine
        motion = refined(job, state, motion, distance_mm)
    return {"icp_from_nominal": motion}


def inner_face(target: np.ndarray) -> float:
    """Where the inner face's plane cuts the axle: the plane with most points among the inboard-most of the cloud."""
    inboard = np.percentile(np.abs(target[:, 0]), 2.0)
    face = cloud_of(target[np.abs(np.abs(target[:, 0]) - inboard) < 2.0])
    coefficients, _ = face.segment_plane(P["plane_distance_mm"], 3, P["plane_iterations"])  # of a x + b y + c z + d = 0
    return float(-coefficients[3] / coefficients[0])


def plane(job: Any, state: State) -> State:
    import open3d as o3d

    o3d.utility.random.seed(0)
    return {"face_mm": {side: inner_face(state["clean"][target]) for side, (_, target) in job.pairs.items()}}


def diameter(source: np.ndarray, target: np.ndarray, motion: np.ndarray, face_mm: float) -> float | None:
    """Twice the mean distance from the axle of the points near 70 mm from the inner face; None if there are none."""
    merged = np.vstack([target, source @ motion[:3, :3].T + motion[:3, 3]])
    near = np.abs(np.abs(merged[:, 0]) - abs(face_mm) - P["circle_mm"]) < P["circle_half_width_mm"]
    return float(2 * np.hypot(merged[near, 1], merged[near, 2]).mean()) if near.any() else None


def radius(job: Any, state: State) -> State:
    made = {}
    for method in ("icp", "icp_from_nominal"):
        for side, (source, target) in job.pairs.items() if method in state else ():
            args = state["clean"][source], state["clean"][target], state[method][side], state["face_mm"][side]
            made[f"{method} {side}"] = diameter(*args)
    return {"diameters_mm": made}


def master(job: Any, state: State) -> State:
    """The same over the reference scan of the certified master, which takes the poses' constant errors out."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    header = json.loads((job.reference / "scan.json").read_text(encoding="utf-8"))
    certified = {c["side"]: c["value_mm"] for c in header["certificate"] if c["quantity"] == "wheel_diameter"}
    clouds = {}
    for name in job.wheel_sensors:
        made = triangulated(job.reference, job.cameras[name], name)
        clouds[name] = cleaned(unrolled(job.reference, *made, job.poses[name]))
    zeroed = {}
    for key, value in state["diameters_mm"].items():
        method, side = key.split()
        source, target = job.pairs[side]
        face = inner_face(clouds[target])
        reference = diameter(clouds[source], clouds[target], state[method][side], face)
        zeroed[key] = certified[side] + value - reference if value and reference else None
    return {"zeroed_mm": zeroed}


STEPS = (
    triangulate,
    outliers,
    downsample,
    normals,
    keypoints,
    descriptors,
    ransac,
    icp,
    icp_from_nominal,
    plane,
    radius,
    master,
)
