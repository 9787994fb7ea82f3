"""Which call makes a closure again?"""

from __future__ import annotations

import ast
import dis
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from epypes.bundle.changes import changes, is_container
from epypes.bundle.defaults import defaults_of
from epypes.bundle.evaluate import is_same
from epypes.bundle.remade import makers, own_parts, unlike, with_inner
from epypes.bundle.source import Definition
from epypes.bundle.text import definition_of, first_line, nested_codes

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

    The factory must return what it defines, every parameter of it must be captured as it was given, and all else that
    is captured must come out the same.
    """
    code = found.function.__code__
    name, _, inner = code.co_qualname.partition(".<locals>.")
    factory = found.function.__globals__.get(name)
    if not isinstance(factory, types.FunctionType) or factory.__closure__ or "." in inner:
        return None
    if code not in factory.__code__.co_consts or hasattr(factory, "__wrapped__") or not _returns(factory, found):
        return None
    made = _with_arguments(factory, found)
    return made if made and _makes_the_same(factory, found) else None


def _returns(factory: types.FunctionType, found: Definition) -> bool:
    """Whether all that a factory returns is what it defines under a function's name."""
    _, node = definition_of(factory.__code__)
    returned = [part.value for part in own_parts(node) if isinstance(part, ast.Return)] if node else []
    if found.is_lambda:
        lines = {value.lineno for value in returned if isinstance(value, ast.Lambda)}
        return lines == {found.function.__code__.co_firstlineno} and len(returned) == 1
    return bool(returned) and all(isinstance(value, ast.Name) and value.id == found.name for value in returned)


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


def _makes_the_same(factory: types.FunctionType, found: Definition) -> bool:
    """Whether another call of the factory gives what is captured, though the notebook may have changed since."""
    _, node = definition_of(factory.__code__)
    if node is None:
        return False
    code = factory.__code__
    given = {name: found.captured[name] for name in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]}
    names = {**factory.__globals__, **given}
    if any(name in given and is_container(given[name]) for _, name in changes(node, names)):
        return False
    inner = [part for part in own_parts(node) if _is_definition(part, found)]
    around = makers(node, inner[0]) if len(inner) == 1 else None
    is_itself = {name for name, value in found.captured.items() if value is found.function}
    captured = {name: value for name, value in with_inner(found.captured, code).items() if name not in is_itself}
    return around is not None and not unlike(around, captured, given, names) and _has_defaults(found, names)


def _is_definition(part: ast.AST, found: Definition) -> bool:
    if found.is_lambda or not isinstance(part, ast.FunctionDef):
        return found.is_lambda and isinstance(part, ast.Lambda)
    return part.name == found.name and first_line(part) == found.line


def _has_defaults(found: Definition, names: Mapping[str, Any]) -> bool:
    return all(is_same(default, value, names) for default, value in defaults_of(found, found.name))


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
