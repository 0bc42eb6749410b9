"""Inboxes and stages that cost nothing: valid bundles without physics, and outputs made up from their inputs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from warehouse import catalog, execute
from warehouse.execute import Outcome, Task
from warehouse.lineage import Ledger
from warehouse.night import Night
from warehouse.summary import Summary
from wheelset_assets.config import Config
from wheelset_assets.declare import Column, Table
from wheelset_assets.stages import SCAN_STAGES

WIDTH, HEIGHT, FRAMES = 40, 24, 4
SENSOR = "left_wheel_a"
Content = dict[str, Any]


def write_rig(inbox: Path, rig_id: str = "rig-1", **changes: Any) -> Path:
    """A rig with one wheel station, seen by one sensor."""
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 500], [0, 0, 0, 1]]
    sensor = {"sensor_id": SENSOR, "station": "left_wheel", "image_size": [WIDTH, HEIGHT], "laser_lines": 1}
    content = {
        "format": "wheelset-rig/1",
        "rig_id": rig_id,
        "stations": [{"station": "left_wheel", "kind": "wheel", "side": "left"}],
        "sensors": [sensor | {"T_rig_sensor": pose}],
        "expansion_per_k": 11.5e-6,
    }
    path = inbox / "rigs" / f"{rig_id}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content | changes))
    return path


def write_calibration(inbox: Path, name: str = "cal-1", **changes: Any) -> Path:
    """A calibration with one board image, which no fake stage looks at."""
    folder = inbox / "calibrations" / name
    board = folder / "boards" / SENSOR / "left" / "000.png"
    board.parent.mkdir(parents=True, exist_ok=True)
    board.write_bytes(b"no image")
    content = {
        "format": "wheelset-calibration/1",
        "calibration_id": name,
        "rig_id": "rig-1",
        "captured_at": "2025-03-01T08:00:00+01:00",
        "temperature_c": {"rig": 20.0},
        "board": {"type": "chessboard", "inner_corners": [9, 6], "square_mm": 10.0},
    }
    return seal(folder, "calibration.json", content | changes)


def write_scan(inbox: Path, name: str, captured_at: str, purpose: str = "production", **changes: Any) -> Path:
    """A scan with four frames of straight stripes."""
    folder = inbox / "scans" / name
    folder.mkdir(parents=True, exist_ok=True)
    write_frames(folder, range(FRAMES), [90.0 * i for i in range(FRAMES)])
    write_stripes(folder)
    content: Content = {
        "format": "wheelset-scan/1",
        "scan_id": name,
        "rig_id": "rig-1",
        "calibration_id": "cal-1",
        "captured_at": captured_at,
        "purpose": purpose,
        "wheelset": {"wheelset_id": "master" if purpose == "reference" else "WS-1", "type": "motor"},
        "temperature_c": {"wheelset": 20.0, "rig": 21.0},
    }
    if purpose == "reference":
        value = {"quantity": "wheel_diameter", "side": "left", "value_mm": 860.0, "expanded_uncertainty_mm": 0.002}
        content["certificate"] = [value]
    return seal(folder, "scan.json", content | changes)


def write_frames(folder: Path, frame: Iterable[int], angle: Iterable[float], kind: pa.DataType | None = None) -> None:
    """frames.parquet, `kind` being the type of the frame's number."""
    columns = {"frame": pa.array(list(frame), kind or pa.int32()), "angle_deg": pa.array(list(angle))}
    pq.write_table(pa.table(columns), folder / "frames.parquet")


def write_stripes(folder: Path, sensor: str = SENSOR, **columns: Any) -> Path:
    """Stripes of one sensor; columns given replace or add to the good ones, None leaves one out."""
    u = np.tile(np.linspace(5, 30, HEIGHT, dtype=np.float32), (FRAMES, 1))
    good = {
        "frame": pa.array(range(FRAMES), pa.int32()),
        "line": pa.array([0] * FRAMES, pa.int8()),
        "left_u": lists(u),
        "right_u": lists(u - 2),
    }
    path = folder / "stripes" / f"{sensor}.parquet"
    path.parent.mkdir(exist_ok=True)
    pq.write_table(pa.table({k: v for k, v in (good | columns).items() if v is not None}), path)
    return path


