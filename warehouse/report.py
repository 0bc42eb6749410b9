"""Computing reports: running the queries of `sql/` that a report lists, on the views of a warehouse.

Every number of a report is made in SQL. The result of a block is at hand to the blocks after it under the name
`<report>_<block>`. What makes up a report is said in `report_accuracy` and its like, how it looks in `render`; nothing
here draws.
"""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa

from warehouse.report_accuracy import ACCURACY, ACCURACY_OF_PAIRS
from warehouse.report_calibration import CALIBRATION
from warehouse.report_declare import BlockSpec, ReportSpec
from warehouse.report_diff import DIFF
from warehouse.report_fleet import FLEET
from warehouse.report_msa import MSA
from warehouse.report_pairs import read_pairs
from warehouse.report_stability import STABILITY
from warehouse.report_wheelset import WHEELSET
from wheelset_assets.quality import ConfigError

REPORTS: dict[str, ReportSpec] = {spec.name: spec for spec in (ACCURACY, STABILITY, FLEET, WHEELSET, MSA, CALIBRATION)}
PRINTED = ("generated_at", "as_of")
AS_OF = "The measurements are those that were current at the moment of as of; reviews, limits and states of scans are today's."
FILTERS = ("since", "until", "rig_id", "wheelset_id", "scan_id", "version_a", "version_b")


@dataclass(frozen=True)
class Query:
    """A SQL file: its text, the question that its comment says it answers, and the meaning of each column."""

    file: str
    text: str
    answers: str
    meanings: Mapping[str, str]


@dataclass(frozen=True)
class Block:
    """A block that was computed."""

    spec: BlockSpec
    query: Query
    table: pa.Table


@dataclass(frozen=True)
class Report:
    """A report that was computed: everything that a rendering may show."""

    spec: ReportSpec
    parameters: Mapping[str, Any]
    blocks: Mapping[str, Block]
    notes: tuple[str, ...] = field(default=())

    @property
    def title(self) -> str:
        """Title of this report, with the wheelset that a page of one is about."""
        one = self.parameters.get("wheelset_id") if self.spec.name == "wheelset" else None
        shown = "".join(letter if letter.isprintable() else " " for letter in str(one or ""))
        return f"{self.spec.title} {shown}".rstrip()

    @property
    def is_empty(self) -> bool:
        """Whether there was nothing to report on."""
        return self.blocks[self.spec.main].table.num_rows == 0


@cache
def query(file: str) -> Query:
    """The query of this file below `sql/`."""
    text = files("warehouse").joinpath("sql").joinpath(file).read_text(encoding="utf-8")
    comment: list[str] = []
    for line in text.splitlines():
        if not line.startswith("--"):
            break
        comment.append(line[2:].strip())
    cut = comment.index("Columns") if "Columns" in comment else len(comment)
    meanings = dict(line.split(": ", 1) for line in comment[cut + 1 :] if line)
    return Query(file=file, text=text, answers=" ".join(comment[:cut]).strip(), meanings=meanings)


def functions() -> str:
    """The macros that the queries use, as CREATE statements."""
    return files("warehouse").joinpath("sql").joinpath("functions.sql").read_text(encoding="utf-8")


def build(connection: duckdb.DuckDBPyConnection, name: str, parameters: Mapping[str, Any] | None = None) -> Report:
    """Run the queries of one report on the views of a warehouse.

    `parameters`: since, until (days, inclusive), rig_id, wheelset_id narrow the report; generated_at and as_of (the moment
    of a connection from `catalog.as_of`), if given, are printed. Nothing stays behind on the connection but temporary macros.
    """
    if name not in REPORTS:
        raise ConfigError(f"there is no report {name!r}; there are: {', '.join(REPORTS)}")
    given = _checked(parameters or {})
    notes: tuple[str, ...] = (AS_OF,) if "as_of" in given else ()
    if name == "wheelset":
        notes += _of_one_wheelset(connection, given)
    return _run(connection, REPORTS[name], given, notes)


def diff(connection: duckdb.DuckDBPyConnection, version_a: str, version_b: str) -> Report:
    """What changed between two versions over the same scans; ConfigError if a version made nothing, with those there are."""
    made = _run(connection, DIFF, {"version_a": version_a, "version_b": version_b})
    versions = made.blocks["versions"].table.to_pylist()
    for version in (version_a, version_b):
        keys = ("code_version", "config_fingerprint", "git_commit")
        if version != "current" and not any((row[key] or "").startswith(version) for row in versions for key in keys):
            known = "; ".join(
                f"{row['code_version']} {row['config_fingerprint']} {row['git_commit']}" for row in versions
            )
            raise ConfigError(
                f"diff {version!r}: no such version here; there are (code, configuration, commit): {known}"
            )
    return made


