"""Definitions of the notebook's functions and classes: their text, what they have captured, and where they stand.

Functions and classes are looked up by object. A decorator stays where it stands. Whether the text makes what the
notebook has by now is found out by the comparison with the module's objects.
"""

from __future__ import annotations

import ast
import copy
import functools
import linecache
import sys
import types
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from typing import Any, TypeGuard

from epypes.bundle.notebook_source import (
    LATE_ANNOTATIONS,
    UNNAMED,
    as_function,
    cell_of,
    code_on_its_own,
    definition_of,
    lambdas_of,
    lines_in,
    names_of,
    own_text,
    parsed,
    place_in,
    place_of,
    statements_of,
)
from epypes.bundle.resolve import Refused, evaluated, importable, layers
from epypes.bundle.side_effects import captured_by, check_globals, check_nonlocal, check_state
from epypes.graph import outputs
from epypes.run.guard import unguarded


@dataclass(frozen=True, slots=True)
class Definition:
    """The definition of a function or class in the notebook.

    Attributes
    ----------
    name
        What its text calls it.
    text
        Its source with the comment above it, not indented.
    node
        Its syntax tree.
    code
        What that text compiles to, as a module.
    file, line
        The file or cell that it is from, as Python knows it, and where it begins there.
    names
        What its names mean by now.
    function
        The function that has this text: of a decorated one, the innermost; None for a class.
    captured
        What a function has from the function around it, by name.
    """

    name: str
    text: str
    node: ast.FunctionDef | ast.ClassDef
    code: types.CodeType
    file: str
    line: int
    names: Mapping[str, Any]
    function: types.FunctionType | None
    captured: Mapping[str, Any]

    @property
    def is_lambda(self) -> bool:
        """Whether it had no name."""
        return self.name == UNNAMED

    @property
    def place(self) -> str:
        """Cell and line, as reasons give them."""
        return place_in(self.file, self.line)

    @property
    def has_late_annotations(self) -> bool:
        """Whether it was compiled not to read its annotations."""
        return self.function is not None and bool(self.function.__code__.co_flags & LATE_ANNOTATIONS)

    def place_in(self, node: ast.AST) -> str:
        """Return the cell and line of a part of it."""
        return place_in(self.file, getattr(node, "lineno", self.line))

    def place_of(self, name: str) -> str:
        """Return the cell and line where it uses a name."""
        uses = (node for node in ast.walk(self.node) if isinstance(node, ast.Name) and node.id == name)
        return self.place_in(next(uses, self.node))


# -- functions -------------------------------------------------------------------------------------------------------


def function_definition(function: Any, what: str) -> Definition:
    """Return the definition of a function of the notebook, with its decorators if each of them has wrapped it.

    Parameters
    ----------
    function
        The function, or what decorators have made of it.
    what
        How to call it in a reason, as ``"Function 'blur'"``.

    Raises
    ------
    Refused
        Its source is not to be had or does not say all of it, or a decorator does more than wrap it.
    """
    found = layers(function)
    innermost = found[-1]
    node = definition_of(innermost.__code__)[1] if isinstance(innermost, types.FunctionType) else None
    decorators = [one for one in node.decorator_list if not _is_mark(one, innermost)] if node is not None else []
    if 0 < len(decorators) == len(found) - 1:
        for decorator, wrapper in zip(decorators, found, strict=False):
            _check_decorator(decorator, wrapper, innermost, what)
        return _of_text(innermost, what, decorators)
    if not isinstance(function, types.FunctionType):
        raise Refused(_no_definition(function, decorators, what))
    return _of_text(function, what, ())


def _of_text(function: types.FunctionType, what: str, decorators: Collection[ast.expr]) -> Definition:
    """Return the definition that this very function has; of its decorators, these and those that return it as it is."""
    code = function.__code__
    place = place_of(code)
    if code.co_flags & (CO_COROUTINE | CO_ASYNC_GENERATOR):
        raise Refused(f"{what} is asynchronous ({place}), which no graph waits for. Write a plain function (def).")
    node: ast.FunctionDef | None
    if code.co_name == "<lambda>":
        lines, nodes = lambdas_of(code)
        if len(nodes) > 1:
            text = f"{what} is one of {len(nodes)} lambdas on a line, which look alike to Python ({place})."
            raise Refused(f"{text} Give each a line of its own, and run the cell again.")
        text, node = as_function(lines, nodes[0]) if nodes else ("", None)
    else:
        lines, found = definition_of(code)
        node = copy.copy(found)
        if node is not None and found is not None:
            known = {ast.unparse(decorator) for decorator in decorators}
            node.decorator_list = [
                one for one in node.decorator_list if ast.unparse(one) in known or _is_written(one, function)
            ]
            text = own_text(lines, found, [one for one in found.decorator_list if one not in node.decorator_list])
    if not lines:
        way_out = "Define it in a cell, or in a module that is installed."
        if "<timed exec>" in place:
            way_out = "Define it in a cell without %%time."
        raise Refused(f"{what} has no source ({place}). {way_out}")
    if node is None:
        text = f"{what} is not what its source says ({place}): that was changed since it was run, or the function was."
        raise Refused(f"{text} Run it again, so that both are the same.")
    check_nonlocal(function, node, what)
    captured = captured_by(function)
    names = {**function.__globals__, **captured} if captured else function.__globals__
    compiled = _compiled(text, what, place)
    return Definition(node.name, text, node, compiled, code.co_filename, code.co_firstlineno, names, function, captured)


def _compiled(text: str, what: str, place: str) -> types.CodeType:
    code = code_on_its_own(text)
    if code is None:
        raise Refused(f"{what} can't be compiled by itself ({place}). Define it at the margin of a cell.")
    return code


