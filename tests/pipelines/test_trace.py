"""The lineage of a scan down to its files, whatever became of it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from small_campaign import Campaign

from pipelines.trace import trace
from wheelset_assets.quality import ConfigError

Node = dict[str, Any]


def nodes(tree: Node) -> Iterator[Node]:
    """The tree, node by node."""
    yield tree
    for child in tree["inputs"]:
        yield from nodes(child)


def good(campaign: Campaign) -> str:
    """A production scan that was measured."""
    return next(p.name for p in sorted((campaign.inbox / "scans").glob("WS-*")) if p.name not in campaign.faults)


def test_every_stage_reference_calibration_and_file(campaign: Campaign) -> None:
    scan = good(campaign)
    found = list(nodes(trace(campaign.warehouse, scan, None)))
    names = {node["name"] for node in found}
    stages = ("measurements", "alignments", "registrations", "features", "filtered_clouds", "triangulated_clouds")
    assert {f"{stage} of {scan}" for stage in stages} <= names
    calibration = next(node for node in found if node["name"].startswith("calibrations of "))
    assert any(node["name"].endswith(".png") for node in nodes(calibration))
    reference = next(node for node in found if node["kind"] == "reference")
    assert any(node["name"] == f"alignments of {reference['version']}" for node in nodes(reference))
    listed = json.loads((campaign.inbox / "scans" / scan / "scan.json").read_text())["files"]
    bundle = next(node for node in found if node["name"] == f"bundle {scan}")
    assert {node["name"]: node["version"] for node in bundle["inputs"] if node["name"] != "scan.json"} == listed
    for node in found:
        if node["kind"] == "stage":
            assert len(node["config_fingerprint"]) == 16
            assert node["produced_at"]
            assert node["outputs"]
            assert len({child["name"] for child in node["inputs"]}) == len(node["inputs"])


def test_one_value(campaign: Campaign) -> None:
    scan = good(campaign)
    tree = trace(campaign.warehouse, None, f"{scan}/wheel_diameter/left")
    assert tree["kind"] == "measurement"
    assert (tree["value"] is None) != (tree["reason"] is None)
    assert tree["inputs"][0]["name"] == f"measurements of {scan}"


def test_spoilt_scans_tell_how_far_they_came(campaign: Campaign) -> None:
    for scan, kind in campaign.faults.items():
        tree = trace(campaign.warehouse, scan, None)
        assert tree["reason"], kind
        if kind in ("wrong-hash", "missing-image"):
            assert (tree["name"], tree["state"], tree["inputs"]) == (f"bundle {scan}", "refused", [])
        else:
            assert tree["name"] == f"triangulated_clouds of {scan}"
            assert any(node["name"] == f"bundle {scan}" for node in nodes(tree)), kind


def test_what_is_not_there(campaign: Campaign) -> None:
    with pytest.raises(ConfigError, match="scan nothing is not in the ledger"):
        trace(campaign.warehouse, "nothing", None)
    with pytest.raises(ConfigError, match="expected SCAN/QUANTITY/SIDE"):
        trace(campaign.warehouse, None, "a/b")
    with pytest.raises(ConfigError, match="there is no measurement"):
        trace(campaign.warehouse, None, f"{good(campaign)}/nonsense/left")
