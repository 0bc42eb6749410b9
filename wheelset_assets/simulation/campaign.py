"""A campaign of simulated measurements: an inbox in the bundle format, and beside it the truth.

Here: what is written in which order, the JSON contents, certificate and review values, truth files. Not here: how a
scan, a board or a file is made (`scan`, `boards`, `bundle`), when and under which conditions (`plan`, `schedule`).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from .boards import board_of, board_poses, pixel_rays, render
from .bundle import file_hashes, publish, write_csv, write_json, write_png
from .faults import FAULTS, Fault, Scene
from .plan import SimulationPlan
from .profiles import Piece, profile_from_points
from .rig import Rig, Sensor, build_rig
from .scan import write_scan
from .schedule import ScheduledCalibration, ScheduledScan, calibrations, schedule
from .streams import stream
from .wheelset import Wheelset, draw_master, draw_wheelset

Progress = Callable[[int, int, str], None]
REVIEW_DAYS_BEFORE = 4
DEFAULT_EXPANSION_PER_K = 11.5e-6  # of wheelsets, by the bundle format


@dataclass(frozen=True)
class SimulatedCampaign:
    """What was written where."""

    inbox: Path
    rig_id: str
    rig_path: Path
    calibration_ids: tuple[str, ...]
    reference_scan_ids: tuple[str, ...]
    production_scan_ids: tuple[str, ...]
    review_path: Path
    truth_path: Path
    truth_rig_path: Path
    faults_path: Path | None
    faults: Mapping[str, str]

    @property
    def n_scans(self) -> int:
        """Number of scans, references included."""
        return len(self.reference_scan_ids) + len(self.production_scan_ids)


def simulate(plan: SimulationPlan, progress: Progress | None = None) -> SimulatedCampaign:
    """Write the campaign's inbox and truth files; what is already in the inbox under other names stays."""
    faults = _assigned(plan)
    rig = build_rig(plan.seed, plan.rig, plan.rig_id, plan.rows, plan.rig_expansion_per_k)
    master = _master(plan)
    wheelsets = [_wheelset(plan, index) for index in range(plan.wheelsets)]
    cals, scans = calibrations(plan), schedule(plan)
    total, done = len(cals) + len(scans), 0
    rig_path = plan.out / "rigs" / f"{rig.rig_id}.json"
    write_json(rig_path, rig.declaration())
    review_path = _write_review(plan, wheelsets)
    truth_path, truth_rig_path = _write_truth(plan, rig, master, wheelsets, cals, scans)
    faults_path = _beside(plan, "faults.json") if plan.faults else None
    if faults_path:
        write_json(faults_path, {scan_id: fault.kind for scan_id, fault in faults.items()})
    for number, calibration in enumerate(cals):
        _write_calibration(plan, rig, number, calibration)
        done += 1
        if progress:
            progress(done, total, calibration.calibration_id)
    for scan in scans:
        wheelset = master if scan.wheelset_index is None else wheelsets[scan.wheelset_index]
        _write_scan(plan, rig, scan, wheelset, cals[scan.calibration], faults.get(scan.scan_id), scans[0])
        done += 1
        if progress:
            progress(done, total, scan.scan_id)
    shutil.rmtree(plan.out / ".staging", ignore_errors=True)
    return SimulatedCampaign(
        plan.out,
        rig.rig_id,
        rig_path,
        tuple(c.calibration_id for c in cals),
        tuple(s.scan_id for s in scans if s.purpose == "reference"),
        tuple(s.scan_id for s in scans if s.purpose == "production"),
        review_path,
        truth_path,
        truth_rig_path,
        faults_path,
        {scan_id: fault.kind for scan_id, fault in faults.items()},
    )


def _assigned(plan: SimulationPlan) -> dict[str, Fault]:
    """{scan_id: fault}: one of the campaign's last production scans for each fault of the plan, in order."""
    unknown = [kind for kind in plan.faults if kind not in FAULTS]
    if unknown:
        raise ValueError(f"plan: unknown fault {unknown[0]!r}; there are {', '.join(FAULTS)}")
    production = [scan.scan_id for scan in schedule(plan) if scan.purpose == "production"]
    struck = production[len(production) - len(plan.faults) :]
    return {scan_id: FAULTS[kind] for scan_id, kind in zip(struck, plan.faults, strict=True)}


def _pieces(plan: SimulationPlan, profile: str) -> tuple[Piece, ...] | None:
    return profile_from_points(*plan.custom_profiles[profile]) if profile in plan.custom_profiles else None


