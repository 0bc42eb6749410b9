"""Execution of one stage over one unit: get, run, audit, publish. The same for all stages; runs in worker processes.

A task carries paths, headers and small tables, never clouds. What a stage says it needs is read here and nowhere else.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa

from warehouse import nominal, place, store
from warehouse.audit import audit
from warehouse.bounds import as_disk_full, is_passing, with_retries
from warehouse.inbox import ScanReader, read_boards, read_frames
from warehouse.lineage import Output
from warehouse.travel import Tables
from wheelset_assets.bundle import CalibrationHeader, Rig, ScanHeader
from wheelset_assets.config import Config, Section
from wheelset_assets.declare import Stage
from wheelset_assets.quality import AlgorithmFailed, ScanUnusable
from wheelset_assets.stages import CONFIG_SECTIONS, STAGES
from wheelset_assets.stages.raw import Reference
from wheelset_assets.tables import TABLES

STAGE_BY_NAME = {stage.name: stage for stage in STAGES}


@dataclass(frozen=True)
class Task:
    """One stage over one unit, ready to be sent to a worker."""

    root: Path
    stage: str
    unit: str
    day: str
    config: Section
    table_paths: Mapping[str, str] = field(default_factory=dict)
    tables: Mapping[str, pa.Table] = field(default_factory=dict)
    bundle_folder: Path | None = None
    bundle_files: Mapping[str, str] = field(default_factory=dict)
    """Names of the bundle's files, with the sha256 that they had when it was verified."""
    scan: ScanHeader | None = None
    calibration: CalibrationHeader | None = None
    rig: Rig | None = None
    reference: Reference | None = None
    flushed: bool = True
    """Whether what it writes must be on disk when it ends; else whoever puts it on record flushes it."""


@dataclass(frozen=True)
class Outcome:
    """What became of a task: outputs written as files, light tables to be merged by day, or why it could not be done."""

    unit: str
    stage: str
    state: str
    reason: str | None = None
    outputs: tuple[Output, ...] = ()
    light: Mapping[str, pa.Table] = field(default_factory=dict)
    seconds: float = 0.0
    points: int = 0
    warnings: tuple[str, ...] = ()
    compute_seconds: float = 0.0
    """Seconds in the stage's own function; the rest of `seconds` is reading, checking and writing."""
    passing: bool = False
    """Whether the failure says nothing of the scan: a disk or network that did not answer. The next run tries again."""


def stage_config(config: Config, stage: Stage) -> Section:
    """The section of the configuration that a stage reads."""
    section: Section = getattr(config, CONFIG_SECTIONS[stage.name])
    return section


def fingerprint(stage: Stage, config: Section, inputs: tuple[tuple[str, str], ...]) -> str:
    """Identity of a computation: stage, code version, configuration, and the version of every input."""
    return fingerprint_of(method(stage, config), inputs)


def method(stage: Stage, config: Section) -> tuple[str, str, str]:
    """What the computations of a stage have in common: its name, code version and configuration."""
    return stage.name, stage.code_version, config.fingerprint()


