"""The call that makes a closure again."""

from __future__ import annotations

import dis
import types
from dataclasses import dataclass
from typing import Any

from epypes.bundle.side_effects import unrepeatable
from epypes.bundle.source import Definition
from epypes.bundle.text import definition_of, nested_codes

_REBINDS = ("STORE_DEREF", "DELETE_DEREF")


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
    name, _, inner = code.co_qualname.partition(".<locals>.")
    factory = found.function.__globals__.get(name)
    if not isinstance(factory, types.FunctionType) or factory.__closure__ or "." in inner:
        return None
    _, node = definition_of(factory.__code__)
    if code not in factory.__code__.co_consts or node is None or hasattr(factory, "__wrapped__"):
        return None
    if unrepeatable(node, {**factory.__globals__, **found.captured}, code) is not None:
        return None
    return _with_arguments(factory, found)


def _with_arguments(factory: types.FunctionType, found: Definition) -> FactoryCall | None:
    code = factory.__code__
    count, named = code.co_argcount, code.co_kwonlyargcount
    parameters = code.co_varnames[: count + named]
    has_more = code.co_flags & (0x04 | 0x08)  # *args and **kwargs, as inspect.CO_VARARGS and CO_VARKEYWORDS
    if has_more or not set(parameters) <= found.captured.keys() or _rebound(code) & set(parameters):
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


def _rebound(code: types.CodeType) -> set[str]:
    """Return the names that code, or what is defined in it, gives another value though others have captured them."""
    instructions = (instruction for part in nested_codes(code) for instruction in dis.get_instructions(part))
    return {instruction.argval for instruction in instructions if instruction.opname in _REBINDS}
