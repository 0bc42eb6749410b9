"""Stages 4 and 5, between tables and arrays: features, and registration of a station's views."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
from numpy.typing import NDArray

from wheelset_assets import tables
from wheelset_assets.bundle import Rig, ScanHeader, Sensor, Station
from wheelset_assets.config import FeatureConfig, RegistrationConfig
from wheelset_assets.metrology import features, registration, rigid
from wheelset_assets.metrology.frequency import align_overlap
from wheelset_assets.metrology.laser_plane import Make, Sensing, turned_to_axle
from wheelset_assets.metrology.revolution import (
    MeanMeridian,
    MeridianGrid,
    RowNoise,
    common_frames,
    grouped_meridians,
    mean_meridian,
    meridian_motion,
    to_meridian,
)
from wheelset_assets.metrology.thermal import grown_pose, growth
from wheelset_assets.quality import AlgorithmFailed, Flag
from wheelset_assets.stages.cloud import grids
from wheelset_assets.stages.drift import plane_of

Array = NDArray[Any]

MAKE = Make(2.0, float(np.radians(1.0)), 3.0, float(np.radians(0.5)))
"""What the scan-bundle format promises: poses within 2 mm and 1 degree, sensing planes a few millimetres from the axle.
Of their angle with it it says no more than that they are meridians; half of what it grants a pose is taken."""


def nominal_pose(sensor: Sensor, rig: Rig, rig_temperature_c: float) -> Array:
    """Nominal rig_from_sensor (4, 4) at a rig temperature."""
    return grown_pose(np.array(sensor.T_rig_sensor, float), growth(rig.expansion_per_k, rig_temperature_c))


View = tuple[str, int]
"""A sensor and one of its laser lines: what is registered. Two lines of one sensor lie in different planes, so that the
nominal pose's error in the directions on which one stripe is silent shifts them against each other in the meridian."""


def station_grids(cloud: pa.Table, poses: Mapping[View, Array], n_frames: int) -> dict[View, MeridianGrid]:
    """Meridian grids of every view that has points and a pose."""
    return {
        (g.sensor_id, g.line): to_meridian(
            g.sensor_id, g.line, g.x, g.y, g.z, g.u_mm, poses[g.sensor_id, g.line], g.first_row, g.row_step
        )
        for g in grids(cloud, n_frames)
        if (g.sensor_id, g.line) in poses
    }


def nominal_poses(rig: Rig, rig_temperature_c: float) -> dict[View, Array]:
    """Nominal rig_from_sensor (4, 4) of every view at a rig temperature."""
    return {
        (s.sensor_id, line): nominal_pose(s, rig, rig_temperature_c)
        for s in rig.sensors
        for line in range(s.laser_lines)
    }


@dataclass(frozen=True)
class Standing:
    """Views before any registration: rig_from_sensor (4, 4), how their laser planes lie to the axle where these are
    known, and which cannot stand as the rig says."""

    poses: dict[View, Array]
    sensing: dict[View, Sensing]
    far: frozenset[View]


def standing(rig: Rig, rig_temperature_c: float, stripe_statistics: pa.Table) -> Standing:
    """Nominal poses, turned so that laser planes lie to the axle as a rig's do (`turned_to_axle`)."""
    poses, sensing, far = nominal_poses(rig, rig_temperature_c), {}, set()
    for row in stripe_statistics.to_pylist():
        view, plane = (row["sensor_id"], row["line"]), plane_of(row)
        if view in poses and plane is not None:
            poses[view], sensing[view], is_far = turned_to_axle(poses[view], plane, MAKE)
            if is_far:
                far.add(view)
    return Standing(poses, sensing, frozenset(far))


def _frame_count(cloud: pa.Table) -> int:
    return int(cloud["frame"].to_numpy().max()) + 1