def fingerprint_of(common: tuple[str, str, str], inputs: tuple[tuple[str, str], ...]) -> str:
    """The same, with what its computations have in common given."""
    lines = [*common, *(f"{name}={value}" for name, value in inputs)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def execute(task: Task) -> Outcome:
    """Run a task. ScanUnusable and AlgorithmFailed become outcomes, and so does trouble with reading or writing that does
    not pass at the third try, and want of memory; a full disk stops the run; anything else is a bug and is raised.
    """
    try:
        return with_retries(lambda: _once(task))
    except MemoryError as error:
        return Outcome(task.unit, task.stage, "failed", f"out of memory: {str(error) or 'the limit of a worker'}")
    except OSError as error:
        if full := as_disk_full(error, task.root):
            raise full from error
        if is_passing(error):
            return Outcome(task.unit, task.stage, "failed", f"input or output: {error}", passing=True)
        if isinstance(error, FileNotFoundError) and _in_bundle(error, task):
            why = f"the bundle vanished while it was read: {error.filename}"
            return Outcome(task.unit, task.stage, "failed", why, passing=True)
        raise


def _in_bundle(error: FileNotFoundError, task: Task) -> bool:
    if task.bundle_folder is None:
        return False
    return not task.bundle_folder.exists() or str(error.filename or "").startswith(str(task.bundle_folder))


def _once(task: Task) -> Outcome:
    started = time.perf_counter()
    stage = STAGE_BY_NAME[task.stage]
    computed = 0.0
    try:
        with _staged(stage, task) as ready:
            got = _get(stage, ready)
            begun = time.perf_counter()
            try:
                produced = compute(stage, task, got)
            finally:
                computed = time.perf_counter() - begun
        if set(produced) != {table.name for table in stage.outputs}:
            raise RuntimeError(f"stage {stage.name} returned {sorted(produced)}")
        warnings: list[str] = []
        for table in stage.outputs:
            warnings += audit(table, produced[table.name])
        outputs, light = _publish(stage, task, produced)
    except ScanUnusable as error:
        return _stopped(task, "refused", error, started, computed)
    except AlgorithmFailed as error:
        return _stopped(task, "failed", error, started, computed)
    points = produced["triangulated_clouds"].num_rows if "triangulated_clouds" in produced else 0
    seconds = time.perf_counter() - started
    return Outcome(task.unit, stage.name, "ok", None, outputs, light, seconds, points, tuple(warnings), computed)


def _stopped(task: Task, state: str, error: Exception, started: float, computed: float) -> Outcome:
    seconds = time.perf_counter() - started
    return Outcome(task.unit, task.stage, state, str(error), seconds=seconds, compute_seconds=computed)


def compute(stage: Stage, task: Task, got: Mapping[str, Any]) -> Mapping[str, pa.Table]:
    """The stage's function over what was read: the one part of a task that is computation."""
    return stage.run(**got, config=task.config)


@contextmanager
def _staged(stage: Stage, task: Task) -> Iterator[Task]:
    """The task with the raw files of its bundle on this machine; those from object storage are hashed again."""
    folder = task.bundle_folder
    if folder is None or not place.is_remote(folder):
        yield task
        return
    names: list[str] = []
    if {"stripes", "boards"} & set(stage.raw_inputs):
        names = sorted(task.bundle_files)
    elif "frames" in stage.raw_inputs:
        names = ["frames.parquet"]
    shown = f"{folder.parent.name}/{folder.name}"
    with ExitStack() as stack:
        try:
            local = stack.enter_context(place.staged(folder, names))
        except FileNotFoundError as error:
            raise ScanUnusable(f"{shown}: a file is gone since it was verified: {error}") from error
        if changed := [name for name in names if store.sha256_file(local / name) != task.bundle_files[name].lower()]:
            raise ScanUnusable(f"{shown}/{changed[0]}: it changed since it was verified")
        yield replace(task, bundle_folder=local)


def _get(stage: Stage, task: Task) -> dict[str, Any]:
    """Everything that the stage declares: stored tables, small tables of the task, contents of the bundle."""
    got: dict[str, Any] = {}
    for name in (*stage.inputs, *stage.optional_inputs):
        if name in task.tables:
            got[name] = task.tables[name]
        elif name in task.table_paths:
            shared = TABLES[name].layout == "calibration"
            got[name] = (_read_shared if shared else store.read_table)(task.root, task.table_paths[name])
        elif name in stage.optional_inputs:
            got[name] = None
        else:
            raise RuntimeError(f"stage {stage.name} of {task.unit}: input {name} was not bound")
    for name in stage.raw_inputs:
        got[name] = _raw(name, task)
    return got


@lru_cache(maxsize=8)
def _read_shared(root: Path, path: str) -> pa.Table:
    """A stored table that many scans need, read once a worker: a file never changes under its name."""
    return store.read_table(root, path)


def _raw(name: str, task: Task) -> Any:
    if name in ("scan", "rig", "reference"):
        return getattr(task, name)
    if name == "nominal":
        return nominal.nominal(task.root, task.scan.wheelset.profile if task.scan else None)
    assert task.bundle_folder is not None
    if name == "frames":
        return read_frames(task.bundle_folder)
    if name == "stripes":
        assert task.rig is not None
        frames = read_frames(task.bundle_folder)
        return ScanReader(task.bundle_folder, list(task.bundle_files), task.rig, len(frames.angle_deg)).stripes()
    if name == "boards":
        assert task.calibration is not None
        return read_boards(task.bundle_folder, task.calibration, list(task.bundle_files))
    raise RuntimeError(f"unknown raw input {name}")


def _publish(stage: Stage, task: Task, produced: Mapping[str, pa.Table]) -> tuple[tuple[Output, ...], Tables]:
    outputs, light = [], Tables()
    for table in stage.outputs:
        data = produced[table.name]
        if table.layout in ("scan", "calibration", "fleet"):
            path, version, size = store.write_table(task.root, table, data, task.day, task.unit, flushed=task.flushed)
            outputs.append(Output(table.name, path, version, data.num_rows, size))
        else:
            data = _named(data, task.unit)
            light[table.name] = data
            outputs.append(Output(table.name, "", store.table_hash(data), data.num_rows, data.nbytes))
    return tuple(outputs), light


def _named(data: pa.Table, unit: str) -> pa.Table:
    """Light rows carry their unit as scan_id, so that a unit's rows can be found in a day's file."""
    index = data.schema.get_field_index("scan_id")
    return data.set_column(index, data.schema.field(index), pa.array([unit] * data.num_rows, pa.string()))
