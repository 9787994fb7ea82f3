"""Which graph computes what another one does, without a trace in the user's own nodes?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from epypes.bundle.nodes import called_by, is_plain_pipeline
from epypes.graph import CompGraph, with_defaults, with_functions
from epypes.pipeline import Pipeline


def apart(cg: CompGraph) -> CompGraph:
    """Return the same graph, in which nodes and pipelines are not those of the user, who may look at their times.

    Nodes and pipelines that do something of their own are kept, since only they know what else they do.
    """
    functions = {name: _own(function) for name, function in cg.functions.items()}
    is_same = all(function is cg.functions[name] for name, function in functions.items())
    return cg if is_same else with_functions(cg, functions)


def _own(function: Any) -> Any:
    inner = called_by(function)
    return _another(inner) if is_plain_pipeline(inner) else inner


def _another(pipeline: Pipeline) -> Pipeline:
    hyperparameters = pipeline.runner.hyperparameters
    cg = without_unfrozen(apart(pipeline.source_cg), hyperparameters)
    return Pipeline(pipeline.name, cg, hyperparameters, workers=pipeline.runner.workers)


def without_unfrozen(cg: CompGraph, hyperparameters: Mapping[str, Any]) -> CompGraph:
    """Return the graph without the defaults that a runner with these hyperparameters has unfrozen: they are inputs."""
    frozen = {token: value for token, value in cg.defaults.items() if token in hyperparameters}
    return cg if len(frozen) == len(cg.defaults) else with_defaults(cg, frozen)
