"""The paper's experiment: a robot, image acquisition and vision, in one process or in several.

The same three nodes, functions and graph in every layout. Semeniuta and Falkman 2019, Figures 12 to 16.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from epypes.optional import optional_import

if TYPE_CHECKING:
    from epypes.experiment.graph import orb_graph, orb_hyperparameters, stereo_pair
    from epypes.experiment.results import Results
    from epypes.experiment.run import run_experiment

__all__ = ["Results", "orb_graph", "orb_hyperparameters", "run_experiment", "stereo_pair"]

_HOME = {"Results": "results", "run_experiment": "run"} | dict.fromkeys(
    ("orb_graph", "orb_hyperparameters", "stereo_pair"), "graph"
)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with optional_import("experiment"):
        return getattr(importlib.import_module(f"epypes.experiment.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
