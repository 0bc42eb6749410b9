"""The DuckDB catalog: one commented view a table over the current Parquet files, which any DuckDB client can open.

`warehouse.duckdb` holds views only. It is built beside the old one and renamed into place at the end of a run, so a
reader sees one consistent state of the warehouse. Paths in it are absolute; after a move it is rebuilt.
"""

from __future__ import annotations

import hashlib
import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.compute as pc

from warehouse import place, report, store
from warehouse.catalog_rows import CURRENT_SINCE, SUPERSEDED, CatalogRows, gather
from warehouse.catalog_tables import DERIVED, SINCE
from warehouse.limits import LIMITS, fingerprint, read_limits
from warehouse.lineage import Ledger
from warehouse.reviews import reviews_fingerprint, store_reviews
from wheelset_assets.declare import ARROW_TYPES, Table
from wheelset_assets.quality import ConfigError
from wheelset_assets.tables import ALL_TABLES, MEASUREMENTS, TABLES

if TYPE_CHECKING:
    import duckdb

NAME = "warehouse.duckdb"
COLLECTED = "_catalog/collected.json"
_SQL_TYPES = {
    "bool": "BOOLEAN",
    "int8": "TINYINT",
    "int16": "SMALLINT",
    "int32": "INTEGER",
    "int64": "BIGINT",
    "float32": "FLOAT",
    "float64": "DOUBLE",
    "string": "VARCHAR",
    "category": "VARCHAR",
    "date": "DATE",
    "timestamp": "TIMESTAMPTZ",
    "strings": "VARCHAR[]",
    "float64s": "DOUBLE[]",
    "float32x33": "FLOAT[33]",
}


def connect(root: Path) -> duckdb.DuckDBPyConnection:
    """Read-only connection to a warehouse's catalog, rebuilt first if the warehouse was moved or its limits edited."""
    import duckdb

    if not (root / NAME).exists():
        raise ConfigError(
            f"{root}: no {NAME} there; run `wheelset run --warehouse {root}` first, "
            "or name the warehouse by --warehouse or WHEELSET_WAREHOUSE"
        )
    connection = open_built(root)
    built = dict(connection.execute("SELECT name, value FROM catalog_facts").fetchall())
    if any(built.get(name) != value for name, value in _facts(root).items()):
        connection.close()
        try:
            build(root, Ledger(root))
        except duckdb.BinderException as error:
            raise ConfigError(
                f"{root}: its tables are older than this program ({str(error).splitlines()[0]}); "
                f"run `wheelset run --warehouse {root}` once to bring them up to date"
            ) from error
        connection = open_built(root)
    return connection


def open_built(root: Path) -> duckdb.DuckDBPyConnection:
    """The catalog as it is. Of one in object storage a copy is opened, which is kept until there is a newer one."""
    import duckdb

    if not place.is_remote(root):
        return duckdb.connect(str(root / NAME), read_only=True)
    facts = place.filesystem(root).info(place.key(root / NAME))
    copies = place.cache_folder(root)
    copy = copies / f"{hashlib.sha256(str(facts['ETag']).encode()).hexdigest()[:16]}.duckdb"
    if not copy.exists():
        copies.mkdir(parents=True, exist_ok=True)
        with place.landing(copy) as temporary:
            place.fetch(root / NAME, temporary)
        for older in copies.glob("*.duckdb"):
            if older != copy:
                older.unlink(missing_ok=True)
    connection = duckdb.connect(str(copy), read_only=True)
    _read_remote(connection, root)
    return connection


def as_of(root: Path, moment: datetime) -> duckdb.DuckDBPyConnection:
    """The catalog in memory with the measurements that were current at a moment, so that a report can be made as it was.

    Scan states, reviews and limits are those of now. ConfigError if superseded values of then were collected since.
    """
    import duckdb

    connect(root).close()
    rows = gather(root.resolve(), Ledger(root))
    until = collected_until(root)
    if until is not None and moment < until:
        raise ConfigError(
            f"--as-of {moment.isoformat()}: values that were superseded up to {until.isoformat()} have been collected "
            "(`wheelset gc`); reports reach back to then"
        )
    connection = duckdb.connect(":memory:")
    if place.is_remote(root):
        _read_remote(connection, root)
    _fill(connection, root.resolve(), rows, _facts(root), moment)
    return connection


def collected_until(root: Path) -> datetime | None:
    """When the latest of the measurements that were collected was superseded; None if none ever was."""
    try:
        return datetime.fromisoformat(json.loads((root / COLLECTED).read_text())["until"])
    except FileNotFoundError:
        return None