def _target(decorator: ast.expr, function: types.FunctionType) -> Any:
    """Return what a decorator calls, if that is a name."""
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return evaluated(called, {**function.__globals__, **captured_by(function)})


def _is_mark(decorator: ast.expr, function: types.FunctionType) -> bool:
    """Whether a decorator is one of EPypes, which returns the function itself."""
    target = _target(decorator, function)
    return target is unguarded or target is outputs


def _is_written(decorator: ast.expr, function: types.FunctionType) -> bool:
    """Whether a decorator that returns the function itself leaves something on it that the module needs."""
    target = _target(decorator, function)
    return target is unguarded or target is functools.wraps


def _check_decorator(decorator: ast.expr, wrapper: Any, function: types.FunctionType, what: str) -> None:
    """Refuse a decorator that keeps something from call to call."""
    place = place_in(function.__code__.co_filename, decorator.lineno)
    what = f"{what} is wrapped by a decorator, @{ast.unparse(decorator)} ({place}):"
    code = wrapper.__code__ if _is_of_notebook(wrapper) else None
    node = definition_of(code)[1] if code is not None else None
    if node is not None:
        check_state(wrapper, node, f"{what} {wrapper.__code__.co_name!r}")
    made_by = _target(decorator, function)
    factory = definition_of(made_by.__code__)[1] if _is_of_notebook(made_by) else None
    if factory is None:
        return
    try:
        check_state(made_by, factory, what)
    except Refused as refusal:
        text = f"{what} it changes what stands outside of it, as registering the function does"
        raise Refused(
            f"{text}. Leave that to a statement below the function, and let the decorator only wrap it."
        ) from refusal


def _is_of_notebook(function: Any) -> TypeGuard[types.FunctionType]:
    """Whether this is a function of the notebook, or of a module that can't be imported, as that of a bundle."""
    if not isinstance(function, types.FunctionType):
        return False
    home = function.__globals__.get("__name__")
    return home == "__main__" or home not in sys.modules


def _no_definition(value: Any, decorators: Collection[ast.expr], what: str) -> str:
    """Return why something that can be called has no definition that makes it."""
    if isinstance(value, types.MethodType | types.BuiltinMethodType):
        kind, text = type(value.__self__), f"a method of an object of class {type(value.__self__).__name__!r}"
    else:
        kind, text = type(value), f"an object of class {type(value).__name__!r}"
    names = vars(sys.modules["__main__"])
    statements = (one for name in names_of(value, names) for one in statements_of(name, names))
    methods = functions_of(kind).values() if importable(kind) is None else ()
    places = [f"cell [{one.cell}], line {one.node.lineno}" for one in statements]
    places += [place_of(method.__code__) for method in methods]
    where = f" ({places[0]})" if places else ""
    if decorators:
        text = f"{what} is {text}{where}, and not each of its decorators has wrapped it"
        return f"{text}. Let each decorator wrap it, and register functions in a statement below."
    return f"{what} is {text}{where}. Write a plain function (def) that makes the object and calls it."


# -- defaults --------------------------------------------------------------------------------------------------------


def defaults_of(function: types.FunctionType) -> dict[str, Any]:
    """Return the defaults of a function by parameter, as they are by now."""
    given, code = function.__defaults__ or (), function.__code__
    names = code.co_varnames[: code.co_argcount]
    return dict(zip(names[len(names) - len(given) :], given, strict=True)) | (function.__kwdefaults__ or {})


def annotated_names(node: ast.AST) -> Iterator[str]:
    """Give the names in all annotations of a definition."""
    for part in ast.walk(node):
        for annotation in (getattr(part, "annotation", None), getattr(part, "returns", None)):
            names = ast.walk(annotation) if annotation is not None else ()
            yield from (name.id for name in names if isinstance(name, ast.Name))


# -- classes ---------------------------------------------------------------------------------------------------------


def class_definition(kind: type, around: Mapping[str, Any], what: str) -> Definition:
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
    text = own_text(lines_in(file), node, ())
    code = _compiled(text, what, place_in(file, node.lineno))
    check_globals(code, node, file, what)
    return Definition(kind.__name__, text, node, code, file, node.lineno, names, None, {})


def statements_of_class(kind: type) -> Iterator[tuple[str, ast.ClassDef]]:
    """Give the class statements of a class's name, each with its file: the last one first.

    They are those in the files and cells of its methods; of a class without methods, in all that Python remembers.
    """
    own = dict.fromkeys(function.__code__.co_filename for function in functions_of(kind).values())
    main = vars(sys.modules["__main__"])
    files = [*own] or [*linecache.cache, str(main.get("__file__", ""))]
    for file in sorted(files, key=lambda file: cell_of(file, main))[::-1]:
        text = "".join(lines_in(file))
        tree = parsed(text) if f"class {kind.__name__}" in text else None
        found = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)] if tree else []
        yield from ((file, node) for node in reversed(found) if node.name == kind.__name__)


def functions_of(kind: type) -> dict[str, types.FunctionType]:
    """Return the functions of a class that were written for it, by name; of a property, its first."""
    found = {name: list(_functions_in(value)) for name, value in vars(kind).items()}
    return {name: functions[0] for name, functions in found.items() if functions}


def _functions_in(value: Any) -> Iterator[types.FunctionType]:
    """Give the functions that an attribute of a class is made of; none that a library has made, as dataclasses do."""
    parts = [value, *(getattr(value, name, None) for name in ("__func__", "fget", "fset", "fdel", "__wrapped__"))]
    if isinstance(value, functools.cached_property):
        parts.append(value.func)
    for part in parts:
        if _is_of_notebook(part) and lines_in(part.__code__.co_filename):
            yield part
