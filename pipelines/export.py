"""`wheelset export`: stored clouds, profiles and measurements in formats that others read."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.ask import open_read_only
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    import duckdb
    import numpy as np

CLOUDS = ("triangulated_clouds", "filtered_clouds", "fused_clouds")
FORMATS = {
    "cloud": ("ply", "pcd", "xyz", "e57"),
    "profile": ("whl", "prw", "csv"),
    "measurements": ("dfq", "csv", "xlsx"),
}


def export(root: Path, what: str, scan: str | None, out: Path, cloud: str, sensor: str | None, side: str | None) -> int:
    """Write what was asked for into `out`, by its suffix; the number of points or values written."""
    if what not in FORMATS:
        raise ConfigError(f"export {what!r}: expected one of {', '.join(FORMATS)}")
    format_ = out.suffix.lstrip(".").lower()
    if format_ not in FORMATS[what]:
        raise ConfigError(f"--out {out}: a {what} can be written as {', '.join('.' + f for f in FORMATS[what])}")
    connection = open_read_only(root)
    try:
        if what == "measurements":
            return _measurements(connection, scan, out, format_)
        if scan is None:
            raise ConfigError(f"export {what}: name the scan by --scan")
        if not connection.execute("SELECT 1 FROM scan_status WHERE scan_id = ?", [scan]).fetchall():
            raise ConfigError(f"--scan {scan!r}: no such scan in {root}")
        if what == "cloud":
            return _cloud(connection, scan, out, format_, cloud, sensor)
        return _profile(connection, scan, out, format_, side)
    finally:
        connection.close()


def _cloud(
    connection: duckdb.DuckDBPyConnection, scan: str, out: Path, format_: str, cloud: str, sensor: str | None
) -> int:
    """A stored cloud in mm: each sensor's own frame, or, for fused_clouds, that of its station's first sensor."""
    import numpy as np

    if cloud not in CLOUDS:
        raise ConfigError(f"--cloud {cloud!r}: expected one of {', '.join(CLOUDS)}")
    column = "station" if cloud == "fused_clouds" else "sensor_id"
    known = [
        row[0]
        for row in connection.execute(
            f"SELECT DISTINCT {column}::VARCHAR FROM {cloud} WHERE scan_id = ? ORDER BY 1", [scan]
        ).fetchall()
    ]
    if not known:
        raise ConfigError(f"export cloud: {scan} has no {cloud}")
    if sensor not in known:
        raise ConfigError(f"--sensor {sensor!r}: the frames differ, so choose one {column} of {', '.join(known)}")
    table = connection.sql(
        f"SELECT x_mm, y_mm, z_mm FROM {cloud} WHERE scan_id = ? AND {column}::VARCHAR = ? ORDER BY frame, line, row"
        if cloud != "fused_clouds"
        else f"SELECT x_mm, y_mm, z_mm FROM {cloud} WHERE scan_id = ? AND {column} = ? ORDER BY sensor_id, frame, line, row",
        params=[scan, sensor],
    ).to_arrow_table()
    points = np.column_stack([np.asarray(table.column(name), dtype=np.float64) for name in ("x_mm", "y_mm", "z_mm")])
    out.parent.mkdir(parents=True, exist_ok=True)
    _write_points(points, out, format_)
    return len(points)


def _write_points(points: np.ndarray, out: Path, format_: str) -> None:
    if format_ == "e57":
        try:
            import pye57
        except ImportError as error:
            raise ConfigError("--out *.e57: needs the extra `e57` (pip install 'wheelset[e57]')") from error
        out.unlink(missing_ok=True)
        file = pye57.E57(str(out), mode="w")
        file.write_scan_raw({f"cartesian{axis}": points[:, i].copy() for i, axis in enumerate("XYZ")}, name=out.stem)
        file.close()
        return
    if format_ == "xyz":
        import numpy as np

        np.savetxt(out, points, fmt="%.6f")
        return
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if not o3d.io.write_point_cloud(out, cloud):
        raise ConfigError(f"--out {out}: cannot be written")


def _profile(connection: duckdb.DuckDBPyConnection, scan: str, out: Path, format_: str, side: str | None) -> int:
    """The mean meridian of one wheel over its turn, as s (0 on the datum circle 70 mm from the inner face) and height."""
    import numpy as np

    from wheelset_assets.exchange import miniprof, simpack

    if side not in ("left", "right"):
        raise ConfigError("export profile: name the wheel by --side left or --side right")
    rows = connection.execute(
        "SELECT p.from_inner_face_mm - 70, p.height_mm, a.side FROM wheel_profiles p"
        " JOIN alignments a ON a.scan_id = p.scan_id AND a.station = p.station"
        " WHERE p.scan_id = ? AND a.side = ? AND p.height_mm IS NOT NULL ORDER BY 1, 2",
        [scan, side],
    ).fetchall()
    if len(rows) < 3:
        raise ConfigError(f"export profile: {scan} has no stored profile of the {side} wheel")
    s, z = np.array([row[:2] for row in rows], dtype=float).T
    facts = connection.execute(
        "SELECT wheelset_id, strftime(captured_at, '%Y-%m-%d %H:%M:%S'), wheelset_temperature_c"
        " FROM measurements WHERE scan_id = ? LIMIT 1",
        [scan],
    ).fetchall()
    wheelset, moment, temperature = facts[0] if facts else ("", "", None)
    if format_ == "whl":
        header = {"ProgramName": "wheelset", "WheelID": wheelset, "ScanID": scan, "Side": side, "DateTime": moment}
        header |= {"Temperature": f"{temperature:.2f}"} if temperature is not None else {}
        text = miniprof.write(miniprof.MiniProfProfile(s, z, header))
    elif format_ == "prw":
        text = simpack.write(s, z, f"{wheelset} {side} {scan} {moment}")
    else:
        text = "s_mm,z_mm\n" + "".join(f"{a:.6f},{b:.6f}\n" for a, b in zip(s, z, strict=True))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8", newline="")
    return len(s)


def _measurements(connection: duckdb.DuckDBPyConnection, scan: str | None, out: Path, format_: str) -> int:
    """Production values, all or of one scan; as DFQ by characteristic with operating limits and the wheelset as serial."""
    rows = connection.sql(
        "SELECT * FROM measurements WHERE purpose = 'production' AND (?::VARCHAR IS NULL OR scan_id = ?)"
        " ORDER BY captured_at, scan_id, quantity, side",
        params=[scan, scan],
    ).to_arrow_table()
    if not rows.num_rows:
        raise ConfigError("export measurements: there are none" + (f" of scan {scan}" if scan else ""))
    out.parent.mkdir(parents=True, exist_ok=True)
    if format_ == "csv":
        from warehouse.render import csv_of

        out.write_text(csv_of(rows), encoding="utf-8", newline="")
    elif format_ == "xlsx":
        from warehouse.render_xlsx import table_book

        out.write_bytes(table_book("measurements", rows))
    else:
        out.write_text(_dfq(connection, rows.to_pylist()), encoding="utf-8", newline="")
    return int(rows.num_rows)


def _dfq(connection: duckdb.DuckDBPyConnection, rows: list[dict[str, Any]]) -> str:
    from wheelset_assets.exchange import qdas

    limits = {
        key[:2]: key[2:]
        for key in connection.execute(
            "SELECT quantity, side, max(limit_min), min(limit_max) FROM verdicts WHERE level = 'operating' GROUP BY ALL"
        ).fetchall()
    }
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["quantity"], row["side"]), []).append(row)
    characteristics = [
        qdas.Characteristic(
            name=re.sub("_", " ", f"{quantity} {side}"),
            unit=found[0]["unit"],
            values=[row["value"] for row in found],
            times=[row["captured_at"] for row in found],
            serials=[row["wheelset_id"] for row in found],
            limit_min=limits.get((quantity, side), (None, None))[0],
            limit_max=limits.get((quantity, side), (None, None))[1],
        )
        for (quantity, side), found in groups.items()
    ]
    return qdas.write("wheelset", "wheelset", characteristics)
