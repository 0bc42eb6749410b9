"""Limits as data: TOML files with a source for each line, read into one table that the catalog's verdicts join.

`WAREHOUSE/limits/*.toml`, if that folder exists, takes the place of the shipped examples in `configs/limits`.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from configs import LIMITS as SHIPPED
from wheelset_assets.declare import Column, Table
from wheelset_assets.quality import ConfigError

FOLDER = "limits"
LEVELS = ("operating", "planning", "after_turning")
"""From the gravest: beyond `operating` the train stays; beyond `planning` the wheelset is turned at the next visit;
`after_turning` is what the lathe must reach."""

LIMITS = Table(
    "limits",
    1,
    "Limits in force, one row a quantity, level and diameter class; from the warehouse's limits folder, else the shipped examples",
    key=(),
    layout="fleet",
    columns=(
        Column("limit_set", "string", "File that the limit comes from"),
        Column("title", "string", "Title of the set"),
        Column("wheelset_type", "string", "Type of wheelset that the set is for; null for any other", nullable=True),
        Column("quantity", "string", "Quantity"),
        Column("side", "string", "Side; null for every side", nullable=True),
        Column("level", "string", "operating, planning or after_turning", values=LEVELS),
        Column("level_rank", "int8", "0 for the gravest level", minimum=0),
        Column("limit_min", "float64", "Smallest permitted value", nullable=True),
        Column("limit_max", "float64", "Largest permitted value", nullable=True),
        Column("diameter_min_mm", "float64", "Holds for wheels of a diameter above this", unit="mm", nullable=True),
        Column("diameter_max_mm", "float64", "Holds for wheels of a diameter up to this", unit="mm", nullable=True),
        Column("source", "string", "Where the limit is from"),
        Column("verified", "bool", "Whether the source itself was seen; false: check it before relying on it"),
    ),
)

Number = Annotated[float, Field(allow_inf_nan=False)]


class Limit(BaseModel):
    """One `[[limit]]` of a file."""

    model_config = ConfigDict(extra="forbid")
    quantity: str = Field(min_length=1)
    side: Literal["left", "right", "both"] | None = None
    level: Literal["operating", "planning", "after_turning"]
    min: Number | None = None
    max: Number | None = None
    diameter_min_mm: Number | None = None
    diameter_max_mm: Number | None = None
    source: str = Field(min_length=1)
    verified: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> Limit:
        if self.min is None and self.max is None:
            raise ValueError("min or max is needed")
        if (self.min if self.min is not None else -math.inf) >= (self.max if self.max is not None else math.inf):
            raise ValueError(f"min {self.min} is not below max {self.max}")
        return self


class LimitSet(BaseModel):
    """One file of limits; `types` lists the wheelset types it is for, none: those that no other file names."""

    model_config = ConfigDict(extra="forbid")
    name: str = Field(min_length=1)
    title: str = ""
    types: list[str] = []
    limit: list[Limit] = []


def limit_files(root: Path) -> list[Path]:
    """Files of limits that hold for a warehouse, by name."""
    own = root / FOLDER
    return sorted((own if own.is_dir() else SHIPPED).glob("*.toml"))


def fingerprint(root: Path) -> str:
    """Changes with the files of limits or their contents."""
    digest = hashlib.sha256()
    for path in limit_files(root):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def read_limits(root: Path) -> pa.Table:
    """Rows of LIMITS for a warehouse; ConfigError names the file, the entry and what was expected."""
    sets = [(path, _read(path)) for path in limit_files(root)]
    named: dict[str, Path] = {}
    for path, found in sets:
        for type_ in found.types:
            if type_ in named:
                raise ConfigError(f"{path}: types: {type_!r} is also in {named[type_].name}; keep it in one file")
            named[type_] = path
    rows: list[dict[str, Any]] = [
        {
            "limit_set": found.name,
            "title": found.title or found.name,
            "wheelset_type": type_,
            "quantity": limit.quantity,
            "side": limit.side,
            "level": limit.level,
            "level_rank": LEVELS.index(limit.level),
            "limit_min": limit.min,
            "limit_max": limit.max,
            "diameter_min_mm": limit.diameter_min_mm,
            "diameter_max_mm": limit.diameter_max_mm,
            "source": limit.source,
            "verified": limit.verified,
        }
        for _, found in sets
        for type_ in (found.types or (None,))
        for limit in found.limit
    ]
    return LIMITS.from_rows(rows) if rows else LIMITS.empty()


def _read(path: Path) -> LimitSet:
    try:
        return LimitSet.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a TOML file: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(
            f"{path}: {place}: {first['msg'].removeprefix('Value error, ')} (got {first.get('input')!r}); "
            "configs/limits/crh3.toml is an example"
        ) from error
