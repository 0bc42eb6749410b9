"""Inboxes without physics, and stages that make their outputs up."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_inbox import FakeStages, inbox_of

from warehouse import night


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> FakeStages:
    """Stages that cost nothing, in place of the eight real ones."""
    fake = FakeStages()
    monkeypatch.setattr(night, "execute", fake)
    return fake


@pytest.fixture
def inbox(tmp_path: Path) -> Path:
    """One day: a reference scan and two scans of a wheelset."""
    return inbox_of(tmp_path / "inbox")
