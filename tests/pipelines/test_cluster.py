"""More than one machine: a run over a Dask cluster, one worker killed on the way, leaves what a local run leaves."""

from __future__ import annotations

from pathlib import Path

import pytest
from dask_cluster import cluster
from small_campaign import Campaign, run
from test_main_job import versions

pytest.importorskip("distributed", reason="the extra cluster is not installed")


def test_dask_workers_one_killed_make_the_same_data(tiny: Campaign, tmp_path: Path) -> None:
    with cluster(tmp_path / "dask", 2) as made:
        lost = made.processes[-1]

        def progress(what: str, unit: str, done: int, total: int) -> None:
            if what == "triangulated_clouds" and done == 1 and lost.poll() is None:
                made.kill(lost)

        summary = run(tiny.inbox, tmp_path / "warehouse", cluster=made.address, progress=progress)
    assert lost.poll() is not None
    assert {n: summary[n] for n in ("measured", "refused", "failed")} == {
        n: tiny.summary[n] for n in ("measured", "refused", "failed")
    }
    assert versions(tmp_path / "warehouse") == versions(tiny.warehouse)
