"""Deliberate faults: each kind spoils one production scan in a way that a pipeline must survive.

Here: what each kind does to the wheelset, the rig, the delivery, the files or the JSON. Not here: which scan it strikes
(`campaign`). Kinds that spoil physics keep the bundle valid; kinds that spoil files leave the physics alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from .meridian import INNER_FACE
from .profiles import DATUM_MM
from .rig import Rig, Sensor
from .wheelset import Patch, Wheelset

Content = dict[str, Any]
IMAGE_FRAMES = 12  # an image-delivered faulty scan stays small


@dataclass(frozen=True)
class Scene:
    """What a fault may look at when it strikes a finished scan: its folder, and when the first reference was taken."""

    folder: Path
    first_reference_at: datetime


@dataclass(frozen=True)
class Fault:
    """One kind: `files` strikes the staged folder before hashing, `json` the content after it (bytes: as they are)."""

    kind: str
    what: str
    wheelset: Callable[[Wheelset], Wheelset] | None = None
    rig: Callable[[Rig], Rig] | None = None
    delivers: Callable[[Sensor, Rig], bool] | None = None
    images_of: Callable[[Sensor], bool] | None = None
    hidden_parts: Callable[[Sensor], tuple[int, ...]] | None = None
    gap_deg: float = 0.0
    empty: bool = False
    files: Callable[[Path], None] | None = None
    json: Callable[[Content, Scene], Content | bytes] | None = None


def _first_file(folder: Path) -> Path:
    """A stripe file, or an image where there are none."""
    return min((folder / "stripes").glob("*.parquet"), default=min(folder.rglob("*.png"), default=folder))


def _first_listed(content: Content) -> str:
    stripes = sorted(name for name in content["files"] if name.startswith("stripes/"))
    return stripes[0] if stripes else min(name for name in content["files"] if name.startswith("images/"))


def _cut_file_off(folder: Path) -> None:
    path = _first_file(folder)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 5])  # a Parquet file's footer is at its end


def _wrong_hash(content: Content, scene: Scene) -> Content:
    name, files = _first_listed(content), content["files"]
    return {**content, "files": {**files, name: files[name][::-1]}}


def _remove_image(content: Content, scene: Scene) -> Content:
    listed = sorted(name for name in content["files"] if name.startswith("images/"))
    (scene.folder / listed[len(listed) // 3]).unlink()
    return content


def _cut_json_off(content: Content, scene: Scene) -> bytes:
    text = json.dumps(content, indent=1)
    return text[: len(text) * 2 // 3].encode()


def _drop_temperature(content: Content, scene: Scene) -> Content:
    return {key: value for key, value in content.items() if key != "temperature_c"}


def _add_unlisted(content: Content, scene: Scene) -> Content:
    source = _first_file(scene.folder)
    source.with_stem("leftover").write_bytes(source.read_bytes())
    return content


def _list_outsider(content: Content, scene: Scene) -> Content:
    name, files = _first_listed(content), content["files"]
    return {**content, "files": {**files, f"../../elsewhere/{Path(name).name}": files[name]}}


def _rename_calibration(content: Content, scene: Scene) -> Content:
    return {**content, "calibration_id": f"{content['calibration_id']}-unknown"}


def _before_any_reference(content: Content, scene: Scene) -> Content:
    return {**content, "captured_at": (scene.first_reference_at - timedelta(hours=1)).isoformat()}


def _grease(wheelset: Wheelset) -> Wheelset:
    blob = Patch(np.deg2rad(70.0), np.deg2rad(12.5), 0.15, DATUM_MM, 18.0)
    left, right = wheelset.wheels
    return replace(wheelset, wheels=(replace(left, patches=(*left.patches, blob)), right))


def _is_last_of_left_wheel(sensor: Sensor, rig: Rig) -> bool:
    return sensor is [s for s in rig.sensors if s.station == "left_wheel"][-1]


def _move_sensor(rig: Rig) -> Rig:
    """0.1 mm in the sensor's meridian plane: 0.06 mm laterally and 0.08 mm away from the axle."""
    sensors = []
    for sensor in rig.sensors:
        radial = sensor.rig_from_sensor_nominal[:3, 3] * np.array([0.0, 1.0, 1.0])
        shift = np.array([0.06, 0.0, 0.0]) + 0.08 * radial / np.linalg.norm(radial)
        sensors.append(sensor.moved(shift) if _is_last_of_left_wheel(sensor, rig) else sensor)
    return replace(rig, sensors=tuple(sensors))


def _left_inner_face(sensor: Sensor) -> tuple[int, ...]:
    return (INNER_FACE,) if sensor.side == "left" else ()


# fmt: off
FAULTS: dict[str, Fault] = {
    fault.kind: fault
    for fault in (
        Fault("corrupt", "a stripe file is cut off, its hash is that of the damaged bytes", files=_cut_file_off),
        Fault("wrong-hash", "a stripe file's listed hash is not its own", json=_wrong_hash),
        Fault("missing-image", "the left journal is delivered as images, one listed image is absent",
              images_of=lambda sensor: sensor.station == "left_journal", json=_remove_image),
        Fault("empty-stripes", "no sensor saw any stripe", empty=True),
        Fault("bad-json", "scan.json is cut off", json=_cut_json_off),
        Fault("missing-key", "scan.json lacks temperature_c", json=_drop_temperature),
        Fault("unlisted-file", "the folder holds a file that is not listed", json=_add_unlisted),
        Fault("path-escape", "a listed path leaves the scan's folder", json=_list_outsider),
        Fault("missing-sensor", "the left wheel's last sensor delivered nothing, and nothing of it is listed",
              delivers=lambda sensor, rig: not _is_last_of_left_wheel(sensor, rig)),
        Fault("missing-station", "the right journal's station delivered nothing",
              delivers=lambda sensor, rig: sensor.station != "right_journal"),
        Fault("sector-gap", "40 degrees of the turn without data", gap_deg=40.0),
        Fault("grease", "0.15 mm of grease on the left datum circle over 25 degrees", wheelset=_grease),
        Fault("inner-face-unseen", "the left inner face gave no light back", hidden_parts=_left_inner_face),
        Fault("unknown-calibration", "the calibration that is named does not exist", json=_rename_calibration),
        Fault("no-reference", "captured before the rig's first reference scan", json=_before_any_reference),
        Fault("moved-sensor", "the left wheel's last sensor moved by 0.1 mm after the reference", rig=_move_sensor),
    )
}
# fmt: on
