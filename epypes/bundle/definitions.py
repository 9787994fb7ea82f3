"""The definition of a function of the notebook: its text, what it has captured, and the names that it reads.

A decorator stays where it stands, and a closure becomes a call of its factory where that call can be found. Whether
they make what the notebook has is found out by the comparison with the module's objects.
"""

from __future__ import annotations

import ast
import copy
import sys
import types
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from typing import Any, TypeGuard

from epypes.bundle.notebook_source import (
    LATE_ANNOTATIONS,
    UNNAMED,
    as_function,
    code_on_its_own,
    definition_of,
    lambdas_of,
    names_from_outside,
    nested_codes,
    own_text,
    place_in,
    place_of,
    place_of_object,
)
from epypes.bundle.resolve import Importable, Refused, evaluated, importable, layers
from epypes.bundle.side_effects import CHANGING, captured_by, check_nonlocal, check_state, dotted_name, unrepeatable
from epypes.bundle.syntax import literal_source
from epypes.graph import outputs
from epypes.run.guard import unguarded


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
        Cell and line, as reasons give them.
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
        """Return the cell and line of a part of it."""
        return place_in(self.file, getattr(node, "lineno", self.line))

    def place_of(self, name: str) -> str:
        """Return the cell and line where it uses a name."""
        uses = (node for node in ast.walk(self.node) if isinstance(node, ast.Name) and node.id == name)
        return self.place_in(next(uses, self.node))


def definition(function: types.FunctionType, what: str, decorators: Collection[ast.expr] = ()) -> Definition:
    """Return the source of a function that was defined in the notebook or the main script.

    Parameters
    ----------
    function
        The function.
    what
        How to call it in a reason, as ``"Function 'blur'"``.
    decorators
        Those that stay, besides ``@ep.unguarded``. Without the others its text is this very function: a decorator may
        have returned another, or the function itself.

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
    known, written = {ast.unparse(decorator) for decorator in decorators}, copy.copy(node)
    written.decorator_list = [
        decorator
        for decorator in node.decorator_list
        if ast.unparse(decorator) in known or evaluated(decorator, function.__globals__) is unguarded
    ]
    text = own_text(lines, node, [one for one in node.decorator_list if one not in written.decorator_list])
    return _defined(function, text, written, what, place)


def _lambda(function: types.FunctionType, what: str, place: str) -> Definition:
    lines, nodes = lambdas_of(function.__code__)
    _check_found(bool(lines), bool(nodes), what, place)
    if len(nodes) > 1:
        text = f"{what} is one of {len(nodes)} lambdas on a line, which look alike to Python ({place})."
        raise Refused(f"{text} Give each a line of its own, and run the cell again.")
    text, node = as_function(lines, nodes[0])
    return _defined(function, text, node, what, place)


def _defined(function: types.FunctionType, text: str, node: ast.FunctionDef, what: str, place: str) -> Definition:
    check_nonlocal(function, node, what)
    code = code_on_its_own(text, node.name)
    if code is None:
        raise Refused(f"{what} can't be compiled by itself ({place}). Define it at the margin of a cell.")
    return Definition(node.name, function, text, node, place, code, captured_by(function), node.name == UNNAMED)


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


def found_definition(function: Any, what: str) -> Definition:
    """Return the definition of a function of the notebook, with its decorators.

    Raises
    ------
    Refused
        It has none, that does not say all of it, or a decorator keeps something from call to call or calls what may
        give something else in another process.
    """
    found = layers(function)
    innermost = found[-1]
    node = definition_of(innermost.__code__)[1] if isinstance(innermost, types.FunctionType) else None
    decorators = other_decorators(node, innermost.__globals__) if node is not None else []
    if 0 < len(decorators) == len(found) - 1:
        for decorator, wrapper in zip(decorators, found, strict=False):
            place = place_in(innermost.__code__.co_filename, decorator.lineno)
            whole = f"{what} is wrapped by a decorator, @{ast.unparse(decorator)} ({place}):"
            _check_layer(decorator, wrapper, innermost.__globals__, whole)
        return definition(innermost, what, decorators)
    if not isinstance(function, types.FunctionType):
        text = f"{what} is {_kind(function)}{_place(function, what)}."
        raise Refused(f"{text} Write a plain function (def) that makes the object and calls it.")
    return definition(function, what)


def method_of(function: Any) -> tuple[str | Importable, str] | None:
    """Return what a method is of, an expression or what can be imported, and the method's name; None for any other."""
    name, owner = getattr(function, "__name__", ""), getattr(function, "__self__", None)
    if isinstance(function, types.MethodDescriptorType | types.WrapperDescriptorType | types.ClassMethodDescriptorType):
        home = importable(function.__objclass__)
        return (home, name) if home else None
    if not isinstance(function, types.MethodType | types.BuiltinMethodType) or getattr(owner, name, None) != function:
        return None
    source = literal_source(owner) if name not in CHANGING else ""
    if source:
        return f"({source})" if source[0] not in "\"'[({" else source, name
    home = importable(owner) if isinstance(owner, type) else None
    return (home, name) if home else None


