"""Where does a function come from: an importable name, or source in the notebook?

Functions are looked up by object, never by name: a name may mean another function by now.
"""

from __future__ import annotations

import ast
import copy
import linecache
import sys
import textwrap
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, TypeGuard

from epypes.graph import outputs
from epypes.run.guard import unguarded


class Refused(Exception):
    """One reason why something can't be promoted; collected, then raised together as PromotionRefused."""


@dataclass(frozen=True, slots=True)
class Importable:
    """An object that ``module`` has as ``qualname``."""

    module: str
    qualname: str


@dataclass(frozen=True, slots=True)
class Definition:
    """A function's definition in the notebook.

    Attributes
    ----------
    text
        Its source with the comment above it, not indented.
    node
        Its syntax tree.
    place
        Cell and line, for people.
    """

    name: str
    function: types.FunctionType
    text: str
    node: ast.FunctionDef
    place: str


def importable(value: Any, *names: str) -> Importable | None:
    """Return a public name under which an object can be imported, if it has one.

    Parameters
    ----------
    value
        A function, class or other object.
    names
        Names that it may have in its module besides its own.
    """
    module = getattr(value, "__module__", None)
    qualname = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    if module == "__main__":
        return None
    fallback = None
    if isinstance(module, str) and isinstance(qualname, str) and _reach(module, qualname) is value:
        fallback = Importable(_public_module(module, qualname, value), qualname)
        if not fallback.module.startswith("_"):
            return fallback
    # C functions and the special forms of typing often know their name, but not their module.
    own = (getattr(value, "__name__", None), getattr(value, "_name", None))
    for name in dict.fromkeys(name for name in (*own, *names) if isinstance(name, str) and name.isidentifier()):
        home = min(_modules_with(name, value), key=_plainness, default=None)
        if home is not None:
            return Importable(home, name)
    return fallback


def _reach(module: str, qualname: str) -> Any:
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = getattr(found, part, None)
    return found


def _public_module(module: str, qualname: str, value: Any) -> str:
    """Return the shortest public module that shows an object whose own module is private (``skimage._shared``)."""
    if "._" not in module and not module.startswith("_"):
        return module
    if (
        module.startswith("_") and _reach(module.lstrip("_"), qualname) is value
    ):  # _functools is what functools is made of
        return module.lstrip("_")
    top = module.partition(".")[0]
    shown = (name for name in list(sys.modules) if name.partition(".")[0] == top and "._" not in name)
    homes = [name for name in shown if not name.startswith("_") and _reach(name, qualname) is value]
    return min(homes, key=_plainness, default=module)


def _plainness(module: str) -> tuple[int, int, str]:
    return module.count("."), len(module), module


def _modules_with(name: str, value: Any) -> Iterator[str]:
    for module_name, module in list(sys.modules.items()):
        if module_name.startswith("_") or "._" in module_name or module_name == "__main__":
            continue
        if isinstance(module, types.ModuleType) and vars(module).get(name) is value:
            yield module_name


def definition(function: Callable[..., Any], what: str) -> Definition:
    """Return the source of a function that was defined in the notebook or the main script.

    Parameters
    ----------
    function
        The function.
    what
        How to call it in a reason, as ``"Function 'blur'"``.

    Raises
    ------
    Refused
        It is not a plain function, or its source is not to be had.
    """
    if not isinstance(function, types.FunctionType):
        raise Refused(f"{what} is {_kind(function)}. Write a plain function (def) that makes the object and calls it.")
    place = place_of(function.__code__)
    if function.__name__ == "<lambda>" or function.__code__.co_name == "<lambda>":
        raise Refused(f"{what} is a lambda ({place}). Write it as a function (def) with a name.")
    if hasattr(function, "__wrapped__"):
        raise Refused(f"{what} is wrapped by a decorator ({place}). Call the decorator's work inside the function.")
    if function.__closure__:
        captured = ", ".join(map(repr, function.__code__.co_freevars))
        raise Refused(f"{what} captures {captured} from the function around it ({place}). Make it a token.")
    lines = linecache.getlines(function.__code__.co_filename)
    node = _find(lines, function.__code__)
    if node is None:
        raise Refused(f"{what} has no source ({place}). Define it in a cell, or in a module that is installed.")
    _check_decorators(node, function, what, place)
    text = _text(lines, node, function.__globals__)
    return Definition(node.name, function, text, _without_outputs(node, function.__globals__), place)


