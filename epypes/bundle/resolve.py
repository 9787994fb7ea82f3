"""The resolution of an object: the name under which it can be imported, or its definition in the notebook.

Objects are looked up by identity, never by name: a name may mean another function by now. A decorator stays where it
stands. Whether the text makes what the notebook has by now is found out by the comparison with the module's objects.
"""

from __future__ import annotations

import ast
import copy
import functools
import itertools
import linecache
import sys
import types
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from typing import Any, Final, TypeGuard

from epypes.bundle.notebook_source import (
    assignment_of,
    cell_of,
    compiled,
    definition_of,
    first_line,
    lambdas_of,
    lines_in,
    names_of,
    nested_codes,
    parsed,
    place_in,
    place_of,
)
from epypes.graph import outputs
from epypes.run.guard import unguarded


class Refused(Exception):
    """One reason why something can't be promoted; collected, then raised together as PromotionRefused."""


# -- what can be imported --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Importable:
    """An object that ``module`` has as ``qualname``."""

    module: str
    qualname: str


def importable(value: Any, *names: str) -> Importable | None:
    """Return a public name under which an object can be imported, if it has one.

    The object's own package is preferred to others that show it too, and there the shortest name.

    Parameters
    ----------
    value
        A function, class or other object.
    names
        Names that it may have in its module besides its own.
    """
    own = str(getattr(value, "__module__", None))
    if own == "__main__":
        return None
    # C functions and the special forms of typing often know their name, but not their module.
    known = [getattr(value, attribute, None) for attribute in ("__qualname__", "__name__", "_name")]
    for name in dict.fromkeys(name for name in (*known, *names) if isinstance(name, str)):
        for module in _modules_with(name.partition(".")[0], own):
            is_public = not module.startswith("_") and "._" not in module
            if is_public and _reached(module, name) is value:
                return Importable(module, name)
    qualname = str(known[0])
    return Importable(own, qualname) if _reached(own, qualname) is value else None


def _modules_with(name: str, own: str) -> Iterator[str]:
    """Give the modules that may have a name: a module and the packages around it, then others that have it already."""
    package = own.partition(".")[0].lstrip("_")  # _functools is what functools is made of
    yield from (package, *itertools.accumulate(own.split("."), "{}.{}".format))

    def distance(module: str) -> tuple[bool, int, int, str]:
        return module.partition(".")[0] != package, module.count("."), len(module), module

    # These are not asked for what they would load only now.
    found = [module for module, loaded in [*sys.modules.items()] if name in getattr(loaded, "__dict__", {})]
    yield from sorted(found, key=distance)


def _reached(module: str, qualname: str) -> Any:
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = getattr(found, part, None)
    return found


