"""Which library's functions does a user's function hand its parameter to?

Read from the source: the call counts in which an argument is the parameter itself, or ``int(k)``, or a tuple of it.
What is called is looked up by object, so it does not matter how it was imported.
"""

from __future__ import annotations

import ast
import builtins
import linecache
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, Final

from epypes.catalog.entry import Entry
from epypes.catalog.lookup import entry_of
from epypes.catalog.signatures import parameter_names
from epypes.graph.redefined import unwrapped

_CONVERSIONS: Final = ("int", "float", "round", "bool")
# A user's function may call another, and that another.
_DEEPEST: Final = 3

_Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda


@dataclass(frozen=True, slots=True)
class Use:
    """What a function does with one of its parameters.

    Attributes
    ----------
    entry
        What the table says of it; None if it is only compared.
    cuts
        The function's parameter with whose values it is compared; empty if there is none.
    """

    entry: Entry | None
    cuts: str = ""


def uses(function: Any, parameter: str) -> tuple[Use, ...]:
    """Return what a function does with a parameter, as far as the table knows and its source is there; never raises."""
    try:
        return tuple(_uses(unwrapped(function), parameter, _DEEPEST))
    except Exception:  # whatever odd objects are among the names of a function, this is a guess
        return ()


def _uses(function: Any, parameter: str, depth: int) -> Iterator[Use]:
    node = definition(function)
    if node is None or not depth or _is_changed(node, parameter):
        return
    names = _names_of(function, node)
    own = {argument.arg for argument in _arguments(node)}
    for part in ast.walk(node):
        if isinstance(part, ast.Call):
            yield from _uses_in_call(part, names, own, parameter, depth, function)
        elif isinstance(part, ast.Compare):
            yield from _uses_in_comparison(part, own, parameter)


def _uses_in_call(
    call: ast.Call, names: Mapping[str, Any], own: set[str], parameter: str, depth: int, caller: FunctionType
) -> Iterator[Use]:
    target = _object(call.func, names)
    if not callable(target):
        return
    given = dict(_given(call, parameter_names(target)))
    for name, value in given.items():
        if not _is_it(value, parameter):
            continue
        entry = entry_of(target, name)
        if entry is not None:
            image = given.get(entry.cuts)
            yield Use(entry, image.id if isinstance(image, ast.Name) and image.id in own else "")
        elif isinstance(target, FunctionType) and _package(target) == _package(caller):
            # What the other function calls its parameters is not known here: it cuts nothing of ours.
            yield from (Use(use.entry) for use in _uses(target, name, depth - 1) if use.entry is not None)


def _uses_in_comparison(comparison: ast.Compare, own: set[str], parameter: str) -> Iterator[Use]:
    sides = [comparison.left, *comparison.comparators]
    if any(_is_it(side, parameter) for side in sides):
        others = (side.id for side in sides if isinstance(side, ast.Name) and side.id in own - {parameter})
        yield from (Use(None, other) for other in others)


def _given(call: ast.Call, names: tuple[str, ...]) -> Iterator[tuple[str, ast.expr]]:
    """Give the arguments of a call by the parameter's name; what stands behind a star is not known."""
    for name, value in zip(names, call.args, strict=False):
        if isinstance(value, ast.Starred):
            break
        yield name, value
    yield from ((keyword.arg, keyword.value) for keyword in call.keywords if keyword.arg)


def _is_it(expression: ast.expr, parameter: str) -> bool:
    """Whether an expression is the parameter: ``k``, ``int(k)``, ``(k, k)``."""
    if isinstance(expression, ast.Name):
        return expression.id == parameter
    if isinstance(expression, ast.Tuple | ast.List):
        return any(_is_it(part, parameter) for part in expression.elts)
    if isinstance(expression, ast.Call) and isinstance(expression.func, ast.Name):
        return expression.func.id in _CONVERSIONS and any(_is_it(part, parameter) for part in expression.args[:1])
    return False


def _is_changed(node: _Definition, parameter: str) -> bool:
    """Whether a function computes another value under the parameter's name."""
    assigned = (part for part in ast.walk(node) if isinstance(part, ast.Name) and part.id == parameter)
    stored = sum(isinstance(part.ctx, ast.Store) for part in assigned)
    kept = sum(
        isinstance(part, ast.Assign)
        and _is_it(part.value, parameter)
        and isinstance(part.targets[0], ast.Name)
        and not isinstance(part.value, ast.Tuple | ast.List)
        for part in ast.walk(node)
    )
    return stored > kept


def definition(function: Any) -> _Definition | None:
    """Return the definition of a function in the text that is there now; None if there is none of it."""
    if not isinstance(function, FunctionType):
        return None
    code = function.__code__
    text = "".join(linecache.getlines(code.co_filename, function.__globals__))
    wanted = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    found = (node for node in _definitions(text).get(code.co_firstlineno, ()) if _name(node) == code.co_name)
    return next((node for node in found if _plain_names(node) == wanted), None)


@lru_cache(maxsize=16)  # one cell often defines many functions
def _definitions(text: str) -> Mapping[int, tuple[_Definition, ...]]:
    """Return the definitions in a text by their first line, decorators included."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError):
        return {}
    found: dict[int, tuple[_Definition, ...]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            line = min([node.lineno, *(mark.lineno for mark in getattr(node, "decorator_list", ()))])
            found[line] = (*found.get(line, ()), node)
    return found


def _name(node: _Definition) -> str:
    return "<lambda>" if isinstance(node, ast.Lambda) else node.name


def _arguments(node: _Definition) -> list[ast.arg]:
    return [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]


def _plain_names(node: _Definition) -> tuple[str, ...]:
    return tuple(argument.arg for argument in _arguments(node))


def _names_of(function: FunctionType, node: _Definition) -> dict[str, Any]:
    """Return what the names in a function mean: those imported in it, around it, in its module, and Python's own."""
    code: CodeType = function.__code__
    cells = zip(code.co_freevars, function.__closure__ or (), strict=False)
    around = {name: found for name, cell in cells for found in _content(cell)}
    return {**vars(builtins), **function.__globals__, **around, **dict(_imported(node))}


def _content(cell: CellType) -> Iterator[Any]:
    with suppress(ValueError):  # empty: the name has no value yet
        yield cell.cell_contents


def _imported(node: _Definition) -> Iterator[tuple[str, Any]]:
    for part in ast.walk(node):
        if isinstance(part, ast.Import):
            for alias in part.names:
                top = alias.name if alias.asname else alias.name.partition(".")[0]
                yield alias.asname or top, sys.modules.get(top)
        elif isinstance(part, ast.ImportFrom) and part.module and not part.level:
            for alias in part.names:
                yield alias.asname or alias.name, getattr(sys.modules.get(part.module), alias.name, None)


def _object(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Look up a dotted name in modules and classes; None for any other expression."""
    if isinstance(expression, ast.Name):
        return names.get(expression.id)
    if isinstance(expression, ast.Attribute):
        home = _object(expression.value, names)
        return getattr(home, expression.attr, None) if isinstance(home, ModuleType | type) else None
    return None


def _package(function: FunctionType) -> str:
    return (function.__module__ or "").partition(".")[0]
