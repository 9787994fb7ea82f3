"""The arguments that a node or pipeline was made with.

They are read back from its attributes. What was set on it later is found by the comparison with the module's objects.
"""

from __future__ import annotations

import dis
import inspect
import types
from collections.abc import Iterator
from typing import Any, Final

from epypes.bundle.classes import functions_of
from epypes.bundle.notebook_source import nested_codes
from epypes.bundle.resolve import Refused
from epypes.bundle.syntax import is_same_data
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import as_written

_GIVEN: Final = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def arguments_of(made: Node, what: str) -> dict[str, Any]:
    """Return the arguments that make an object again, by parameter; those that are as by default are left out.

    Raises
    ------
    Refused
        The object does not hold an argument.
    """
    found: dict[str, Any] = {}
    for parameter in parameters_of(type(made)):
        value = _kept(made, parameter.name)
        if value is _MISSING and parameter.default is parameter.empty:
            way_out = f"Keep it in __init__: self.{parameter.name} = {parameter.name}."
            raise Refused(f"{what} is made with {parameter.name!r}, which it does not keep. {way_out}")
        if value is not _MISSING and value is not parameter.default and not is_same_data(value, parameter.default):
            found[parameter.name] = value
    return found


def by_position(kind: type) -> list[str]:
    """Return the arguments that may be given by position, in order."""
    first = next(above for above in kind.__mro__ if "__init__" in vars(above))
    _, *parameters = inspect.signature(vars(first)["__init__"]).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is parameter.POSITIONAL_OR_KEYWORD]


class _Missing:
    pass


_MISSING: Final = _Missing()


def parameters_of(kind: type) -> Iterator[inspect.Parameter]:
    """Give the parameters of a class's __init__; of those that take any others, also those of the class above."""
    seen: set[str] = set()
    for above in kind.__mro__:
        if "__init__" not in vars(above):
            continue
        _, *parameters = inspect.signature(vars(above)["__init__"]).parameters.values()
        named = [parameter for parameter in parameters if parameter.kind not in _GIVEN]
        yield from (parameter for parameter in named if parameter.name not in seen)
        seen.update(parameter.name for parameter in named)
        if len(named) == len(parameters):
            return


def _kept(made: Node, name: str) -> Any:
    """Return the value of an argument that an object keeps."""
    if isinstance(made, Pipeline) and name in ("cg", "hparams", "workers"):
        return {
            "cg": made.source_cg,
            "hparams": dict(made.runner.hyperparameters) or None,
            "workers": made.runner.workers,
        }[name]
    for attribute in (name, f"_{name}"):
        if attribute in vars(made):
            return as_written(vars(made)[attribute])
    return _MISSING


# What EPypes calls of an object when it runs.
_HOOKS: Final = ("__call__", "compute", "run", "handle", "emit", "stages", "f_in", "f_out", "on_error")
# What the pipelines of EPypes keep of a run, or hand to each other.
_PIPELINES: Final = frozenset({
    "network", "runner", "source_cg", "attributes", "q_in", "q_out", "f_in", "f_out", "on_error", "failed",
    "working_on", "_attempts", "_failed_last", "_own", "loop",
})  # fmt: skip


def is_set_elsewhere(made: Node, name: str) -> bool:
    """Whether an attribute of a node is one of EPypes, or one that a run sets: what it counts or remembers."""
    if name in {*vars(Node("node", len)), *_PIPELINES, "__wrapped__"}:
        return True
    is_watched = as_written(vars(made)[name]) is not vars(made)[name]
    return is_watched or name in {*_set_by_runs(type(made), _called_by(made))}


def _called_by(made: Node) -> list[str]:
    """Return the names of the methods that a run calls: the hooks, and what the node was made to call."""
    function = getattr(made, "func", None)
    own = [function.__name__] if isinstance(function, types.MethodType) and function.__self__ is made else []
    return [*_HOOKS, *own]


def _set_by_runs(kind: type, called: list[str]) -> Iterator[str]:
    """Give the attributes that a run sets by the methods of a class: what it counts or remembers."""
    functions = {name: function for above in reversed(kind.__mro__) for name, function in functions_of(above).items()}
    waiting, reached = [*called], set[str]()
    while waiting:
        name = waiting.pop()
        if name in reached or name not in functions or name == "__init__":
            continue
        reached.add(name)
        for code in nested_codes(functions[name].__code__):
            waiting += code.co_names
            found = dis.get_instructions(code)
            yield from (instruction.argval for instruction in found if instruction.opname == "STORE_ATTR")
