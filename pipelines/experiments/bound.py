"""Cramér–Rao bounds of the draws of the accuracy experiment: the least spread that the given noise allows.

An unbiased estimator that knew the noise could spread no less about the truth than this: the Fisher information of the
stripe centres about each quantity at the true poses, the form of the profile near it being unknown (a polynomial), with
the scatter of the axis of rotation and of the thermometers, which no stripe tells. A quantity that the master does not
zero rests on cameras and poses besides: the boards' corners leave the calibration's covariance open, the nominal poses
the sensing plane, the stripes in the overlap of two sensors their registration. How the quantity follows these is taken
from its budget, and of the registration that alone: what it leaves at least comes from the stripes' noise. Simulated
truth and true poses are used here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheelset_assets.metrology.revolution import MeanMeridian, mean_meridian
from wheelset_assets.simulation.noise import NoiseModel
from wheelset_assets.simulation.rig import Rig
from wheelset_assets.simulation.wheelset import Wheelset
from wheelset_assets.stages.pose import station_grids

Array = NDArray[Any]
CALIBRATION, SENSING, REGISTRATION = (
    "calibration of the sensors",
    "sensing plane beside the axle",
    "registration of the sensors",
)
TOGETHER_MM, TANGENT_ROWS = 0.3, 6
"""Rows of two sensors this near to each other are seen by both; a row's tangent is that over so many to either side."""
TREAD_HALF_WIDTH_MM, TREAD_DEGREE = 10.0, 4
TIP_HALF_WIDTH_MM, TIP_DEGREE = 4.0, 4
FLANK_HALF_WIDTH_MM, FLANK_DEGREE = 1.5, 2
STRAIGHT_HALF_WIDTH_MM = 200.0
TIP_MM = 15.0
"""About where, from the inner face, the flange is highest: its height there is known to first order of the offset."""
FACE_BAND_MM = 0.6
"""Points this near to a flat face's true plane are on it: a calibration's error moves them by some tenths."""


@dataclass(frozen=True)
class _Rows:
    """Mean meridian rows of one sensor in the true frame: place, and what one frame's centre noise makes of it, in mm.

    towards: unit direction (lateral, radial) in which a row's depth error moves the point, (rows, 2).
    """

    row: Array
    lateral_mm: Array
    radial_mm: Array
    sigma_mm: Array
    towards: Array
    n_frames: Array


def stripe_bounds(
    tables: dict[str, pa.Table], rig: Rig, rig_c: float, wheelset: Wheelset, growth: float, shift_mm: float
) -> dict[tuple[str, str], float]:
    """Standard deviation in mm, by quantity and side, that the stripe noise of one scan leaves at least."""
    noise, rows = NoiseModel(), _station_rows(tables, rig, rig_c)
    truth = {key: value * growth for key, value in wheelset.truths().items()}
    variance: dict[tuple[str, str], float] = {}
    faces: dict[tuple[str, str], float] = {}
    for side, sign in (("left", -1.0), ("right", 1.0)):
        face = shift_mm + sign * 0.5 * truth["inner_distance", "both"]
        shoulder = shift_mm + sign * 0.5 * truth["shoulder_distance", "both"]
        tread, journal = 0.5 * truth["wheel_diameter", side], 0.5 * truth["journal_diameter", side]
        wheel = [(r, sign * (r.lateral_mm - face)) for r in rows.get(f"{side}_wheel", [])]
        axle = [(r, sign * (r.lateral_mm - shoulder)) for r in rows.get(f"{side}_journal", [])]

        def flank(above_tread_mm: float, wheel: Any = wheel, tread: float = tread) -> float:
            parts = [
                (r, np.where(s > TIP_MM, r.radial_mm - tread - above_tread_mm, np.inf), r.lateral_mm, 0)
                for r, s in wheel
            ]
            return _level(parts, FLANK_HALF_WIDTH_MM, FLANK_DEGREE, noise)

        tread_v = _level([(r, s - 70.0, r.radial_mm, 1) for r, s in wheel], TREAD_HALF_WIDTH_MM, TREAD_DEGREE, noise)
        tip_v = _level([(r, s - TIP_MM, r.radial_mm, 1) for r, s in wheel], TIP_HALF_WIDTH_MM, TIP_DEGREE, noise)
        faces["wheel", side] = _straight(
            [(r, (np.abs(s) < FACE_BAND_MM) & (r.radial_mm < tread + 9.0), 0) for r, s in wheel], noise
        )
        faces["journal", side] = _straight(
            [(r, (np.abs(s) < FACE_BAND_MM) & (r.radial_mm > journal + 2.0), 0) for r, s in axle], noise
        )
        cylinder = _straight([(r, np.abs(r.radial_mm - journal) < FACE_BAND_MM, 1) for r, _ in axle], noise)
        variance["wheel_diameter", side] = 4 * tread_v
        variance["journal_diameter", side] = 4 * cylinder
        variance["flange_height", side] = tread_v + tip_v
        variance["flange_thickness", side] = flank(10.0) + faces["wheel", side]
        variance["qr", side] = flank(10.0) + flank(truth["flange_height", side] - 2.0)
    variance["inner_distance", "both"] = faces["wheel", "left"] + faces["wheel", "right"]
    variance["shoulder_distance", "both"] = faces["journal", "left"] + faces["journal", "right"]
    return {key: float(np.sqrt(v)) for key, v in variance.items() if np.isfinite(v)}


