"""`wheelset tool …`: the parts of the method on anyone's files, without a rig, an inbox or a warehouse.

One module a tool; each adds its command to `tool_app` and imports what is heavy when it is called.
"""

from __future__ import annotations

import typer

tool_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="The parts of the method on any files: no rig, inbox or warehouse is needed.",
)

from pipelines.tools import calibrate as _calibrate  # noqa: E402, F401
from pipelines.tools import msa as _msa  # noqa: E402, F401
from pipelines.tools import profile as _profile  # noqa: E402, F401
from pipelines.tools import register as _register  # noqa: E402, F401
from pipelines.tools import stripes as _stripes  # noqa: E402, F401
