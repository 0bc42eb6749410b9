"""`wheelset export` of a real warehouse, read back by independent readers."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from small_campaign import Campaign

from pipelines.ask import open_read_only
from pipelines.export import export
from wheelset_assets.quality import ConfigError


def first(campaign: Campaign) -> tuple[str, str, np.ndarray]:
    """A scan, one of its sensors, and that sensor's filtered points."""
    connection = open_read_only(campaign.warehouse)
    scan, sensor = connection.execute(
        "SELECT scan_id, sensor_id::VARCHAR FROM filtered_clouds ORDER BY 1, 2 LIMIT 1"
    ).fetchall()[0]
    rows = connection.execute(
        "SELECT x_mm, y_mm, z_mm FROM filtered_clouds WHERE scan_id = ? AND sensor_id = ? ORDER BY frame, line, row",
        [scan, sensor],
    ).fetchall()
    connection.close()
    return scan, sensor, np.array(rows)


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "e57"])
def test_a_cloud_keeps_its_points(campaign: Campaign, tmp_path: Path, suffix: str) -> None:
    scan, sensor, points = first(campaign)
    out = tmp_path / f"cloud.{suffix}"
    n = export(campaign.warehouse, "cloud", scan, out, "filtered_clouds", sensor, None)
    if suffix == "e57":
        pye57 = pytest.importorskip("pye57")
        file = pye57.E57(str(out))
        data = file.read_scan_raw(0)
        found = np.column_stack([data[f"cartesian{axis}"] for axis in "XYZ"])
        file.close()
    elif suffix == "xyz":
        found = np.loadtxt(out)
    else:
        o3d = pytest.importorskip("open3d")
        found = np.asarray(o3d.io.read_point_cloud(str(out)).points)
    assert n == len(points) == len(found)
    assert np.max(np.abs(found - points)) < 1e-4


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_measurements_as_dfq_csv_and_excel(campaign: Campaign, tmp_path: Path) -> None:
    aqdef = pytest.importorskip("aqdefreader")
    connection = open_read_only(campaign.warehouse)
    stored = connection.execute(
        "SELECT value FROM measurements WHERE purpose = 'production' AND quantity = 'wheel_diameter' AND side = 'left'"
        " ORDER BY captured_at, scan_id"
    ).fetchall()
    connection.close()
    n = export(campaign.warehouse, "measurements", None, tmp_path / "m.dfq", "", None, None)
    part = aqdef.read_dfq_file(str(tmp_path / "m.dfq")).get_part(0)
    (found,) = [c for c in part.get_characteristics() if c.get_data("K2002") == "wheel diameter left"]
    values = [float(m.value) for m in found.get_measurements() if int(m.attribute or 0) == 0]
    assert values == pytest.approx([value for (value,) in stored if value is not None], abs=6e-6)
    assert float(found.get_data("K2110")) == 830.0
    assert export(campaign.warehouse, "measurements", None, tmp_path / "m.csv", "", None, None) == n
    with (tmp_path / "m.csv").open(encoding="utf-8", newline="") as file:
        assert len(list(csv.DictReader(file))) == n
    openpyxl = pytest.importorskip("openpyxl")
    export(campaign.warehouse, "measurements", None, tmp_path / "m.xlsx", "", None, None)
    assert openpyxl.load_workbook(tmp_path / "m.xlsx").active.max_row == n + 1


def test_what_cannot_be_exported_says_why(campaign: Campaign, tmp_path: Path) -> None:
    scan, _, _ = first(campaign)
    with pytest.raises(ConfigError, match="can be written as"):
        export(campaign.warehouse, "cloud", scan, tmp_path / "x.doc", "filtered_clouds", None, None)
    with pytest.raises(ConfigError, match="choose one sensor_id of"):
        export(campaign.warehouse, "cloud", scan, tmp_path / "x.ply", "filtered_clouds", "nobody", None)
    with pytest.raises(ConfigError, match="no such scan"):
        export(campaign.warehouse, "cloud", "nothing", tmp_path / "x.ply", "filtered_clouds", None, None)
    with pytest.raises(ConfigError, match="--side"):
        export(campaign.warehouse, "profile", scan, tmp_path / "x.whl", "", None, None)
