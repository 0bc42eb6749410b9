"""The lineage of a scan as a tree, from the ledger down to the sha256 of raw files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from warehouse.lineage import BUNDLE, CALIBRATION_DAY, DayLedger, Ledger, Record
from wheelset_assets.bundle import ScanHeader
from wheelset_assets.quality import ConfigError
from wheelset_assets.stages import CALIBRATION, MEASUREMENT, SCAN_STAGES


def trace(root: Path, scan: str | None, measurement: str | None) -> dict[str, Any]:
    """Tree of a scan, or of one of its measurements: {name, version, …, inputs: [tree, …]}."""
    ledger = Ledger(root)
    value = None
    if measurement is not None:
        parts = measurement.split("/")
        if len(parts) != 3:
            raise ConfigError(f"--measurement {measurement!r}: expected SCAN/QUANTITY/SIDE")
        scan = parts[0]
        value = _value(root, *parts)
    assert scan is not None
    day = next((d for d in [*ledger.days(), "undated"] if ledger.day(d).get(scan, BUNDLE)), None)
    if day is None:
        raise ConfigError(f"lineage: scan {scan} is not in the ledger of {root}")
    tree = _Tracer(ledger).unit(ledger.day(day), scan)
    return {"name": measurement, **value, "inputs": [tree]} if measurement is not None and value is not None else tree


def _value(root: Path, scan: str, quantity: str, side: str) -> dict[str, Any]:
    from pipelines.ask import open_read_only

    rows = (
        open_read_only(root)
        .execute(
            "SELECT value, unit, expanded_uncertainty, reason FROM measurements WHERE scan_id = ? AND quantity = ? AND side = ?",
            [scan, quantity, side],
        )
        .fetchall()
    )
    if not rows:
        raise ConfigError(f"lineage: there is no measurement {scan}/{quantity}/{side}")
    row = rows[0]
    return {"kind": "measurement", "value": row[0], "unit": row[1], "expanded_uncertainty": row[2], "reason": row[3]}


class _Tracer:
    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger

    def unit(self, day: DayLedger, unit: str) -> dict[str, Any]:
        """The last stage that a unit reached, with everything below it."""
        for stage in reversed(SCAN_STAGES):
            record = day.get(unit, stage.name)
            if record is not None:
                return self.record(day, record)
        bundle = day.get(unit, BUNDLE)
        assert bundle is not None
        return self.bundle(bundle)

    def record(self, day: DayLedger, record: Record) -> dict[str, Any]:
        """One stage over one unit."""
        node: dict[str, Any] = {
            "name": f"{record.stage} of {record.unit}",
            "kind": "stage",
            "state": record.state,
            "reason": record.reason,
            "version": record.version,
            "code_version": record.code_version,
            "config_fingerprint": record.config_fingerprint,
            "git_commit": record.git_commit,
            "packages": record.packages,
            "produced_at": record.produced_at.isoformat() if record.produced_at else None,
            "inputs": [],
            "outputs": [{"table": o.table, "version": o.version, "path": o.path} for o in record.outputs],
        }
        seen: set[str] = set()
        for name, version in record.inputs:
            child = self._input(day, record, name, version)
            if child["name"] not in seen:
                seen.add(child["name"])
                node["inputs"].append(child)
        return node

    def _input(self, day: DayLedger, record: Record, name: str, version: str) -> dict[str, Any]:
        producer = next((s for s in (CALIBRATION, *SCAN_STAGES) if any(t.name == name for t in s.outputs)), None)
        if name == "calibrations":
            calibration_id = record.unit.partition("@")[2] or self._header(day, record.scan_id).calibration_id
            found = self.ledger.day(CALIBRATION_DAY).get(calibration_id, CALIBRATION.name)
            if found is not None:
                node = self.record(self.ledger.day(CALIBRATION_DAY), found)
                return node
        elif producer is not None:
            found = day.get(record.unit, producer.name)
            if found is not None:
                return self.record(day, found)
        if name == "bundle":
            owner = self.ledger.day(CALIBRATION_DAY) if record.stage == CALIBRATION.name else day
            bundle = owner.get(record.scan_id, BUNDLE) or self._bundle_anywhere(record.scan_id)
            if bundle is not None:
                return self.bundle(bundle)
        if name == "reference" and record.stage == MEASUREMENT.name:
            at = next((d for d in self.ledger.days() if self.ledger.day(d).get(version, BUNDLE)), None)
            if at is not None:
                alignment = self.ledger.day(at).get(version, "alignments")
                children = [self.record(self.ledger.day(at), alignment)] if alignment is not None else []
                return {
                    "name": f"reference scan {version}",
                    "kind": "reference",
                    "version": version,
                    "inputs": children,
                }
        return {"name": name, "kind": "input", "version": version, "inputs": []}

    def _header(self, day: DayLedger, scan_id: str) -> ScanHeader:
        bundle = day.get(scan_id, BUNDLE) or self._bundle_anywhere(scan_id)
        assert bundle is not None
        assert bundle.header is not None
        return ScanHeader.model_validate_json(bundle.header)

    def _bundle_anywhere(self, scan_id: str) -> Record | None:
        return next((r for d in self.ledger.days() if (r := self.ledger.day(d).get(scan_id, BUNDLE)) is not None), None)

    @staticmethod
    def bundle(record: Record) -> dict[str, Any]:
        """The raw files of a bundle."""
        files = [{"name": name, "kind": "file", "version": sha, "inputs": []} for name, sha in record.inputs]
        return {
            "name": f"bundle {record.unit}",
            "kind": "bundle",
            "state": record.state,
            "reason": record.reason,
            "version": record.fingerprint,
            "inputs": files,
        }