def run_features(
    *, filtered_clouds: pa.Table, stripe_statistics: pa.Table, rig: Rig, scan: ScanHeader, config: FeatureConfig
) -> Mapping[str, pa.Table]:
    """Stage 4: keypoints and descriptors of each sensor's turn, folded into a patch of a few columns."""
    before = standing(rig, scan.temperature_c.rig, stripe_statistics).poses
    poses = {view: pose for view, pose in before.items() if view[1] == 0}
    parts = []
    for (name, line), grid in station_grids(filtered_clouds, poses, _frame_count(filtered_clouds)).items():
        points = _folded_patch(grid, config)
        if len(points) < 20:
            continue
        near, salient = config.normal_radius_mm, max(config.saliency_radius_mm, config.non_maximum_radius_mm)
        pairs = features.neighbour_pairs(points, max(near, salient, config.descriptor_radius_mm))
        normal = features.normals(points, near, poses[name, line][:3, 3], pairs.within(near))
        keypoints = features.iss_keypoints(
            points,
            config.saliency_radius_mm,
            config.non_maximum_radius_mm,
            config.gamma_21,
            config.gamma_32,
            pairs=pairs.within(salient),
        )
        known = np.isfinite(normal[keypoints.index]).all(axis=1) & _in_the_middle(points, keypoints.index)
        index = keypoints.index[known]
        described = pairs.within(config.descriptor_radius_mm)
        histogram = features.fpfh(points, normal, config.descriptor_radius_mm, index, pairs=described)
        parts.append(
            tables.FEATURES.from_columns(
                {
                    "sensor_id": [name] * len(index),
                    "keypoint": np.arange(len(index), dtype=np.int32),
                    **{f"{axis}_mm": points[index, i] for i, axis in enumerate("xyz")},
                    "saliency_mm2": keypoints.saliency[known],
                    "n_neighbours": keypoints.n_neighbours[known].astype(np.int32),
                    "fpfh": pa.FixedSizeListArray.from_arrays(pa.array(histogram.astype(np.float32).ravel()), 33),
                }
            )
        )
    return {"features": pa.concat_tables(parts).combine_chunks() if parts else tables.FEATURES.empty()}


def _folded_patch(grid: MeridianGrid, config: FeatureConfig) -> Array:
    """Points (n, 3) of one sensor's turn, folded: interleaved sets of frames, each turned a spacing farther about the axle.

    A wheel repeats its meridian all along the turn, so turning a set of frames about the rig's axle moves its points
    over the same surface; the columns are real data with independent noise, as near to each other as the rows.
    """
    lateral, radial = grouped_meridians(grid.lateral_mm, grid.radial_mm, config.patch_columns)
    psi = np.radians(grid.direction_deg)
    columns = []
    for k, (a, r) in enumerate(zip(lateral, radial, strict=True)):
        a, r = _resampled(a, r, config.spacing_mm)
        turned = psi + (k - (len(lateral) - 1) / 2) * config.spacing_mm / np.median(r) if len(r) else psi
        columns.append(np.column_stack([a, r * np.cos(turned), r * np.sin(turned)]))
    return np.concatenate(columns)


