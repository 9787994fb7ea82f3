"""Nodes and pipelines made again: clones of graphs and runners, the arguments of a node, what a run has set on it.

To run a clone leaves no trace in the user's own nodes and pipelines.
"""

from __future__ import annotations

import dis
import inspect
from collections.abc import Iterator, Mapping
from typing import Any, Final, TypeGuard

from epypes.bundle.source.expressions import is_same_data
from epypes.bundle.source.objects import without_nodes
from epypes.bundle.source.references import nested_codes
from epypes.bundle.source.resolve import Refused, functions_of
from epypes.graph import CompGraph, with_defaults, with_functions
from epypes.pipeline import Node, Pipeline
from epypes.run import CompGraphRunner
from epypes.run.guard import as_written

# -- clones ------------------------------------------------------------------------------------------------------------


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
    inner = without_nodes(function)
    if not is_plain_pipeline(inner):
        return inner
    hyperparameters = inner.runner.current.own
    cg = _frozen(clone_graph(inner.source_cg), hyperparameters)
    return Pipeline(inner.name, cg, hyperparameters, workers=inner.runner.workers, guard=inner.runner.guard)


def clone_runner(runner: CompGraphRunner, hyperparameters: Mapping[str, Any] | None = None) -> CompGraphRunner:
    """Return another runner of a clone of the graph, with the same options; what was unfrozen is an input there too.

    Parameters
    ----------
    runner
        The runner; it stays as it is.
    hyperparameters
        Its values in place of the runner's own, such as copies of them.
    """
    values = runner.current.own if hyperparameters is None else hyperparameters
    return CompGraphRunner(
        _frozen(clone_graph(runner.cg), values), values,
        workers=runner.workers, guard=runner.guard, check_mutation=runner.check_mutation,
    )  # fmt: skip


def _frozen(cg: CompGraph, hyperparameters: Mapping[str, Any]) -> CompGraph:
    """Return the graph without the defaults that a runner with these hyperparameters has unfrozen."""
    frozen = {token: value for token, value in cg.defaults.items() if token in hyperparameters}
    return cg if len(frozen) == len(cg.defaults) else with_defaults(cg, frozen)


# -- the arguments that a node or pipeline was made with ---------------------------------------------------------------


def arguments_of(made: Node, what: str) -> dict[str, Any]:
    """Return the arguments that make an object again, by parameter; those that are as by default are left out.

    Raises
    ------
    Refused
        The object does not hold an argument.
    """
    held = dict(vars(made))
    if isinstance(made, Pipeline):
        runner = made.runner
        held |= {"cg": made.source_cg, "hparams": dict(runner.current.own) or None}
        held |= {"workers": runner.workers, "guard": runner.guard}
    found: dict[str, Any] = {}
    for parameter in parameters_of(type(made)):
        value = as_written(held.get(parameter.name, held.get(f"_{parameter.name}", parameter.default)))
        if value is parameter.empty:
            way_out = f"Keep it in __init__: self.{parameter.name} = {parameter.name}."
            raise Refused(f"{what} is made with {parameter.name!r}, which it does not keep. {way_out}")
        if value is not parameter.default and not is_same_data(value, parameter.default):
            found[parameter.name] = value
    return found


def parameters_of(kind: type) -> Iterator[inspect.Parameter]:
    """Give the parameters of a class's __init__; of those that take any others, also those of the class above."""
    seen: set[str] = set()
    for above in kind.__mro__:
        if "__init__" not in vars(above):
            continue
        _, *parameters = inspect.signature(vars(above)["__init__"]).parameters.values()
        named = [one for one in parameters if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)]
        yield from (parameter for parameter in named if parameter.name not in seen)
        seen.update(parameter.name for parameter in named)
        if len(named) == len(parameters):
            return


# What EPypes calls of an object when it runs.
_HOOKS: Final = ("__call__", "compute", "run", "handle", "emit", "stages", "f_in", "f_out", "on_error")
# What nodes and pipelines of EPypes keep of a run, or hand to each other.
_OF_EPYPES: Final = frozenset({
    *vars(Node("node", len)), "__wrapped__", "network", "runner", "source_cg", "attributes", "q_in", "q_out", "f_in",
    "f_out", "on_error", "failed", "_attempts", "_events", "_f_ins", "_failed_last", "_has_usual_emit", "_settled",
    "loop",
})  # fmt: skip


def is_set_by_runs(made: Node, name: str) -> bool:
    """Whether an attribute of a node is one of EPypes, or one that a run sets: what it counts or remembers."""
    value = vars(made)[name]
    return name in _OF_EPYPES or as_written(value) is not value or name in _attributes_set_by_runs(made)


def _attributes_set_by_runs(made: Node) -> set[str]:
    """Return the attributes that the methods set that a run calls: the hooks, and what the node was made to call."""
    functions: dict[str, Any] = {}
    for above in reversed(type(made).__mro__):
        functions |= functions_of(above)
    waiting = [*_HOOKS, getattr(getattr(made, "func", None), "__name__", "")]
    found, reached = set[str](), {"__init__"}
    while waiting:
        name = waiting.pop()
        if name in functions and name not in reached:
            reached.add(name)
            for code in nested_codes(functions[name].__code__):
                waiting += code.co_names
                found |= {one.argval for one in dis.get_instructions(code) if one.opname == "STORE_ATTR"}
    return found
