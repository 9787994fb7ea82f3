"""The library functions that a user's function passes its parameter to, read from its source.

A call counts in which an argument is the parameter itself, ``int(k)``, or a tuple of it. The called function is looked
up by object, so it does not matter how it was imported.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import FunctionType, ModuleType
from typing import Any, Final

from epypes.catalog.lookup import CatalogEntry, entry_of
from epypes.graph import unwrapped
from epypes.graph.signature import documented_signature
from epypes.graph.source import Definition, argument_names, definition_of

_CONVERSIONS: Final = ("int", "float", "round", "bool")
# A user's function may call another, and that another.
_DEEPEST: Final = 3


@dataclass(frozen=True, slots=True)
class Use:
    """A use that a function makes of one of its parameters.

    Attributes
    ----------
    entry
        The table's entry of the library function that gets it; None if it is only compared.
    cuts
        The function's parameter with whose values it is compared; empty if there is none.
    """

    entry: CatalogEntry | None
    cuts: str = ""


def parameter_names(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of the parameters that can be given by position, a C function's too; empty if not known.

    Never raises.

    Examples
    --------
    >>> parameter_names(lambda image, k, *rest: image)
    ('image', 'k')
    """
    try:
        signature = inspect.signature(function)
    except Exception:  # C functions have no signature, and odd objects raise anything
        return _documented_names(function)
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    names = tuple(name for name, parameter in signature.parameters.items() if parameter.kind in positional)
    return names or _documented_names(function)


def _documented_names(function: Callable[..., Any]) -> tuple[str, ...]:
    if isinstance(function, type):
        function = getattr(function, "create", function)  # an object of OpenCV is made as its create() makes it
    text = getattr(function, "__doc__", None)
    found = documented_signature(text) if isinstance(text, str) else None
    return found[0] if found else ()


def uses(function: Any, parameter: str) -> tuple[Use, ...]:
    """Return the uses of a parameter, as far as the table knows them and the source is available; never raises."""
    try:
        return tuple(_uses(unwrapped(function), parameter, _DEEPEST))
    except Exception:  # the names of a function may mean any odd objects, and this is a guess
        return ()


def _uses(function: Any, parameter: str, depth: int) -> Iterator[Use]:
    node = definition_of(function)
    if node is None or not depth or _is_changed(node, parameter):
        return
    names, own = _names_of(function, node), set(argument_names(node))
    for part in ast.walk(node):
        if isinstance(part, ast.Call):
            yield from _uses_in_call(part, names, own, parameter, depth, function)
        elif isinstance(part, ast.Compare):
            sides = [part.left, *part.comparators]
            if any(_is_parameter(side, parameter) for side in sides):
                others = (side.id for side in sides if isinstance(side, ast.Name) and side.id in own - {parameter})
                yield from (Use(None, other) for other in others)


def _uses_in_call(
    call: ast.Call, names: Mapping[str, Any], own: set[str], parameter: str, depth: int, caller: FunctionType
) -> Iterator[Use]:
    target = _object(call.func, names)
    if not callable(target):
        return
    arguments = _arguments(call, parameter_names(target))
    for name, value in arguments.items():
        if not _is_parameter(value, parameter):
            continue
        entry = entry_of(target, name)
        if entry is not None:
            image = arguments.get(entry.cuts)
            yield Use(entry, image.id if isinstance(image, ast.Name) and image.id in own else "")
        elif isinstance(target, FunctionType) and _package(target) == _package(caller):
            # The other function's parameters have names of their own, so it compares none of this function's.
            yield from (Use(use.entry) for use in _uses(target, name, depth - 1) if use.entry is not None)


def _arguments(call: ast.Call, names: tuple[str, ...]) -> dict[str, ast.expr]:
    """Return the arguments of a call by the parameter's name, up to a starred one."""
    starred = (place for place, value in enumerate(call.args) if isinstance(value, ast.Starred))
    arguments = dict(zip(names, call.args[: next(starred, None)], strict=False))
    return arguments | {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg}


def _is_parameter(expression: ast.expr, parameter: str) -> bool:
    """Whether an expression is the parameter: ``k``, ``int(k)``, ``(k, k)``."""
    if isinstance(expression, ast.Name):
        return expression.id == parameter
    if isinstance(expression, ast.Tuple | ast.List):
        return any(_is_parameter(part, parameter) for part in expression.elts)
    if isinstance(expression, ast.Call) and isinstance(expression.func, ast.Name):
        return expression.func.id in _CONVERSIONS and any(
            _is_parameter(part, parameter) for part in expression.args[:1]
        )
    return False


def _is_changed(node: Definition, parameter: str) -> bool:
    """Whether a function assigns another value to the parameter's name; ``k = int(k)`` is the same value."""
    parts = [*ast.walk(node)]
    conversions = [
        part.targets[0] for part in parts if isinstance(part, ast.Assign) and _is_parameter(part.value, parameter)
    ]
    stores = (part for part in parts if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store))
    return any(store.id == parameter and store not in conversions for store in stores)


def _names_of(function: FunctionType, node: Definition) -> dict[str, Any]:
    """Return the objects of the names in a function: Python's own, its module's, enclosing ones, imported in it."""
    known = inspect.getclosurevars(function)
    names = {**known.builtins, **known.globals, **known.nonlocals}
    for part in ast.walk(node):
        if isinstance(part, ast.Import):
            for alias in part.names:
                top = alias.name if alias.asname else alias.name.partition(".")[0]
                names[alias.asname or top] = sys.modules.get(top)
        elif isinstance(part, ast.ImportFrom) and part.module and not part.level:
            for alias in part.names:
                names[alias.asname or alias.name] = getattr(sys.modules.get(part.module), alias.name, None)
    return names


def _object(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Return the object of a dotted name in modules and classes; None for any other expression."""
    if isinstance(expression, ast.Name):
        return names.get(expression.id)
    if isinstance(expression, ast.Attribute):
        owner = _object(expression.value, names)
        return getattr(owner, expression.attr, None) if isinstance(owner, ModuleType | type) else None
    return None


def _package(function: FunctionType) -> str:
    return (function.__module__ or "").partition(".")[0]
