"""Which call makes a closure again?"""

from __future__ import annotations

import ast
import dis
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from epypes.bundle.source import Definition
from epypes.bundle.text import definition_of, nested_codes

_DEREF = ("STORE_DEREF", "DELETE_DEREF")


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
    """Return the call that makes a closure again; None if what is captured does not tell it.

    The factory must return what it defines, and every parameter of it must be captured as it was given.
    """
    code = found.function.__code__
    name, _, inner = code.co_qualname.partition(".<locals>.")
    factory = found.function.__globals__.get(name)
    if not isinstance(factory, types.FunctionType) or factory.__closure__ or "." in inner:
        return None
    if code not in factory.__code__.co_consts or hasattr(factory, "__wrapped__") or not _returns(factory, found):
        return None
    return _with_arguments(factory, found)


def _returns(factory: types.FunctionType, found: Definition) -> bool:
    """Whether all that a factory returns is what it defines under a function's name."""
    _, node = definition_of(factory.__code__)
    returned = [part.value for part in _own(node) if isinstance(part, ast.Return)] if node else []
    if found.is_lambda:
        lines = {value.lineno for value in returned if isinstance(value, ast.Lambda)}
        return lines == {found.function.__code__.co_firstlineno} and len(returned) == 1
    return bool(returned) and all(isinstance(value, ast.Name) and value.id == found.name for value in returned)


def _own(node: ast.AST) -> Iterator[ast.AST]:
    """Return the parts of a function, but not those of functions inside of it."""
    for part in ast.iter_child_nodes(node):
        yield part
        if not isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef):
            yield from _own(part)


def _with_arguments(factory: types.FunctionType, found: Definition) -> FactoryCall | None:
    code = factory.__code__
    count, named = code.co_argcount, code.co_kwonlyargcount
    parameters = code.co_varnames[: count + named]
    has_more = code.co_flags & (0x04 | 0x08)  # *args and **kwargs, as inspect.CO_VARARGS and CO_VARKEYWORDS
    if has_more or not set(parameters) <= found.captured.keys() or rebound(code) & set(parameters):
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


def rebound(code: types.CodeType) -> set[str]:
    """Return the names that code, or what is defined in it, gives another value though others have captured them."""
    return {
        instruction.argval
        for part in nested_codes(code)
        for instruction in dis.get_instructions(part)
        if instruction.opname in _DEREF
    }