def _station_rows(tables: dict[str, pa.Table], rig: Rig, rig_c: float) -> dict[str, list[_Rows]]:
    """Rows of every sensor, by station: means over the frames, placed by the true pose."""
    cloud = tables["triangulated_clouds"]
    noise = NoiseModel()
    true_px = float(np.hypot(noise.white_px, noise.speckle_px))
    estimated = {(r["sensor_id"], r["line"]): r["centre_noise_px"] for r in tables["stripe_statistics"].to_pylist()}
    sensor_ids = cloud["sensor_id"].combine_chunks().dictionary_encode()
    code, coded = sensor_ids.indices.to_numpy(), sensor_ids.dictionary.to_pylist()
    columns = {c: cloud[c].to_numpy().astype(float) for c in ("line", "row", "x_mm", "y_mm", "z_mm", "u_depth_um")}
    found: dict[str, list[_Rows]] = {}
    for sensor in rig.sensors:
        pose = sensor.rig_from_sensor_at(rig_c, rig.expansion_per_k)
        for line in range(len(sensor.planes)):
            if sensor.sensor_id not in coded:
                continue
            member = (code == coded.index(sensor.sensor_id)) & (columns["line"] == line)
            if not member.any():
                continue
            row = columns["row"][member].astype(int)
            count = np.bincount(row)
            seen = np.flatnonzero(count > 2)
            mean = {c: _median_by(row, columns[c][member], seen) for c in ("x_mm", "y_mm", "z_mm", "u_depth_um")}
            points = np.column_stack([mean["x_mm"], mean["y_mm"], mean["z_mm"]])
            at = points @ pose[:3, :3].T + pose[:3, 3]
            sight = points / np.linalg.norm(points, axis=1)[:, None] @ pose[:3, :3].T
            radial = np.hypot(at[:, 1], at[:, 2])
            outward = (sight[:, 1] * at[:, 1] + sight[:, 2] * at[:, 2]) / radial
            scale = true_px / (estimated[sensor.sensor_id, line] or true_px)
            sigma = mean["u_depth_um"] * 1e-3 * scale
            found.setdefault(sensor.station, []).append(
                _Rows(seen, at[:, 0], radial, sigma, np.column_stack([sight[:, 0], outward]), count[seen])
            )
    return found


