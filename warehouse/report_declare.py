"""The vocabulary in which reports are declared, and the blocks that several of them share. Declarations only.

Adding a report means a folder of queries in `sql/`, a `ReportSpec` beside the others, and its name in `report.REPORTS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FigureKind = Literal[
    "errors_over_time",
    "bland_altman",
    "six_dimensions",
    "control",
    "wear",
    "history",
    "polar",
    "profile",
    "map",
    "cells",
    "residuals",
]


@dataclass(frozen=True)
class BlockSpec:
    """One table of a report: its query, and how the page reads it. `shown` names the columns that people see first."""

    name: str
    sql: str
    title: str
    says: str = ""
    empty: str = "Nothing."
    shown: tuple[str, ...] = ()
    n_keys: int = 2
    limit: int = 60


@dataclass(frozen=True)
class FigureSpec:
    """One family of pictures: drawn from the blocks that `kind` needs, and computed nowhere else."""

    name: str
    kind: FigureKind
    title: str
    says: str
    legend: tuple[tuple[str, str], ...]
    after: str


@dataclass(frozen=True)
class ReportSpec:
    """A report: `blocks` in the order of computing, `order` in that of reading.

    `steps` are queries that the blocks build on, by the name under which they find them; `main` is the block that a
    single CSV or Parquet file holds, and without whose rows there is `nothing` to report.
    """

    name: str
    title: str
    about: str
    main: str
    nothing: str
    order: tuple[str, ...]
    blocks: tuple[BlockSpec, ...]
    figures: tuple[FigureSpec, ...] = ()
    steps: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        names = {block.name for block in self.blocks}
        if (
            set(self.order) != names
            or self.main not in names
            or any(figure.after not in names for figure in self.figures)
        ):
            raise ValueError(
                f"report {self.name}: order, main and figures must name its blocks, the order each of them"
            )

    def view(self, block: BlockSpec) -> str:
        """Name under which later queries find this block."""
        return f"{self.name}_{block.name}"


REFUSED_SCANS = BlockSpec(
    name="refused",
    sql="shared/refused_scans.sql",
    title="Scans refused or failed",
    empty="No scan was refused or failed.",
    n_keys=1,
)
VALUES_NOT_GIVEN = BlockSpec(
    name="not_given",
    sql="shared/values_not_given.sql",
    title="Values not given",
    empty="Every scan that was measured gave all its values.",
)
SERVICE_VALUES = ("service_values", "shared/service_values.sql")
PRODUCTION_VALUES = ("production_values", "shared/production_values.sql")
