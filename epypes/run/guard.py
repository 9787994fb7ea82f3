"""How is a function kept from spoiling another function's input?

Arrays travel as read-only views (rule 7 of the design). Writing in place raises at the line that did it.
numpy is never imported here: an array can only turn up once somebody else has imported it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_MARK = "__epypes_unguarded__"
# What holds no array, known at a glance: most values of a graph are looked at several times per run.
_ARRAYLESS = frozenset({int, float, bool, str, bytes, complex, type(None)})


def unguarded(function: F) -> F:
    """Mark a function that rejects read-only arrays: it gets them writable, and must not write.

    Examples
    --------
    >>> @unguarded
    ... def smooth(image):
    ...     return image
    """
    try:
        setattr(function, _MARK, True)
    except (AttributeError, TypeError) as error:
        name = getattr(function, "__name__", function)
        raise TypeError(f"{name!r} can't be marked. Write a function (def) that calls it, and mark that.") from error
    return function


def is_unguarded(function: object) -> bool:
    """Whether a function, or the function that it wraps, is marked as unguarded."""
    return bool(getattr(function, _MARK, False))


def is_array(value: Any) -> bool:
    """Whether a value is a NumPy array."""
    numpy = sys.modules.get("numpy")
    # By type: isinstance would ask the value itself for its class, which hostile objects answer as they like.
    return numpy is not None and issubclass(type(value), numpy.ndarray)


def is_plain_array(value: Any) -> bool:
    """Whether a value is a NumPy array, and not of a subclass."""
    numpy = sys.modules.get("numpy")
    return numpy is not None and type(value) is numpy.ndarray


def own_view(value: Any) -> Any:
    """Return an array as a view for the reader alone, whose shape may be changed; anything else as it is."""
    if not is_array(value):
        return value
    return value.copy() if hasattr(value, "mask") else value.view()


def read_only(value: Any) -> Any:
    """Return arrays, and arrays in a tuple, named tuple or list, as read-only views; anything else as it is.

    A masked array is copied, since its mask can be changed through any view.
    """
    if type(value) in _ARRAYLESS:
        return value
    if is_array(value):
        view = own_view(value)
        view.flags.writeable = False
        return view
    if (type(value) in (tuple, list) or _is_named_tuple(value)) and any(map(is_array, value)):
        make = getattr(type(value), "_make", type(value))
        return make(read_only(item) if is_array(item) else item for item in value)
    return value


def _is_named_tuple(value: Any) -> bool:
    return issubclass(type(value), tuple) and hasattr(type(value), "_make")


def writable(value: Any) -> Any:
    """Return a writable view of a guarded array, for an unguarded function; a copy where memory is read-only."""
    if is_array(value):
        view = value.view()
        try:
            view.flags.writeable = True
        except ValueError:
            return value.copy()
        return view
    if type(value) in (tuple, list) or _is_named_tuple(value):
        return getattr(type(value), "_make", type(value))(writable(item) for item in value)
    return value


def explain_write(function: str, tokens: Sequence[str], exception: BaseException) -> str | None:
    """Return a sentence on why writing in place failed, if that is what this exception is about."""
    text = str(exception).replace("-", "").replace(" ", "")
    if "readonly" not in text:
        return None
    which = ", ".join(map(repr, tokens))
    return (
        f"Inputs are read-only, so that {function!r} can't change {which} for other functions. "
        "Work on a copy, made with .copy(), or mark the function with @ep.unguarded if it only reads."
    )
