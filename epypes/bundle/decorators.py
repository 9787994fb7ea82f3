"""The definition of a function that decorators have wrapped.

A decorator stays where it stands. Whether the decorators of the text make what the notebook has is found out by the
comparison with the module's objects.
"""

from __future__ import annotations

import ast
import sys
import types
from typing import Any, Final

from epypes.bundle.cells import place_in, place_of
from epypes.bundle.side_effects import check_state, unrepeatable
from epypes.bundle.source import Definition, Refused, definition, evaluated, importable, other_decorators
from epypes.bundle.text import definition_of

# A wrapper may be made to wrap itself; nobody wraps this deep on purpose.
_DEEPEST: Final = 100


def layers(function: Any) -> list[Any]:
    """Return a function, what it wraps, and so on down to what wraps nothing."""
    found = [function]
    while len(found) < _DEEPEST and "__wrapped__" in getattr(found[-1], "__dict__", {}):
        found.append(found[-1].__wrapped__)
    return found


def has_decorators(function: Any) -> bool:
    """Whether the text of what an object wraps names decorators that may have made the object."""
    innermost = layers(function)[-1]
    if not isinstance(innermost, types.FunctionType):
        return False
    _, node = definition_of(innermost.__code__)
    return node is not None and bool(other_decorators(node, innermost.__globals__))


def decorated(function: Any, what: str) -> Definition:
    """Return the definition, with its decorators, of a function that wraps another.

    Raises
    ------
    Refused
        Its text has no decorator for each layer, a layer keeps something from call to call, or a decorator of the
        notebook calls what may give something else in another process.
    """
    found = layers(function)
    innermost = found[-1]
    if not isinstance(innermost, types.FunctionType):
        raise Refused(f"{what} wraps an object of class {type(innermost).__name__!r}. Wrap a plain function (def).")
    _, node = definition_of(innermost.__code__)
    names = innermost.__globals__
    decorators = other_decorators(node, names) if node else []
    if node is not None and len(decorators) != len(found) - 1:
        text = f"{what} is wrapped {len(found) - 1} times and has {len(decorators)} decorators that could do it"
        place = place_of(innermost.__code__)
        raise Refused(f"{text} ({place}). Wrap it by @ above its definition, with functools.wraps in each decorator.")
    for decorator, wrapper in zip(decorators, found, strict=False):
        place = place_in(innermost.__code__.co_filename, decorator.lineno)
        whole = f"{what} is wrapped by a decorator, @{ast.unparse(decorator)} ({place}):"
        _check_layer(decorator, wrapper, names, whole)
    return definition(innermost, what, decorators)


def _check_layer(decorator: ast.expr, wrapper: Any, names: dict[str, Any], what: str) -> None:
    given = [*decorator.args, *(word.value for word in decorator.keywords)] if isinstance(decorator, ast.Call) else []
    for argument in given:
        if unrepeatable(ast.Expression(argument), names) is not None:
            text = f"{what} its argument {ast.unparse(argument)!r} may be something else in a service"
            raise Refused(f"{text}. Compute it above under a name of its own.")
    if not isinstance(wrapper, types.FunctionType) or _is_of_library(wrapper):
        return
    _, node = definition_of(wrapper.__code__)
    if node is not None:
        check_state(wrapper, node, f"{what} {wrapper.__code__.co_name!r}")
    made_by = evaluated(decorator.func if isinstance(decorator, ast.Call) else decorator, names)
    if isinstance(made_by, types.FunctionType) and importable(made_by) is None:
        _, factory = definition_of(made_by.__code__)
        part = unrepeatable(factory, made_by.__globals__, wrapper.__code__) if factory is not None else None
        if part is not None:
            place = place_in(made_by.__code__.co_filename, part.lineno)
            text = f"{what} it calls {ast.unparse(part)!r} ({place}), which may give something else in a service"
            raise Refused(f"{text}. Compute it above under a name of its own.")


def _is_of_library(function: types.FunctionType) -> bool:
    """Whether the code of a function is from a module that can be imported, as that of functools."""
    home = sys.modules.get(str(function.__globals__.get("__name__")))
    return home is not None and home.__name__ != "__main__" and vars(home) is function.__globals__
