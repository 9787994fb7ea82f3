"""Is a decorated function what its text says?

Nothing is called to find out. A decorator that wraps with functools.wraps leaves what it wrapped in ``__wrapped__``: so
each layer is compared with the decorator that the text names for it.
"""

from __future__ import annotations

import ast
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from epypes.bundle.cells import place_in, place_of
from epypes.bundle.closures import rebound
from epypes.bundle.evaluate import UNKNOWN, is_same, value_of
from epypes.bundle.source import Definition, Refused, definition, evaluated, importable, other_decorators
from epypes.bundle.text import definition_of, nested_codes
from epypes.bundle.wrappers import captured_by, library_state, own_state

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
        The decorators in the text are not what made it.
    """
    found = layers(function)
    innermost = found[-1]
    if not isinstance(innermost, types.FunctionType):
        raise Refused(f"{what} wraps an object of class {type(innermost).__name__!r}. Wrap a plain function (def).")
    _, node = definition_of(innermost.__code__)
    decorators = other_decorators(node, innermost.__globals__) if node else []
    place = place_of(innermost.__code__)
    if node is not None and len(decorators) != len(found) - 1:
        text = f"{what} is wrapped {len(found) - 1} times and has {len(decorators)} decorators that could do it"
        raise Refused(f"{text} ({place}). Wrap it by @ above its definition, with functools.wraps in each decorator.")
    for decorator, wrapper, wrapped in zip(decorators, found, found[1:], strict=False):
        why = _contradiction(decorator, wrapper, wrapped, innermost.__globals__)
        if why:
            where = place_in(innermost.__code__.co_filename, decorator.lineno)
            text = f"{what} is wrapped by a decorator, @{ast.unparse(decorator)} ({where}), {why}."
            raise Refused(f"{text} Run that cell again, or call the decorator's work inside the function.")
    return definition(innermost, what, decorators)


def _contradiction(decorator: ast.expr, wrapper: Any, wrapped: Any, names: Mapping[str, Any]) -> str:
    """Return why a wrapper is not what a decorator makes; "" if nothing speaks against it."""
    made_by = evaluated(decorator.func if isinstance(decorator, ast.Call) else decorator, names)
    if made_by is None:
        return "which is no name of a function"
    if isinstance(made_by, types.FunctionType) and importable(made_by) is None:
        return _own_contradiction(decorator, made_by, wrapper, wrapped, names)
    if importable(made_by) is None:
        return f"an object of class {type(made_by).__name__!r}"
    if isinstance(wrapper, types.FunctionType) and wrapper.__globals__ is names:
        return "which did not make it"
    return library_state(decorator, wrapper, wrapped, names)


def _own_contradiction(
    decorator: ast.expr, made_by: types.FunctionType, wrapper: Any, wrapped: Any, names: Mapping[str, Any]
) -> str:
    """Return why a wrapper is not what a decorator of the notebook makes."""
    if not isinstance(wrapper, types.FunctionType) or wrapper.__code__ not in set(nested_codes(made_by.__code__)):
        return "which makes something else by now"
    captured = captured_by(wrapper)
    if not any(value is wrapped for value in captured.values()):
        return "which wraps something else"
    changed = [name for name in captured if name in rebound(wrapper.__code__)]
    if changed:
        return f"which counts or keeps something in {changed[0]!r} from call to call"
    given: dict[str, Any] = {}
    for name, expression in _arguments(decorator, made_by):
        if name in captured and (expression is None or not is_same(expression, captured[name], names)):
            return f"whose argument {name!r} had another value"
        given[name] = UNKNOWN if expression is None else value_of(expression, names)
    return own_state(made_by, wrapper, wrapped, given, names)


def _arguments(decorator: ast.expr, made_by: Callable[..., Any]) -> Iterator[tuple[str, ast.expr | None]]:
    """Return the arguments of a decorator by parameter; None for one that is not a plain expression."""
    if not isinstance(decorator, ast.Call):
        return
    named = {keyword.arg: keyword.value for keyword in decorator.keywords if keyword.arg}
    try:
        bound = inspect.signature(made_by).bind(*decorator.args, **named)
    except TypeError:
        yield from ((name, None) for name in inspect.signature(made_by).parameters)
        return
    for name, given in bound.arguments.items():
        yield name, given if isinstance(given, ast.expr) else None
