"""Where does a function come from: an importable name, or source in the notebook?

Functions are looked up by object, never by name: a name may mean another function by now.
"""

from __future__ import annotations

import ast
import copy
import sys
import types
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from typing import Any, TypeGuard

from epypes.bundle.cells import place_in, place_of
from epypes.bundle.lambdas import UNNAMED, as_function, lambdas_of
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
    name
        What its text calls it.
    function
        The function that has this text: of a decorated one, the innermost.
    text
        Its source with the comment above it, not indented.
    node
        Its syntax tree.
    place
        Cell and line, for people.
    code
        What that text compiles to, where it is written to.
    captured
        What it has from the function around it, by name.
    is_lambda
        Whether it had no name.
    """

    name: str
    function: types.FunctionType
    text: str
    node: ast.FunctionDef
    place: str
    code: types.CodeType
    captured: Mapping[str, Any] = field(default_factory=dict)
    is_lambda: bool = False

    @property
    def names(self) -> Mapping[str, Any]:
        """What its global names mean by now."""
        return {**self.function.__globals__, **self.captured} if self.captured else self.function.__globals__

    @property
    def file(self) -> str:
        """The file or cell that it is from, as Python knows it."""
        return self.function.__code__.co_filename

    @property
    def line(self) -> int:
        """Where it begins."""
        return self.function.__code__.co_firstlineno

    def place_in(self, node: ast.AST) -> str:
        """Return where a part of it stands, for people."""
        return place_in(self.file, getattr(node, "lineno", self.line))

    def place_of(self, name: str) -> str:
        """Return where it uses a name, for people."""
        uses = (node for node in ast.walk(self.node) if isinstance(node, ast.Name) and node.id == name)
        return self.place_in(next(uses, self.node))


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


def definition(function: types.FunctionType, what: str, decorated: Collection[ast.expr] = ()) -> Definition:
    """Return the source of a function that was defined in the notebook or the main script.

    Parameters
    ----------
    function
        The function.
    what
        How to call it in a reason, as ``"Function 'blur'"``.
    decorated
        Its decorators that are known to have made what the notebook has.

    Raises
    ------
    Refused
        Its source is not to be had, or does not say all of it.
    """
    place = place_of(function.__code__)
    _check_kind(function, what, place)
    if function.__code__.co_name == "<lambda>":
        return _lambda(function, what, place)
    lines, node = definition_of(function.__code__)
    _check_found(bool(lines), node is not None, what, place)
    if node is None:
        raise Refused(what)
    _check_decorators(node, function, what, place, {ast.unparse(decorator) for decorator in decorated})
    names = function.__globals__
    text = own_text(lines, node, [mark for mark in node.decorator_list if _names_outputs(mark, names)])
    return _defined(function, text, _without_outputs(node, names), what, place)


def _lambda(function: types.FunctionType, what: str, place: str) -> Definition:
    lines, nodes = lambdas_of(function.__code__)
    _check_found(bool(lines), bool(nodes), what, place)
    if len(nodes) > 1:
        text = f"{what} is one of {len(nodes)} lambdas on a line, which nothing tells apart ({place})."
        raise Refused(f"{text} Give each a line of its own, and run the cell again.")
    text, node = as_function(lines, nodes[0])
    return _defined(function, text, node, what, place)


def _defined(function: types.FunctionType, text: str, node: ast.FunctionDef, what: str, place: str) -> Definition:
    check_nonlocal(function, node, what)
    code = code_on_its_own(text, node, function.__code__)
    if code is None:
        reason = f"{what} computes something else if its text is moved to another place ({place})."
        raise Refused(f"{reason} Define it at the margin of a cell, not in a class.")
    captured = _captured(function, what, place)
    return Definition(node.name, function, text, node, place, code, captured, node.name == UNNAMED)


def check_nonlocal(function: types.FunctionType, node: ast.AST, what: str) -> None:
    """Refuse a function that keeps something from call to call in the function around it."""
    code = function.__code__
    for part in ast.walk(node):
        kept = [name for name in part.names if name in code.co_freevars] if isinstance(part, ast.Nonlocal) else []
        if kept and isinstance(part, ast.Nonlocal):
            text = f"{what} changes {kept[0]!r} of the function around it ({place_in(code.co_filename, part.lineno)})"
            raise Refused(f"{text}, so that every call finds it different. Make it a token, or return the value.")


def _captured(function: types.FunctionType, what: str, place: str) -> dict[str, Any]:
    try:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
    except ValueError as error:
        text = f"{what} uses names of the function around it that have no value ({place})."
        raise Refused(f"{text} Define them before, or define it outside.") from error
    return dict(zip(function.__code__.co_freevars, cells, strict=True))


def _check_found(has_lines: bool, has_node: bool, what: str, place: str) -> None:
    if not has_lines:
        way_out = "Define it in a cell, or in a module that is installed."
        if "<timed exec>" in place:
            way_out = "Define it in a cell without %%time."
        raise Refused(f"{what} has no source ({place}). {way_out}")
    if not has_node:
        text = f"{what} is not what its source says ({place}): that was changed since it was run, or the function was."
        raise Refused(f"{text} Run it again, so that both are the same.")


def _check_kind(function: types.FunctionType, what: str, place: str) -> None:
    if function.__code__.co_flags & (CO_COROUTINE | CO_ASYNC_GENERATOR):
        raise Refused(f"{what} is asynchronous ({place}), which no graph waits for. Write a plain function (def).")


def _check_decorators(
    node: ast.FunctionDef, function: types.FunctionType, what: str, place: str, known: Collection[str]
) -> None:
    for decorator in other_decorators(node, function.__globals__):
        if ast.unparse(decorator) not in known:
            text = f"{what} is decorated by @{ast.unparse(decorator)} ({place}), and does not say so itself."
            raise Refused(f"{text} Use functools.wraps in the decorator, or call its work inside the function.")


def other_decorators(node: ast.FunctionDef, names: Mapping[str, Any]) -> list[ast.expr]:
    """Return the decorators of a definition that are no marks of EPypes."""
    return [decorator for decorator in node.decorator_list if not _is_our_mark(decorator, names)]


def _is_our_mark(decorator: ast.expr, names: Mapping[str, Any]) -> bool:
    """Whether a decorator is ``@ep.unguarded``, or ``@ep.outputs`` of literals: both return the function itself."""
    if _names_outputs(decorator, names):
        call = decorator
        return not call.keywords and all(isinstance(name, ast.Constant) for name in call.args)
    return evaluated(decorator, names) is unguarded


def _names_outputs(decorator: ast.expr, names: Mapping[str, Any]) -> TypeGuard[ast.Call]:
    return isinstance(decorator, ast.Call) and evaluated(decorator.func, names) is outputs


def _without_outputs(node: ast.FunctionDef, names: Mapping[str, Any]) -> ast.FunctionDef:
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