def _read_remote(connection: duckdb.DuckDBPyConnection, root: Path) -> None:
    """Let a connection read the files of a warehouse in object storage, without an extension of DuckDB."""
    from warehouse.place_files import ReadOnce

    connection.register_filesystem(ReadOnce(place.filesystem(root), place.key(root)))


def _facts(root: Path) -> dict[str, str]:
    """What the catalog was built from beside the ledger: if it is no longer so, it is built again."""
    return {"root": str(root.resolve()), "limits": fingerprint(root), "reports": report.fingerprint()}


def update(root: Path, ledger: Ledger, reviews: list[Path]) -> None:
    """Build the catalog anew if the ledger, the reviews, or what else it rests on has changed since it was built."""
    import duckdb

    wanted = _facts(root) | _sources(ledger, reviews)
    try:
        with open_built(root) as connection:
            built = dict(connection.execute("SELECT name, value FROM catalog_facts").fetchall())
    except (duckdb.Error, OSError):  # there is none yet, or none that this program can read
        built = {}
    if built != wanted:
        build(root, ledger, reviews)


def _sources(ledger: Ledger, reviews: list[Path]) -> dict[str, str]:
    """What only a run may let the catalog follow: between runs it stays at the state of the last."""
    return {"ledger": ledger.fingerprint(), "reviews": reviews_fingerprint(reviews)}


def build(root: Path, ledger: Ledger, reviews: list[Path] | None = None) -> Path:
    """Build the catalog anew from the ledger and put it in place."""
    import duckdb

    root = root.resolve()
    if reviews is not None:
        store_reviews(root, reviews)
    rows = gather(root, ledger)
    for name, data in rows.derived.items():
        store.write_bytes(root / "_catalog" / f"{name}.parquet", data)
    store.write_bytes(root / "_catalog" / "limits.parquet", _limits_parquet(root))
    with place.landing(root / NAME) as temporary, duckdb.connect(str(temporary)) as connection:
        if place.is_remote(root):
            _read_remote(connection, root)
        facts = _facts(root) | ({} if reviews is None else _sources(ledger, reviews))
        _fill(connection, root, rows, facts)
    return root / NAME


def _fill(
    connection: duckdb.DuckDBPyConnection,
    root: Path,
    rows: CatalogRows,
    facts: dict[str, str],
    moment: datetime | None = None,
) -> None:
    """All facts, views and comments; with the measurements of a moment, if given.

    A commit for each table, not for each of its comments: until it, DuckDB keeps a copy of the view, with its list of
    files, for each of them.
    """
    connection.execute("BEGIN")
    connection.execute("CREATE TABLE catalog_facts (name VARCHAR, value VARCHAR)")
    connection.executemany("INSERT INTO catalog_facts VALUES (?, ?)", list(facts.items()))
    for table in ALL_TABLES:
        _create_view(connection, table, [str(root / path) for path in rows.files.get(table.name, ())])
        connection.execute("COMMIT")
        connection.execute("BEGIN")
    for table in DERIVED:
        _create_view(connection, table, [str(root / "_catalog" / f"{table.name}.parquet")])
    _create_history(connection, root, rows.superseded)
    _create_as_of(connection, rows.current_since)
    if moment is not None:
        connection.execute("CREATE TABLE measurements_then AS FROM measurements_as_of($1)", [moment])
        connection.execute("DROP VIEW measurements")
        connection.execute("ALTER TABLE measurements_then RENAME TO measurements")
    _create_fused_clouds(connection)
    for statement in (report.functions(), *_limit_views(), *report.catalog_statements()):
        connection.execute(statement)
    connection.execute("COMMIT")


def _limits_parquet(root: Path) -> bytes:
    """The limits in force; none where a file of them is wrong, which `limit_troubles` tells: a night must not sink by it."""
    import pyarrow.parquet as pq

    try:
        table = read_limits(root)
    except ConfigError:
        table = LIMITS.empty()
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def limit_troubles(root: Path) -> list[str]:
    """Why the limits cannot be read, if so; there are then no verdicts."""
    try:
        read_limits(root)
    except ConfigError as error:
        return [f"limits left out: {error}"]
    return []


