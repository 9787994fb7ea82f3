"""Can no value be of both of two types?

The answer is "surely not" or "it may be": what can't be judged may be.
"""

from __future__ import annotations

import numbers
import types
import typing
from abc import ABCMeta
from typing import Annotated, Any, Final, Literal, Union

# An alias may stand for itself by mistake.
_DEEPEST: Final = 100
_NONE: Final = type(None)
_PYTHON_NUMBERS: Final = frozenset({bool, int, float, complex})
# PEP 484 once let bytes stand for all three, and much code still does.
_BYTES: Final = frozenset({bytes, bytearray, memoryview})
# NumPy's scalar types that have no values of their own.
_ABSTRACT_SCALARS: Final = frozenset(
    {"generic", "number", "integer", "signedinteger", "unsignedinteger", "inexact", "floating", "complexfloating",
     "flexible", "character"}
)  # fmt: skip


def are_disjoint(left: Any, right: Any) -> bool:
    """Whether surely no value satisfies both type hints.

    Examples
    --------
    >>> are_disjoint(int, str), are_disjoint(int, float), are_disjoint(int | None, str | None)
    (True, False, False)
    """
    return all(_pair_is_disjoint(one, other) for one in alternatives(left) for other in alternatives(right))


def bare(hint: Any) -> Any:
    """Return a hint without its ``Annotated``, and what a ``type`` alias stands for."""
    for _ in range(_DEEPEST):
        origin = typing.get_origin(hint)
        if origin is Annotated:
            hint = typing.get_args(hint)[0]
        elif _is_alias(hint):
            hint = hint.__value__
        elif _is_alias(origin):  # NDArray[np.uint8], from Python 3.12 on
            hint = origin.__value__[typing.get_args(hint)]
        else:
            break
    return hint


def _is_alias(hint: Any) -> bool:
    return type(hint).__name__ == "TypeAliasType"


def alternatives(hint: Any) -> list[Any]:
    """Return the members of a union, those of unions in it included; any other hint alone, without ``Annotated``."""
    found, pending = [], [hint]
    while pending:
        plain = bare(pending.pop())
        if typing.get_origin(plain) in (Union, types.UnionType):
            pending.extend(typing.get_args(plain))
        else:
            found.append(_NONE if plain is None else plain)
    return found


def _pair_is_disjoint(left: Any, right: Any) -> bool:
    if typing.get_origin(left) is Literal:
        return all(_excludes(right, value) for value in typing.get_args(left))
    if typing.get_origin(right) is Literal:
        return _pair_is_disjoint(right, left)
    one, other = typing.get_origin(left) or left, typing.get_origin(right) or right
    if not isinstance(one, type) or not isinstance(other, type):
        return False  # a TypeVar, a NewType ...
    if one is other:
        return _dtypes_differ(left, right)
    return _classes_are_disjoint(one, other)


def _excludes(hint: Any, value: Any) -> bool:
    """Whether a hint surely does not allow a value of a Literal."""
    if typing.get_origin(hint) is Literal:
        return not any(type(value) is type(other) and value == other for other in typing.get_args(hint))
    return _pair_is_disjoint(type(value), hint)


def _classes_are_disjoint(left: type, right: type) -> bool:
    if _is_open(left) or _is_open(right):
        return False
    try:
        if issubclass(left, right) or issubclass(right, left):
            return False
        return not (_are_exchanged(left, right) or _have_a_common_subclass(left, right))
    except Exception:  # a TypedDict, or a metaclass that raises
        return False


def _is_open(kind: type) -> bool:
    """Whether classes may satisfy this one without saying so: abstract classes, protocols, Any and its subclasses."""
    return isinstance(kind, ABCMeta) or Any in kind.__mro__


def _are_exchanged(left: type, right: type) -> bool:
    """Whether values of one type are commonly given where the other is written, as an int for a float."""
    if {left, right} <= _BYTES:
        return True
    return _is_number(left) and _is_number(right)


def _is_number(kind: type) -> bool:
    # NumPy's bool is no numbers.Number, but stands for Python's.
    return kind in _PYTHON_NUMBERS or issubclass(kind, numbers.Number) or _is_numpy_scalar(kind)


def _is_numpy_scalar(kind: type) -> bool:
    return any(base.__module__ == "numpy" and base.__name__ == "generic" for base in kind.__mro__)


def _have_a_common_subclass(left: type, right: type) -> bool:
    """Whether there is a class that is both, as with a mix-in."""
    seen: set[type] = set()
    pending = [left]
    while pending:
        kinds: list[type] = type.__subclasses__(pending.pop())
        for kind in kinds:
            if issubclass(kind, right):
                return True
            if kind not in seen:
                seen.add(kind)
                pending.append(kind)
    return False


def _dtypes_differ(left: Any, right: Any) -> bool:
    """Whether both are ``NDArray`` of concrete dtypes that are not the same."""
    one, other = _dtype(left), _dtype(right)
    if one is None or other is None:
        return False
    return not (issubclass(one[1], other[1]) or issubclass(other[1], one[1]) or _is_equal_dtype(one, other))


def _is_equal_dtype(left: tuple[Any, type], right: tuple[Any, type]) -> bool:
    # np.longlong and np.int64 are two classes of one dtype.
    try:
        return bool(left[0](left[1]) == right[0](right[1]))
    except Exception:  # numpy's own: a scalar type of which it can't make a dtype
        return True


def _dtype(hint: Any) -> tuple[Any, type] | None:
    """Return the class ``np.dtype`` and the scalar type of an ``NDArray[scalar]``, None if it is not concrete."""
    arguments = typing.get_args(hint)
    origin = typing.get_origin(hint)
    if len(arguments) != 2 or getattr(origin, "__module__", "") != "numpy":
        return None
    scalars = typing.get_args(arguments[1])
    if len(scalars) != 1 or not isinstance(scalars[0], type) or scalars[0].__name__ in _ABSTRACT_SCALARS:
        return None
    return (typing.get_origin(arguments[1]), scalars[0]) if _is_numpy_scalar(scalars[0]) else None
