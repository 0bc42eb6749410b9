"""Inbox and warehouse in object storage: runs by local processes and by Dask workers leave what a run on a disk leaves,
and every command works on it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from dask_cluster import cluster
from small_campaign import Campaign, run

from pipelines.ask import query
from pipelines.trace import trace
from warehouse import place
from warehouse.check import verify
from warehouse.collect import Retention, collect
from wheelset_assets.quality import ConfigError

pytest.importorskip("s3fs", reason="the extra cluster is not installed")

ROOT = Path(__file__).parents[2]
CURRENT = "SELECT unit, stage, output_name, output_version, input_name, input_version, path FROM lineage WHERE superseded_at IS NULL"
SCAN = "WS-000-20250405-00"


def versions(root: Path) -> set[tuple]:
    """Every current output with its version, inputs and path."""
    return {tuple(row.values()) for row in query(root, CURRENT).to_pylist()}


def upload(folder: Path, to: str) -> Path:
    """A folder copied to object storage."""
    at = place.place(to)
    place.filesystem(at).put(f"{folder}/", place.key(at), recursive=True)
    return at


@pytest.fixture(scope="module")
def stored(tiny: Campaign, s3: dict[str, str]) -> Campaign:
    """The tiny campaign, processed by local workers from and to object storage."""
    from s3_server import BUCKET

    inbox, warehouse = upload(tiny.inbox, f"s3://{BUCKET}/site/inbox"), place.place(f"s3://{BUCKET}/site/warehouse")
    return Campaign(inbox, warehouse, tiny.faults, run(inbox, warehouse, workers=2))


def test_local_workers_make_the_same_data(tiny: Campaign, stored: Campaign) -> None:
    assert versions(stored.warehouse) == versions(tiny.warehouse) != set()
    counts = ("measured", "refused", "failed", "points")
    assert {n: stored.summary[n] for n in counts} == {n: tiny.summary[n] for n in counts}
    again = run(stored.inbox, stored.warehouse)
    assert (again["measured"], again["points"], again["unchanged"]) == (0, 0, 6)


def test_two_dask_workers_one_killed_make_the_same_data(
    tiny: Campaign, stored: Campaign, prefix: str, s3: dict[str, str], tmp_path: Path
) -> None:
    warehouse = place.place(prefix)
    with cluster(tmp_path, 2, s3) as made:
        lost = made.processes[-1]

        def progress(what: str, unit: str, done: int, total: int) -> None:
            if what == "triangulated_clouds" and lost.poll() is None:
                made.kill(lost)

        run(stored.inbox, warehouse, cluster=made.address, progress=progress)
    assert lost.poll() is not None
    assert versions(warehouse) == versions(tiny.warehouse)


def test_a_knob_recomputes_from_its_stage_on_and_history_can_be_asked(stored: Campaign, tmp_path: Path) -> None:
    at = copy(stored, "knob")
    config = tmp_path / "knobs.toml"
    config.write_text("[filtering]\ngaussian_sigma_rows = 0.7\n")
    before = versions(at.warehouse)
    summary = run(at.inbox, at.warehouse, config=config)
    assert summary["measured"] == 4
    assert summary["points"] == 0, "no cloud was triangulated again"
    assert versions(at.warehouse) != before
    rows = query(at.warehouse, "SELECT count(*) AS n, count(superseded_at) AS s FROM measurements_history").to_pylist()[
        0
    ]
    assert rows["n"] == rows["s"] > 0
    gone = collect(at.warehouse, Retention(keep_days=0, keep_versions=0), delete=True)
    assert gone.versions > 0
    assert gone.files > 0
    assert not set(gone.paths) & set(place.objects(at.warehouse))
    after = verify(at.warehouse, None)
    assert (after["broken"], after["unnamed"]) == ([], 0)
    assert query(at.warehouse, "SELECT count(*) AS n FROM measurements_history").to_pylist() == [{"n": 0}]


def copy(stored: Campaign, name: str) -> Campaign:
    """The warehouse copied to another prefix: its catalog is rebuilt there."""
    to = place.place(f"{stored.warehouse}-{name}")
    files = place.filesystem(to)
    for name in place.objects(stored.warehouse):
        files.copy(f"{place.key(stored.warehouse)}/{name}", f"{place.key(to)}/{name}")
    return Campaign(stored.inbox, to, stored.faults, stored.summary)


def test_a_broken_object_is_found(stored: Campaign) -> None:
    at = copy(stored, "rot")
    query(at.warehouse, "FROM scan_status")  # rebuilds the catalog, which names the place that it was copied from
    assert verify(at.warehouse, at.inbox) == {**verify(stored.warehouse, None), "broken": []}
    file = next(n for n in sorted(place.objects(at.warehouse)) if n.startswith("filtered_clouds/"))
    (at.warehouse / file).write_bytes(b"rot")
    assert f"{file}: its bytes do not hash to its name" in verify(at.warehouse, None)["broken"]


def test_a_query_reads_the_warehouse_and_nothing_beside_it(stored: Campaign) -> None:
    (stored.warehouse.parent / "warehouse-secret.csv").write_bytes(b"a\n1\n")
    for file in (f"{stored.warehouse}-secret.csv", "/etc/passwd", f"{stored.inbox}/rigs/bench-1.json"):
        with pytest.raises(ConfigError, match="Permission Error"):
            query(stored.warehouse, f"SELECT * FROM read_text('{file}')")
    for pattern in ("../warehouse-secret.csv", "../*.csv", "x/../../*.csv"):  # object storage knows no way up
        assert query(stored.warehouse, f"FROM read_text('{stored.warehouse}/{pattern}')").num_rows == 0
    assert query(stored.warehouse, "SELECT count(*) AS n FROM fused_clouds").to_pylist()[0]["n"] > 1000


def test_the_lineage_of_a_scan_is_the_same(tiny: Campaign, stored: Campaign) -> None:
    def bare(node: dict) -> tuple:
        return node["name"], node["version"], [bare(child) for child in node["inputs"]]

    assert bare(trace(stored.warehouse, SCAN, None)) == bare(trace(tiny.warehouse, SCAN, None))


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["run"], 0),
        (["status"], 0),
        (["report", "accuracy"], 0),
        (["budget", SCAN, "--quantity", "wheel_diameter"], 0),
        (["replay", SCAN], 0),
        (["verify"], 0),
        (["sql", "SELECT recording FROM scan_status WHERE state = 'failed'"], 0),
        (["lineage", "no-such-scan"], 2),
    ],
)
def test_commands(stored: Campaign, tmp_path: Path, arguments: list[str], code: int) -> None:
    """From another folder, by names alone, as a user has them."""
    program = [sys.executable, "-c", "from pipelines.cli import main; main()", *arguments, "--json"]
    places = ["--inbox", str(stored.inbox), "--warehouse", str(stored.warehouse)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([*program, *places], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    if code == 0:
        document = json.loads(done.stdout)
        if arguments[0] == "status":
            assert document["idle"]
        if arguments[0] == "sql":
            (row,) = document
            assert row["recording"].startswith(str(stored.warehouse))
            assert place.place(row["recording"]).stat().st_size > 1000
        if arguments[0] == "replay":
            assert place.place(document["recording"]).stat().st_size > 1000
    assert list(tmp_path.iterdir()) == [], "nothing is left where the command ran"