def _limit_views() -> list[str]:
    """Views of the verdicts, with comments."""
    statements = []
    for name in ("verdicts", "diameter_differences"):
        asked = report.query(f"limits/{name}.sql")
        statements.append(f"CREATE VIEW {name} AS\n{asked.text}")
        statements.append(f"COMMENT ON VIEW {name} IS {_quoted(asked.answers)}")
        statements += [f"COMMENT ON COLUMN {name}.{c} IS {_quoted(m)}" for c, m in asked.meanings.items()]
    return statements


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _create_view(connection: duckdb.DuckDBPyConnection, table: Table, files: list[str]) -> None:
    """View of a table over its files, typed even when there are none, with comments."""
    columns = [(c.name, _SQL_TYPES[c.type]) for c in table.columns]
    if files:
        hive = table.layout == "scan"
        extra = "scan_id, CAST(day AS VARCHAR) AS day, " if hive else ""
        picked = ", ".join(
            f'CAST("{name}" AS {kind}) AS "{name}"' for name, kind in columns if not (hive and name == "scan_id")
        )
        options = f"hive_partitioning = {str(hive).lower()}"
        if hive:
            options += ", hive_types = {'day': VARCHAR, 'scan_id': VARCHAR}"
        where = " WHERE scan_id NOT LIKE '%@%'" if table.layout == "day" else ""
        body = f"SELECT {extra}{picked} FROM read_parquet({_listed(files)}, {options}){where}"
    else:
        extra = "CAST(NULL AS VARCHAR) AS scan_id, CAST(NULL AS VARCHAR) AS day, " if table.layout == "scan" else ""
        body = f"SELECT {extra}{', '.join(f'CAST(NULL AS {kind}) AS {name}' for name, kind in columns)} WHERE false"
    connection.execute(f"CREATE VIEW {table.name} AS {body}")
    connection.execute(f"COMMENT ON VIEW {table.name} IS {_quoted(table.meaning)}")
    for column in table.columns:
        connection.execute(f'COMMENT ON COLUMN {table.name}."{column.name}" IS {_quoted(column.comment)}')
    if table.layout == "scan":
        connection.execute(f"COMMENT ON COLUMN {table.name}.scan_id IS 'Scan bundle that the row comes from'")
        connection.execute(f"COMMENT ON COLUMN {table.name}.day IS 'Acquisition day'")


def _listed(files: list[str]) -> str:
    """The files as an argument of read_parquet: one text, for a list of thousands would be as many expressions."""
    if any(chr(10) in file for file in files):
        return f"[{', '.join(map(_quoted, files))}]"
    return f"string_split({_quoted(chr(10).join(files))}, chr(10))"


def _create_history(connection: duckdb.DuckDBPyConnection, root: Path, superseded: pa.Table) -> None:
    """Superseded measurements: rows of older day files whose scan has a newer version."""
    present = sorted(store.files_of(root, MEASUREMENTS)) if superseded.num_rows else []
    rows = superseded.filter(pc.is_in(superseded["path"], pa.array(present, pa.string())))
    paths = pa.array([str(root / path) for path in rows["path"].to_pylist()], pa.string())
    rows = rows.set_column(0, "path", paths)
    _create_table(connection, "superseded", SUPERSEDED, rows)
    if rows.num_rows:
        old = sorted(set(paths.to_pylist()))
        typed = ", ".join(f'CAST(NULL AS {_SQL_TYPES[c.type]}) AS "{c.name}"' for c in MEASUREMENTS.columns)
        # Superseded files may be older than a column: it is null there.
        body = f"""SELECT * FROM (SELECT {typed} WHERE false) UNION ALL BY NAME
            SELECT m.* EXCLUDE (filename), s.output_version, s.since, s.superseded_at, s.superseded_by, s.code_version,
                s.config_fingerprint
            FROM read_parquet({_listed(old)}, filename = true, union_by_name = true) m
            JOIN superseded s ON m.filename = s.path AND m.scan_id = s.scan_id"""
    else:
        body = """SELECT *, CAST(NULL AS VARCHAR) AS output_version, CAST(NULL AS TIMESTAMPTZ) AS since,
            CAST(NULL AS TIMESTAMPTZ) AS superseded_at,
            CAST(NULL AS VARCHAR) AS superseded_by,
            CAST(NULL AS VARCHAR) AS code_version, CAST(NULL AS VARCHAR) AS config_fingerprint FROM measurements WHERE false"""
    connection.execute(f"CREATE VIEW measurements_history AS {body}")
    connection.execute(
        "COMMENT ON VIEW measurements_history IS 'Superseded values of measurements, with when and by what'"
    )
    for column in MEASUREMENTS.columns:
        connection.execute(f'COMMENT ON COLUMN measurements_history."{column.name}" IS {_quoted(column.comment)}')
    for name, text in (
        ("output_version", "Version of the scan's rows that held the value"),
        ("since", "When the value became current [utc]"),
        ("superseded_at", "When the value was superseded [utc]"),
        ("superseded_by", "Version that superseded it"),
        ("code_version", "Version of the stage and its tables that made the value"),
        ("config_fingerprint", "Fingerprint of the configuration that made the value"),
    ):
        connection.execute(f"COMMENT ON COLUMN measurements_history.{name} IS {_quoted(text)}")