def lists(values: np.ndarray) -> pa.Array:
    """Rows of an array as fixed-size lists of float32."""
    flat = pa.array(np.asarray(values, np.float32).ravel())
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def seal(folder: Path, header: str = "scan.json", content: Content | None = None, **changes: Any) -> Path:
    """Write a bundle's JSON anew over the files that are there, with changes; returns the folder."""
    path = folder / header
    content = dict(content if content is not None else json.loads(path.read_text())) | changes
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p != path]
    hashes = {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    path.write_text(
        json.dumps({"files": hashes} | {k: v for k, v in content.items() if k != "files" or changes.get(k)})
    )
    return folder


def inbox_of(root: Path, *, days: Iterable[str] = ("2025-04-05",), scans: int = 2) -> Path:
    """An inbox with a rig, a calibration, and for each day a reference scan at 8 and scans from 9 o'clock."""
    write_rig(root)
    write_calibration(root)
    (root / "cmm").mkdir()
    for day in days:
        write_scan(root, f"ref-{day}", f"{day}T08:00:00+08:00", "reference")
        for i in range(scans):
            write_scan(root, f"scan-{day}-{i}", f"{day}T{9 + i:02}:00:00+08:00")
    return root


# --- stages that make their outputs up ---------------------------------------------------------------------------


def fake_row(table: Table, task: Task) -> Content:
    """A row within the declared limits; its first number depends on the stage, the unit, the inputs and the knobs."""
    content = [table.name, task.unit, task.config.fingerprint(), *sorted(task.table_paths.values())]
    for name, data in sorted(task.tables.items()):
        if table.name != "readings" or not name.startswith("reference_"):  # a reading knows no reference
            content.append(f"{name} {execute.store.table_hash(data)}")
    if task.bundle_folder is not None:
        content += [hashlib.sha256((task.bundle_folder / n).read_bytes()).hexdigest() for n in task.bundle_files]
    number = int(hashlib.sha256("\n".join(content).encode()).hexdigest()[:6], 16) / 1000
    known: Content = {"scan_id": task.unit, "calibration_id": task.unit, "quantity": "wheel_diameter", "side": "left"}
    if task.scan is not None:
        known |= {
            "calibration_id": task.scan.calibration_id,
            "rig_id": task.scan.rig_id,
            "wheelset_id": task.scan.wheelset.wheelset_id,
            "purpose": task.scan.purpose,
            "captured_at": task.scan.captured_at,
            "acquired_on": task.scan.acquired_on,
        }
    known |= {"value": number, "expanded_uncertainty": 0.01, "unit": "mm", "share": 1.0}
    return {c.name: known.get(c.name, _made_up(c, number)) for c in table.columns}


def _made_up(column: Column, number: float) -> Any:
    if column.nullable:
        return None
    if column.values:
        return column.values[0]
    if column.type.startswith("float") and column.type in ("float32", "float64"):
        low = column.minimum or 0.0
        return low + (number % 1000 if column.maximum is None else (number % 1) * (column.maximum - low))
    constants: Mapping[str, Any] = {
        "bool": True,
        "string": "x",
        "category": "x",
        "strings": [],
        "float64s": [number],
        "float32x33": [0.0] * 33,
        "date": date(2025, 4, 5),
        "timestamp": datetime(2025, 4, 5, tzinfo=UTC),
    }
    return constants.get(column.type, int(column.minimum or 0))


class FakeStages:
    """Stands in for `execute`: counts what it is asked for; `failing` maps (stage, unit) to a reason."""

    def __init__(self) -> None:
        self.ran: list[tuple[str, str]] = []
        self.failing: dict[tuple[str, str], str | Exception] = {}

    def __call__(self, task: Task) -> Outcome:
        self.ran.append((task.stage, task.unit))
        why = self.failing.get((task.stage, task.unit))
        if isinstance(why, Exception | KeyboardInterrupt):
            raise why
        if why is not None:
            return Outcome(task.unit, task.stage, "failed", why)
        stage = execute.STAGE_BY_NAME[task.stage]
        produced = {table.name: table.from_rows([fake_row(table, task)]) for table in stage.outputs}
        outputs, light = execute._publish(stage, task, produced)
        return Outcome(task.unit, task.stage, "ok", None, outputs, light, 0.25, 10 if stage is SCAN_STAGES[0] else 0)

    def take(self) -> list[tuple[str, str]]:
        """What ran since the last call."""
        ran, self.ran = self.ran, []
        return ran


def run_night(inbox: Path, warehouse: Path, config: Config | None = None, **options: Any) -> Summary:
    """A run in this process, without Dagster, recordings, worker processes or catalog (`rows` builds it when asked)."""
    with Night(warehouse, inbox, config or Config(), workers=0, wait_seconds=0, **options) as night:
        night.prepare()
        night.run_calibrations()
        for day in night.days_with_work():
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
        night.run_fleet()
        return night.summary()


def counts(summary: Summary) -> tuple[int, int, int, int]:
    """measured, refused, failed, unchanged."""
    return summary.measured, summary.refused, summary.failed, summary.unchanged


def rows(warehouse: Path, query: str) -> list[tuple]:
    """Rows of a query over the catalog, built anew if the ledger is newer."""
    import duckdb

    ledger, built = Ledger(warehouse), warehouse / catalog.NAME
    if not built.exists() or any(Path(p).stat().st_mtime_ns > built.stat().st_mtime_ns for p in ledger.files()):
        catalog.build(warehouse, ledger)
    with duckdb.connect(str(warehouse / catalog.NAME), read_only=True) as connection:
        return connection.execute(query).fetchall()


def states(warehouse: Path) -> dict[str, tuple[str, str | None]]:
    """State and reason of every scan."""
    return {s: (state, why) for s, state, why in rows(warehouse, "SELECT scan_id, state, reason FROM scan_status")}