def _kind(value: object) -> str:
    if isinstance(value, partial):
        return "a functools.partial that was changed"
    if isinstance(value, type):
        return f"the class {value.__name__!r}, defined in the notebook"
    if isinstance(value, types.MethodType | types.BuiltinMethodType):
        return f"a method of an object of class {type(value.__self__).__name__!r}"
    return f"an object of class {type(value).__name__!r}"


def _place(value: Any, what: str) -> str:
    """Return where a callable is from, as far as that is known, in brackets."""
    names = vars(sys.modules["__main__"])
    key = what.split("'")[1] if what.startswith("Function '") else ""
    kind = value if isinstance(value, type) else type(getattr(value, "__self__", value))
    code = getattr(value, "__code__", None) or (_code_in(kind) if importable(kind) is None else None)
    where = place_of_object(value, names, key) or (place_of(code) if code is not None else "")
    return f" ({where})" if where else ""


def _code_in(kind: type) -> types.CodeType | None:
    methods = (getattr(value, "__code__", None) for value in vars(kind).values())
    return next((code for code in methods if code is not None), None)


def _check_layer(decorator: ast.expr, wrapper: Any, names: dict[str, Any], what: str) -> None:
    given = [*decorator.args, *(word.value for word in decorator.keywords)] if isinstance(decorator, ast.Call) else []
    for argument in given:
        if unrepeatable(ast.Expression(argument), names) is not None:
            text = f"{what} its argument {ast.unparse(argument)!r} may be something else in a service"
            raise Refused(f"{text}. Compute it above under a name of its own.")
    made_by = evaluated(decorator.func if isinstance(decorator, ast.Call) else decorator, names)
    is_own = made_by is None or importable(made_by) is None
    if is_own and not isinstance(made_by, types.FunctionType):
        kind = "no name of a function" if made_by is None else f"an object of class {type(made_by).__name__!r}"
        raise Refused(f"{what} it is {kind}. Write the decorator as a function (def).")
    code = wrapper.__code__ if isinstance(wrapper, types.FunctionType) and not _is_of_library(wrapper) else None
    _, node = definition_of(code) if code is not None else ([], None)
    if node is not None:
        check_state(wrapper, node, f"{what} {wrapper.__code__.co_name!r}")
    if is_own:
        _, factory = definition_of(made_by.__code__)
        part = unrepeatable(factory, made_by.__globals__, code) if factory is not None else None
        if part is not None:
            place = place_in(made_by.__code__.co_filename, part.lineno)
            text = f"{what} it calls {ast.unparse(part)!r} ({place}), which may give something else in a service"
            raise Refused(f"{text}. Compute it above under a name of its own.")


def _is_of_library(function: types.FunctionType) -> bool:
    """Whether the code of a function is from a module that can be imported, as that of functools."""
    home = sys.modules.get(str(function.__globals__.get("__name__")))
    return home is not None and home.__name__ != "__main__" and vars(home) is function.__globals__


@dataclass(frozen=True, slots=True)
class FactoryCall:
    """A call that makes a closure.

    Attributes
    ----------
    factory
        The function that defines the closure and returns it.
    positional, named
        What it was called with.
    """

    factory: types.FunctionType
    positional: tuple[Any, ...]
    named: dict[str, Any]


def factory_call(found: Definition) -> FactoryCall | None:
    """Return the call that should make a closure again; None if what is captured does not show it.

    Every parameter of the factory must be captured, and what it calls must give the same in every process. Whether the
    call makes what the notebook has is found out by the comparison with the module's objects.
    """
    code = found.function.__code__
    factory = found.function.__globals__.get(code.co_qualname.partition(".<locals>.")[0])
    if not isinstance(factory, types.FunctionType) or code not in factory.__code__.co_consts:
        return None
    _, node = definition_of(factory.__code__)
    if node is None:
        return None
    if unrepeatable(node, {**factory.__globals__, **found.captured}, code) is not None:
        return None
    return _with_arguments(factory, found)


