"""What is it that a graph calls, if it is neither importable nor a plain function?"""

from __future__ import annotations

import sys
import types
from functools import partial
from typing import Any

from epypes.bundle.cells import place_of, place_of_object
from epypes.bundle.decorators import decorated, has_decorators, layers
from epypes.bundle.literal import literal_source
from epypes.bundle.side_effects import CHANGING
from epypes.bundle.source import Definition, Importable, Refused, definition, importable


def found_definition(function: Any, what: str) -> Definition:
    """Return the definition of a function of the notebook, with its decorators.

    Raises
    ------
    Refused
        It has none, or that does not say all of it.
    """
    if len(layers(function)) > 1 and (isinstance(function, types.FunctionType) or has_decorators(function)):
        return decorated(function, what)
    if not isinstance(function, types.FunctionType):
        text = f"{what} is {_kind(function)}{_place(function, what)}."
        raise Refused(f"{text} Write a plain function (def) that makes the object and calls it.")
    return definition(function, what)


def is_function(value: Any) -> bool:
    """Whether a value is a function, or made of functions: a partial, a method, what a decorator has wrapped."""
    kinds = (types.FunctionType, types.MethodType, types.BuiltinMethodType, types.MethodDescriptorType, partial)
    return isinstance(value, kinds) or len(layers(value)) > 1


def holds_functions(value: Any) -> bool:
    """Whether there are functions of the notebook in tuples, lists and dicts."""
    return any(is_function(leaf) and importable(leaf) is None for leaf in _leaves(value, 5))


def _leaves(value: Any, depth: int) -> list[Any]:
    if depth and type(value) in (tuple, list, dict):
        parts = value.values() if isinstance(value, dict) else value
        return [leaf for part in parts for leaf in _leaves(part, depth - 1)]
    return [value]


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