def _create_table(connection: duckdb.DuckDBPyConnection, name: str, schema: pa.Schema, rows: pa.Table) -> None:
    """A table of the catalog's own, with the rows of an Arrow table."""
    kinds = {pa.string(): "VARCHAR", SINCE: "TIMESTAMPTZ"}
    connection.execute(f"CREATE TABLE {name} ({', '.join(f'{f.name} {kinds[f.type]}' for f in schema)})")
    if rows.num_rows:
        connection.register("given", rows)
        connection.execute(f"INSERT INTO {name} SELECT {', '.join(schema.names)} FROM given")
        connection.unregister("given")


def _create_as_of(connection: duckdb.DuckDBPyConnection, current_since: pa.Table) -> None:
    """`measurements_as_of(moment)`: the rows that were current then, as far back as superseded versions are kept."""
    _create_table(connection, "current_since", CURRENT_SINCE, current_since)
    columns = ", ".join(f'm."{c.name}"' for c in MEASUREMENTS.columns)
    connection.execute(f"""
        CREATE MACRO measurements_as_of(moment) AS TABLE
        SELECT {columns} FROM measurements m JOIN current_since c ON m.scan_id = c.scan_id
        WHERE c.since <= CAST(moment AS TIMESTAMPTZ)
        UNION ALL
        SELECT {columns} FROM measurements_history m
        WHERE m.since <= CAST(moment AS TIMESTAMPTZ) AND m.superseded_at > CAST(moment AS TIMESTAMPTZ)""")


def _create_fused_clouds(connection: duckdb.DuckDBPyConnection) -> None:
    """Filtered points in the frame of their station's first sensor: transforms are stored, transformed copies are not."""
    connection.execute("""
        CREATE VIEW fused_clouds AS
        WITH pose AS (
            SELECT scan_id, station, source_sensor_id AS sensor_id, source_line AS line, qw, qx, qy, qz, tx_mm, ty_mm, tz_mm
            FROM registrations WHERE (source_sensor_id, source_line) <> (target_sensor_id, target_line)
            UNION SELECT DISTINCT scan_id, station, target_sensor_id, target_line, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 FROM registrations)
        SELECT c.scan_id, p.station, c.sensor_id, c.line, c.frame, c.row,
            (1 - 2 * (qy * qy + qz * qz)) * x_mm + 2 * (qx * qy - qz * qw) * y_mm + 2 * (qx * qz + qy * qw) * z_mm + tx_mm AS x_mm,
            2 * (qx * qy + qz * qw) * x_mm + (1 - 2 * (qx * qx + qz * qz)) * y_mm + 2 * (qy * qz - qx * qw) * z_mm + ty_mm AS y_mm,
            2 * (qx * qz - qy * qw) * x_mm + 2 * (qy * qz + qx * qw) * y_mm + (1 - 2 * (qx * qx + qy * qy)) * z_mm + tz_mm AS z_mm,
            c.u_depth_um
        FROM filtered_clouds c JOIN pose p ON c.scan_id = p.scan_id AND c.sensor_id = p.sensor_id AND c.line = p.line""")
    connection.execute(
        "COMMENT ON VIEW fused_clouds IS 'Filtered points of every sensor in the frame of the first sensor of its station [mm]'"
    )
    cloud = TABLES["filtered_clouds"]
    comments = {"scan_id": "Scan bundle that the row comes from", "station": "Station of the rig"}
    comments |= {name: cloud.column(name).comment for name in ("sensor_id", "line", "frame", "row", "u_depth_um")}
    for axis in "xyz":
        comments[f"{axis}_mm"] = f"{axis.upper()} in the frame of the station's first sensor [mm]"
    for name, text in comments.items():
        connection.execute(f"COMMENT ON COLUMN fused_clouds.{name} IS {_quoted(text)}")


assert set(_SQL_TYPES) == set(ARROW_TYPES)
