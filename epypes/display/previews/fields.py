"""Which named fields is a value written by?"""

from __future__ import annotations

import dataclasses
from types import FunctionType, SimpleNamespace
from typing import Any, Final

from epypes.display.previews.kinds import declared, items_in, stored

_ATTRIBUTES: Final[Any] = declared(SimpleNamespace, "__dict__")


def fields_of(value: Any) -> dict[str, Any] | None:
    """Return the fields of a named tuple, or of a dataclass that Python writes by its fields; None of any other.

    Fields that are not to be in the repr are left out, and those that a property computes.
    """
    kind = type(value)
    if issubclass(kind, tuple):
        names = declared(kind, "_fields")
        return dict(zip(names, items_in(value), strict=False)) if type(names) is tuple else None
    if declared(kind, "__repr__") is SimpleNamespace.__repr__:
        return dict(_ATTRIBUTES.__get__(value))
    if not _is_written_by_fields(kind):
        return None
    fields = ((field.name, stored(value, field.name)) for field in dataclasses.fields(kind) if field.repr)
    return {name: found[0] for name, found in fields if found}


def _is_written_by_fields(kind: type) -> bool:
    """Whether a class has the repr that ``dataclass`` makes: one of its author's own may be to hide something."""
    if type(declared(kind, "__dataclass_fields__")) is not dict:
        return False
    # The function that dataclass makes is told from others as pprint does.
    made = getattr(declared(kind, "__repr__"), "__wrapped__", None)
    return type(made) is FunctionType and "__create_fn__" in made.__qualname__
