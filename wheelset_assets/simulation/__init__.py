"""The simulator: true wheelsets and rigs, and the scan bundles that such a rig would hand over. Product code.

`simulate(SimulationPlan(out=...))` writes an inbox and, beside it, the truth. From the rest of the project it imports
only `metrology.rigid`: an error shared with an estimator would cancel and pass every test. Imports are lazy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .campaign import SimulatedCampaign, simulate
    from .faults import FAULTS
    from .noise import NoiseModel
    from .plan import Defects, SimulationPlan
    from .presets import PRESETS

__all__ = ["FAULTS", "PRESETS", "Defects", "NoiseModel", "SimulatedCampaign", "SimulationPlan", "simulate"]

_HOME = {
    "FAULTS": "faults",
    "PRESETS": "presets",
    "Defects": "plan",
    "NoiseModel": "noise",
    "SimulatedCampaign": "campaign",
    "SimulationPlan": "plan",
    "simulate": "campaign",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)
