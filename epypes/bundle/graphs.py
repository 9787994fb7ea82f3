"""How do graphs stand in a module, with the switches, nodes and pipelines that are functions of them?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from epypes.bundle.instances import arguments_of, by_position
from epypes.bundle.lines import Group, Piece, assignment, call, laid_out, piece_of, prefixed, quoted
from epypes.bundle.slicer import Slice, slice_functions
from epypes.bundle.source import Refused
from epypes.bundle.values import expression
from epypes.bundle.words import word_of
from epypes.graph import CompGraph, Switch, as_switch, is_placeholder
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import as_written


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
        items: list[Piece] = []
        for name, reference in self.references.items():
            if name in self.switches:
                items.append(f"**{self.switches[name]}.functions")
            else:
                items.append(prefixed(f"{quoted(name)}: ", piece_of(reference)))
        return _exploded(f"{variable} = {{", items)

    def io(self, variable: str, cg: CompGraph) -> list[str]:
        """Return the lines of what each function takes and makes."""
        items: list[Piece] = []
        for name, (given, made) in cg.func_io.items():
            if name in self.switches and type(given) is tuple and isinstance(made, str):
                items.append(f"**{self.switches[name]}.func_io")
            else:
                pair = Group("(", (_side(given), _side(made)), ")", is_display=True)
                items.append(prefixed(f"{quoted(name)}: ", pair))
        return _exploded(f"{variable} = {{", items)


def _exploded(opening: str, items: list[Piece]) -> list[str]:
    lines = [line for item in items for line in laid_out(item, 1, ",")]
    return [opening, *lines, "}"] if items else [f"{opening}}}"]


def _side(tokens: str | tuple[str, ...] | list[str] | None) -> Piece:
    if tokens is None or isinstance(tokens, str):
        return "None" if tokens is None else quoted(tokens)
    return Group("(", tuple(map(quoted, tokens)), ")", is_display=True)


def grouped(cg: CompGraph) -> list[Piece]:
    """Return the items of a dict: for each group its functions."""
    return [
        prefixed(f"{quoted(name)}: ", Group("[", tuple(map(quoted, functions)), "]", is_display=True))
        for name, functions in cg.groups.items()
    ]


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
                yield from self._callables_in(bare(function), what)

    def _callables_in(self, value: Any, what: str) -> Iterator[tuple[str, Callable[..., Any]]]:
        if isinstance(value, CompGraph):
            yield from self._callables(value, f" of {what[0].lower()}{what[1:]}")
        elif isinstance(value, Node):
            if type(value) is not Pipeline:
                yield f"Class {type(value).__name__!r} of {what[0].lower()}{what[1:]}", type(value)
            for part in self._arguments_of(value, what).values():
                if isinstance(part, CompGraph | Node) or callable(part):
                    yield from self._callables_in(bare(part), what)
        else:
            yield what, value

    def _arguments_of(self, made: Node, what: str) -> dict[str, Any]:
        if id(made) not in self._arguments:
            try:
                self._arguments[id(made)] = arguments_of(made, what)
            except Refused as refusal:
                self.gathered.refusals.append(str(refusal))
                self._arguments[id(made)] = {}
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
                references[name] = self._value(bare(function), what, name)
        return GraphText(references, switches)

    def _value(self, value: Any, what: str, name: str) -> str:
        """Return the expression of a function, or of an argument that makes one."""
        if isinstance(value, Node):
            if id(value) not in self._made:
                self._made[id(value)] = self._instance(value, what, name)
            return self._made[id(value)]
        if id(value) in self._plain:
            return self._plain[id(value)]
        source = ""
        try:
            source = expression(self.gathered, value, what)
        except Refused as refusal:
            self.gathered.refusals.append(str(refusal))
            return "None"
        if not source:
            self.gathered.refusals.append(
                f"{what} is made with a {type(value).__name__} that no expression makes again. "
                "Make it in __init__, from numbers, strings, a small array or tuples of them."
            )
        return source or "None"

    def _variable(self, name: str) -> str:
        variable = word_of(name, self.gathered.is_taken)
        self.gathered.keep_name(variable)
        return variable

    def _switch(self, cg: CompGraph, name: str, switch: Switch, what: str) -> str:
        by, *tokens = cg.func_inputs(name)
        (output,) = cg.func_outputs(name)
        keys = [self._value(key, what, name) for key in switch.branches]
        pairs = [prefixed(f"{key}: ", quoted(token)) for key, token in zip(keys, tokens, strict=True)]
        variable = self._variable(name)
        branches = Group("{", tuple(pairs), "}", is_display=True)
        arguments: list[Piece] = [quoted(name), branches, f"by={quoted(by)}", f"output={quoted(output)}"]
        made = call(f"{self._epypes(what)}.switch", arguments)
        self.blocks.append(
            [f"# Only the branch that {_shown(by)} chooses is computed.", *assignment([variable], True, made, 0)]
        )
        return variable

    def _instance(self, made: Node, what: str, name: str) -> str:
        """Write an object of a class of nodes or pipelines; return its variable."""
        kind, given = type(made), self._arguments_of(made, what)
        try:
            known = self._class(kind, what)
        except Refused as refusal:
            self.gathered.refusals.append(str(refusal))
            return "None"
        variable = self._variable(name)
        arguments, lines, names = list[Piece](), list[str](), by_position(kind)
        for parameter, value in given.items():
            if isinstance(value, CompGraph):
                piece, lines = self._inner_graph(value, what, variable)
            else:
                piece = piece_of(self._value(bare(value), what, f"{name}_{parameter}"))
            is_next = names[: len(arguments) + 1] == [*given][: len(arguments) + 1]
            arguments.append(piece if is_next else prefixed(f"{parameter}=", piece))
        self.blocks.append([*lines, *assignment([variable], True, call(known, arguments), 0)])
        return variable

    def _class(self, kind: type, what: str) -> str:
        if kind is Pipeline:
            return f"{self._epypes(what)}.Pipeline"
        return self.gathered.add_class(kind, None, f"Class {kind.__name__!r} of {what[0].lower()}{what[1:]}")

    def _inner_graph(self, cg: CompGraph, what: str, variable: str) -> tuple[Piece, list[str]]:
        """Return the expression of the graph of a pipeline, and the lines that it stands on."""
        text = self._graph(cg, f" of {what[0].lower()}{what[1:]}")
        functions, io = self._variable(f"{variable}_functions"), self._variable(f"{variable}_io")
        ends = f"{', '.join(cg.source_tokens) or 'nothing'} -> {', '.join(cg.sink_tokens) or 'nothing'}"
        lines = [f"# {_shown(f'A graph of its own: {ends}.')}", *text.functions(functions), *text.io(io, cg)]
        epypes = self._epypes(what)
        piece: Piece = call(f"{epypes}.CompGraph", [functions, io, *["types=False"][: not cg.types]])
        for name, members in cg.groups.items():
            inside = Group("functions=[", tuple(map(quoted, members)), "]", is_display=True)
            piece = call(f"{epypes}.group", [piece, quoted(name), inside])
        return piece, lines

    def _epypes(self, what: str) -> str:
        try:
            return self.gathered.module_name("epypes", what)
        except Refused as refusal:
            self.gathered.refusals.append(str(refusal))
            return "epypes"


def bare(function: Any) -> Any:
    """Return the function of a node that does nothing else than call it; anything else as it is."""
    while type(function) is Node:
        function = as_written(function.func)
    return function


def _shown(text: str) -> str:
    """Return text as it may stand in a comment, whatever it holds."""
    shown = "".join(character if character.isprintable() else "?" for character in text)
    return shown if len(shown) <= 80 else f"{shown[:77]}..."
