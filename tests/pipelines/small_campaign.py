"""Small campaigns for the tests of the whole program: simulate, run, copy."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from wheelset_assets.simulation import SimulationPlan, simulate

FAULTS = ("corrupt", "wrong-hash", "missing-image", "empty-stripes")


@dataclass(frozen=True)
class Campaign:
    """An inbox, the warehouse made from it, the spoiled scans, and the summary of the run."""

    inbox: Path
    warehouse: Path
    faults: dict[str, str]
    summary: dict

    def copy(self, to: Path) -> Campaign:
        """The same inbox and warehouse elsewhere, times of modification kept."""
        shutil.copytree(self.inbox, to / "inbox")
        shutil.copytree(self.warehouse, to / "warehouse")
        return Campaign(to / "inbox", to / "warehouse", self.faults, self.summary)


def simulated(out: Path, **changes: object) -> dict[str, str]:
    """A campaign small enough for tests: 36 frames x 384 rows; returns the faults."""
    plan = {"wheelsets": 2, "days": 2, "repeats": 2, "seed": 4, "frames": 36, "rows": 384, "board_poses": 7} | changes
    return simulate(SimulationPlan(out=out, **plan)).faults  # type: ignore[arg-type]


def run(inbox: Path, warehouse: Path, workers: int = 0, **options: object) -> dict:
    """A run as the command line does it; its summary. Without workers, as starting them takes longer than a small run."""
    from pipelines.runner import run as run_night
    from pipelines.settings import settings

    config, cluster = options.pop("config", None), options.pop("cluster", None)
    return run_night(settings(inbox, warehouse, config, workers, cluster), **options).as_json()  # type: ignore[arg-type]
