"""Every question of docs/sql-cookbook.md is asked of a real warehouse, through the command's own gate; and the shell."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from small_campaign import Campaign

from pipelines.ask import query
from pipelines.shell import Shell
from wheelset_assets.quality import ConfigError

COOKBOOK = Path(__file__).parents[2] / "docs" / "sql-cookbook.md"
RECIPES = re.findall(
    r"^## (\d+\. .+?)$.*?```sql\n(.*?)```", COOKBOOK.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
)
MAY_BE_EMPTY = {"16", "17", "18"}
"""Superseded values, and verdicts that a young fleet does not give."""


def test_the_questions_are_numbered() -> None:
    assert [int(head.split(".")[0]) for head, _ in RECIPES] == list(range(1, 23))


@pytest.mark.parametrize(("head", "text"), RECIPES, ids=[head for head, _ in RECIPES])
def test_the_question_has_an_answer(campaign: Campaign, head: str, text: str) -> None:
    answer = query(campaign.warehouse, text)
    assert answer.num_columns > 1
    if head.split(".")[0] not in MAY_BE_EMPTY:
        assert answer.num_rows > 0, head


def test_the_shell_answers_lists_and_explains(campaign: Campaign, capsys: pytest.CaptureFixture[str]) -> None:
    told: list[str] = []
    shell = Shell(campaign.warehouse, told.append)
    assert shell.line(".tables")
    assert any(line.startswith("measurements ") and "20 °C" in line for line in told)
    told.clear()
    assert shell.line(".schema measurements")
    assert any(line.startswith("expanded_uncertainty") and "U = k u" in line for line in told)
    assert shell.line("SELECT count(*) AS n")
    assert shell.pending
    assert shell.line("FROM measurements;")
    assert "n" in capsys.readouterr().out
    assert shell.line(".format csv")
    assert shell.line("SELECT 1 AS one;")
    assert capsys.readouterr().out == '"one"\n1\n'
    told.clear()
    assert shell.line("DELETE FROM measurements;")
    assert "only queries are allowed" in told[0]
    assert shell.line(".schema nothing")
    assert "expected a view" in told[-1]
    assert shell.line(".nonsense")
    assert ".tables" in told[-1]
    assert not shell.line(".quit")


def test_the_shell_filters_and_completes(campaign: Campaign, capsys: pytest.CaptureFixture[str]) -> None:
    shell = Shell(campaign.warehouse)
    shell.line(".format csv")
    shell.line(".set wheelset_id nobody")
    shell.line("SELECT count(*) AS n FROM production_values;")
    assert capsys.readouterr().out.splitlines()[-1] == "0"
    shell.line(".set wheelset_id")
    shell.line("SELECT count(*) > 0 AS n FROM production_values;")
    assert capsys.readouterr().out.splitlines()[-1] == "true"
    assert "value" in shell.words("SELECT va FROM measurements")
    assert "u_depth_um" not in shell.words("SELECT u FROM measurements")
    assert ".schema" in shell.words(".sc")
    assert "measurements" in shell.words(".schema mea")


def test_a_query_may_come_from_a_report(campaign: Campaign, tmp_path: Path) -> None:
    from warehouse.report import REPORTS
    from warehouse.report import query as file_of

    for spec in REPORTS.values():
        for block in spec.blocks:
            assert query(campaign.warehouse, file_of(block.sql).text).num_columns > 0
    with pytest.raises(ConfigError, match="one statement"):
        query(campaign.warehouse, "SELECT 1; SELECT 2")
