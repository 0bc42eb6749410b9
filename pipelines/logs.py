"""Structured logs: one JSON object a line, on standard error (`WHEELSET_LOG=json`) or in a file (`--log-json FILE`).

The warehouse says what happens through `logging` under the name `wheelset`, with facts beside the message; here they
become lines. Nothing is written unless asked for.
"""

from __future__ import annotations

import json
import logging
import os
from datetime import UTC, datetime
from pathlib import Path

from warehouse.events import LOGGER
from wheelset_assets.quality import ConfigError


class JsonLines(logging.Formatter):
    """`{"time": …, "level": …, "event": …, and the facts}`, times in UTC."""

    def format(self, record: logging.LogRecord) -> str:
        """One line; what is not JSON becomes its text."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
            **getattr(record, "facts", {}),
        }
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str, ensure_ascii=False)


def to_standard_error() -> bool:
    """Whether WHEELSET_LOG asks for JSON lines on standard error; ConfigError if it asks for something unknown."""
    wanted = os.environ.get("WHEELSET_LOG", "")
    if wanted not in ("", "json"):
        raise ConfigError(f"WHEELSET_LOG: expected json; found {wanted!r}")
    return bool(wanted)


def configure(file: Path | None = None) -> None:
    """Send the program's events where the user wants them. Called again, it takes the place of what was there."""
    for handler in list(LOGGER.handlers):
        LOGGER.removeHandler(handler)
        handler.close()
    handlers: list[logging.Handler] = [logging.StreamHandler()] if to_standard_error() else []
    if file is not None:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            handlers.append(logging.FileHandler(file, encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"--log-json {file}: cannot be written: {error.strerror}") from error
    for handler in handlers:
        handler.setFormatter(JsonLines())
        LOGGER.addHandler(handler)
    LOGGER.propagate = False
    LOGGER.setLevel(logging.INFO if handlers else logging.CRITICAL)
