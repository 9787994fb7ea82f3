"""Clones of graphs and runners: running them leaves no trace in the user's own nodes and pipelines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, TypeGuard

from epypes.graph import CompGraph, with_defaults, with_functions
from epypes.pipeline import Node, Pipeline
from epypes.run import CompGraphRunner
from epypes.run.guard import as_written

# A node may be made to wrap itself; no graph needs to wrap this deep.
_DEEPEST: Final = 100


def called_by(function: Any) -> Any:
    """Return the function of a node that does nothing else than call it; anything else as it is."""
    for _ in range(_DEEPEST):
        kind = type(function)
        if not isinstance(function, Node) or isinstance(function, Pipeline):
            break
        if kind.compute is not Node.compute or kind.__call__ is not Node.__call__:
            break
        function = as_written(function.func)
    return function


def is_plain_pipeline(function: Any) -> TypeGuard[Pipeline]:
    """Whether this is a pipeline that does nothing else than run its graph."""
    kind = type(function)
    hooks = ("__call__", "compute", "run")
    return isinstance(function, Pipeline) and all(getattr(kind, hook) is getattr(Pipeline, hook) for hook in hooks)


def clone_graph(cg: CompGraph) -> CompGraph:
    """Return the same graph with nodes and pipelines of its own, whose times and counts the user does not see.

    Nodes and pipelines that do something of their own stay themselves: a copy could not do it.
    """
    functions = {name: _clone(function) for name, function in cg.functions.items()}
    is_same = all(function is cg.functions[name] for name, function in functions.items())
    return cg if is_same else with_functions(cg, functions)


def _clone(function: Any) -> Any:
    inner = called_by(function)
    if not is_plain_pipeline(inner):
        return inner
    hyperparameters = inner.runner.hyperparameters
    cg = _frozen(clone_graph(inner.source_cg), hyperparameters)
    return Pipeline(inner.name, cg, hyperparameters, workers=inner.runner.workers)


def clone_runner(runner: CompGraphRunner, hyperparameters: Mapping[str, Any] | None = None) -> CompGraphRunner:
    """Return another runner of a clone of the graph, with the same options; what was unfrozen is an input there too.

    Parameters
    ----------
    runner
        The runner; it stays as it is.
    hyperparameters
        Its values in place of the runner's own, such as copies of them.
    """
    values = runner.hyperparameters if hyperparameters is None else hyperparameters
    return CompGraphRunner(
        _frozen(clone_graph(runner.cg), values), values,
        workers=runner.workers, guard=runner.guard, check_mutation=runner.check_mutation,
    )  # fmt: skip


def _frozen(cg: CompGraph, hyperparameters: Mapping[str, Any]) -> CompGraph:
    """Return the graph without the defaults that a runner with these hyperparameters has unfrozen."""
    frozen = {token: value for token, value in cg.defaults.items() if token in hyperparameters}
    return cg if len(frozen) == len(cg.defaults) else with_defaults(cg, frozen)
