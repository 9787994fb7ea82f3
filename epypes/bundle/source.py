"""Where does a function come from: an importable name, or source in the notebook?

Functions are looked up by object, never by name: a name may mean another function by now.
"""

from __future__ import annotations

import ast
import copy
import linecache
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from typing import Any, TypeGuard

from epypes.bundle.text import code_on_its_own, definition_of, own_text
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
    code
        What that text compiles to, where it is written to.
    """

    name: str
    function: types.FunctionType
    text: str
    node: ast.FunctionDef
    place: str
    code: types.CodeType

    @property
    def names(self) -> Mapping[str, Any]:
        """The names of the notebook."""
        return self.function.__globals__


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
    _check_kind(function, what, place)
    lines, node = definition_of(function.__code__)
    if not lines:
        raise Refused(f"{what} has no source ({place}). Define it in a cell, or in a module that is installed.")
    if node is None:
        text = f"{what} is not what its source says ({place}): that was changed since it was run, or the function was."
        raise Refused(f"{text} Run it again, so that both are the same.")
    _check_decorators(node, function, what, place)
    _check_attributes(function, what, place)
    names = function.__globals__
    text = own_text(lines, node, [mark for mark in node.decorator_list if _names_outputs(mark, names)])
    kept = _without_outputs(node, names)
    code = code_on_its_own(text, kept, function.__code__)
    if code is None:
        text = f"{what} computes something else if its text is moved to another place ({place})."
        raise Refused(f"{text} Define it at the margin of a cell, not in a class.")
    return Definition(node.name, function, text, kept, place, code)


def _check_kind(function: types.FunctionType, what: str, place: str) -> None:
    """Refuse functions that have no text of their own, or whose text is not all of them."""
    code = function.__code__
    if function.__name__ == "<lambda>" or code.co_name == "<lambda>":
        raise Refused(f"{what} is a lambda ({place}). Write it as a function (def) with a name.")
    if code.co_flags & (CO_COROUTINE | CO_ASYNC_GENERATOR):
        raise Refused(f"{what} is asynchronous ({place}), which no graph waits for. Write a plain function (def).")
    if hasattr(function, "__wrapped__"):
        raise Refused(f"{what} is wrapped by a decorator ({place}). Call the decorator's work inside the function.")
    if function.__closure__:
        captured = ", ".join(map(repr, code.co_freevars))
        raise Refused(f"{what} captures {captured} from the function around it ({place}). Make it a token.")


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
    return place_in(code.co_filename, code.co_firstlineno)


def place_in(file: str, number: int) -> str:
    """Return a place in a file or cell: the cell's number, if it is from a notebook, and the line."""
    line = f"line {number}"
    source = "".join(linecache.getlines(file)).strip()
    cells = getattr(sys.modules.get("__main__"), "In", None)
    if isinstance(cells, list) and source:
        cell = max((index for index, cell in enumerate(cells) if str(cell).strip() == source), default=None)
        if cell is not None:
            return f"cell [{cell}], {line}"
    return f"{file}, {line}"


def _check_decorators(node: ast.FunctionDef, function: types.FunctionType, what: str, place: str) -> None:
    for decorator in node.decorator_list:
        if not _is_our_mark(decorator, function.__globals__):
            text = f"{what} is decorated by @{ast.unparse(decorator)} ({place})."
            raise Refused(f"{text} Call the decorator's work inside the function.")


def _check_attributes(function: types.FunctionType, what: str, place: str) -> None:
    """Refuse what was hung on a function besides our marks: its text does not say it, and its code may read it."""
    own = ", ".join(repr(name) for name in function.__dict__ if not name.startswith("__epypes_"))
    if own:
        text = f"{what} has attributes that its text does not give it, {own} ({place})."
        raise Refused(f"{text} Make them constants or tokens, and define the function again.")


def _is_our_mark(decorator: ast.expr, names: dict[str, Any]) -> bool:
    """Whether a decorator is ``@ep.unguarded``, or ``@ep.outputs`` of literals: both return the function itself."""
    if _names_outputs(decorator, names):
        call = decorator
        return not call.keywords and all(isinstance(name, ast.Constant) for name in call.args)
    return evaluated(decorator, names) is unguarded


def _names_outputs(decorator: ast.expr, names: dict[str, Any]) -> TypeGuard[ast.Call]:
    return isinstance(decorator, ast.Call) and evaluated(decorator.func, names) is outputs


def _without_outputs(node: ast.FunctionDef, names: dict[str, Any]) -> ast.FunctionDef:
    """Return the definition without ``@ep.outputs``: what is written out has the graph's io, and no need of it."""
    kept = copy.copy(node)
    kept.decorator_list = [decorator for decorator in node.decorator_list if not _names_outputs(decorator, names)]
    return kept


def evaluated(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Look up a dotted name; None for any other expression."""
    if isinstance(expression, ast.Name):
        return names.get(expression.id)
    if isinstance(expression, ast.Attribute):
        return getattr(evaluated(expression.value, names), expression.attr, None)
    return None
