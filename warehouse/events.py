"""What a run does, as events for whoever listens: a name, and facts beside it (scan_id, stage, unit, state, seconds, …)."""

from __future__ import annotations

import logging
from typing import Any

LOGGER = logging.getLogger("wheelset")
LOGGER.addHandler(logging.NullHandler())


def event(name: str, level: int = logging.INFO, /, **facts: Any) -> None:
    """Something that happened; costs next to nothing if nobody listens. Facts that are None are left out."""
    if LOGGER.isEnabledFor(level):
        LOGGER.log(level, name, extra={"facts": {key: value for key, value in facts.items() if value is not None}})