def evaluated(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Look up a dotted name; None for any other expression."""
    if isinstance(expression, ast.Name):
        return names.get(expression.id)
    if isinstance(expression, ast.Attribute):
        return getattr(evaluated(expression.value, names), expression.attr, None)
    return None


# -- definitions -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Definition:
    """The definition of a function or class in the notebook.

    Attributes
    ----------
    what
        How reasons call it, as ``"Function 'blur'"``.
    node
        Its syntax tree; a lambda's is that of a function with one statement.
    dropped
        The decorators that do not stay.
    file, lines
        The file or cell that it is from, as Python knows it, and the lines there.
    names
        What its names mean by now.
    function
        The function that has this text: of a decorated one, the innermost; None for a class.
    captured
        What a function has from the function around it, by name.
    wrappers
        The functions that decorators have wrapped around it, each with its decorator.
    changed
        Expressions of the defaults whose text makes another value than the function has, by the text's.
    """

    what: str
    node: ast.FunctionDef | ast.ClassDef
    file: str
    lines: Sequence[str]
    names: Mapping[str, Any]
    function: types.FunctionType | None
    captured: Mapping[str, Any]
    dropped: Collection[ast.expr]
    wrappers: Sequence[tuple[ast.expr, Any]] = ()
    changed: Mapping[ast.expr, str] = field(default_factory=dict)

    @property
    def is_lambda(self) -> bool:
        """Whether it had no name."""
        return self.function is not None and self.function.__code__.co_name == "<lambda>"

    @property
    def line(self) -> int:
        """Where it begins in its file or cell."""
        return first_line(self.node)

    def codes(self) -> list[types.CodeType]:
        """Return the code of its statement in a module, but for changed defaults, and all code in it."""
        node = copy.copy(self.node)
        node.decorator_list = [one for one in node.decorator_list if one not in self.dropped]
        if isinstance(node, ast.FunctionDef):
            nones: dict[ast.expr, ast.expr] = {one: ast.copy_location(ast.Constant(None), one) for one in self.changed}
            node.args = with_defaults(node.args, nones)
        code = compiled(ast.Module([node], []))
        return [*nested_codes(code)] if code is not None else []

    def place_in(self, node: ast.AST) -> str:
        """Return the cell and line of a part of it."""
        return place_in(self.file, getattr(node, "lineno", self.line))

    def place_of(self, name: str) -> str:
        """Return the cell and line where it uses a name."""
        uses = (node for node in ast.walk(self.node) if isinstance(node, ast.Name) and node.id == name)
        return self.place_in(next(uses, self.node))


# A wrapper may be made to wrap itself; a hundred layers are no accident of a notebook.
_DEEPEST: Final = 100


def layers(function: Any) -> list[Any]:
    """Return a function, what it wraps, and so on down to what wraps nothing."""
    found = [function]
    while len(found) < _DEEPEST and "__wrapped__" in getattr(found[-1], "__dict__", {}):
        found.append(found[-1].__wrapped__)
    return found


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
        Its source is not to be had or does not say all of it.
    """
    *wrappers, innermost = layers(function)
    node = definition_of(innermost.__code__)[1] if isinstance(innermost, types.FunctionType) else None
    decorators = [one for one in node.decorator_list if _target(one, innermost) not in _MARKS] if node else []
    if decorators and len(decorators) == len(wrappers):
        function = innermost
    elif isinstance(function, types.FunctionType):
        decorators = []
    else:
        raise Refused(_no_definition(function, innermost, what))
    code: types.CodeType = function.__code__
    place = place_of(code)
    if code.co_flags & (CO_COROUTINE | CO_ASYNC_GENERATOR):
        raise Refused(f"{what} is asynchronous ({place}), which no graph waits for. Write a plain function (def).")
    lines, node = definition_of(code)
    if code.co_name == "<lambda>":
        lines, nodes = lambdas_of(code)
        node = _as_function(nodes[0]) if len(nodes) == 1 else None
    if not lines:
        way_out = "Define it in a cell without %%time, in a file, or in a module that is installed"
        way_out += ": Python keeps no text of what is typed at a prompt."
        raise Refused(f"{what} has no source ({place}). {way_out}")
    if node is None:
        text = f"{what} is not what its source says ({place}): that was changed since it was run, or the function was."
        raise Refused(f"{text} Run it again, so that both are the same.")
    captured = captured_by(function)
    names = {**function.__globals__, **captured} if captured else function.__globals__
    targets = {one: _target(one, function) for one in node.decorator_list}
    # A decorator that has returned the function itself may have left something on it.
    dropped = [one for one, target in targets.items() if target is outputs or not (decorators or target in _LEAVING)]
    wrapped = [*zip(decorators, wrappers, strict=False)]
    return Definition(what, node, code.co_filename, lines, names, function, captured, dropped, wrapped)


# What returns the function itself, and what leaves something on it.
_MARKS: Final = (unguarded, outputs)
_LEAVING: Final = (unguarded, functools.wraps)


def _as_function(node: ast.Lambda) -> ast.FunctionDef:
    """Return a lambda as a function that is called so until its name is known."""
    body: list[ast.stmt] = [ast.copy_location(ast.Return(node.body), node.body)]
    return ast.copy_location(ast.FunctionDef("function", node.args, body, []), node)


def captured_by(function: types.FunctionType) -> dict[str, Any]:
    """Return what a function has from the functions around it, by name; nothing of a name without a value."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return {name: cell.cell_contents for name, cell in cells if cell != types.CellType()}


def _target(decorator: ast.expr, function: types.FunctionType) -> Any:
    """Return what a decorator calls, if that is a name."""
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return evaluated(called, {**function.__globals__, **captured_by(function)})


def is_of_notebook(function: Any) -> TypeGuard[types.FunctionType]:
    """Whether this is a function of the notebook, or of a module that can't be imported, as that of a bundle."""
    if not isinstance(function, types.FunctionType):
        return False
    home = function.__globals__.get("__name__")
    return home == "__main__" or home not in sys.modules


def _no_definition(value: Any, innermost: Any, what: str) -> str:
    """Return why something that can be called has no definition that makes it."""
    owner = value.__self__ if isinstance(value, types.MethodType | types.BuiltinMethodType) else value
    kind = type(owner)
    text = f"{'an' if owner is value else 'a method of an'} object of class {kind.__name__!r}"
    names = vars(sys.modules["__main__"])
    given = filter(None, (assignment_of(name, names) for name in names_of(value, names)))
    places = [f"cell [{cell}], line {node.lineno}" for node, _, cell in given]
    methods = functions_of(kind).values() if importable(kind) is None else ()
    places += [place_of(function.__code__) for function in (*methods, innermost) if is_of_notebook(function)]
    where = f" ({places[0]})" if places else ""
    return f"{what} is {text}{where}. Write a plain function (def) that makes the object and calls it."


# -- the parts of definitions ----------------------------------------------------------------------------------------


def with_defaults(given: ast.arguments, new: Mapping[ast.expr, ast.expr]) -> ast.arguments:
    """Return the parameters of a function with other defaults."""
    given = copy.copy(given)
    given.defaults = [new.get(default, default) for default in given.defaults]
    given.kw_defaults = [default and new.get(default, default) for default in given.kw_defaults]
    return given


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
    """Return the definition of a class of the notebook or the main script.

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
        Its source is not to be had.
    """
    if kind.__qualname__ != kind.__name__:
        text = f"{what} is defined inside {kind.__qualname__.rpartition('.')[0]!r}"
        raise Refused(f"{text}. Define it at the margin of a cell.")
    file, node = next(statements_of_class(kind), ("", None))
    if node is None:
        way_out = "Write a class statement for it, as class P(typing.NamedTuple), and make again what was made of it."
        raise Refused(f"{what} has no class statement: it was made by a call. {way_out}")
    names = next((function.__globals__ for function in functions_of(kind).values()), around)
    return Definition(what, node, file, lines_in(file), names, None, {}, ())


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
    """Return the functions of a class that were written for it, by name; of a property, its first.

    Those that a library has made, as dataclasses does, are left out.
    """
    found: dict[str, types.FunctionType] = {}
    for name, value in vars(kind).items():
        attributes = ("__func__", "fget", "fset", "fdel", "func", "__wrapped__")
        for part in (value, *(getattr(value, attribute, None) for attribute in attributes)):
            if is_of_notebook(part) and lines_in(part.__code__.co_filename):
                found.setdefault(name, part)
    return found
