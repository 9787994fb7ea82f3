"""Graphs as they stand in a module, with the switches, nodes and pipelines that are functions of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from epypes.bundle.expressions import expression_or_none, noted_refusals
from epypes.bundle.instances import arguments_of, by_position
from epypes.bundle.slice import Slice, slice_functions
from epypes.bundle.syntax import Item, identifier_of, laid_out, one_per_line, quoted
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
        self._plain: dict[int, str] = {}
        self._made: dict[int, str] = {}
        self._arguments: dict[int, dict[str, Any]] = {}

    def write(self, cg: CompGraph, more: Mapping[str, Callable[..., Any]]) -> GraphText:
        """Write a graph; ``more`` are functions besides it, by how reasons call them. Refusals are gathered."""
        called = [*self._callables(cg, ""), *more.items()]
        references = slice_functions(self.gathered, called)
        self._plain = {id(function): source for (_, function), source in zip(called, references, strict=True)}
        return self._graph(cg, "")

    def reference(self, function: Callable[..., Any]) -> str:
        """Return the expression of a function that was given as one of ``more``."""
        return self._plain[id(function)]

    def _callables(self, cg: CompGraph, where: str) -> Iterator[tuple[str, Callable[..., Any]]]:
        """Give the functions that have a text or a name of their own, with those inside of nodes and pipelines."""
        for name, function in cg.functions.items():
            what = f"Function {name!r}{where}"
            if is_placeholder(function):
                way_out = f"Give it: ep.extend(cg, {{{name!r}: ...}}), and run that graph."
                self.gathered.refusals.append(f"{what} is a placeholder. {way_out}")
            elif as_switch(function) is None:
                yield from self._callables_in(_bare(function), what)

    def _callables_in(self, value: Any, what: str) -> Iterator[tuple[str, Callable[..., Any]]]:
        if isinstance(value, CompGraph):
            yield from self._callables(value, _inside(what))
        elif isinstance(value, Node):
            if type(value) is not Pipeline:
                yield f"Class {type(value).__name__!r}{_inside(what)}", type(value)
            for part in self._arguments_of(value, what).values():
                if isinstance(part, CompGraph | Node) or callable(part):
                    yield from self._callables_in(_bare(part), what)
        else:
            yield what, value

    def _arguments_of(self, made: Node, what: str) -> dict[str, Any]:
        if id(made) not in self._arguments:
            self._arguments[id(made)] = {}
            with noted_refusals(self.gathered):
                self._arguments[id(made)] = arguments_of(made, what)
        return self._arguments[id(made)]

    def _graph(self, cg: CompGraph, where: str) -> GraphText:
        references: dict[str, str] = {}
        switches: dict[str, str] = {}
        for name, function in cg.functions.items():
            what = f"Function {name!r}{where}"
            found = as_switch(function)
            if found is not None:
                switches[name] = references[name] = self._switch(cg, name, found, what)
            elif not is_placeholder(function):
                references[name] = self._value(_bare(function), what, name)
        return GraphText(references, switches)

    def _value(self, value: Any, what: str, name: str) -> str:
        """Return the expression of a function, or of an argument that makes one."""
        if isinstance(value, Node):
            if id(value) not in self._made:
                self._made[id(value)] = "None"
                with noted_refusals(self.gathered):
                    self._made[id(value)] = self._instance(value, what, name)
            return self._made[id(value)]
        known = self._plain.get(id(value))
        return known or expression_or_none(self.gathered, value, what, _NOT_MADE_AGAIN)

    def _variable(self, name: str) -> str:
        variable = identifier_of(name, self.gathered.is_taken)
        self.gathered.keep_name(variable)
        return variable

    def _switch(self, cg: CompGraph, name: str, switch: Switch, what: str) -> str:
        by, *tokens = cg.func_inputs(name)
        (output,) = cg.func_outputs(name)
        keys = [self._value(key, what, name) for key in switch.branches]
        branches = ", ".join(f"{key}: {quoted(token)}" for key, token in zip(keys, tokens, strict=True))
        variable = self._variable(name)
        arguments = f"{quoted(name)}, {{{branches}}}, by={quoted(by)}, output={quoted(output)}"
        made = f"{self._epypes(what)}.switch({arguments})"
        comment = f"# Only the branch that {_printable(by)} chooses is computed."
        self.blocks.append([comment, *laid_out(made, before=f"{variable} = ")])
        return variable

    def _instance(self, made: Node, what: str, name: str) -> str:
        """Write an object of a class of nodes or pipelines; return its variable."""
        kind, given = type(made), self._arguments_of(made, what)
        if kind is Pipeline:
            known = f"{self._epypes(what)}.Pipeline"
        else:
            known = self.gathered.add_class(kind, None, f"Class {kind.__name__!r}{_inside(what)}")
        variable = self._variable(name)
        arguments, lines, names = list[str](), list[str](), by_position(kind)
        for parameter, value in given.items():
            if isinstance(value, CompGraph):
                source, lines = self._inner_graph(value, what, variable)
            else:
                source = self._value(_bare(value), what, f"{name}_{parameter}")
            is_next = names[: len(arguments) + 1] == [*given][: len(arguments) + 1]
            arguments.append(source if is_next else f"{parameter}={source}")
        self.blocks.append([*lines, *laid_out(f"{known}({', '.join(arguments)})", before=f"{variable} = ")])
        return variable

    def _inner_graph(self, cg: CompGraph, what: str, variable: str) -> tuple[str, list[str]]:
        """Return the expression of the graph of a pipeline, and the lines that it stands on."""
        text = self._graph(cg, _inside(what))
        functions, io = self._variable(f"{variable}_functions"), self._variable(f"{variable}_io")
        ends = f"{', '.join(cg.source_tokens) or 'nothing'} -> {', '.join(cg.sink_tokens) or 'nothing'}"
        lines = [f"# {_printable(f'A graph of its own: {ends}.')}", *text.functions(functions), *text.io(io, cg)]
        epypes = self._epypes(what)
        source = f"{epypes}.CompGraph({functions}, {io}{'' if cg.types else ', types=False'})"
        for name, members in cg.groups.items():
            source = f"{epypes}.group({source}, {quoted(name)}, functions=[{', '.join(map(quoted, members))}])"
        return source, lines

    def _epypes(self, what: str) -> str:
        with noted_refusals(self.gathered):
            return self.gathered.module_name("epypes", what)
        return "epypes"


def _inside(what: str) -> str:
    """Return what stands behind the name of something that is part of a function."""
    return f" of {what[0].lower()}{what[1:]}"


def _bare(function: Any) -> Any:
    """Return the function of a node that does nothing else than call it; anything else as it is."""
    while type(function) is Node:
        function = as_written(function.func)
    return function


def _printable(text: str) -> str:
    """Return text as it may stand in a comment, whatever it holds."""
    shown = "".join(character if character.isprintable() else "?" for character in text)
    return shown if len(shown) <= 80 else f"{shown[:77]}..."
