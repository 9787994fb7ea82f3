"""The call that makes a record again: a member of an enumeration, a dataclass's object, a named tuple.

A class may do more with its arguments than keep them. The comparison with the module's objects finds that out.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any


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
    if not all(is_given for _, is_given in records):
        return ""
    parts = [(name, expression_of(getattr(value, name))) for name in names]
    if not all(source for _, source in parts):
        return ""
    return f"{class_of(kind)}({', '.join(f'{name}={source}' for name, source in parts)})"


def _of_tuple(value: Any) -> list[tuple[str, bool]]:
    return [(name, True) for name in type(value)._fields]
