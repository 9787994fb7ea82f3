"""The source of a function: its definition as a syntax tree, found by the place and the code of the function."""

from __future__ import annotations

import ast
import linecache
from collections.abc import Iterable, Mapping
from functools import lru_cache
from types import CodeType, FunctionType
from typing import Any

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda


class _Lines:
    """The lines of a file as linecache keeps them, compared by identity: hashing a large file takes longer."""

    def __init__(self, lines: list[str]) -> None:
        self.lines = lines

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Lines) and self.lines is other.lines

    def __hash__(self) -> int:
        return id(self.lines)


def definition_of(function: Any) -> Definition | None:
    """Return the definition of a function in its source as it is now; None if it is not there, or not surely this one.

    Parameters
    ----------
    function
        A Python function; None is returned for anything else.
    """
    if not isinstance(function, FunctionType):
        return None
    code = function.__code__
    names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    lines = linecache.getlines(code.co_filename, function.__globals__)
    found = [
        node
        for node in _definitions(_Lines(lines)).get(code.co_firstlineno, ())
        if getattr(node, "name", "<lambda>") == code.co_name and argument_names(node) == names
    ]
    if len(found) > 1:  # lambdas in one line
        found = [node for node in found if _has_place(code, node)]
    return found[0] if len(found) == 1 else None


def argument_names(node: Definition) -> tuple[str, ...]:
    """Return the names of a definition's parameters, but for ``*args`` and ``**kwargs``."""
    return tuple(argument.arg for argument in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs))


@lru_cache(maxsize=16)  # one cell often defines many functions
def _definitions(given: _Lines) -> Mapping[int, tuple[Definition, ...]]:
    """Return the definitions in a file by their first line, decorators included."""
    try:
        tree = ast.parse("".join(given.lines))
    except (SyntaxError, ValueError, RecursionError):
        return {}
    found: dict[int, tuple[Definition, ...]] = {}
    for node in ast.walk(tree):
        if isinstance(node, Definition):
            line = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", ()))])
            found[line] = (*found.get(line, ()), node)
    return found


def _has_place(code: CodeType, node: Definition) -> bool:
    """Whether code was compiled from the body of a definition, by the columns of its instructions."""
    parts: Iterable[ast.AST] = node.body if isinstance(node.body, list) else (node.body,)
    places = {
        (part.lineno, part.end_lineno, part.col_offset, part.end_col_offset)
        for part in parts
        if isinstance(part, ast.expr | ast.stmt)
    }
    return any(place in places for place in code.co_positions())
