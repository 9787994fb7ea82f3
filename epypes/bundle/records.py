"""Which call makes a record again: a member of an enumeration, a dataclass's object, a named tuple?

A class may do more with its arguments than keep them. So the call is tried at promotion, and what it makes is compared.
"""

from __future__ import annotations

import copy
import enum
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

from epypes.bundle.classvalues import is_same_value


def made_again(value: Any, expression_of: Callable[[Any], str], class_of: Callable[[type], str]) -> str:
    """Return the expression of a member of an enumeration, or of a record of values; "" for any other.

    Parameters
    ----------
    value
        Anything.
    expression_of
        Returns the expression of a value in it; "" if there is none.
    class_of
        Returns the expression of a class, which is added to the module.
    """
    kind = type(value)
    if isinstance(value, enum.Enum):
        return f"{class_of(kind)}.{value.name}" if value.name in kind.__members__ else ""
    if not hasattr(kind, "__dataclass_fields__") and not (isinstance(value, tuple) and hasattr(kind, "_fields")):
        return ""
    records = [(field.name, field.init) for field in fields(value)] if is_dataclass(value) else _of_tuple(value)
    names = [name for name, _ in records]
    if not all(is_given for _, is_given in records) or not _is_made_alike(value, names):
        return ""
    parts = [(name, expression_of(getattr(value, name))) for name in names]
    if not all(source for _, source in parts):
        return ""
    return f"{class_of(kind)}({', '.join(f'{name}={source}' for name, source in parts)})"


def _of_tuple(value: Any) -> list[tuple[str, bool]]:
    return [(name, True) for name in type(value)._fields]


def _is_made_alike(value: Any, names: list[str]) -> bool:
    """Whether an object that is made with the values of the fields of another is like it."""
    try:
        # A class may change what it is given.
        again = type(value)(**{name: copy.deepcopy(getattr(value, name)) for name in names})
        return _is_alike(again, value)
    except Exception:  # whatever a user's class raises
        return False


def _is_alike(one: Any, other: Any) -> bool:
    if type(one) is not type(other) or _attributes(one).keys() != _attributes(other).keys():
        return False
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(_is_alike, one, other))
    if isinstance(one, dict):
        return _is_alike([*one.items()], [*other.items()])
    if not is_dataclass(one):
        return is_same_value(one, other)
    names = dict.fromkeys([*(field.name for field in fields(one)), *_attributes(one)])
    return all(_is_alike(getattr(one, name), getattr(other, name)) for name in names)


def _attributes(value: Any) -> dict[str, Any]:
    """Return the attributes that an object of a class without slots has of its own."""
    found = getattr(value, "__dict__", {})
    return found if isinstance(found, dict) else {}