def _in_the_middle(points: Array, index: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether points lie in the middle third of the patch across the meridian: its edges are not the wheel's."""
    angle = np.unwrap(np.arctan2(points[:, 2], points[:, 1]))
    half = np.ptp(angle) / 2
    return np.abs(angle[index] - (angle.min() + half)) <= half / 3


def _resampled(lateral: Array, radial: Array, spacing_mm: float) -> tuple[Array, Array]:
    """Points along a profile, thinned to bins of spacing_mm of arc length by their mean; gaps stay gaps."""
    ok = np.isfinite(lateral)
    a, r = lateral[ok], radial[ok]
    if len(a) < 2:
        return a, r
    chord = np.hypot(np.diff(a), np.diff(r))
    smooth_step = np.minimum(chord, np.median(chord) * 3)  # noise must not lengthen the arc without bound
    gap = chord > max(5 * spacing_mm, 10 * float(np.median(chord)))
    arc = np.concatenate([[0.0], np.cumsum(np.where(gap, chord, smooth_step))])
    bins = np.floor(arc / spacing_mm).astype(np.int64)
    _, index = np.unique(bins, return_inverse=True)
    count = np.bincount(index)
    return np.bincount(index, a) / count, np.bincount(index, r) / count


@dataclass(frozen=True)
class StationScan:
    """A station's views that delivered points, in order of preference, with their poses so far and grids."""

    station: Station
    views: list[View]
    poses: dict[View, Array]
    grids: dict[View, MeridianGrid]
    means: dict[View, MeanMeridian]
    curves: dict[View, Array]
    noises: dict[View, RowNoise]
    """Noise of each of the curves' rows."""
    flags: dict[View, Flag]
    """What every registration of a view is flagged with."""


def station_scans(
    filtered_clouds: pa.Table, stripe_statistics: pa.Table, rig: Rig, scan: ScanHeader
) -> list[StationScan]:
    before = standing(rig, scan.temperature_c.rig, stripe_statistics)
    poses = before.poses
    found = station_grids(filtered_clouds, poses, _frame_count(filtered_clouds))
    seen_sensors = {sensor for sensor, _ in found}
    result = []
    for station in rig.stations:
        wanted = rig.station_sensors(station.station)
        views = [(s.sensor_id, line) for s in wanted for line in range(s.laser_lines) if (s.sensor_id, line) in found]
        if views:
            frames = common_frames([found[v].lateral_mm for v in views])
            means = {v: mean_meridian(found[v].lateral_mm, found[v].radial_mm, frames) for v in views}
            curves = {v: _curve(mean) for v, mean in means.items()}
            noises = {v: mean.row_noise() for v, mean in means.items()}
            absent = Flag.NONE if {s.sensor_id for s in wanted} <= seen_sensors else Flag.SENSOR_MISSING
            flags = {v: absent | (Flag.FAR_FROM_NOMINAL if v in before.far else Flag.NONE) for v in views}
            known = {v: poses[v] for v in views}, {v: found[v] for v in views}
            result.append(StationScan(station, views, *known, means, curves, noises, flags))
    return result


Keypoints = Mapping[str, pa.Table]
Register = Callable[[StationScan, View, View, Keypoints, RegistrationConfig], tuple[Array | None, dict[str, Any]]]
"""A way to register a source view to a target view: motion of the rig frame (4, 4), or None, and the row to store."""


def run_registrations(
    *,
    filtered_clouds: pa.Table,
    stripe_statistics: pa.Table,
    features: pa.Table,
    rig: Rig,
    scan: ScanHeader,
    config: RegistrationConfig,
) -> Mapping[str, pa.Table]:
    """Stage 5: every view of a station against its first, then the fused mean meridian."""
    return registered(filtered_clouds, stripe_statistics, features, rig, scan, config, register_by_icp)


def registered(
    filtered_clouds: pa.Table,
    stripe_statistics: pa.Table,
    features: pa.Table,
    rig: Rig,
    scan: ScanHeader,
    config: RegistrationConfig,
    register: Register,
) -> Mapping[str, pa.Table]:
    """Tables of stage 5 by a way to register two views; the stage's own is `register_by_icp`."""
    rows, profiles = [], []
    keypoints = {
        name: features.filter(pa.compute.equal(features["sensor_id"], name))
        for name in sorted(set(features["sensor_id"].to_pylist()))
    }
    for station in station_scans(filtered_clouds, stripe_statistics, rig, scan):
        target = station.views[0]
        motions: dict[View, Array | None] = {target: np.eye(4)}
        if len(station.views) == 1:
            rows.append(_single_row(station))
        for source in station.views[1:]:
            motions[source], row = register(station, source, target, keypoints, config)
            rows.append(row)
        profiles.append(_fused_profile(station, motions))
    fused = pa.concat_tables(profiles).combine_chunks() if profiles else tables.FUSED_PROFILES.empty()
    return {
        "registrations": tables.REGISTRATIONS.from_rows([{"scan_id": scan.scan_id, **row} for row in rows]),
        "fused_profiles": fused,
    }


def _curve(mean: MeanMeridian) -> Array:
    """Mean meridian (n, 2) in image-row order, without the rows that were not seen."""
    ok = np.isfinite(mean.lateral_mm)
    return np.column_stack([mean.lateral_mm[ok], mean.radial_mm[ok]])


def turned_meridian(motion: Array, curve: Array, direction_deg: float) -> Array:
    """Meridian coordinates (n, 2) of a curve in the meridian plane after a motion of the rig frame."""
    psi = np.radians(direction_deg)
    points = np.column_stack([curve[:, 0], curve[:, 1] * np.cos(psi), curve[:, 1] * np.sin(psi)])
    moved = rigid.apply(motion, points)
    return np.column_stack([moved[:, 0], np.hypot(moved[:, 1], moved[:, 2])])


def register_by_icp(
    station: StationScan, source: View, target: View, keypoints: Keypoints, config: RegistrationConfig
) -> tuple[Array | None, dict[str, Any]]:
    curves = {view: station.curves[view] for view in (source, target)}
    flags = station.flags[source] | station.flags[target]
    if min(map(len, curves.values())) < config.min_pairs:  # too few frames for a mean meridian, or hardly a row
        return None, _nominal_row(station, source, target, flags | Flag.NO_REGISTRATION)
    direction = station.grids[source].direction_deg
    tolerance_mm, tolerance_rad = (
        config.nominal_translation_mm * np.sqrt(2),
        np.radians(config.nominal_rotation_deg) * np.sqrt(2),
    )
    pivot = (float(curves[source][:, 0].mean()), float(curves[source][:, 1].mean()))
    coarse = None
    if source[1] == target[1] == 0:  # features are of line 0
        coarse = coarse_pose(keypoints.get(source[0]), keypoints.get(target[0]), pivot, config)
    start = np.eye(4)
    if coarse is None:
        flags |= Flag.COARSE_FROM_NOMINAL
    else:
        start = meridian_motion(
            direction, pivot, coarse.rotation_rad, float(coarse.shift_mm[0]), float(coarse.shift_mm[1])
        )
    settings = registration.IcpSettings(
        tolerance_mm,
        tolerance_rad,
        config.max_iterations,
        config.convergence_um * 1e-3,
        config.max_pair_mm,
        config.min_pairs,
        config.form_floor_um * 1e-3,
        config.constrained_ratio,
    )
    noise = (station.noises[source], station.noises[target])
    found, started_coarse = _best_start(curves[source], curves[target], direction, start, settings, noise)
    if not started_coarse:
        flags |= Flag.COARSE_FROM_NOMINAL
    if found is None:
        return None, _nominal_row(station, source, target, flags | Flag.NO_REGISTRATION)
    if found.n_constrained < 3:
        flags |= Flag.FEW_CONSTRAINTS
    check, disagrees = _frequency_check(
        turned_meridian(found.motion, curves[source], direction), curves[target], config
    )
    if disagrees:
        flags |= Flag.FREQUENCY_DISAGREES
    row = pose_row(station, source, target, found.motion, flags) | {
        "method": "icp",
        "inlier_rmse_mm": found.rmse_mm,
        "fitness": found.fitness,
        "n_iterations": found.n_iterations,
        "n_matches": coarse.n_inliers if coarse else 0,
        "n_constrained": found.n_constrained,
        "u_lateral_um": found.u_lateral_mm * 1e3,
        "u_radial_um": found.u_radial_mm * 1e3,
        "u_meridian_deg": float(np.degrees(found.u_rotation_rad)),
        "correction_lateral_mm": found.lateral_mm,
        "correction_radial_mm": found.radial_mm,
        "correction_meridian_deg": float(np.degrees(found.rotation_rad)),
        "coarse_lateral_mm": float(coarse.shift_mm[0]) if coarse else None,
        "coarse_radial_mm": float(coarse.shift_mm[1]) if coarse else None,
        "coarse_meridian_deg": float(np.degrees(coarse.rotation_rad)) if coarse else None,
        "information": list(found.information.ravel()),
    }
    return found.motion, row | check


def _frequency_check(source: Array, target: Array, config: RegistrationConfig) -> tuple[dict[str, float], bool]:
    """What phase correlation and spectrum still find between the registered meridians, in the middle of the overlap."""
    distance = registration.project_on_curve(source, target)
    together = distance.valid & (np.abs(distance.distance_mm) < 1.0)
    found = align_overlap(source, target)
    if found is None or not together.any():
        return {}, False
    step = found.shift_mm * 1e3
    beyond = np.abs(step).max() > config.frequency_limit_um or abs(found.rotation_deg) > config.frequency_limit_deg
    return {
        "frequency_lateral_um": float(step[0]),
        "frequency_radial_um": float(step[1]),
        "frequency_meridian_deg": found.rotation_deg,
        "overlap_rms_um": float(np.sqrt((distance.distance_mm[together] ** 2).mean())) * 1e3,
    }, bool(beyond)


def _best_start(
    source: Array,
    target: Array,
    direction: float,
    coarse: Array,
    settings: registration.IcpSettings,
    noise: tuple[RowNoise, RowNoise],
) -> tuple[registration.MeridianRegistration | None, bool]:
    """Fine registration from the coarse pose and from the nominal one; the better by inliers and residual is taken."""
    found: list[tuple[registration.MeridianRegistration, bool]] = []
    starts = [(np.eye(4), False)] if np.array_equal(coarse, np.eye(4)) else [(coarse, True), (np.eye(4), False)]
    for start, is_coarse in starts:
        try:
            found.append(
                (registration.register_meridians(source, target, direction, start, settings, noise), is_coarse)
            )
        except (AlgorithmFailed, np.linalg.LinAlgError):
            continue
    if not found:
        return None, False
    return max(found, key=lambda f: f[0].fitness / (f[0].rmse_mm + 2e-3))


def coarse_pose(
    source: pa.Table | None, target: pa.Table | None, pivot: tuple[float, float], config: RegistrationConfig
) -> registration.CoarsePose | None:
    """Coarse pose about the pivot from mutual FPFH matches within reach of the nominal poses."""
    if source is None or target is None or source.num_rows < 2 or target.num_rows < 2:
        return None
    places, histograms = [], []
    for table in (source, target):
        x, y, z = (table[f"{axis}_mm"].to_numpy() for axis in "xyz")
        places.append(np.column_stack([x, np.hypot(y, z)]) - pivot)
        histograms.append(np.asarray(table["fpfh"].combine_chunks().flatten()).reshape(-1, 33).astype(float))
    near = np.linalg.norm(places[0][:, None] - places[1][None], axis=2) <= config.match_radius_mm
    i, j = registration.mutual_matches(histograms[0], histograms[1], near)
    return registration.coarse_meridian_pose(
        places[0][i],
        places[1][j],
        max_rotation_rad=np.radians(2 * config.nominal_rotation_deg * 1.5),
        max_shift_mm=2 * config.nominal_translation_mm * 1.5,
        inlier_mm=config.coarse_inlier_mm,
        trials=config.coarse_trials,
        seed=config.seed,
    )


def pose_row(station: StationScan, source: View, target: View, motion: Array, flags: Flag) -> dict[str, Any]:
    """Columns of a registration that a motion of the rig frame (4, 4) at the nominal poses decides; the others empty."""
    same = source == target
    target_from_source = np.eye(4) if same else rigid.inverse(station.poses[target]) @ motion @ station.poses[source]
    q = rigid.quaternion_from_rotation(target_from_source[:3, :3])
    t = target_from_source[:3, 3]
    empty = {column.name: None for column in tables.REGISTRATIONS.columns if column.nullable}
    return empty | {
        "station": station.station.station,
        "source_sensor_id": source[0],
        "source_line": source[1],
        "target_sensor_id": target[0],
        "target_line": target[1],
        "direction_deg": station.grids[target].direction_deg,
        "qw": q[0],
        "qx": q[1],
        "qy": q[2],
        "qz": q[3],
        "tx_mm": t[0],
        "ty_mm": t[1],
        "tz_mm": t[2],
        "n_iterations": 0,
        "n_matches": 0,
        "n_constrained": 0,
        "quality_flags": flags.names(),
    }


def _nominal_row(station: StationScan, source: View, target: View, flags: Flag) -> dict[str, Any]:
    return pose_row(station, source, target, np.eye(4), flags) | {"method": "nominal"}


def _single_row(station: StationScan) -> dict[str, Any]:
    view = station.views[0]
    return pose_row(station, view, view, np.eye(4), station.flags[view]) | {"method": "single"}


def _fused_profile(station: StationScan, motions: dict[View, Array | None]) -> pa.Table:
    """Mean meridian of each registered view, with the distance from the station's other views."""
    parts: list[tuple] = []
    curves: dict[View, Array] = {}
    for view in station.views:
        if (motion := motions[view]) is None:
            continue
        mean = station.means[view]
        seen = np.flatnonzero(np.isfinite(mean.lateral_mm))
        whole = np.isfinite(mean.u_mm[seen])
        row = seen[whole]
        curves[view] = turned_meridian(motion, station.curves[view], station.grids[view].direction_deg)[whole]
        parts.append((*view, row, curves[view], mean))
    made = []
    for name, line, row, curve, mean in parts:
        grid = station.grids[name, line]
        residual = np.full(len(row), np.nan)
        for other, other_curve in curves.items():
            if other != (name, line) and len(row) and len(other_curve) > 10:
                projection = registration.project_on_curve(curve, other_curve)
                use = projection.valid & (np.abs(projection.distance_mm) < 1.0) & np.isnan(residual)
                residual[use] = projection.distance_mm[use]
        made.append(
            tables.FUSED_PROFILES.from_columns(
                {
                    "station": [station.station.station] * len(row),
                    "sensor_id": [name] * len(row),
                    "line": np.full(len(row), line, np.int8),
                    "row": (grid.first_row + row * grid.row_step).astype(np.int16),
                    "lateral_mm": curve[:, 0],
                    "radial_mm": curve[:, 1],
                    "u_um": mean.u_mm[row] * 1e3,
                    "n_frames": mean.n_frames[row].astype(np.int32),
                    "residual_um": pa.array(residual * 1e3, from_pandas=True),
                }
            )
        )
    return pa.concat_tables(made)