def _master(plan: SimulationPlan) -> Wheelset:
    profile = plan.profiles[0]
    name = f"{plan.artefact_mark}{plan.master_id}"
    master = draw_master(plan.artefact_seed, name, profile, plan.wheelset_type)
    return replace(master, pieces=_pieces(plan, profile), expansion_per_k=plan.wheelset_expansion_per_k)


def _wheelset(plan: SimulationPlan, index: int) -> Wheelset:
    profile = plan.profiles[index % len(plan.profiles)]
    name = f"{plan.artefact_mark}{plan.wheelset_label(index)}"
    wheelset = draw_wheelset(plan.artefact_seed, index, name, profile, plan.wheelset_type)
    defects = plan.defects
    wheels = [w.with_polygon(defects.polygon_order, defects.polygon_um * 1e-3) for w in wheelset.wheels]
    if defects.flat_length_mm:
        wheels[0] = wheels[0].with_flat(np.deg2rad(200.0), defects.flat_length_mm)
    left, right = (replace(j, taper_mm=defects.journal_taper_um * 1e-3) for j in wheelset.journals)
    return replace(
        wheelset,
        pieces=_pieces(plan, profile),
        wheels=(wheels[0], wheels[1]),
        journals=(left, right),
        expansion_per_k=plan.wheelset_expansion_per_k,
    )


def _beside(plan: SimulationPlan, suffix: str) -> Path:
    """A file beside the inbox, named after it (and after the campaign, if that has a name)."""
    name = f"{plan.out.name}.{plan.name}" if plan.name else plan.out.name
    return plan.out.parent / f"{name}.{suffix}"


def _staging(plan: SimulationPlan, name: str) -> Path:
    folder = plan.out / ".staging" / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _write_calibration(plan: SimulationPlan, rig: Rig, number: int, calibration: ScheduledCalibration) -> None:
    staged = _staging(plan, calibration.calibration_id)
    for index, sensor in enumerate(rig.sensors):
        _write_boards(staged / "boards" / sensor.sensor_id, plan, rig, number, index, sensor)
    content = {
        "format": "wheelset-calibration/1",
        "calibration_id": calibration.calibration_id,
        "rig_id": rig.rig_id,
        "captured_at": calibration.captured_at.isoformat(),
        "temperature_c": {"rig": calibration.reported_rig_c},
        "board": {"type": "chessboard", "inner_corners": list(rig.inner_corners), "square_mm": rig.square_mm},
        "files": file_hashes(staged),
    }
    final = plan.out / "calibrations" / calibration.calibration_id
    publish(staged, final, "calibration.json", content)


def _write_boards(folder: Path, plan: SimulationPlan, rig: Rig, number: int, index: int, sensor: Sensor) -> None:
    board = board_of(rig)
    poses = board_poses(board, sensor, plan.board_poses, plan.seed, number, index)
    cameras = (("left", sensor.left, np.eye(4)), ("right", sensor.right, sensor.right_from_left))
    for camera, (side, lens, camera_from_left) in enumerate(cameras):
        rays = pixel_rays(lens)
        for k, pose in enumerate(poses):
            rng = stream(plan.seed, "board-noise", number, index, camera, k)
            write_png(folder / side / f"{k:03d}.png", render(board, camera_from_left @ pose, rays, rng))


def _write_scan(
    plan: SimulationPlan,
    rig: Rig,
    scan: ScheduledScan,
    wheelset: Wheelset,
    calibration: ScheduledCalibration,
    fault: Fault | None,
    first_reference: ScheduledScan,
) -> None:
    staged = _staging(plan, scan.scan_id)
    write_scan(staged, plan, rig, scan, wheelset, fault)
    if fault and fault.files:
        fault.files(staged)
    content: dict[str, Any] = {
        "format": "wheelset-scan/1",
        "scan_id": scan.scan_id,
        "rig_id": rig.rig_id,
        "calibration_id": calibration.calibration_id,
        "captured_at": scan.captured_at.isoformat(),
        "purpose": scan.purpose,
        "wheelset": _wheelset_entry(wheelset),
        "temperature_c": {
            "wheelset": scan.conditions.reported_wheelset_c,
            "rig": scan.conditions.reported_rig_c,
        },
        "files": file_hashes(staged),
    }
    if scan.purpose == "reference":
        content["certificate"] = _certificate(plan, wheelset)
    damaged: dict[str, Any] | bytes = content
    if fault and fault.json:
        damaged = fault.json(content, Scene(staged, first_reference.captured_at))
    publish(staged, plan.out / "scans" / scan.scan_id, "scan.json", damaged)