def _kind(value: object) -> str:
    if isinstance(value, partial):
        return "a functools.partial"
    if isinstance(value, type):
        return f"the class {value.__name__!r}, defined in the notebook"
    if isinstance(value, types.MethodType):
        return f"a method of an object of class {type(value.__self__).__name__!r}"
    return f"an object of class {type(value).__name__!r}"


def place_of(code: types.CodeType) -> str:
    """Return where code stands: the cell's number, if it is from a notebook, and the line."""
    line = f"line {code.co_firstlineno}"
    source = "".join(linecache.getlines(code.co_filename)).strip()
    cells = getattr(sys.modules.get("__main__"), "In", None)
    if isinstance(cells, list) and source:
        number = max((index for index, cell in enumerate(cells) if str(cell).strip() == source), default=None)
        if number is not None:
            return f"cell [{number}], {line}"
    return f"{code.co_filename}, {line}"


def _find(lines: list[str], code: types.CodeType) -> ast.FunctionDef | None:
    return _definitions("".join(lines)).get((code.co_name, code.co_firstlineno))


@lru_cache(maxsize=16)  # one cell often defines many functions
def _definitions(source: str) -> dict[tuple[str, int], ast.FunctionDef]:
    """Return the definitions in a cell by name and first line, decorators included."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return {}
    found: dict[tuple[str, int], ast.FunctionDef] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            found.setdefault((node.name, first), node)
    return found


def _check_decorators(node: ast.FunctionDef, function: types.FunctionType, what: str, place: str) -> None:
    for decorator in node.decorator_list:
        if not _is_our_mark(decorator, function.__globals__):
            text = f"{what} is decorated by @{ast.unparse(decorator)} ({place})."
            raise Refused(f"{text} Call the decorator's work inside the function.")


def _is_our_mark(decorator: ast.expr, names: dict[str, Any]) -> bool:
    """Whether a decorator is ``@ep.unguarded``, or ``@ep.outputs`` of literals: both return the function itself."""
    if _names_outputs(decorator, names):
        call = decorator
        return not call.keywords and all(isinstance(name, ast.Constant) for name in call.args)
    return _evaluated(decorator, names) is unguarded


def _names_outputs(decorator: ast.expr, names: dict[str, Any]) -> TypeGuard[ast.Call]:
    return isinstance(decorator, ast.Call) and _evaluated(decorator.func, names) is outputs


def _without_outputs(node: ast.FunctionDef, names: dict[str, Any]) -> ast.FunctionDef:
    """Return the definition without ``@ep.outputs``: what is written out has the graph's io, and no need of it."""
    kept = copy.copy(node)
    kept.decorator_list = [decorator for decorator in node.decorator_list if not _names_outputs(decorator, names)]
    return kept


def _evaluated(expression: ast.expr, names: dict[str, Any]) -> Any:
    """Look up a dotted name; None for any other expression."""
    if isinstance(expression, ast.Name):
        return names.get(expression.id)
    if isinstance(expression, ast.Attribute):
        return getattr(_evaluated(expression.value, names), expression.attr, None)
    return None


def _text(lines: list[str], node: ast.FunctionDef, names: dict[str, Any]) -> str:
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)]) - 1
    while first and lines[first - 1].lstrip().startswith("#"):
        first -= 1
    dropped = {
        number
        for decorator in node.decorator_list
        if _names_outputs(decorator, names)
        for number in range(decorator.lineno, (decorator.end_lineno or decorator.lineno) + 1)
    }
    kept = [line for number, line in enumerate(lines[first : node.end_lineno], first + 1) if number not in dropped]
    return textwrap.dedent("".join(kept)).rstrip() + "\n"
