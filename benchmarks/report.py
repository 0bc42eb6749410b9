"""Renders a benchmark's results as Markdown; every number is in the results already."""

from __future__ import annotations

from statistics import median
from typing import Any

from benchmarks.compare import STEPS_BY_STAGE, peer_seconds
from benchmarks.processes import MEMORY_NOTE

NO_RATE = ("calibrations", "verify", "repeatability")


def markdown(results: dict[str, Any]) -> str:
    """The whole report."""
    parts = [
        "# What one main job costs",
        _head(results),
        "## Stages, one process, one thread",
        _stages(results),
        "## The whole job",
        _whole(results),
        "## Bytes stored",
        _bytes(results),
        "## Beside OpenCV and Open3D",
        _peer(results),
        "## Errors against the truth",
        _errors(results),
    ]
    return "\n\n".join(parts) + "\n"


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table, padded so that it reads as plain text too; the first column is text, the others numbers."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    rule = "|" + "|".join("-" * (w + 2) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    first, *rest = (
        [_pad(cell, w, i) for i, (cell, w) in enumerate(zip(row, widths, strict=True))] for row in [header, *rows]
    )
    return "\n".join([_line(first), rule, *(_line(row) for row in rest)])


def _pad(cell: str, width: int, column: int) -> str:
    return cell.ljust(width) if column == 0 else cell.rjust(width)


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits, thousands apart; a dash for nothing."""
    if value is None:
        return "-"
    if value == 0 or abs(value) >= 10 ** (digits - 1):
        return f"{value:,.0f}"
    return f"{value:.{digits}g}" if abs(value) >= 1e-3 else f"{value:.1e}"


def seconds(values: list[float]) -> str:
    """Median, with the range if there is one."""
    middle = number(median(values))
    return middle if len(values) == 1 else f"{middle} ({number(min(values))}-{number(max(values))})"


def _head(results: dict[str, Any]) -> str:
    machine, data = results["machine"], results["data"]
    facts = [
        f"- Machine: {machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB, {machine['system']}",
        f"- Software: Python {machine['python']}, {machine['packages']}; commit {machine['commit']}",
        f"- Command: `{results['command']}`",
        f"- Job: {data['sensors']} sensors, {data['frames']} frames of {data['rows']} rows, "
        f"{data['points']:,} triangulated points; calibration from {data['board_poses']} board poses a sensor",
        f"- Repeats: {results['repeats']}; seconds are medians, with the range in brackets",
    ]
    return "\n".join(facts)


def _stages(results: dict[str, Any]) -> str:
    points, rows = results["data"]["points"], []
    for name, timing in results["stages"].items():
        rate = None if name in NO_RATE else points / median(timing["seconds"])
        rows.append([name, seconds(timing["seconds"]), number(rate), number(timing["peak_mb"])])
    whole = results["end_to_end"]
    rows.append(
        ["stages 2-7, bundle to values", seconds(whole["seconds"]), number(whole["points_per_second"]["median"]), ""]
    )
    note = (
        "Each with reading its inputs, its checks, and its Parquet files. `verify` hashes the bundle. Peak: resident "
        "memory of the process while the stage ran, libraries and leftovers of earlier stages included."
    )
    return table(["stage", "seconds", "points/s", "peak MB"], rows) + "\n\n" + note


def _whole(results: dict[str, Any]) -> str:
    labels = {
        "calibration": "calibration alone",
        "night": "reference and wheelset scan",
        "scan": "wheelset scan alone",
    }
    rows = []
    for name, run in results["command_line"].items():
        rate = run["points"] / median(run["seconds"]) if run["points"] else None
        rows.append(
            [
                labels[name],
                seconds(run["seconds"]),
                number(rate),
                number(run["peak_tree_mb"]),
                number(run["peak_process_mb"]),
            ]
        )
    header = ["`wheelset run`, 2 workers", "seconds", "points/s", "peak MB, all", "peak MB, largest"]
    return table(header, rows) + f"\n\nWall clock from the start of the command to its end. Peak of all: {MEMORY_NOTE}."


def _bytes(results: dict[str, Any]) -> str:
    stored = results["bytes_per_point"]
    rows = [[name, number(size)] for name, size in stored["tables"].items() if size >= 5e-4]
    rest = sum(size for size in stored["tables"].values() if size < 5e-4)
    rows += [
        ["all others", number(rest)],
        ["in all", number(stored["total"])],
        ["the bundle as delivered", number(stored["bundle"])],
    ]
    return table(["table", "bytes a point"], rows)


def _peer(results: dict[str, Any]) -> str:
    peer = results["peer"]
    if not peer["available"]:
        return f"No peer: {peer['reason']}."
    rows = []
    for stage, steps in STEPS_BY_STAGE.items():
        rows.append(_beside(stage, results["stages"][stage]["seconds"], peer_seconds(peer, stage), ", ".join(steps)))
    rows.append(_beside("all of these", results["end_to_end"]["seconds"], peer_seconds(peer), ""))
    header = ["stage", "wheelset s", "peer s", "peer CPU s", "peer / wheelset", "the peer's steps"]
    steps = [[name, _step(step)] for name, step in peer["steps"].items()]
    parameters = ", ".join(f"{name} {value}" for name, value in peer["parameters"].items())
    limits = f"Limit of a step: {peer['limit_seconds']:g} s. Peak memory {number(peer['peak_tree_mb'])} MB."
    notes = [
        "The peer triangulates all sensors and does the rest for the wheel stations alone; it states no uncertainty, "
        "checks and stores nothing, and may use all cores, where wheelset had one thread. `icp_from_nominal` and "
        "`master` are in no sum.",
        f"{limits} Parameters: {parameters}.",
    ]
    return "\n\n".join([table(header, rows), table(["the peer's step", "seconds"], steps), *notes])


def _beside(label: str, ours: list[float], theirs: dict[str, Any], steps: str) -> list[str]:
    more = "" if theirs["complete"] else "> "
    ratio = theirs["seconds"] / median(ours)
    if not theirs["complete"] and theirs["seconds"] == 0:
        return [label, seconds(ours), "-", "-", "-", steps]
    cpu = number(theirs["cpu_seconds"])
    return [label, seconds(ours), more + number(theirs["seconds"]), more + cpu, more + number(ratio), steps]


def _step(step: dict[str, Any]) -> str:
    return number(step["seconds"]) if step["state"] == "done" else f"{step['state']}: {step.get('reason', '')}"


def _errors(results: dict[str, Any]) -> str:
    accuracy = results["accuracy"]
    keys = ("lateral_um", "radial_um", "meridian_deg", "total_deg", "displacement_mm")
    poses = [[f"{e['station']}, {e['method']}", *(number(e[k]) for k in keys)] for e in accuracy["registration"]]
    diameters = [
        [f"{e['side']}, {e['method']}", number(e["error_um"]), number(e["expanded_uncertainty_um"])]
        for e in accuracy["wheel_diameter"]
    ]
    header = [
        "pose of the second sensor in the first",
        "lateral um",
        "radial um",
        "meridian deg",
        "total deg",
        "shift mm",
    ]
    note = (
        "Lateral, radial and meridian rotation are what a stripe can tell; the total rotation and the shift count the "
        "turn about the axle, too, which no method can see on a surface of revolution."
    )
    return "\n\n".join([table(header, poses), note, table(["wheel diameter", "error um", "claimed U um"], diameters)])
