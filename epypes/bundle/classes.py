"""The definition of a class of the notebook, which stands in the module as it is written.

Like functions, classes are looked up by object. Whether the class statement makes what the notebook has by now is found
out by the comparison with the module's objects.
"""

from __future__ import annotations

import ast
import linecache
import sys
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from epypes.bundle.notebook_source import (
    cell_of,
    code_on_its_own,
    given_names,
    lines_in,
    names_from_outside,
    nested_codes,
    own_text,
    parsed,
    place_in,
)
from epypes.bundle.resolve import Refused
from epypes.bundle.side_effects import check_globals, unrepeatable


@dataclass(frozen=True, slots=True)
class ClassDefinition:
    """A class's definition in the notebook.

    Attributes
    ----------
    text
        Its source with the comment above it and its decorators, not indented.
    node
        Its syntax tree.
    place
        Cell and line, as reasons give them.
    code
        What that text compiles to, as a module.
    names
        The names of the notebook.
    file
        The file or cell that it is from, as Python knows it.
    captured
        Nothing: a class inside of a function is not taken.
    """

    name: str
    text: str
    node: ast.ClassDef
    place: str
    code: types.CodeType
    names: Mapping[str, Any]
    file: str
    captured: Mapping[str, Any] = field(default_factory=dict)

    @property
    def line(self) -> int:
        """Where it begins."""
        return self.node.lineno

    def place_of(self, name: str) -> str:
        """Return the cell and line where it uses a name."""
        uses = (node.lineno for node in ast.walk(self.node) if isinstance(node, ast.Name) and node.id == name)
        return place_in(self.file, next(uses, self.line))


def class_definition(kind: type, around: Mapping[str, Any], what: str) -> ClassDefinition:
    """Return the source of a class that was defined in the notebook or the main script.

    Parameters
    ----------
    kind
        The class.
    around
        The names where it was found, which are those of the notebook if it has no method that knows them.
    what
        How to call it in a reason, as ``"Class 'Blur'"``.

    Raises
    ------
    Refused
        Its source is not to be had, or says something else.
    """
    if kind.__qualname__ != kind.__name__:
        text = f"{what} is defined inside {kind.__qualname__.rpartition('.')[0]!r}"
        raise Refused(f"{text}. Define it at the margin of a cell.")
    file, node = next(statements_of_class(kind), ("", None))
    if node is None:
        way_out = "Write a class statement for it, as class P(typing.NamedTuple), and make again what was made of it."
        raise Refused(f"{what} has no class statement: it was made by a call. {way_out}")
    names = next((function.__globals__ for function in functions_of(kind).values()), around)
    place = place_in(file, node.lineno)
    part = unrepeatable(node, names)
    if part is not None:
        text = f"{what} calls {ast.unparse(part)!r} ({place_in(file, part.lineno)}) when it is defined"
        way_out = "Compute it above the class under a name of its own, VALUE = ..., and use that name in the class"
        raise Refused(f"{text}: that may give something else in a service. {way_out}.")
    text = own_text(lines_in(file), node, ())
    code = code_on_its_own(text)
    if code is None:
        raise Refused(f"{what} can't be compiled by itself ({place}). Define it at the margin of a cell.")
    check_globals(code, node, file, what)
    return ClassDefinition(kind.__name__, text, node, place, code, names, file)


def statements_of_class(kind: type) -> Iterator[tuple[str, ast.ClassDef]]:
    """Give the class statements that may be the one of a class, each with its file: the last one first.

    They hold the lines of its methods and give a value to nothing that it lacks, if there is such a statement.
    """
    found = [(file, node) for file in _files(kind) for node in _classes(lines_in(file), kind.__name__)]
    lines = [function.__code__.co_firstlineno for function in functions_of(kind).values()]
    known = {*vars(kind), *vars(kind).get("_fields", ()), *vars(kind).get("__dataclass_fields__", ())}
    known |= {*vars(kind).get("__members__", ())}
    cells = vars(sys.modules["__main__"])
    yield from sorted(found, key=lambda pair: (not _may_make(pair[1], lines, known), -cell_of(pair[0], cells)))


def _may_make(node: ast.ClassDef, lines: list[int], known: set[str]) -> bool:
    bound = {name for part in node.body for name in given_names(part)}
    return bound <= known and any(node.lineno <= line <= (node.end_lineno or line) for line in lines or [node.lineno])


def class_names(found: ClassDefinition) -> Iterator[str]:
    """Return the names that a class reads from outside when it is defined or used, each once, in order of use."""
    names: dict[str, None] = {}
    for code in nested_codes(found.code):
        names.update(dict.fromkeys(names_from_outside(code)))
    names.pop(found.name, None)
    return iter(names)


def functions_of(kind: type) -> dict[str, types.FunctionType]:
    """Return the functions of a class that were written for it, by name; of a property, its first."""
    found = {name: list(_functions_in(value)) for name, value in vars(kind).items()}
    return {name: functions[0] for name, functions in found.items() if functions}


def _functions_in(value: Any) -> Iterator[types.FunctionType]:
    """Give the functions that an attribute of a class is made of; none that a library has made, as dataclasses do."""
    parts = [value, *(getattr(value, name, None) for name in ("__func__", "fget", "fset", "fdel", "__wrapped__"))]
    if isinstance(value, cached_property):
        parts.append(value.func)
    for part in parts:
        if isinstance(part, types.FunctionType) and lines_in(part.__code__.co_filename):
            home = part.__globals__.get("__name__")
            if home == "__main__" or home not in sys.modules:
                yield part


def _files(kind: type) -> Iterator[str]:
    """Give the files and cells that may hold a class: those of its methods, else all that Python remembers."""
    own = dict.fromkeys(function.__code__.co_filename for function in functions_of(kind).values())
    if own:
        yield from own
        return
    yield from reversed([*linecache.cache])
    main = getattr(sys.modules.get("__main__"), "__file__", None)
    if isinstance(main, str) and main not in linecache.cache:
        yield main


def _classes(lines: list[str], name: str) -> list[ast.ClassDef]:
    """Return the definitions of a class in a text, the last one first."""
    text = "".join(lines)
    tree = parsed(text) if f"class {name}" in text else None
    found = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == name] if tree else []
    return found[::-1]
