"""`wheelset diff`: the same scans under another configuration, and what became of the values."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_campaign import Campaign, run

from pipelines.ask import open_read_only
from warehouse.report import diff
from wheelset_assets.quality import ConfigError


def test_what_another_configuration_changes(campaign: Campaign, tmp_path: Path) -> None:
    copy = campaign.copy(tmp_path)
    before = open_read_only(copy.warehouse)
    old = {
        row[:3]: row[3:]
        for row in before.execute(
            "SELECT scan_id, quantity, side, value, expanded_uncertainty FROM measurements"
        ).fetchall()
    }
    (first,) = before.execute("SELECT DISTINCT config_fingerprint FROM diff_versions").fetchall()
    before.close()
    config = tmp_path / "other.toml"
    config.write_text("[measurement]\naxis_u_um = 2.5\n")
    run(copy.inbox, copy.warehouse, config=config)
    connection = open_read_only(copy.warehouse)
    rows = diff(connection, first[0][:8], "current").blocks["values"].table.to_pylist()
    scans = {key[0] for key, (value, _) in old.items() if value is not None}  # the first reference has none to change
    assert {(row["scan_id"], row["quantity"], row["side"]) for row in rows} == {key for key in old if key[0] in scans}
    for row in rows:
        value, expanded = old[row["scan_id"], row["quantity"], row["side"]]
        assert row["old_value"] == value
        assert row["old_expanded_uncertainty"] == expanded
        if row["what"] == "changed" and value is not None:
            assert row["change"] == pytest.approx(row["new_value"] - value)
    grown = [
        row["new_expanded_uncertainty"] > row["old_expanded_uncertainty"]
        for row in rows
        if row["quantity"] == "journal_diameter" and row["old_value"] is not None
    ]
    assert grown
    assert all(grown)  # the axis of rotation enters every diameter
    same = diff(connection, "current", "current").blocks["values"].table.to_pylist()
    assert {row["what"] for row in same} == {"same"}
    with pytest.raises(ConfigError, match="no such version"):
        diff(connection, "9.9.9", "current")