def _with_arguments(factory: types.FunctionType, found: Definition) -> FactoryCall | None:
    code = factory.__code__
    count, named = code.co_argcount, code.co_kwonlyargcount
    parameters = code.co_varnames[: count + named]
    has_more = code.co_flags & (0x04 | 0x08)  # *args and **kwargs, as inspect.CO_VARARGS and CO_VARKEYWORDS
    if has_more or not set(parameters) <= found.captured.keys():
        return None
    positional = [found.captured[name] for name in parameters[:count]]
    while _is_default(factory, positional):
        positional.pop()
    by_name = factory.__kwdefaults__ or {}
    rest = {name: found.captured[name] for name in parameters[count:]}
    given = {name: value for name, value in rest.items() if name not in by_name or by_name[name] is not value}
    return FactoryCall(factory, tuple(positional), given)


def _is_default(factory: types.FunctionType, positional: list[Any]) -> bool:
    """Whether the last argument need not be given."""
    defaults = factory.__defaults__ or ()
    missing = len(positional) - (factory.__code__.co_argcount - len(defaults))
    return 0 < missing <= len(defaults) and defaults[missing - 1] is positional[-1]


def global_names(found: Definition, replaced_defaults: Collection[ast.expr] = ()) -> Iterator[str]:
    """Return the global names that a function reads when it is called or defined, each once, in order of use.

    Parameters
    ----------
    found
        Its definition.
    replaced_defaults
        Defaults that are written otherwise.
    """
    names: dict[str, None] = {}
    for code in nested_codes(found.code):
        names.update(dict.fromkeys(names_from_outside(code)))
    arguments = found.node.args
    every = (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg)
    outside = [argument.annotation for argument in every if argument] + [found.node.returns]
    outside += [default for default in defaults_in(found.node) if default not in replaced_defaults]
    for expression in (*outside, *found.node.decorator_list):
        for node in ast.walk(expression) if expression else ():
            if isinstance(node, ast.Name):
                names[node.id] = None
    return iter(names)


def only_in_annotations(found: Definition) -> set[str]:
    """Return the names in annotations of a function that was compiled not to read them; none of any other function."""
    code = found.function.__code__
    if not code.co_flags & LATE_ANNOTATIONS:
        return set()
    read = {name for inner in nested_codes(code) for name in names_from_outside(inner)}
    others = [*defaults_in(found.node), *found.node.decorator_list]
    read |= {part.id for expression in others for part in ast.walk(expression) if isinstance(part, ast.Name)}
    return set(annotated_names(found.node)) - read


def annotated_names(node: ast.AST) -> Iterator[str]:
    """Give the names in all annotations of a definition."""
    for part in ast.walk(node):
        for annotation in (getattr(part, "annotation", None), getattr(part, "returns", None)):
            names = ast.walk(annotation) if annotation is not None else ()
            yield from (name.id for name in names if isinstance(name, ast.Name))


def defaults_in(node: ast.FunctionDef | ast.Lambda) -> list[ast.expr]:
    """Return the defaults of a definition: of parameters by position, then of those by name."""
    return [*node.args.defaults, *(default for default in node.args.kw_defaults if default is not None)]


def default_values(node: ast.FunctionDef, function: types.FunctionType) -> list[tuple[str, ast.expr, Any]]:
    """Return the defaults by parameter, as they are written and as they are; none if it has others than are written."""
    by_position, by_name = [*node.args.posonlyargs, *node.args.args], node.args.kwonlyargs
    pairs = [*zip(by_position[::-1], node.args.defaults[::-1], strict=False)][::-1]
    pairs += [(one, default) for one, default in zip(by_name, node.args.kw_defaults, strict=True) if default]
    known = defaults_of(function)
    is_as_written = known.keys() == {one.arg for one, _ in pairs}
    return [(one.arg, default, known[one.arg]) for one, default in pairs] if is_as_written else []


def defaults_of(function: types.FunctionType) -> dict[str, Any]:
    """Return the defaults of a function by parameter, as they are by now."""
    given, code = function.__defaults__ or (), function.__code__
    names = code.co_varnames[: code.co_argcount]
    return dict(zip(names[len(names) - len(given) :], given, strict=True)) | (function.__kwdefaults__ or {})


def submodules(tree: ast.AST, name: str, module: types.ModuleType) -> tuple[str, ...]:
    """Return the submodules that are reached as attributes (``skimage.filters``): each needs an import of its own."""
    found: dict[str, None] = {}
    for node in ast.walk(tree):
        chain = dotted_name(node)
        if chain[:1] == (name,):
            reached: Any = module
            dotted = name
            for part in chain[1:]:
                reached = getattr(reached, part, None)
                if not isinstance(reached, types.ModuleType) or reached.__name__ != f"{dotted}.{part}":
                    break
                dotted = f"{dotted}.{part}"
            if dotted != name:
                found[dotted] = None
    return tuple(found)
