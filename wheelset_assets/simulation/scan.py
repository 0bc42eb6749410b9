"""One simulated scan: from a true wheelset and rig under given conditions to the files of a staged folder.

Here: angles of the frames, tracing of all sensors, noise, delivery as stripes or images. Not here: names, dates, JSON
(`campaign`), damage to finished files (`faults`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .bundle import write_frames, write_png, write_stripes
from .faults import IMAGE_FRAMES, Fault
from .images import render_frames
from .meridian import STEP_MM
from .noise import NoiseModel, add_noise, encoder_error_deg
from .plan import SimulationPlan
from .rig import Rig, Sensor
from .schedule import Conditions, ScheduledScan
from .streams import stream
from .stripes import Placement, Stripes, trace
from .wheelset import Surface, Wheelset

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Turn:
    """Angles (deg) of the frames, as the encoder reports them and as the body truly stood."""

    reported_deg: Array
    body_deg: Array


def turn_of(conditions: Conditions, frames: int, noise: NoiseModel, rng: np.random.Generator) -> Turn:
    """One revolution in equal steps: nominal positions, read with the encoder's error."""
    nominal = conditions.first_angle_deg + np.arange(frames) * 360.0 / frames
    return Turn(nominal + encoder_error_deg(nominal, noise, rng), nominal + conditions.body_zero_deg)


def placement_of(conditions: Conditions, wheelset: Wheelset) -> Placement:
    """Where the grown wheelset lies in the rig."""
    growth = 1.0 + wheelset.expansion_per_k * (conditions.wheelset_c - 20.0)
    return Placement(conditions.shift_mm, conditions.axis_mm, growth)


def perfect_stripes(
    wheelset: Wheelset,
    rig: Rig,
    sensor: Sensor,
    conditions: Conditions,
    body_deg: Array,
    hidden_parts: tuple[int, ...] = (),
    surface: Surface | None = None,
) -> list[Stripes]:
    """Noise-free stripes of one sensor, one item a laser line, under the conditions of a scan."""
    surface = surface or wheelset.surface(sensor.kind, sensor.side, node_step_mm(sensor))
    pose = sensor.rig_from_sensor_at(conditions.rig_c, rig.expansion_per_k)
    place = placement_of(conditions, wheelset)
    turned = np.deg2rad(body_deg)
    return [trace(surface, place, sensor, pose, plane, turned, hidden_parts) for plane in sensor.planes]


def node_step_mm(sensor: Sensor) -> float:
    """Nodes of the meridian a little finer than the image's rows on the surface, at most 0.2 mm apart."""
    return float(np.clip(0.7 * sensor.working_distance_mm / sensor.left.fy_px, STEP_MM, 0.2))


def write_scan(
    folder: Path, plan: SimulationPlan, rig: Rig, scan: ScheduledScan, wheelset: Wheelset, fault: Fault | None
) -> None:
    """All files of a scan but its JSON, into a staged folder."""
    fault = fault or Fault("none", "")
    wheelset = fault.wheelset(wheelset) if fault.wheelset else wheelset
    seen_by = fault.rig(rig) if fault.rig else rig
    frames = min(plan.frames, IMAGE_FRAMES) if fault.images_of else plan.frames
    turn = turn_of(scan.conditions, frames, plan.noise, stream(plan.seed, "encoder", *scan.key))
    write_frames(folder / "frames.parquet", turn.reported_deg)
    keep = _outside_gap(turn.body_deg, fault.gap_deg)
    for index, sensor in enumerate(seen_by.sensors):
        if fault.delivers and not fault.delivers(sensor, seen_by):
            continue
        as_images = plan.images or bool(fault.images_of and fault.images_of(sensor))
        hidden = fault.hidden_parts(sensor) if fault.hidden_parts else ()
        lines = perfect_stripes(wheelset, seen_by, sensor, scan.conditions, turn.body_deg, hidden)
        lines = _noisy(plan, scan, sensor, index, lines, as_images)
        if fault.empty:
            lines = [Stripes(line.left_u * np.nan, line.right_u * np.nan) for line in lines]
        if as_images:
            _write_images(folder, plan, scan, sensor, index, lines, keep)
        else:
            write_stripes(folder / "stripes" / f"{sensor.sensor_id}.parquet", lines, keep)


def _noisy(
    plan: SimulationPlan, scan: ScheduledScan, sensor: Sensor, index: int, lines: list[Stripes], as_images: bool
) -> list[Stripes]:
    """Noise of the centres; in images the camera's grey noise takes the place of the white part."""
    model = replace(plan.noise, white_px=0.0) if as_images else plan.noise
    width = sensor.image_size[0]
    return [
        add_noise(line, model, width, stream(plan.seed, "stripe", *scan.key, index, number))
        for number, line in enumerate(lines)
    ]


def _write_images(
    folder: Path,
    plan: SimulationPlan,
    scan: ScheduledScan,
    sensor: Sensor,
    index: int,
    lines: list[Stripes],
    keep: NDArray[np.bool_] | None,
) -> None:
    for camera, side in enumerate(("left", "right")):
        centres = [line.left_u if side == "left" else line.right_u for line in lines]
        rng = stream(plan.seed, "image", *scan.key, index, camera)
        rendered = render_frames(centres, sensor.image_size, plan.stripe_sigma_px, rng)
        for frame, image in enumerate(rendered):
            if keep is None or keep[frame]:
                write_png(folder / "images" / sensor.sensor_id / side / f"{frame:06d}.png", image)


def _outside_gap(body_deg: Array, gap_deg: float) -> NDArray[np.bool_] | None:
    """Which frames (F,) lie outside the gap, which begins at body angle 100 deg."""
    return None if gap_deg <= 0 else (body_deg - 100.0) % 360.0 >= gap_deg
