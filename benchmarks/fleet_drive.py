"""The process that is measured by `benchmarks.fleet_night`: one run through Dagster, and what it cost its driver.

With `recorded`, the stages' own functions are not called again for every copy of a template, nor for a calibration: what
they returned for the first is given back. Reading, checking, writing, ledger and Dagster are the program's, unchanged.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

RECORDED = "WHEELSET_BENCHMARK_RECORDED"
CPU = "WHEELSET_BENCHMARK_CPU"
"""Folder with a file a process, to which each computation adds a line: the processor seconds that it took."""


def watched(task: Any) -> Any:
    """`execute`, with the computation measured, and that of a template's copies looked up; runs in the workers."""
    from warehouse import execute

    execute.compute = _timed
    return execute.execute(task)


def _timed(stage: Any, task: Any, got: Mapping[str, Any]) -> Mapping[str, pa.Table]:
    begun = time.process_time()
    try:
        return _looked_up(stage, task, got) if RECORDED in os.environ else stage.run(**got, config=task.config)
    finally:
        with (Path(os.environ[CPU]) / str(os.getpid())).open("a", encoding="ascii") as file:
            file.write(f"{time.process_time() - begun}\n")


def _looked_up(stage: Any, task: Any, got: Mapping[str, Any]) -> Mapping[str, pa.Table]:
    if task.scan is None:
        name = task.calibration.calibration_id if task.calibration is not None else None
    elif name := task.scan.comment:
        name = f"{name}-{'first' if task.scan.scan_id == 'ref-0000' else task.scan.purpose}"
    if not name:
        return stage.run(**got, config=task.config)  # type: ignore[no-any-return]
    folder = Path(os.environ[RECORDED]) / stage.name / name
    if not folder.exists():
        made = stage.run(**got, config=task.config)
        staged = folder.with_name(f".{folder.name}-{os.getpid()}")
        staged.mkdir(parents=True, exist_ok=True)
        for name, table in made.items():
            with pa.OSFile(str(staged / name), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
                writer.write_table(table)
        try:
            staged.rename(folder)
        except OSError:  # another worker recorded it meanwhile
            return made  # type: ignore[no-any-return]
    found = {}
    for table in stage.outputs:
        with pa.OSFile(str(folder / table.name), "rb") as file:
            kept = pa.ipc.open_file(file).read_all()
            found[table.name] = kept if task.scan is None else _of_this_scan(kept, task)
    return found


def _of_this_scan(table: pa.Table, task: Any) -> pa.Table:
    """The recorded rows under this scan's own identifiers and times."""
    own = {
        "scan_id": task.unit,
        "wheelset_id": task.scan.wheelset.wheelset_id,
        "captured_at": task.scan.captured_at,
        "acquired_on": task.scan.acquired_on,
    }
    for name, value in own.items():
        if (index := table.schema.get_field_index(name)) >= 0:
            field = table.schema.field(index)
            values = pa.array([value] * table.num_rows, field.type)
            table = table.set_column(index, field, values)
    return table


def main(arguments: list[str]) -> int:
    """Run once: inbox, warehouse, workers, where recorded computations are (`-` computes everything), and perhaps `plain`."""
    from benchmarks.memory import peak_mb
    from pipelines.runner import run
    from pipelines.settings import settings
    from warehouse import night
    from warehouse.pool import one_thread

    inbox, warehouse, workers, folder, *plain = arguments
    one_thread()
    if folder != "-":
        os.environ[RECORDED] = folder
    night.execute = watched  # type: ignore[attr-defined]
    s = settings(Path(inbox), Path(warehouse), None, int(workers))
    with tempfile.TemporaryDirectory() as os.environ[CPU]:
        summary = _without_dagster(s) if plain else run(s)
        computed = [float(line) for file in Path(os.environ[CPU]).iterdir() for line in file.read_text().split()]
    print(json.dumps(summary.as_json() | {"driver_peak_mb": peak_mb(), "compute_cpu_seconds": round(sum(computed), 3)}))
    return 0


def _without_dagster(s: Any) -> Any:
    """What the runner does, stage by stage, without recordings."""
    from warehouse import catalog
    from warehouse.night import Night
    from wheelset_assets.stages import SCAN_STAGES

    with Night(s.warehouse, s.inbox, s.config, workers=s.workers) as night:
        night.prepare()
        night.run_calibrations()
        for day in night.days_with_work():
            for stage in SCAN_STAGES:
                night.run_stage(stage, day)
        night.run_fleet()
        catalog.update(night.root, night.ledger, night.state.inbox.reviews())
        return night.summary()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