def accuracy_from_pairs(path: Path) -> Report:
    """The statistics of the accuracy report for measured and reference values from a CSV file."""
    pairs, notes = read_pairs(path)
    connection = duckdb.connect(":memory:")
    try:
        connection.execute("SET TimeZone = 'UTC'")
        connection.register("pairs_file", pairs)
        return _run(connection, ACCURACY_OF_PAIRS, {"pairs": path.name}, notes)
    finally:
        connection.close()


def catalog_statements() -> tuple[str, ...]:
    """Statements that make every report's queries views of a warehouse, with comments: numbers without a report."""
    statements = [functions()]
    views = {name: query(file) for spec in REPORTS.values() for name, file in spec.steps}
    for spec in (*REPORTS.values(), DIFF):
        views |= {spec.view(block): query(block.sql) for block in spec.blocks}
    for name, asked in views.items():
        statements.append(f"CREATE OR REPLACE VIEW {name} AS\n{asked.text}")
        statements.append(f"COMMENT ON VIEW {name} IS {_quoted(asked.answers)}")
        statements += [f"COMMENT ON COLUMN {name}.{c} IS {_quoted(m)}" for c, m in asked.meanings.items()]
    return tuple(statements)


@cache
def fingerprint() -> str:
    """Changes with the reports' queries: a catalog with other ones is rebuilt before it is asked."""
    return hashlib.sha256("\0".join(catalog_statements()).encode()).hexdigest()[:16]


def _of_one_wheelset(connection: duckdb.DuckDBPyConnection, given: dict[str, str]) -> tuple[str, ...]:
    """Choose the wheelset and the scan that the page is about where they were not given, and say so."""
    scan, wheelset = given.get("scan_id"), given.get("wheelset_id")
    rows = connection.execute(
        "SELECT wheelset_id, scan_id FROM measurements WHERE purpose = 'production' AND value IS NOT NULL"
        " AND ($1::VARCHAR IS NULL OR scan_id = $1) AND ($2::VARCHAR IS NULL OR wheelset_id = $2)"
        " AND ($3::DATE IS NULL OR acquired_on <= $3::DATE) ORDER BY captured_at DESC, scan_id DESC LIMIT 1",
        [scan, wheelset, given.get("until")],
    ).fetchall()
    if not rows and (scan or wheelset):
        return ()
    if not scan and not wheelset:
        first = build(connection, "fleet", given).blocks["turning"].table.column("wheelset_id").to_pylist()
        if not first:
            return ()
        given["wheelset_id"] = first[0]
        chosen = f"No wheelset was named: this is {first[0]}, the first of the fleet's list."
        return (chosen, *_of_one_wheelset(connection, given))
    given["wheelset_id"], given["scan_id"] = rows[0]
    return ()


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _run(
    connection: duckdb.DuckDBPyConnection,
    spec: ReportSpec,
    parameters: Mapping[str, Any],
    notes: tuple[str, ...] = (),
) -> Report:
    blocks: dict[str, Block] = {}
    names: list[str] = []
    steps: list[str] = []
    connection.execute(functions().replace("CREATE OR REPLACE MACRO", "CREATE OR REPLACE TEMP MACRO"))

    def answer(name: str, asked: Query) -> pa.Table:
        table = connection.sql(asked.text).to_arrow_table()
        connection.register(name, table)
        names.append(name)
        return table

    with _variables(connection, parameters):
        try:
            for name, file in spec.steps:
                connection.execute(f"CREATE OR REPLACE TEMP VIEW {name} AS\n{query(file).text}")
                steps.append(name)
            for block in spec.blocks:
                asked = query(block.sql)
                blocks[block.name] = Block(block, asked, answer(spec.view(block), asked))
        finally:
            for name in names:
                connection.unregister(name)
            for name in steps:
                connection.execute(f"DROP VIEW IF EXISTS temp.{name}")
    return Report(spec=spec, parameters=parameters, blocks={name: blocks[name] for name in spec.order}, notes=notes)


@contextmanager
def _variables(connection: duckdb.DuckDBPyConnection, parameters: Mapping[str, Any]) -> Iterator[None]:
    """The filters as variables of the session, for as long as the queries run; those not given are not set."""
    try:
        for name in FILTERS:
            connection.execute(f"RESET VARIABLE {name}")
            if name in parameters:
                connection.execute(f"SET VARIABLE {name} = $1", [parameters[name]])
        yield
    finally:
        for name in FILTERS:
            connection.execute(f"RESET VARIABLE {name}")


def _checked(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters that were given, as text; an unknown one or a day that is none is an error of usage."""
    given = {name: value for name, value in parameters.items() if value is not None}
    if unknown := sorted(set(given) - {*FILTERS, *PRINTED}):
        known = ", ".join((*FILTERS, *PRINTED))
        raise ConfigError(f"a report has no parameter {', '.join(unknown)}; it has: {known}")
    for name in ("since", "until"):
        if name in given:
            try:
                given[name] = datetime.date.fromisoformat(str(given[name])).isoformat()
            except ValueError:
                raise ConfigError(f"{name} {given[name]!r}: expected a day as YYYY-MM-DD") from None
    return {name: str(value) for name, value in given.items()}
