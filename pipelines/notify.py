"""The hook that sends a run's summary: a command of the site's own, which reads the JSON on its standard input."""

from __future__ import annotations

import json
import shlex
import subprocess
from typing import Any

SECONDS = 60


def send(command: str, document: dict[str, Any]) -> str | None:
    """Run the command; why it failed, or None. It is no shell line: pipes and the like belong into a script."""
    try:
        words = shlex.split(command)
        done = subprocess.run(
            words,
            input=json.dumps(document, default=str).encode(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=SECONDS,
            check=False,
        )
    except (OSError, ValueError, IndexError, subprocess.TimeoutExpired) as error:
        return f"--notify {command!r}: {error}"
    if done.returncode == 0:
        return None
    tail = done.stderr.decode(errors="replace").strip()[-200:]
    return f"--notify {command!r}: ended with {done.returncode}{': ' + tail if tail else ''}"