def _wheelset_entry(wheelset: Wheelset) -> dict[str, Any]:
    entry = {"wheelset_id": wheelset.wheelset_id, "type": wheelset.type, "profile": wheelset.profile}
    known = wheelset.expansion_per_k == DEFAULT_EXPANSION_PER_K
    return entry if known else {**entry, "expansion_per_k": wheelset.expansion_per_k}


def _printed(
    wheelset: Wheelset, expanded_mm: Mapping[str, float], scale: float, rng: np.random.Generator
) -> list[tuple[str, str, float, float]]:
    """(quantity, side, value, U) as an instrument of expanded uncertainty U states them, to 0.1 um."""
    out = []
    for (quantity, side), true_mm in sorted(wheelset.truths().items()):
        error = rng.standard_normal()  # drawn for every quantity, so that the list chosen changes no other value
        if quantity in expanded_mm:
            value = true_mm + scale * expanded_mm[quantity] / 2 * error
            out.append((quantity, side, round(value, 4), expanded_mm[quantity]))
    return out


def _certificate(plan: SimulationPlan, master: Wheelset) -> list[dict[str, Any]]:
    rng = stream(plan.artefact_seed, "certificate")
    rows = _printed(master, plan.certificate_expanded_uncertainty_mm, plan.certificate_error_scale, rng)
    return [{"quantity": q, "side": s, "value_mm": v, "expanded_uncertainty_mm": u} for q, s, v, u in rows]


def _write_review(plan: SimulationPlan, wheelsets: list[Wheelset]) -> Path:
    measured_at = plan.at(plan.first_day - timedelta(days=REVIEW_DAYS_BEFORE), 0.0).isoformat()
    rows = []
    for index, wheelset in enumerate(wheelsets):
        rng = stream(plan.artefact_seed, "cmm", index)
        printed = _printed(wheelset, plan.cmm_expanded_uncertainty_mm, plan.cmm_error_scale, rng)
        rows += [(wheelset.wheelset_id, q, s, v, u, measured_at, "CMM-1") for q, s, v, u in printed]
    path = plan.out / "cmm" / (f"review-{plan.name}.csv" if plan.name else "review.csv")
    header = ("wheelset_id", "quantity", "side", "value_mm", "expanded_uncertainty_mm", "measured_at", "instrument")
    write_csv(path, header, rows)
    return path


def _write_truth(
    plan: SimulationPlan,
    rig: Rig,
    master: Wheelset,
    wheelsets: list[Wheelset],
    cals: list[ScheduledCalibration],
    scans: list[ScheduledScan],
) -> tuple[Path, Path]:
    """Truth tables: quantities of every production scan (Parquet), and everything else that was true (JSON)."""
    truths = [wheelset.truths() for wheelset in wheelsets]
    rows = [
        (scan.scan_id, wheelsets[scan.wheelset_index].wheelset_id, quantity, side, value)
        for scan in scans
        if scan.wheelset_index is not None
        for (quantity, side), value in truths[scan.wheelset_index].items()
    ]
    names = ("scan_id", "wheelset_id", "quantity", "side", "truth_mm")
    types = (pa.string(), pa.string(), pa.string(), pa.string(), pa.float64())
    columns = list(zip(*rows, strict=True)) if rows else [()] * 5
    table = pa.table({n: pa.array(list(c), t) for n, t, c in zip(names, types, columns, strict=True)})
    truth_path = _beside(plan, "truth.parquet")
    truth_path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, truth_path, compression="zstd")
    truth_rig_path = _beside(plan, "truth-rig.json")
    write_json(
        truth_rig_path,
        {
            "seed": plan.seed,
            "rig": {**asdict(rig), "sensors": [_true_sensor(s) for s in rig.sensors]},
            "noise": asdict(plan.noise),
            "wheelsets": [{k: v for k, v in asdict(w).items() if k != "pieces"} for w in (master, *wheelsets)],
            "calibrations": [{**asdict(c), "captured_at": c.captured_at.isoformat()} for c in cals],
            "scans": [{**asdict(s), "captured_at": s.captured_at.isoformat()} for s in scans],
        },
    )
    return truth_path, truth_rig_path


def _true_sensor(sensor: Sensor) -> dict[str, Any]:
    """A sensor as plain lists, matrices as nested rows."""
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(sensor).items()}
