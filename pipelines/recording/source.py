"""One scan as the warehouse has it: records, tables, rig, calibration, poses and angles. No viewer is known here.

Poses are composed from stored transforms; nothing is estimated again. What is not there is None, and `notes` say why.
"""

from __future__ import annotations

import difflib
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from warehouse import place, store
from warehouse.inbox import read_frames
from warehouse.light import LIGHT, LightTables
from warehouse.lineage import BUNDLE, CALIBRATION_DAY, Ledger, Record
from warehouse.state import PRODUCER, UNDATED
from wheelset_assets.bundle import Rig, ScanHeader
from wheelset_assets.metrology.thermal import grown_pose, growth
from wheelset_assets.quality import ConfigError, ScanUnusable
from wheelset_assets.stages import CALIBRATION, SCAN_STAGES
from wheelset_assets.stages.geometry import scan_geometry
from wheelset_assets.stages.pose import standing
from wheelset_assets.tables import ALIGNMENTS, STRIPE_STATISTICS

Array = NDArray[np.float64]


@dataclass
class Source:
    """A scan of a warehouse: its current records by stage, and what follows from them."""

    root: Path
    scan_id: str
    day: str
    ledger: Ledger
    records: dict[str, Record]
    inbox: Path | None = None
    notes: list[str] = field(default_factory=list)
    _tables: dict[str, pa.Table | None] = field(default_factory=dict)
    _stack: ExitStack = field(default_factory=ExitStack)

    def close(self) -> None:
        """Give up what was fetched from object storage."""
        self._stack.close()

    # --- what became of it ---------------------------------------------------------------------------------------

    @cached_property
    def deciding(self) -> Record:
        """The record that stopped the scan, or else its last one."""
        ordered = [self.records[name] for name in (BUNDLE, *(s.name for s in SCAN_STAGES)) if name in self.records]
        return next((r for r in ordered if not r.ok), ordered[-1])

    @property
    def state(self) -> str:
        """measured, refused, failed or pending, as in scan_status."""
        if not self.deciding.ok:
            return self.deciding.state
        return "measured" if all(s.name in self.records for s in SCAN_STAGES) else "pending"

    @property
    def stage(self) -> str:
        """Stage that stopped the scan, or the last one that it passed."""
        return self.deciding.stage

    @property
    def reason(self) -> str | None:
        """Why the scan was stopped; details follow on further lines."""
        return None if self.deciding.ok else self.deciding.reason or "no reason on record"

    # --- what describes it ---------------------------------------------------------------------------------------

    @cached_property
    def header(self) -> ScanHeader | None:
        """The scan's own JSON, if its bundle was accepted."""
        text = self.records[BUNDLE].header
        return ScanHeader.model_validate_json(text) if text else None

    @cached_property
    def rig(self) -> Rig | None:
        """The rig as it was declared when the scan was processed."""
        if self.header is None:
            return None
        calibration = self.ledger.day(CALIBRATION_DAY).get(self.header.calibration_id, CALIBRATION.name)
        for record in (*reversed(self.records.values()), *([calibration] if calibration else [])):
            sha = dict(record.inputs).get("rig")
            path = self.root / "_rigs" / f"{sha}.json"
            if sha and path.is_file():
                rig = Rig.model_validate_json(path.read_text(encoding="utf-8-sig"))
                if rig.rig_id == self.header.rig_id:
                    return rig
        for path in sorted((self.root / "_rigs").glob("*.json"), key=lambda p: p.stat().st_mtime, reverse=True):
            rig = Rig.model_validate_json(path.read_text(encoding="utf-8-sig"))
            if rig.rig_id == self.header.rig_id:
                self.notes.append(
                    f"No stage noted which declaration of rig {rig.rig_id} it saw; the newest one that is kept is drawn."
                )
                return rig
        self.notes.append(
            f"The declaration of rig {self.header.rig_id} is not on record: no cameras, no places in the rig."
        )
        return None

    @cached_property
    def calibration(self) -> Record | None:
        """Record of the scan's calibration."""
        return (
            self.ledger.day(CALIBRATION_DAY).get(self.header.calibration_id, CALIBRATION.name) if self.header else None
        )

    @cached_property
    def calibrations(self) -> pa.Table | None:
        """Calibrated sensors, refused ones included; None if the calibration made no table."""
        return self.calibration_table(CALIBRATION.name)

    def calibration_table(self, name: str) -> pa.Table | None:
        """A table of the calibration that the scan names; None if it was not made, or if its file is gone."""
        if self.calibration is None or not self.calibration.ok:
            return None
        return self._read(name, self.calibration.output(name).path)

    def table(self, name: str) -> pa.Table | None:
        """A stored table of the scan; None if no stage made it, or if its file is gone."""
        if name not in self._tables:
            record = self.records.get(PRODUCER[name].name)
            if record is None or not record.ok:
                self._tables[name] = None
            elif name in LIGHT:
                try:
                    self._tables[name] = LightTables(self.root, self.ledger, self.day).get(name, self.scan_id)
                except FileNotFoundError:
                    self._gone(name)
                    self._tables[name] = None
            else:
                self._tables[name] = self._read(name, record.output(name).path)
        return self._tables[name]

    def rows(self, name: str) -> list[dict]:
        """Rows of a small table, none if it is missing."""
        table = self.table(name)
        return [] if table is None else table.to_pylist()

    def _read(self, name: str, path: str) -> pa.Table | None:
        if (self.root / path).is_file():
            return store.read_table(self.root, path)
        self._gone(name)
        return None

    def _gone(self, name: str) -> None:
        self.notes.append(f"The table {name} is no longer stored: its file was removed from the warehouse.")

    # --- where things are ----------------------------------------------------------------------------------------

    @cached_property
    def poses_before(self) -> dict[str, Array]:
        """rig_from_sensor (4, 4) at the scan's rig temperature as stages 4 and 5 begin with it, by the first line."""
        if self.rig is None or self.header is None:
            return {}
        found = standing(self.rig, self.header.temperature_c.rig, self._stripe_statistics).poses
        return {sensor: pose for (sensor, line), pose in found.items() if line == 0}

    @property
    def _stripe_statistics(self) -> pa.Table:
        known = self.table("stripe_statistics")
        return STRIPE_STATISTICS.empty() if known is None else known

    @cached_property
    def poses(self) -> dict[str, Array]:
        """rig_from_sensor (4, 4) at the scan's rig temperature: registered and squared as far as that is stored."""
        poses = dict(self.poses_before)
        registrations = self.table("registrations")
        if registrations is not None and self.rig is not None and self.header is not None:
            alignments = self.table("alignments")
            found = scan_geometry(
                self.rig,
                self.header,
                self._stripe_statistics,
                registrations,
                ALIGNMENTS.empty() if alignments is None else alignments,
            )
            g = growth(self.rig.expansion_per_k, self.header.temperature_c.rig)
            for (name, _), pose in sorted(found.poses.items(), reverse=True):  # the first line decides
                poses[name] = grown_pose(pose, g)
        return poses

    @cached_property
    def angle_deg(self) -> Array | None:
        """Angle of the turn by frame number: from the bundle if it is there unchanged, else from the stored turns."""
        folder = self.bundle_folder
        if folder is not None and self.unchanged("frames.parquet"):
            try:
                return read_frames(folder).angle_deg
            except ScanUnusable:
                pass
        turns = self.table("turns")
        if turns is None or turns.num_rows < 2:
            return None
        frame, first = np.unique(turns["frame"].to_numpy(), return_index=True)
        return np.interp(np.arange(frame.max() + 1), frame, turns["angle_deg"].to_numpy()[first])

    # --- raw files -----------------------------------------------------------------------------------------------

    @cached_property
    def bundle_folder(self) -> Path | None:
        """Folder of the scan's bundle, on this machine, if an inbox was named and has it."""
        folder = self.inbox / "scans" / self.scan_id if self.inbox else None
        return self._stack.enter_context(place.staged(folder)) if folder is not None and folder.is_dir() else None

    @property
    def bundle_files(self) -> dict[str, str]:
        """Raw files of the accepted bundle with their sha256; none for a refused bundle."""
        return {name: sha for name, sha in self.records[BUNDLE].inputs if name != "scan.json"}

    def unchanged(self, file: str) -> bool:
        """Whether a raw file is still there with the recorded hash."""
        path = self.bundle_folder / file if self.bundle_folder else None
        wanted = self.bundle_files.get(file)
        return path is not None and wanted is not None and path.is_file() and store.sha256_file(path) == wanted.lower()


def open_source(root: Path, scan_id: str, inbox: Path | None) -> Source:
    """The scan of this name; ConfigError with the nearest names if the warehouse has none."""
    ledger = Ledger(root)
    if not ledger.folder.is_dir():
        raise ConfigError(
            f"{root}: not a warehouse, or nothing was ever run into it; name it by --warehouse or WHEELSET_WAREHOUSE"
        )
    known: list[str] = []
    for day in dict.fromkeys((*reversed(ledger.days()), UNDATED)):
        current = ledger.day(day).current
        if (scan_id, BUNDLE) in current:
            return Source(root, scan_id, day, ledger, _in_order(scan_id, current), inbox)
        known += [unit for unit, stage in current if stage == BUNDLE]
    near = difflib.get_close_matches(scan_id, known, n=5, cutoff=0.4) or sorted(known)[:5]
    raise ConfigError(
        f"no scan {scan_id} in {root}; " + (f"nearest: {', '.join(near)}" if near else "it holds no scan yet")
    )


def _in_order(scan_id: str, current: dict[tuple[str, str], Record]) -> dict[str, Record]:
    names = (BUNDLE, *(s.name for s in SCAN_STAGES))
    return {name: current[scan_id, name] for name in names if (scan_id, name) in current}
