"""What the experiments share: where profiles and clouds come from, and how a result is printed, stored and drawn."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.options import print_json
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

OutOption = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="DIR", help="Folder for Parquet and figure [default: experiments]", show_default=False
    ),
]
ScanOption = Annotated[
    str | None, typer.Option("--scan", metavar="SCAN", help="A stored scan of the warehouse instead of simulated data")
]
SensorOption = Annotated[
    str | None,
    typer.Option("--sensor", help="Sensor of that scan [default: its first wheel sensor]", show_default=False),
]
StationOption = Annotated[
    str | None,
    typer.Option("--station", help="Station of that scan [default: its first wheel station]", show_default=False),
]
FigureOption = Annotated[str, typer.Option("--figure", help="Kind of the figure: png, svg or pdf")]
NOISE_MM = 0.003
"""Noise of the simulated profiles across the line: about that of a mean meridian's rows in a scan of 60 frames."""
STEP_MM = 0.15


def simulated_profile(name: str = "S1002") -> Array:
    """A nominal wheel profile (n, 2), lateral and height in mm, in even steps of arc length."""
    import numpy as np

    from configs import nominal_profile

    s, z = nominal_profile(name)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(s), np.diff(z)))])
    at = np.arange(0.0, arc[-1], STEP_MM)
    return np.column_stack([np.interp(at, arc, s), np.interp(at, arc, z)])


def stored_profile(root: Path, scan_id: str, station: str | None) -> tuple[Array, str]:
    """Mean meridian (n, 2) of a stored scan's station, about its middle, and what it is. The sensor that saw most of it."""
    import numpy as np

    from pipelines.recording.source import open_source

    source = open_source(root, scan_id, None)
    table = source.table("fused_profiles")
    if table is None or table.num_rows == 0:
        raise ConfigError(f"scan {scan_id} has no fused profile: {source.reason or 'it did not reach registration'}")
    names = list(dict.fromkeys(table["station"].to_pylist()))
    wanted = station or next((n for n in names if "wheel" in n), names[0])
    if wanted not in names:
        raise ConfigError(f"scan {scan_id} has no station {wanted}; it has {', '.join(names)}")
    rows = [r for r in table.to_pylist() if r["station"] == wanted]
    views: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        views.setdefault((row["sensor_id"], row["line"]), []).append(row)
    best = max(views, key=lambda v: len(views[v]))
    found = sorted(views[best], key=lambda r: r["row"])
    curve = np.array([[r["lateral_mm"], r["radial_mm"]] for r in found])
    return curve - curve.mean(axis=0), f"{scan_id}, {wanted}, sensor {best[0]}"


def write(
    rows: Sequence[dict[str, Any]], figure: Figure | None, out: Path | None, name: str, kind: str
) -> dict[str, str]:
    """Rows as `DIR/NAME.parquet`, the figure beside it; returns where they lie."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if kind not in ("png", "svg", "pdf"):
        raise ConfigError(f"--figure {kind}: known are png, svg and pdf")
    folder = out or Path("experiments")
    folder.mkdir(parents=True, exist_ok=True)
    places = {"parquet": str(folder / f"{name}.parquet")}
    pq.write_table(pa.Table.from_pylist(list(rows)), places["parquet"])
    if figure is not None:
        places["figure"] = str(folder / f"{name}.{kind}")
        figure.savefig(places["figure"], dpi=120, metadata={"Date": None} if kind == "svg" else None)
    return places


def computed(
    function: Callable[[Any], list[dict[str, Any]]], jobs: Sequence[Any], workers: int
) -> list[dict[str, Any]]:
    """Rows of a function over jobs in their order, in worker processes, with progress on standard error."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from rich.console import Console
    from rich.progress import track

    quiet = Console(file=sys.stderr)
    rows: list[dict[str, Any]] = []
    if workers == 1:
        for job in track(jobs, "draws", console=quiet):
            rows += function(job)
        return rows
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        # Neighbours share a rig, so they go to one worker.
        for found in track(pool.map(function, jobs, chunksize=10), "draws", total=len(jobs), console=quiet):
            rows += found
    return rows


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    """A figure without a display, and its axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def tell(
    title: str, headings: Sequence[str], lines: Sequence[Sequence[str]], notes: Sequence[str], places: dict[str, str],
    document: dict[str, Any], as_json: bool,
) -> None:  # fmt: skip
    """The table, its notes and where the files lie; or one JSON document. A line of one cell begins a section."""
    if as_json:
        print_json(document | {"files": places})
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="right" if k else "left", overflow="fold")
    for line in lines:
        if len(line) == 1:
            table.add_section()
            table.add_row(line[0], style="bold")
        else:
            table.add_row(*line)
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    for note in notes:
        print(note)
    print("written: " + ", ".join(places.values()))
