"""Organised depth grids of a stored scan, or of one that is simulated and processed for the purpose."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipelines.recording.source import Source

    Array = NDArray[np.float64]

FILTERS = ("none", "median", "mean", "gaussian", "quadratic", "bilateral")


@dataclass(frozen=True)
class DepthGrid:
    """Triangulated depth (frames, rows) of one sensor's first line in mm, lateral place of its rows in the sensor, median
    standard uncertainty of a depth, correlation of neighbouring rows' noise, and what it is."""

    depth_mm: Array
    across_mm: Array
    noise_mm: float
    correlation: float
    of: str


@contextmanager
def scan_source(scan: str | None, warehouse: Path | None) -> Iterator[Source]:
    """The stored scan, or a small simulated campaign, processed as any other, that is gone afterwards."""
    from pipelines.recording.source import open_source
    from pipelines.settings import settings

    if scan:
        yield open_source(settings(None, warehouse).warehouse, scan, None)
        return
    from pipelines.runner import run
    from wheelset_assets.simulation import SimulationPlan, simulate

    print("no --scan: simulating and processing a small campaign …", file=sys.stderr)
    with tempfile.TemporaryDirectory() as folder:
        inbox = Path(folder) / "inbox"
        simulate(SimulationPlan(out=inbox, wheelsets=1, repeats=1, seed=1, frames=60, rows=512, board_poses=7))
        s = settings(inbox, Path(folder) / "warehouse")
        run(s)
        names = sorted(p.name for p in (inbox / "scans").iterdir() if "ref" not in p.name.lower())
        yield open_source(s.warehouse, names[0], None)


def depth_grid(source: Source, sensor: str | None) -> DepthGrid:
    """Depth of a sensor of the scan without outliers, before smoothing; default: the first wheel sensor with points."""
    import numpy as np

    from wheelset_assets.metrology import filtering
    from wheelset_assets.metrology.grids import nan_median
    from wheelset_assets.stages.cloud import grids

    cloud = source.table("triangulated_clouds")
    if cloud is None or cloud.num_rows == 0:
        raise ConfigError(f"scan {source.scan_id} has no triangulated cloud: {source.reason or 'it is not at hand'}")
    names = sorted(set(cloud["sensor_id"].unique().to_pylist()))
    wanted = sensor or next((n for n in names if "wheel" in n), names[0])
    if wanted not in names:
        raise ConfigError(f"scan {source.scan_id} has no sensor {wanted}; it has {', '.join(names)}")
    n_frames = int(cloud["frame"].to_numpy().max()) + 1
    grid = next(g for g in grids(cloud, n_frames) if g.sensor_id == wanted)
    gone = filtering.outliers(grid.z, 5.0, 11)
    z = np.where(gone, np.nan, grid.z)
    statistics: list[dict[str, Any]] = source.rows("stripe_statistics")
    length = next((r["noise_correlation_rows"] for r in statistics if r["sensor_id"] == wanted), None) or 1.0
    across = nan_median(grid.y, axis=0)
    return DepthGrid(
        z, across, float(np.nanmedian(grid.u_mm)), (length - 1) / (length + 1), f"{source.scan_id}, sensor {wanted}"
    )


def noise_um(depth_mm: Array) -> float:
    """Scatter of a point about the mean of its neighbours in the frames before and after, which share its place."""
    import numpy as np

    from wheelset_assets.metrology.grids import robust_scatter

    return robust_scatter(depth_mm[1:-1] - 0.5 * (depth_mm[:-2] + depth_mm[2:])) / float(np.sqrt(1.5)) * 1e3
