"""How is a function kept from spoiling another function's input?

Arrays travel as read-only views (rule 7 of the design). Writing in place raises at the line that did it.
numpy is never imported here: an array can only turn up once somebody else has imported it.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from sys import getrefcount
from typing import Any, Final, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_MARK = "__epypes_unguarded__"
# What holds no array, known at a glance: most values of a graph are looked at several times per run.
ARRAYLESS: Final = frozenset({int, float, bool, str, bytes, complex, type(None)})
# Of a long tuple or list the first item tells whether it holds arrays: to look at each of 500 keypoints would take
# 10 us at every call, and much more when they are not in the caches.
LONG: Final = 33
# Types of first items that were found to be no arrays.
HARMLESS: Final[set[type]] = set()


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


# numpy's array type as soon as it has been seen: looking it up costs as much as a view.
_ndarray: Any = None


def array_type() -> Any:
    """Return numpy's array type, or None as long as nobody has imported numpy."""
    global _ndarray
    if _ndarray is None:
        _ndarray = getattr(sys.modules.get("numpy"), "ndarray", None)
    return _ndarray


def is_array(value: Any) -> bool:
    """Whether a value is a NumPy array."""
    kind = array_type()
    # By type: isinstance would ask the value itself for its class, which hostile objects answer as they like.
    return kind is not None and issubclass(type(value), kind)


def is_plain_array(value: Any) -> bool:
    """Whether a value is a NumPy array, and not of a subclass."""
    return type(value) is array_type()


def own_view(value: Any) -> Any:
    """Return an array as a view for the reader alone, whose shape may be changed; anything else as it is."""
    if not is_array(value):
        return value
    return value.copy() if hasattr(value, "mask") else value.view()


def lend(value: Any) -> Any:
    """Return a value as a function or a reader gets it: arrays as read-only views of its own, lists as copies.

    Of tuples, named tuples and lists, the arrays in them count. A masked array is copied, since its mask can be
    changed through any view.
    """
    kind = type(value)
    if kind in ARRAYLESS:
        return value
    if kind is (_ndarray or array_type()):
        view = value.view()
        view.setflags(False)
        return view
    if is_array(value):
        return _locked(own_view(value))
    if _holds_arrays(value):
        return _make(kind)(lend(item) if is_array(item) else item for item in value)
    return value.copy() if kind is list else value


def _locked(array: Any) -> Any:
    array.flags.writeable = False
    return array


def keep(value: Any, fresh_count: int) -> Any:
    """Return what a function returned as it is stored: arrays locked, and copied where others could write to them.

    A function that goes on using the memory of its result would change a value that has been handed out. So an
    array to which somebody else holds a reference is copied; a new one, the usual case, is locked as it is. The same
    goes for lists, and for the arrays in lists and tuples.

    Parameters
    ----------
    value
        What was returned.
    fresh_count
        The reference count, seen from here, of a value that nobody else knows.
    """
    kind = type(value)
    if kind in ARRAYLESS:
        return value
    is_known = getrefcount(value) > fresh_count
    if kind is (_ndarray or array_type()):
        value = _own(value, is_known)
        value.setflags(False)
        return value
    if is_array(value):
        return _locked(own_view(value))
    if _holds_arrays(value):
        fresh_item = 0 if is_known else fresh_count + 1
        return _make(kind)(keep(item, fresh_item) if is_array(item) else item for item in value)
    return value.copy() if kind is list and is_known else value


def _own(array: Any, is_known: bool) -> Any:
    """Return an array whose memory nobody else will write to, as far as can be seen."""
    owner = array.base
    if not array.flags.writeable:
        return array
    if is_known or (type(owner) is type(array) and getrefcount(owner) > _FRESH_OWNER):
        return array.copy(order="K")
    # In memory of another library's object, it is unknown whether that is used again; the object itself stays as it is.
    return array if owner is None or type(owner) is type(array) else array.view()


def _holds_arrays(value: Any) -> bool:
    """Whether a tuple, named tuple or list has an array among its items."""
    if type(value) is not tuple and type(value) is not list and not _is_named_tuple(value):
        return False
    if len(value) < LONG or value[0] is None:
        return any(map(is_array, value))
    first = type(value[0])
    if first not in HARMLESS and not is_array(value[0]):
        HARMLESS.add(first)
    return first not in HARMLESS


def _make(kind: type) -> Any:
    return getattr(kind, "_make", kind)


def _is_named_tuple(value: Any) -> bool:
    return issubclass(type(value), tuple) and hasattr(type(value), "_make")


def writable(value: Any) -> Any:
    """Return a writable view of a guarded array, for an unguarded function; a copy where memory is read-only."""
    if is_array(value):
        try:
            view = value.view()
            view.flags.writeable = True
        except ValueError:
            view = _view_of_locked(value)
        return view
    if _holds_arrays(value):
        return _make(type(value))(writable(item) for item in value)
    return value


_unlocking = threading.Lock()


def _view_of_locked(array: Any) -> Any:
    """Return a writable view of an array that ``keep`` has locked; a copy of one whose memory is read-only for good."""
    if array.base is not None or not array.flags.owndata:
        return array.copy()
    with _unlocking:
        array.setflags(write=True)
        try:
            return array.view()
        finally:
            array.setflags(write=False)


def is_same_guarded_array(old: Any, new: Any, given: Sequence[Any]) -> bool:
    """Whether a function returned the very memory that it returned before, and that nobody has written to.

    Parameters
    ----------
    old, new
        What it returned before and now, both as ``keep`` gave them.
    given
        The values that the function read, as they are stored, but for those that are new.
    """
    if old is new and new.base is None:
        return True
    owner = new.base
    if owner is None or owner is not old.base or new.flags.writeable:
        return False
    if new.shape != old.shape or new.strides != old.strides or new.dtype != old.dtype:
        return False
    if new.__array_interface__["data"] != old.__array_interface__["data"]:
        return False
    # Memory that can be written to has kept its content only if it is an input's, which counts as unchanged.
    # Of another library's object that is not known; bytes never change.
    can_change = type(owner) is not bytes and getattr(getattr(owner, "flags", None), "writeable", True)
    return not can_change or any(owner is value or owner is getattr(value, "base", None) for value in given)


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


class _Holder:
    def __init__(self, base: object) -> None:
        self.base = base


def _count(value: Any, unused: int) -> int:
    return getrefcount(value)


def _measure_fresh() -> tuple[int, int, int]:
    """Return the reference counts of an object that only its finder knows: seen by ``keep``, by its caller, as owner.

    Measured, since interpreters differ in which references they count.
    """
    holder = _Holder(object())
    owner = holder.base
    result = object()
    return _count(result, 0), getrefcount(result), getrefcount(owner)


FRESH, FRESH_HERE, _FRESH_OWNER = _measure_fresh()
