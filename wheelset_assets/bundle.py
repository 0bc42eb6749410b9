"""Declarations of the scan-bundle format 1: rig, calibration, scan and certificate as models that check themselves.

Reading files, hashes and folders is the inbox's work. Unknown keys are kept and ignored.
"""

from __future__ import annotations

import re
from datetime import UTC, date, datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

IDENTIFIER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
Identifier = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-fA-F]{64}$")]
RESERVED = {"con", "prn", "aux", "nul", *(f"{name}{i}" for name in ("com", "lpt") for i in range(1, 10))}


class Model(BaseModel):
    """Base of the format's models: frozen, extra keys kept; null for an optional key is as good as no such key."""

    model_config = ConfigDict(frozen=True, extra="allow")

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        optional = {name for name, field in cls.model_fields.items() if not field.is_required()}
        return {key: value for key, value in data.items() if value is not None or key not in optional}


def _written_out(value: Any) -> Any:
    """Seconds since 1970, which the parser would take as well, are not ISO 8601."""
    if isinstance(value, str) and value.count("-") >= 2:
        return value
    if isinstance(value, datetime):
        return value
    raise ValueError("a time in ISO 8601 with an offset from UTC, such as 2025-04-05T08:00:00+08:00")


def _with_offset(value: datetime) -> datetime:
    if value.tzinfo is None:
        raise ValueError("a time with an offset from UTC, such as 2025-04-05T08:00:00+08:00")
    try:
        value.astimezone(UTC)
    except OverflowError:
        raise ValueError("a time within the years 1 to 9999 of UTC") from None
    return value


Moment = Annotated[datetime, BeforeValidator(_written_out)]


class Station(Model):
    """A place of the rig that sees one wheel's rim or one journal."""

    station: Identifier
    kind: Literal["wheel", "journal"]
    side: Literal["left", "right"]


class Sensor(Model):
    """A stereo laser-stripe sensor with its nominal pose (rig from sensor, at a rig temperature of 20 °C)."""

    sensor_id: Identifier
    station: Identifier
    image_size: tuple[Annotated[int, Field(ge=16, le=20000)], Annotated[int, Field(ge=16, le=20000)]]
    laser_lines: Literal[1, 2]
    T_rig_sensor: Annotated[
        list[Annotated[list[Finite], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)
    ]

    @model_validator(mode="after")
    def _rigid(self) -> Sensor:
        m = self.T_rig_sensor
        dots = [sum(m[i][k] * m[j][k] for k in range(3)) - (i == j) for i in range(3) for j in range(3)]
        determinant = (
            m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
            - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
        )
        if max(abs(d) for d in dots) > 1e-4 or determinant < 0 or m[3] != [0, 0, 0, 1]:
            raise ValueError("T_rig_sensor: a rigid transform of four rows, the last 0 0 0 1")
        return self


class Rig(Model):
    """rigs/<rig_id>.json."""

    format: Literal["wheelset-rig/1"]
    rig_id: Identifier
    stations: Annotated[list[Station], Field(min_length=1)]
    sensors: Annotated[list[Sensor], Field(min_length=1)]
    expansion_per_k: Annotated[Finite, Field(ge=0, le=1e-3)]

    @model_validator(mode="after")
    def _references(self) -> Rig:
        stations = [s.station for s in self.stations]
        sensors = [s.sensor_id for s in self.sensors]
        for what, names in (("station", stations), ("sensor_id", sensors)):
            if len(set(names)) != len(names):
                raise ValueError(f"{what}: each only once")
        if unknown := {s.station for s in self.sensors} - set(stations):
            raise ValueError(f"sensors: station {sorted(unknown)[0]!r} is not among the stations")
        return self

    def station_sensors(self, station: str) -> list[Sensor]:
        """Sensors of a station in order of preference."""
        return [sensor for sensor in self.sensors if sensor.station == station]


class Board(Model):
    """Calibration board."""

    type: Literal["chessboard", "charuco"]
    inner_corners: tuple[Annotated[int, Field(ge=2, le=200)], Annotated[int, Field(ge=2, le=200)]]
    square_mm: Annotated[Finite, Field(gt=0)]
    marker_mm: Annotated[Finite, Field(gt=0)] | None = None
    dictionary: str | None = None
    legacy_pattern: bool = False


class RigTemperature(Model):
    """Temperatures of a calibration."""

    rig: Finite


class ScanTemperature(Model):
    """Temperatures of a scan."""

    wheelset: Finite
    rig: Finite


class CalibrationHeader(Model):
    """calibrations/<calibration_id>/calibration.json."""

    format: Literal["wheelset-calibration/1"]
    calibration_id: Identifier
    rig_id: Identifier
    captured_at: Moment
    temperature_c: RigTemperature
    board: Board
    files: dict[str, Sha256]
    valid_from: Moment | None = None
    valid_until: Moment | None = None

    @field_validator("captured_at", "valid_from", "valid_until")
    @classmethod
    def _zoned(cls, value: datetime | None) -> datetime | None:
        return value if value is None else _with_offset(value)


class WheelsetHeader(Model):
    """The wheelset that a scan shows."""

    wheelset_id: Identifier
    type: str
    profile: str | None = None
    expansion_per_k: Annotated[Finite, Field(gt=0, le=1e-3)] = 11.5e-6


class CertificateValue(Model):
    """One certified value of the master wheelset at 20 °C, k = 2."""

    quantity: str
    side: Literal["left", "right", "both"]
    value_mm: Finite
    expanded_uncertainty_mm: Annotated[Finite, Field(ge=0)]


class ScanHeader(Model):
    """scans/<scan_id>/scan.json."""

    format: Literal["wheelset-scan/1"]
    scan_id: Identifier
    rig_id: Identifier
    calibration_id: Identifier
    captured_at: Moment
    purpose: Literal["production", "reference"]
    wheelset: WheelsetHeader
    temperature_c: ScanTemperature
    files: dict[str, Sha256]
    reference_scan_id: Identifier | None = None
    certificate: list[CertificateValue] = []
    operator: str | None = None
    trainset: str | None = None
    car: str | None = None
    bogie: str | None = None
    axle: str | None = None
    mileage_km: Finite | None = None
    comment: str | None = None

    @field_validator("captured_at")
    @classmethod
    def _zoned(cls, value: datetime) -> datetime:
        return _with_offset(value)

    @field_validator("trainset", "car", "bogie", "axle", "operator", "comment", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        return str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value

    @property
    def acquired_on(self) -> date:
        """Day of the scan in its own offset."""
        return self.captured_at.date()


def explain(error: ValidationError, file: str) -> str:
    """One sentence for a person: file, key, what was found and what was expected."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "the document"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "missing":
        return f"{file}: required key {key} is missing"
    shown = repr(first.get("input"))
    return f"{file}: key {key}: {message}; found {shown if len(shown) <= 80 else shown[:77] + '...'}"
