"""`wheelset tool register`: formats in, JSON out, errors that say what to do."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from pipelines.tools import tool_app
from pipelines.tools.clouds import read_cloud, read_pose
from pipelines.tools.register import without_outliers
from wheelset_assets.metrology import rigid
from wheelset_assets.quality import ConfigError


@pytest.fixture(scope="module")
def hills():
    """Two samples (n, 3) of one bumpy sheet, and the pose of the first, thrown away, on the second."""
    random = np.random.default_rng(4)
    bumps = random.uniform(-30, 30, (14, 2))
    heights, widths = random.uniform(-6, 6, 14), random.uniform(4, 9, 14)
    clouds = []
    for low, high in ((-30, 18), (-18, 30)):
        a, b = random.uniform(low, high, 9000), random.uniform(-30, 30, 9000)
        square = ((np.column_stack([a, b])[:, None] - bumps) ** 2).sum(axis=2)
        clouds.append(np.column_stack([a, b, (heights * np.exp(-square / (2 * widths**2))).sum(axis=1)]))
    throw = rigid.transform(Rotation.random(rng=random).as_matrix(), [120.0, -40.0, 300.0])
    return rigid.apply(throw, clouds[0]), clouds[1], rigid.inverse(throw)


def write(points, path):
    """A cloud (n, 3) as a file of the kind that its name says."""
    kind = path.suffix
    if kind in (".ply", ".pcd"):
        open3d = pytest.importorskip("open3d", exc_type=ImportError)
        open3d.io.write_point_cloud(str(path), open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)))
    elif kind == ".xyz":
        path.write_text("x;y;z;intensity\n" + "\n".join(";".join(map(repr, map(float, p))) + ";7" for p in points))
    elif kind == ".e57":
        import pye57

        with pye57.E57(str(path), mode="w") as file:
            file.write_scan_raw({f"cartesian{c}": np.ascontiguousarray(points[:, k]) for k, c in enumerate("XYZ")})
    else:
        pq.write_table(pa.table({c: points[:, k] for k, c in enumerate(("x_mm", "y_mm", "z_mm"))}), path)
    return path


@pytest.mark.parametrize("kind", [".ply", ".pcd", ".xyz", ".e57", ".parquet"])
def test_every_kind_of_file_gives_its_points(hills, tmp_path, kind):
    points = hills[0][:200]
    found = read_cloud(write(points, tmp_path / f"cloud{kind}"))
    assert found.shape == (200, 3)
    assert np.abs(found - points).max() < 1e-4  # PCD holds single precision


def call(*arguments):
    """Exit code, standard output and standard error of the command, called as the program calls it."""
    result = CliRunner().invoke(tool_app, ["register", *map(str, arguments)], standalone_mode=False)
    if isinstance(result.exception, ConfigError):
        raise result.exception
    return result.return_value, result.stdout


def test_two_clouds_are_registered_from_nothing_and_from_a_start(hills, tmp_path):
    source, target, truth = hills
    files = write(source, tmp_path / "a.parquet"), write(target, tmp_path / "b.xyz")
    code, text = call(*files, "--json", "--out", tmp_path / "pose.txt")
    found = json.loads(text)
    assert code == 0
    assert np.abs(rigid.apply(np.array(found["target_from_source"]), source) - rigid.apply(truth, source)).max() < 0.05
    assert np.shape(found["information"]) == (6, 6)
    assert found["n_constrained"] == 6
    assert 0.7 < found["fitness"] < 0.85
    assert 0 < found["inlier_rmse"] < 0.1
    code, text = call(*files, "--json", "--initial", tmp_path / "pose.txt")
    again = json.loads(text)
    assert code == 0
    assert again["started_from"] == "initial"
    assert np.array(again["target_from_source"]) == pytest.approx(np.array(found["target_from_source"]), abs=1e-3)


def test_what_cannot_be_registered_ends_with_code_three_and_a_reason(hills, tmp_path):
    flat = np.column_stack([np.random.default_rng(0).uniform(0, 10, (3000, 2)), np.zeros(3000)])
    files = write(flat, tmp_path / "flat.xyz"), write(hills[1], tmp_path / "b.parquet")
    code, text = call(*files, "--json")
    assert code == 3
    assert json.loads(text)["reason"]


def test_errors_name_the_file_and_the_remedy(tmp_path):
    for name, content, message in (
        ("none.ply", None, "no such file"),
        ("cloud.obj", "v 0 0 0", "PLY, PCD, XYZ"),
        ("empty.xyz", "# nothing", "three numbers"),
    ):
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(ConfigError, match=message):
            read_cloud(tmp_path / name)
    for content, message in (
        ("1 0 0", "3 numbers"),
        ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "no rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 5 5 5 1", "last row"),
    ):
        (tmp_path / "pose.txt").write_text(content)
        with pytest.raises(ConfigError, match=message):
            read_pose(tmp_path / "pose.txt")


@pytest.mark.parametrize("kind", ["statistical", "radius"])
def test_outliers_are_left_out_on_demand(hills, tmp_path, kind):
    """A twentieth of gross outliers, about half a sheet's size away: most go, and few points of the sheet."""
    source, target, truth = hills
    random = np.random.default_rng(8)
    dirt = rigid.apply(rigid.inverse(truth), random.uniform(-60, 60, (450, 3)))
    dirty = np.concatenate([source, dirt])
    places = write(dirty, tmp_path / "a.parquet"), write(target, tmp_path / "b.parquet")
    code, printed = call(*places, "--outliers", kind, "--json")
    found = json.loads(printed)
    assert code == 0
    assert 250 < found["n_outliers"] < 900
    kept = without_outliers(dirty, kind)
    assert len(kept) > 0.97 * len(source)
    left_over = np.isin(kept.round(9).view([("", float)] * 3), dirt.round(9).view([("", float)] * 3)).sum()
    assert left_over < 0.5 * len(dirt)
    assert found["n_source"] + found["n_target"] + found["n_outliers"] == len(dirty) + len(target)
    error = np.array(found["target_from_source"]) @ rigid.inverse(truth)
    assert np.abs(error[:3, 3] + error[:3, :3] @ target.mean(axis=0) - target.mean(axis=0)).max() < 0.2
    assert json.loads(call(*places, "--json")[1])["n_outliers"] == 0


def test_removing_every_point_names_the_option(hills, tmp_path):
    places = write(hills[0][:2], tmp_path / "a.parquet"), write(hills[1], tmp_path / "b.parquet")
    with pytest.raises(ConfigError, match="--outliers radius leaves none"):
        call(*places, "--outliers", "radius")
