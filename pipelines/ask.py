"""Ad-hoc questions: one read-only query over the catalog, and its answer as table, CSV, JSON or Parquet."""

from __future__ import annotations

import io
import json
import re
import sys
from dataclasses import asdict
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warehouse import catalog
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa

FORMATS = ("table", "csv", "json", "parquet")
_SPACE = r"(\s|--[^\n]*\n|/\*.*?\*/)"
_EXPLAIN = re.compile(
    rf"^{_SPACE}*EXPLAIN({_SPACE}|ANALYZE\b|\({_SPACE}*(ANALYZE|FORMAT)\b[^)]*\))*", re.IGNORECASE | re.DOTALL
)


def open_read_only(root: Path, moment: datetime | None = None) -> duckdb.DuckDBPyConnection:
    """Connection that can read the warehouse's folder and nothing else, and write nothing there.

    With a moment, of the measurements as they were then.
    """
    connection = catalog.connect(root) if moment is None else catalog.as_of(root, moment)
    folder = f"{root.resolve()}/".replace("'", "''")
    connection.execute("SET TimeZone = 'UTC'")
    connection.execute(f"SET allowed_directories = ['{folder}']")
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")
    return connection


def query(root: Path, text: str, variables: dict[str, str] | None = None) -> pa.Table:
    """Answer to one read-only statement; ConfigError with DuckDB's message if it is wrong or would write."""
    import duckdb

    connection = open_read_only(root)
    try:
        _refuse_writing(connection, text)
        for name, value in (variables or {}).items():
            connection.execute(f"SET VARIABLE {name} = $1", [value])
        answer = connection.sql(text).to_arrow_table()
        return answer.rename_columns(_distinct(answer.column_names))
    except duckdb.Error as error:
        raise ConfigError(f"sql: {error}") from error
    finally:
        connection.close()


def _refuse_writing(connection: duckdb.DuckDBPyConnection, text: str) -> None:
    """ConfigError unless the text is one query; `EXPLAIN ANALYZE` runs what it explains, so that must be a query too."""
    from duckdb import StatementType

    statements = connection.extract_statements(text)
    if len(statements) != 1:
        raise ConfigError(f"sql: expected one statement; found {len(statements)}")
    kind = statements[0].type
    if kind == StatementType.EXPLAIN:
        explained = connection.extract_statements(_EXPLAIN.sub("", statements[0].query, count=1))
        kind = explained[0].type if explained else kind
    if kind != StatementType.SELECT:
        raise ConfigError(f"sql: only queries are allowed; found {kind.name}")


def _distinct(names: list[str]) -> list[str]:
    """Column names that occur again get a number, or a JSON object could not hold them."""
    found: list[str] = []
    for name in names:
        number = 1
        while (unique := name if number == 1 else f"{name}_{number}") in found:
            number += 1
        found.append(unique)
    return found


def ask(root: Path, text: str, format_: str, out: Path | None, variables: dict[str, str] | None = None) -> int:
    """Answer a query in a format, to a file or to standard output."""
    if format_ not in FORMATS:
        raise ConfigError(f"--format {format_!r}: expected one of {', '.join(FORMATS)}")
    answer = query(root, text, variables)
    if format_ == "table":
        _write((_as_text(answer) + "\n").encode(), out)
    elif format_ == "json":
        _write((json.dumps(plain_rows(answer), indent=1, allow_nan=False) + "\n").encode(), out)
    elif format_ == "csv":
        import pyarrow.csv as pc

        sink = io.BytesIO()
        pc.write_csv(_flat(answer), sink)
        _write(sink.getvalue(), out)
    else:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if out is None and sys.stdout.isatty():
            raise ConfigError("--format parquet: name a file by --out, or redirect standard output")
        sink = io.BytesIO()
        try:
            pq.write_table(answer, sink, compression="zstd")
        except pa.ArrowNotImplementedError as error:
            raise ConfigError(
                f"--format parquet: cannot hold a column's type; cast it in the query: {error}"
            ) from error
        _write(sink.getvalue(), out)
    return 0


def _write(data: bytes, out: Path | None) -> None:
    if out is None:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()
        return
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"--out {out}: cannot be written: {error.strerror}") from error