def _median_by(row: Array, values: Array, rows: Array) -> Array:
    order = np.lexsort((values, row))
    start = np.searchsorted(row[order], rows)
    end = np.searchsorted(row[order], rows, side="right")
    return values[order][(start + end - 1) // 2]


def _straight(parts: list[tuple[_Rows, Array, int]], noise: NoiseModel) -> float:
    """Least variance of a straight part's level at its middle; rows that are on it, and which coordinate is measured."""
    placed = []
    for rows, on, axis in parts:
        along, measured = (rows.radial_mm, rows.lateral_mm) if axis == 0 else (rows.lateral_mm, rows.radial_mm)
        middle = float(along[on].mean()) if on.any() else 0.0
        placed.append((rows, np.where(on, along - middle, np.inf), measured, axis))
    return _level(placed, STRAIGHT_HALF_WIDTH_MM, 1, noise)


def _level(parts: list[tuple[_Rows, Array, Array, int]], half_width: float, degree: int, noise: NoiseModel) -> float:
    """Least variance of a curve's level at 0, over all frames: the curve is a polynomial of the first array near 0.

    parts: rows of each sensor, their places along the curve, the measured coordinate, and which of (lateral, radial) it
    is. Sensors add their information: their noise is independent. Infinite where nothing was seen.
    """
    information = np.zeros((degree + 1, degree + 1))
    for rows, at, measured, axis in parts:
        near = np.flatnonzero(np.abs(at) <= half_width)
        if len(near) <= degree + 1:
            continue
        # An error along the line of sight moves a point along the curve, too: what counts is its part across the curve.
        slope = np.gradient(measured[near], at[near]) if len(near) > 2 else np.zeros(len(near))
        across = rows.towards[near, axis] - np.clip(slope, -20, 20) * rows.towards[near, 1 - axis]
        sigma = rows.sigma_mm[near] * np.maximum(np.abs(across), 1e-6)
        apart = np.abs(rows.row[near][:, None] - rows.row[near][None, :])
        share = noise.speckle_px**2 / (noise.speckle_px**2 + noise.white_px**2)
        correlation = share * np.exp(-(apart**2) / (2 * noise.speckle_rows**2)) + (1 - share) * (apart == 0)
        design = (at[near, None] / half_width) ** np.arange(degree + 1) / sigma[:, None]
        information += float(np.median(rows.n_frames[near])) * design.T @ np.linalg.solve(correlation, design)
    if np.linalg.matrix_rank(information) <= degree:
        return float("inf")
    return float(np.linalg.inv(information)[0, 0])


def nuisance_bounds(budgets: pa.Table, registered: dict[str, float]) -> dict[tuple[str, str], float]:
    """Standard deviation in mm, by quantity and side, that cameras and poses leave open at least.

    registered: by side, the least standard deviation of its wheel sensors' registration over what it claims.
    """
    variance: dict[tuple[str, str], float] = {}
    for row in budgets.to_pylist():
        if row["source"] in (CALIBRATION, SENSING, REGISTRATION):
            key = (row["quantity"], row["side"])
            share = registered.get(row["side"], 0.0) if row["source"] == REGISTRATION else 1.0
            variance[key] = variance.get(key, 0.0) + (share * row["contribution"]) ** 2
    return {key: float(np.sqrt(v)) for key, v in variance.items()}


def registration_bounds(
    tables: dict[str, pa.Table], rig: Rig, rig_c: float, registrations: pa.Table
) -> dict[str, float]:
    """By side, the least standard deviation along the axle of the registration of the wheel's two sensors, over its claim."""
    cloud = tables["triangulated_clouds"]
    poses = {
        (sensor.sensor_id, line): sensor.rig_from_sensor_at(rig_c, rig.expansion_per_k)
        for sensor in rig.sensors
        for line in range(len(sensor.planes))
    }
    grids = station_grids(cloud, poses, int(cloud["frame"].to_numpy().max()) + 1)
    found = {}
    for row in registrations.to_pylist():
        if row["method"] != "icp" or not row["station"].endswith("_wheel"):
            continue
        views = [(row[f"{end}_sensor_id"], row[f"{end}_line"]) for end in ("source", "target")]
        means = [
            mean_meridian(grids[v].lateral_mm, grids[v].radial_mm, np.ones(len(grids[v].lateral_mm), bool))
            for v in views
        ]
        information = _pose_information(means[0], means[1], NoiseModel())
        if np.linalg.matrix_rank(information) == 3:
            least_mm = float(np.sqrt(np.linalg.inv(information)[0, 0]))
            found[row["station"].removesuffix("_wheel")] = 1e3 * least_mm / row["u_lateral_um"]
    return found


def _pose_information(one: MeanMeridian, other: MeanMeridian, noise: NoiseModel) -> Array:
    """Fisher information (3, 3) about a lateral and a radial shift (mm) and a turn in the meridian plane (rad) between two
    sensors, of the rows that both see; the curve that they see is not known, so that only their difference tells."""
    (points, own), (others, theirs) = _with_noise(one), _with_noise(other)
    distance, partner = cKDTree(others).query(points)
    both = np.flatnonzero(distance < TOGETHER_MM)
    if not both.size:
        return np.zeros((3, 3))
    partner = partner[both]
    (normal, step), (_, other_step) = _normals(points), _normals(others)
    n = normal[both]
    # Rows of a sensor share their speckle over some lines; of the other sensor there may be more or fewer to a row.
    share = noise.speckle_px**2 / (noise.speckle_px**2 + noise.white_px**2)
    length = 1 - share + share * np.sqrt(2 * np.pi) * noise.speckle_rows
    across = [(vectors * n).sum(axis=1) ** 2 for vectors in (own[both], theirs[partner])]
    variance = length * (across[0] + across[1] * other_step[partner] / step[both])
    about = points[both] - points[both].mean(axis=0)
    columns = np.column_stack([n, n[:, 1] * about[:, 0] - n[:, 0] * about[:, 1]])
    return (columns / variance[:, None]).T @ columns


def _with_noise(mean: MeanMeridian) -> tuple[Array, Array]:
    """Rows of a meridian (n, 2), and the noise of each as a vector (n, 2), both in mm."""
    points = np.column_stack([mean.lateral_mm, mean.radial_mm])[np.isfinite(mean.lateral_mm)]
    vectors = mean.row_noise().vectors_mm
    known = np.isfinite(vectors[:, 0])
    return points[known], vectors[known]


def _normals(points: Array) -> tuple[Array, Array]:
    """Unit normals (n, 2) of a meridian (n, 2), and the distance from row to row in mm."""
    at = np.arange(len(points))
    low, high = np.maximum(at - TANGENT_ROWS, 0), np.minimum(at + TANGENT_ROWS, at[-1])
    along = points[high] - points[low]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    return np.column_stack([-along[:, 1], along[:, 0]]) / length[:, None], length / np.maximum(high - low, 1)


def other_bounds(
    budgets: pa.Table, thermometer_c: float, configured_c: float, axis_um: float
) -> dict[tuple[str, str], float]:
    """Standard deviation in mm, by quantity and side, from the axis of rotation and the thermometers as they truly err.

    Sensitivities are those of the budgets: geometry and lengths alone. axis_um: radius of the ball in which the axis lies
    in each scan.
    """
    variance: dict[tuple[str, str], float] = {}
    for row in budgets.to_pylist():
        key = (row["quantity"], row["side"])
        if row["source"].endswith("temperature") or row["source"].startswith("rig temperature"):
            term = row["contribution"] * thermometer_c / configured_c
        elif row["source"] == "axis of rotation":  # one coordinate of a point in a ball, in the scan and the reference
            term = row["sensitivity"] * axis_um * 1e-3 / np.sqrt(5.0) * np.sqrt(2.0)
        else:
            continue
        variance[key] = variance.get(key, 0.0) + term**2
    return {key: float(np.sqrt(v)) for key, v in variance.items()}
