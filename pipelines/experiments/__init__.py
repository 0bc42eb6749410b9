"""`wheelset experiment …`: the paper's experiments and ours, each beside what the paper prints.

One module an experiment; each adds its command to `experiment_app` and imports what is heavy when it is called.
"""

from __future__ import annotations

import typer

experiment_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="The paper's experiments and ours: each prints its result beside the paper's, writes Parquet and a figure.",
)

from pipelines.experiments import ablation as _ablation  # noqa: E402, F401
from pipelines.experiments import accuracy as _accuracy  # noqa: E402, F401
from pipelines.experiments import depth as _depth  # noqa: E402, F401
from pipelines.experiments import rotation as _rotation  # noqa: E402, F401
from pipelines.experiments import smoothing as _smoothing  # noqa: E402, F401
from pipelines.experiments import translation as _translation  # noqa: E402, F401