def _flat(answer: pa.Table) -> pa.Table:
    """Nested columns as JSON text, times with their zone: what CSV can hold."""
    import pyarrow as pa

    for i, field in enumerate(answer.schema):
        kind = field.type
        if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
            continue
        values = [_plain(v) for v in answer.column(i).to_pylist()]
        if pa.types.is_nested(kind):
            values = [None if v is None else json.dumps(v) for v in values]
        texts = [None if v is None else str(v) for v in values]
        answer = answer.set_column(i, field.name, pa.array(texts, pa.string()))
    return answer


def plain_rows(answer: pa.Table) -> list[dict[str, Any]]:
    """Rows in plain JSON types; what is not a number becomes null."""
    return [{name: _plain(value) for name, value in row.items()} for row in answer.to_pylist()]


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if value - value == 0 else None
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value.isoformat() if hasattr(value, "isoformat") else str(value)


def _as_text(answer: pa.Table) -> str:
    """An answer for a terminal, at most 200 rows of it."""
    from rich.console import Console
    from rich.table import Table

    shown = plain_rows(answer.slice(0, 200))
    table = Table(show_edge=False, header_style="bold")
    numeric = {
        f.name for f in answer.schema if str(f.type) in ("double", "float", "int64", "int32", "int16", "int8", "uint64")
    }
    for name in answer.column_names:
        table.add_column(name, justify="right" if name in numeric else "left", overflow="fold")
    for row in shown:
        table.add_row(*(_cell(row[name]) for name in answer.column_names))
    stream = io.StringIO()
    width = None if sys.stdout.isatty() else 200
    console = Console(file=stream, width=width or Console().width, highlight=False, markup=False)
    console.print(table)
    more = answer.num_rows - len(shown)
    return stream.getvalue().rstrip("\n") + (
        f"\n… {more} more rows (use --format csv, json or parquet for all)" if more > 0 else ""
    )


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}" if abs(value) < 1e-3 and value != 0 else f"{value:.6f}".rstrip("0").rstrip(".")
    if isinstance(value, list):
        return ", ".join(_cell(v) for v in value[:8]) + (" …" if len(value) > 8 else "")
    return str(value)


def budget_rows(root: Path, scan: str, quantity: str, side: str | None) -> list[dict[str, Any]]:
    """Budget of a scan's value by falling share; ConfigError if there is none, with what there is."""
    connection = open_read_only(root)
    rows = (
        connection.sql(
            "SELECT * FROM budgets WHERE scan_id = ? AND quantity = ? AND (? IS NULL OR side = ?) ORDER BY side, share DESC, source",
            params=[scan, quantity, side, side],
        )
        .to_arrow_table()
        .to_pylist()
    )
    if rows:
        return rows
    reasons = connection.execute(
        "SELECT side, reason FROM measurements WHERE scan_id = ? AND quantity = ?", [scan, quantity]
    ).fetchall()
    if reasons:
        raise ConfigError(f"budget: {scan} {quantity} has no value: " + "; ".join(f"{s}: {r}" for s, r in reasons))
    known = [
        r[0]
        for r in connection.execute(
            "SELECT DISTINCT quantity FROM budgets WHERE scan_id = ? ORDER BY 1", [scan]
        ).fetchall()
    ]
    raise ConfigError(
        f"budget: no {quantity} of scan {scan}"
        + (f"; it has {', '.join(known)}" if known else "; there is no such scan, or it was not measured")
    )


def monte_carlo_rows(root: Path, budget: list[dict[str, Any]], draws: int) -> list[dict[str, Any]]:
    """Propagation of distributions (JCGM 101) through the budget of each side, beside value ± U."""
    from wheelset_assets.metrology.monte_carlo import propagate
    from wheelset_assets.metrology.uncertainty import Source

    if draws < 10_000:
        raise ConfigError(f"--monte-carlo {draws}: expected 10000 draws or more; a million are usual")
    connection = open_read_only(root)
    rows = []
    for side in dict.fromkeys(row["side"] for row in budget):
        own = [row for row in budget if row["side"] == side]
        key = (own[0]["scan_id"], own[0]["quantity"], side)
        found = connection.execute(
            "SELECT value, unit FROM measurements WHERE scan_id = ? AND quantity = ? AND side = ?", list(key)
        ).fetchone()
        assert found is not None, "a budget without its value"
        sources = [
            Source(row["source"], row["standard_uncertainty"], row["source_unit"], row["sensitivity"])
            for row in sorted(own, key=lambda row: row["source"])
        ]
        result = propagate(found[0], sources, draws)
        rows.append(dict(zip(("scan_id", "quantity", "side"), key, strict=True)) | {"unit": found[1]} | asdict(result))
    return rows
