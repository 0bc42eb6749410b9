"""The vocabulary in which tables and stages are declared: Column, Table, Check, Stage.

Frozen and self-validating. Parquet schemas, DuckDB views and comments, Dagster metadata, generated checks and the data
dictionary all derive from these objects; no value of any of them is written down twice.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pyarrow as pa

NAME = re.compile(r"[a-z][a-z0-9_]*")
UNITS = ("", "mm", "um", "px", "deg", "rad", "c", "k", "1", "s", "byte", "1/k", "mm^2", "utc", "db")
ARROW_TYPES: dict[str, pa.DataType] = {
    "bool": pa.bool_(),
    "int8": pa.int8(),
    "int16": pa.int16(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "float32": pa.float32(),
    "float64": pa.float64(),
    "string": pa.string(),
    "category": pa.dictionary(pa.int32(), pa.string()),
    "date": pa.date32(),
    "timestamp": pa.timestamp("us", tz="UTC"),
    "strings": pa.list_(pa.string()),
    "float64s": pa.list_(pa.float64()),
    "float32x33": pa.list_(pa.float32(), 33),
}


@dataclass(frozen=True)
class Column:
    """One column: its name carries its unit, `meaning` is a sentence for people, limits become checks."""

    name: str
    type: str
    meaning: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    nullable: bool = False
    values: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"column name {self.name!r}: lower case, digits and underscores only")
        if self.type not in ARROW_TYPES:
            raise ValueError(f"column {self.name}: unknown type {self.type!r}; known: {', '.join(ARROW_TYPES)}")
        if self.unit not in UNITS:
            raise ValueError(f"column {self.name}: unknown unit {self.unit!r}; known: {', '.join(UNITS)}")
        if self.unit in ("mm", "um", "px", "deg", "c") and f"_{self.unit}" not in self.name:
            raise ValueError(f"column {self.name}: its name must carry its unit _{self.unit}")

    @property
    def arrow(self) -> pa.Field:
        """The Arrow field of this column."""
        return pa.field(self.name, ARROW_TYPES[self.type], nullable=self.nullable)

    @property
    def comment(self) -> str:
        """Meaning with unit, as shown by DuckDB, Dagster and the data dictionary."""
        return f"{self.meaning} [{self.unit}]" if self.unit else self.meaning


@dataclass(frozen=True)
class Check:
    """SQL that selects the failing rows of `{table}`; an empty answer passes. `error` stops the publication.

    `screen`, if there is one, says of a table in microseconds that the SQL would select nothing; where it says no, the SQL
    decides. It may say no without need, never yes.
    """

    name: str
    sql: str
    meaning: str
    severity: Literal["error", "warn"] = "error"
    screen: Callable[[pa.Table], bool] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Table:
    """One stored table. `layout` says how it rests: a file a scan, a file a day, a file a calibration, or one file."""

    name: str
    version: int
    meaning: str
    columns: tuple[Column, ...]
    key: tuple[str, ...]
    layout: Literal["scan", "day", "calibration", "fleet"]
    checks: tuple[Check, ...] = ()

    def __post_init__(self) -> None:
        names = [column.name for column in self.columns]
        if len(set(names)) != len(names):
            raise ValueError(f"table {self.name}: a column is declared twice")
        if missing := set(self.key) - set(names):
            raise ValueError(f"table {self.name}: key columns {sorted(missing)} are not declared")

    @property
    def schema(self) -> pa.Schema:
        """Arrow schema, in the declared order."""
        return pa.schema([column.arrow for column in self.columns])

    def column(self, name: str) -> Column:
        """The declared column of this name; KeyError if there is none."""
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(f"table {self.name} has no column {name}")

    def empty(self) -> pa.Table:
        """A table with the declared schema and no row."""
        return self.schema.empty_table()

    def from_columns(self, columns: Mapping[str, Any]) -> pa.Table:
        """Arrow table from arrays or lists by name, cast to the declared types; a name too few or too many is an error."""
        names = [column.name for column in self.columns]
        if set(columns) != set(names):
            wrong = sorted(set(columns) ^ set(names))
            raise ValueError(f"table {self.name}: columns do not match its declaration: {', '.join(wrong)}")
        arrays = [as_arrow(columns[column.name], column.arrow.type) for column in self.columns]
        return pa.Table.from_arrays(arrays, schema=self.schema)

    def from_rows(self, rows: list[dict[str, Any]]) -> pa.Table:
        """Arrow table from dictionaries that each name every column."""
        return self.from_columns({column.name: [row[column.name] for row in rows] for column in self.columns})

    def generated_checks(self) -> tuple[Check, ...]:
        """Checks that follow from the declaration: key unique, limits kept, values among those declared, no NaN."""
        return tuple(_generated(self)) + self.checks


def as_arrow(values: Any, type_: pa.DataType) -> pa.Array:
    """Arrow array of the wanted type from a numpy array, list or Arrow array."""
    if isinstance(values, pa.ChunkedArray):
        values = values.combine_chunks()
    if isinstance(values, pa.Array):
        return values if values.type == type_ else values.cast(type_)
    return pa.array(values, type=type_)


def _generated(table: Table) -> list[Check]:
    checks = []
    if table.key:
        key = ", ".join(table.key)
        checks.append(
            Check("key_unique", f"SELECT {key} FROM {{table}} GROUP BY ALL HAVING count(*) > 1", f"{key} names one row")
        )
    for column in table.columns:
        bounds = []
        if column.minimum is not None:
            bounds.append(f"{column.name} < {column.minimum!r}")
        if column.maximum is not None:
            bounds.append(f"{column.name} > {column.maximum!r}")
        if column.type.startswith("float") and column.type in ("float32", "float64"):
            bounds.append(f"isnan({column.name}) OR isinf({column.name})")
        if bounds:
            sql = f"SELECT * FROM {{table}} WHERE {' OR '.join(bounds)} LIMIT 20"
            checks.append(Check(f"{column.name}_limits", sql, f"{column.name} is finite and within its limits"))
        if column.values:
            listed = ", ".join(f"'{value}'" for value in column.values)
            checks.append(
                Check(
                    f"{column.name}_values",
                    f"SELECT * FROM {{table}} WHERE {column.name} NOT IN ({listed}) LIMIT 20",
                    f"{column.name} is one of {listed}",
                )
            )
    return checks


@dataclass(frozen=True)
class Stage:
    """One of the eight stages: what it reads, what it makes, and the function in between.

    `version` is the meaning of the algorithm: raise it when the same inputs may give other numbers. `run` takes the
    declared inputs as keyword-only arguments and `config`; it does no input or output, and returns one Arrow table for
    each name in `outputs`. The first output names the asset.
    """

    version: int
    meaning: str
    scope: Literal["calibration", "scan", "fleet"]
    inputs: tuple[str, ...]
    outputs: tuple[Table, ...]
    config_type: type
    run: Callable[..., Mapping[str, pa.Table]]
    raw_inputs: tuple[str, ...] = ()
    optional_inputs: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        parameters = inspect.signature(self.run).parameters
        wanted = {*self.inputs, *self.raw_inputs, *self.optional_inputs, "config"}
        if set(parameters) != wanted:
            raise ValueError(f"stage {self.name}: run takes {sorted(parameters)}, but {sorted(wanted)} are declared")
        if any(parameter.kind is not inspect.Parameter.KEYWORD_ONLY for parameter in parameters.values()):
            raise ValueError(f"stage {self.name}: every argument of run must be keyword-only")

    @property
    def name(self) -> str:
        """Name of the stage, of its asset and of its first table."""
        return self.outputs[0].name

    @property
    def code_version(self) -> str:
        """Version of the algorithm and of the tables that it writes."""
        return f"{self.version}." + ".".join(str(table.version) for table in self.outputs)
