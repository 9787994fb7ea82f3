"""Graphs as they stand in a module, with the switches, nodes and pipelines that are functions of them."""

from __future__ import annotations

import dis
import inspect
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from epypes.bundle.expressions import (
    UNKNOWN,
    Item,
    escaped,
    expression_or_none,
    is_same_data,
    laid_out,
    one_per_line,
    quoted,
)
from epypes.bundle.notebook_source import nested_codes
from epypes.bundle.resolve import Refused, functions_of
from epypes.bundle.slice import Slice
from epypes.graph import CompGraph, Switch, as_switch, is_placeholder
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import as_written

_NOT_MADE_AGAIN = (
    "is made with a {kind} that no expression makes again. Make it in __init__, from numbers, strings, a small array "
    "or tuples of them."
)


@dataclass(frozen=True, slots=True)
class GraphText:
    """A graph as it stands in a module.

    Attributes
    ----------
    references
        By function, the expression that refers to it.
    switches
        By function that is a switch, the variable of the graph that ``ep.switch`` makes.
    """

    references: Mapping[str, str]
    switches: Mapping[str, str] = field(default_factory=dict)

    def functions(self, variable: str) -> list[str]:
        """Return the lines of the functions by name."""
        items = [
            ("", f"**{self.switches[name]}.functions") if name in self.switches else (f"{quoted(name)}: ", reference)
            for name, reference in self.references.items()
        ]
        return one_per_line(f"{variable} = {{", items, "}")

    def io(self, variable: str, cg: CompGraph) -> list[str]:
        """Return the lines of what each function takes and makes."""
        items: list[Item] = []
        for name, (given, made) in cg.func_io.items():
            if name in self.switches and type(given) is tuple and isinstance(made, str):
                items.append(("", f"**{self.switches[name]}.func_io"))
            else:
                items.append((f"{quoted(name)}: ", f"({_side(given)}, {_side(made)})"))
        return one_per_line(f"{variable} = {{", items, "}")


def _side(tokens: str | tuple[str, ...] | list[str] | None) -> str:
    if tokens is None or isinstance(tokens, str):
        return "None" if tokens is None else quoted(tokens)
    return f"({', '.join(map(quoted, tokens))}{',' if len(tokens) == 1 else ''})"


class Graphs:
    """Writes a graph, and before it the graphs of pipelines and all else that its functions are made of.

    Parameters
    ----------
    gathered
        The module that it is for; is added to.

    Attributes
    ----------
    blocks
        What stands between the functions and the graph, in order.
    """

    def __init__(self, gathered: Slice) -> None:
        self.gathered = gathered
        self.blocks: list[list[str]] = []
        self._made: dict[int, str] = {}

    def write(self, cg: CompGraph, where: str = "") -> GraphText:
        """Write a graph, or that of a pipeline in it, with where it is; refusals are gathered."""
        references: dict[str, str] = {}
        switches: dict[str, str] = {}
        for name, function in cg.functions.items():
            what = f"Function {name!r}{where}"
            switch = as_switch(function)
            if switch is not None:
                with self.gathered.noted_refusals():
                    switches[name] = references[name] = self._switch(cg, name, switch, what)
            elif is_placeholder(function):
                way_out = f"Give it: ep.extend(cg, {{{name!r}: ...}}), and run that graph."
                self.gathered.refusals.append(f"{what} is a placeholder. {way_out}")
            else:
                references[name] = self.value(function, what, name)
        return GraphText(references, switches)

    def value(self, value: Any, what: str, name: str) -> str:
        """Return the expression of a function, or of an argument that makes one."""
        while type(value) is Node:  # it does nothing else than call its function
            value = as_written(value.func)
        if not isinstance(value, Node):
            return expression_or_none(self.gathered, value, what, _NOT_MADE_AGAIN, name)
        if id(value) not in self._made:
            self._made[id(value)] = "None"
            with self.gathered.noted_refusals():
                self._made[id(value)] = self._instance(value, what, name)
        return self._made[id(value)]

    def _switch(self, cg: CompGraph, name: str, switch: Switch, what: str) -> str:
        by, *tokens = cg.func_inputs(name)
        (output,) = cg.func_outputs(name)
        keys = [self.value(key, what, name) for key in switch.branches]
        branches = ", ".join(f"{key}: {quoted(token)}" for key, token in zip(keys, tokens, strict=True))
        variable = self.gathered.free_name(name)
        arguments = f"{quoted(name)}, {{{branches}}}, by={quoted(by)}, output={quoted(output)}"
        made = f"{self.gathered.module_name('epypes', what)}.switch({arguments})"
        comment = f"# Only the branch that {escaped(by, 80)} chooses is computed."
        self.blocks.append([comment, *laid_out(made, before=f"{variable} = ")])
        return variable

    def _instance(self, made: Node, what: str, name: str) -> str:
        """Write an object of a class of nodes or pipelines; return its variable."""
        kind, given = type(made), arguments_of(made, what)
        if kind is Pipeline:
            known = f"{self.gathered.module_name('epypes', what)}.Pipeline"
        else:
            known = self.gathered.add_class(kind, f"Class {kind.__name__!r}{_inside(what)}")
        arguments, lines = list[str](), list[str]()
        for parameter, value in given.items():
            if isinstance(value, CompGraph):
                source, lines = self._inner_graph(value, what, name)
            else:
                source = self.value(value, what, f"{name}_{parameter}")
            arguments.append(f"{parameter}={source}")
        variable = self.gathered.free_name(name)
        self.blocks.append([*lines, *laid_out(f"{known}({', '.join(arguments)})", before=f"{variable} = ")])
        return variable

    def _inner_graph(self, cg: CompGraph, what: str, name: str) -> tuple[str, list[str]]:
        """Return the expression of the graph of a pipeline, and the lines that it stands on."""
        text = self.write(cg, _inside(what))
        functions, io = self.gathered.free_name(f"{name}_functions"), self.gathered.free_name(f"{name}_io")
        ends = f"{', '.join(cg.source_tokens) or 'nothing'} -> {', '.join(cg.sink_tokens) or 'nothing'}"
        lines = [f"# {escaped(f'A graph of its own: {ends}.', 80)}", *text.functions(functions), *text.io(io, cg)]
        epypes = self.gathered.module_name("epypes", what)
        source = f"{epypes}.CompGraph({functions}, {io}{'' if cg.types else ', types=False'})"
        for name, members in cg.groups.items():
            source = f"{epypes}.group({source}, {quoted(name)}, functions=[{', '.join(map(quoted, members))}])"
        return source, lines


def _inside(what: str) -> str:
    """Return what stands behind the name of something that is part of a function."""
    return f" of {what[0].lower()}{what[1:]}"


# -- the arguments that a node or pipeline was made with -------------------------------------------------------------

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
        value = _attribute(made, parameter.name)
        if value is UNKNOWN and parameter.default is parameter.empty:
            way_out = f"Keep it in __init__: self.{parameter.name} = {parameter.name}."
            raise Refused(f"{what} is made with {parameter.name!r}, which it does not keep. {way_out}")
        if value is not UNKNOWN and value is not parameter.default and not is_same_data(value, parameter.default):
            found[parameter.name] = value
    return found


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


def _attribute(made: Node, name: str) -> Any:
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
    return UNKNOWN


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
