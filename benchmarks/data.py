"""The benchmark's data: a simulated rig, its calibration, a reference scan and one wheelset scan, kept between runs.

Here: simulation into a cache folder, the part-inboxes that let a run begin in the middle, what the bundles state. Not
here: the truth's comparison with results (`truth`), any timing.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import wheelset_assets.simulation as simulation

SEED = 11
RIG = "bench"


@dataclass(frozen=True)
class Data:
    """Places and names of one simulated campaign."""

    folder: Path
    scan_id: str
    reference_id: str
    calibration_id: str
    rig_id: str

    @property
    def inbox(self) -> Path:
        """Rig, calibration, reference scan and wheelset scan."""
        return self.folder / "inbox"

    @property
    def calibration_inbox(self) -> Path:
        """The same files without any scan."""
        return self.folder / "inbox-calibration"

    @property
    def reference_inbox(self) -> Path:
        """The same files without the wheelset scan."""
        return self.folder / "inbox-reference"

    @property
    def bundle(self) -> Path:
        """Folder of the wheelset scan."""
        return self.inbox / "scans" / self.scan_id

    @property
    def truth(self) -> Path:
        """True quantities of the scan."""
        return self.folder / "inbox.truth.parquet"

    @property
    def truth_rig(self) -> dict[str, Any]:
        """True poses and conditions."""
        return json.loads((self.folder / "inbox.truth-rig.json").read_text(encoding="utf-8"))

    def bundle_bytes(self) -> int:
        """Size of the wheelset scan as delivered."""
        return folder_bytes(self.bundle)


def prepared(root: Path, frames: int, rows: int, board_poses: int) -> Data:
    """The campaign of this size in `root`: taken from there, or simulated if the simulator's code is new to it."""
    name = f"{RIG}-{frames}x{rows}-{board_poses}-seed{SEED}-{_simulator_version()}"
    folder = root / name
    if not (folder / "data.json").exists():
        partial = root / f".partial-{os.getpid()}-{name}"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        _simulate(partial, frames, rows, board_poses)
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)
    facts = json.loads((folder / "data.json").read_text(encoding="utf-8"))
    return Data(folder, **facts)


def _simulate(folder: Path, frames: int, rows: int, board_poses: int) -> None:
    plan = simulation.SimulationPlan(
        out=folder / "inbox",
        wheelsets=1,
        days=1,
        repeats=1,
        seed=SEED,
        rig=RIG,
        frames=frames,
        rows=rows,
        board_poses=board_poses,
    )
    made = simulation.simulate(plan)
    for name, scans in (("inbox-calibration", ()), ("inbox-reference", made.reference_scan_ids)):
        for part in ("rigs", "calibrations", "cmm"):
            link_tree(folder / "inbox" / part, folder / name / part)
        (folder / name / "scans").mkdir()
        for scan_id in scans:
            link_tree(folder / "inbox" / "scans" / scan_id, folder / name / "scans" / scan_id)
    facts = {
        "scan_id": made.production_scan_ids[0],
        "reference_id": made.reference_scan_ids[0],
        "calibration_id": made.calibration_ids[0],
        "rig_id": made.rig_id,
    }
    (folder / "data.json").write_text(json.dumps(facts), encoding="utf-8")


def _simulator_version() -> str:
    """Changes with any file of the simulator, so that no cache outlives the code that filled it."""
    home = Path(simulation.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(home.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:10]


def link_tree(source: Path, target: Path) -> None:
    """The same files under another name, size and time unchanged: hard links, or copies where there are none."""
    shutil.copytree(source, target, copy_function=_link)


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def folder_bytes(folder: Path) -> int:
    """Sum of the sizes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
