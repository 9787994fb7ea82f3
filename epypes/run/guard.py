"""Values as functions and readers get them, and as runs store them, so that no function spoils another's input.

Arrays travel as read-only views (rule 7 of the design): writing in place raises at the line that did it. Lists, dicts
and other mutable containers travel as shallow copies. An iterator can be read only once, so it is refused.
Neither numpy nor pandas is imported here: their values can only turn up once another module has imported them.
"""

from __future__ import annotations

import copy
import functools
import re
import sys
import threading
import weakref
from array import array as number_array
from collections import deque
from collections.abc import Callable, Sequence
from sys import getrefcount
from types import BuiltinFunctionType, FunctionType
from typing import TYPE_CHECKING, Any, Final, TypeVar

from epypes.errors import InvalidType, IteratorRefused
from epypes.graph.identity import innermost
from epypes.graph.signature import documented_in_out
from epypes.nothing import Nothing, NothingGiven, NothingType

if TYPE_CHECKING:
    from epypes.run.program import Program

F = TypeVar("F", bound=Callable[..., Any])

_MARK = "__epypes_unguarded__"
# What a bundle's function has that reaches what can be changed: given its name in a graph, it makes the function
# that is called in its place. That one has the second.
WATCH: Final = "__epypes_watch__"
WRITTEN: Final = "__epypes_written__"
_WATCHED: Final = frozenset({FunctionType, functools.partial, functools._lru_cache_wrapper})
# What holds no array, known at a glance: most values of a graph are looked at several times per run.
ARRAYLESS: Final = frozenset({int, float, bool, str, bytes, complex, type(None)})
# What readers get as it is stored; functions never get Nothing.
READ_AS_STORED: Final = ARRAYLESS | {NothingType}
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
        raise InvalidType(f"{name!r} can't be marked. Write a function (def) that calls it, and mark that.") from error
    return function


def is_unguarded(function: object) -> bool:
    """Whether a function, or the function that it wraps, is marked as unguarded."""
    return bool(getattr(function, _MARK, False))


# By C function, the places that its docstring names: to ask for one of 3 kB takes longer than all else here.
_IN_OUT: Final[weakref.WeakKeyDictionary[Any, tuple[int, ...]]] = weakref.WeakKeyDictionary()


def in_out_places(function: Any, count: int) -> tuple[int, ...]:
    """Return at which of ``count`` inputs a function of OpenCV, as ``cv2.circle``, writes its results into them.

    That is read from the docstrings of C functions, which name such a parameter among the results too. A function in
    Python is the user's own, and writes into copies that it makes itself.
    """
    if type(function) is FunctionType:
        return ()
    given = 0
    if type(function) is not BuiltinFunctionType:
        function = innermost(function)
        while type(function) is functools.partial:
            function, given = function.func, given + len(function.args)
        if type(function) is not BuiltinFunctionType:
            return ()
    places = _IN_OUT.get(function)
    if places is None:
        places = _IN_OUT[function] = documented_in_out(function.__doc__ or "")
    return tuple([place - given for place in places if 0 <= place - given < count]) if places else ()


def called_for(name: str, function: Any) -> Any:
    """Return what is called for a function of a graph: in a loaded bundle, what watches over its calls."""
    make = getattr(function, WATCH, None) if type(function) in _WATCHED else None
    return function if make is None else make(name)


def as_written(function: Any) -> Any:
    """Return the function that a bundle's module defines, of one that watches over its calls."""
    return getattr(function, WRITTEN, function) if type(function) is FunctionType else function


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


# How to copy a value of a type that functions could change, by type; None if it is passed as it is. It holds each type
# that was seen, so that a common one is found at a glance; iterators are never in it.
COPIERS: Final[dict[type, Callable[[Any], Any] | None]] = {}
_MOST_TYPES: Final = 1_000
_MRO: Final = type.__dict__["__mro__"].__get__
_NAMES: Final = type.__dict__["__dict__"].__get__
_MUTABLE: Final = (list, dict, set, deque, bytearray, number_array)


def _learn(kind: type) -> Callable[[Any], Any] | None:
    """Return how values of a type are copied, and remember it; an iterator is passed as it is, where it may be."""
    if is_iterator(kind):
        return None
    pandas = sys.modules.get("pandas")
    frames = tuple(getattr(pandas, name, ()) for name in ("DataFrame", "Series"))
    copier: Callable[[Any], Any] | None = None
    if kind in (list, dict, set):
        copier = kind.copy  # twice as fast as copy.copy
    elif issubclass(kind, _MUTABLE):
        copier = _copy_of_container
    else:
        copier = _copy_of_frame if issubclass(kind, frames) else None
    if len(COPIERS) < _MOST_TYPES:
        COPIERS[kind] = copier
    return copier


def _copy_of_container(value: Any) -> Any:
    try:
        return copy.copy(value)
    except Exception:  # its own class refuses: it is passed as it is
        return value


def _copy_of_frame(frame: Any) -> Any:
    """Return a copy of a DataFrame or Series: of a pandas with copy-on-write, one that shares memory until a write."""
    pandas: Any = sys.modules["pandas"]
    is_lazy = not pandas.__version__.startswith(("0.", "1.", "2.")) or pandas.options.mode.copy_on_write is True
    return frame.copy(deep=not is_lazy)


def _own_copy(value: Any) -> Any:
    """Return a shallow copy of a mutable container; anything else as it is."""
    kind = type(value)
    copier = COPIERS[kind] if kind in COPIERS else _learn(kind)
    return value if copier is None else copier(value)


def is_iterator(kind: type) -> bool:
    """Whether values of a type are iterators: a generator, a zip, an open file."""
    # Past what a metaclass may answer instead.
    for base in _MRO(kind):
        names = _NAMES(base)
        if "__next__" in names:
            return names["__next__"] is not None
    return False


def require_reusable(value: Any, program: Program, slot: int) -> None:
    """Raise IteratorRefused if the value for a slot can be read only once, and the program guards its values."""
    kind = type(value)
    if not program.guard or kind in COPIERS:
        return
    if is_iterator(kind):
        token = program.tokens[slot]
        raise IteratorRefused(token, program.cg.digraph.producer.get(token), value)
    _learn(kind)


def own_view(value: Any) -> Any:
    """Return an array as a view for the reader alone, whose shape may be changed; anything else as it is."""
    if not is_array(value):
        return value
    return value.copy() if hasattr(value, "mask") else value.view()


def lend(value: Any) -> Any:
    """Return a value as a function gets it: arrays as read-only views of its own, containers as copies.

    The arrays in a tuple, named tuple, list, deque or dict count; what is deeper is shared. A masked array is copied,
    since its mask can be changed through any view.

    Raises
    ------
    NothingGiven
        The value is Nothing, which functions don't receive. Every guarded input of a value that is no number, text or
        array comes by here, so the usual ones are not asked.
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
    if value is Nothing:
        raise NothingGiven
    made = _own_copy(value)
    return _with_items(made, lend) if _holds_arrays(made) else made


def lend_to_reader(value: Any) -> Any:
    """Return a value as the user gets it: as ``lend`` does, and Nothing too."""
    return value if type(value) in READ_AS_STORED else lend(value)


def _locked(value: Any) -> Any:
    value.flags.writeable = False
    return value


def keep(value: Any, fresh_count: int, program: Program, slot: int, values: Sequence[Any]) -> Any:
    """Return what a function returned as it is stored: arrays locked, and copied where others could write to them.

    A function that goes on using the memory of its result would change a value that has been handed out. So an
    array to which others hold a reference is copied; a new one, the usual case, is locked as it is. The same
    goes for mutable containers, and for the arrays in them and in tuples.

    Parameters
    ----------
    value
        What was returned; or a hyperparameter's value.
    fresh_count
        The reference count, seen from here, of a value that nobody else knows.
    program, slot
        Where it is stored.
    values
        The values by slot, of which the function has read its inputs; empty for a hyperparameter.

    Raises
    ------
    IteratorRefused
        The value can be read only once.
    """
    kind = type(value)
    if kind in ARRAYLESS:
        return value
    is_known = getrefcount(value) > fresh_count
    if kind is (_ndarray or array_type()):
        value = _own(value, is_known, program, slot, values)
        value.setflags(False)
        return value
    if is_array(value):
        return _locked(value.copy() if hasattr(value, "mask") else _own(value, is_known, program, slot, values))
    if kind not in COPIERS:
        require_reusable(value, program, slot)
    copier = COPIERS[kind] if kind in COPIERS else _learn(kind)
    # A copy by pandas is made in any case: a new DataFrame may share its memory with others.
    made = value if copier is None or not (is_known or copier is _copy_of_frame) else copier(value)
    if not _holds_arrays(made):
        return made
    fresh_item = 0 if is_known else _FRESH_ITEM
    return _with_items(made, lambda item: keep(item, fresh_item, program, slot, values))


def _with_items(value: Any, change: Callable[[Any], Any], which: Callable[[Any], bool] = is_array) -> Any:
    """Return a tuple with its arrays changed; do that to a container in place, which is the caller's own."""
    if issubclass(type(value), tuple):
        return _make(type(value))(change(item) if which(item) else item for item in value)
    for key in list(value) if issubclass(type(value), dict) else range(len(value)):
        item = value[key]
        if which(item):
            value[key] = change(item)
    return value


def _own(array: Any, is_known: bool, program: Program, slot: int, values: Sequence[Any]) -> Any:
    """Return an array whose memory nobody else will write to, as far as can be seen."""
    owner = array.base
    if is_known and array.flags.writeable:
        return _copy(array)
    if owner is None:
        return array
    is_writable = array.flags.writeable
    while type(owner) is _ndarray or is_array(owner):
        if (is_writable or owner.flags.writeable) and getrefcount(owner) > FRESH_OWNER:
            return array if not is_writable and _is_input(owner, program, slot, values) else _copy(array)
        owner = owner.base
        if owner is None:
            return array
    # In memory of another library's object, it is unknown whether that is used again.
    return array if _is_constant(owner) else _copy(array)


def _copy(array: Any) -> Any:
    """Return a copy of an array; of one that was broadcast, what is repeated is copied once."""
    if 0 not in array.strides or not array.size:
        return array.copy(order="K")
    once = array[tuple(slice(None) if stride else slice(1) for stride in array.strides)].copy(order="K")
    return sys.modules["numpy"].broadcast_to(_locked(once), array.shape, subok=True)


def _is_input(owner: Any, program: Program, slot: int, values: Sequence[Any]) -> bool:
    """Whether memory is that of a value which the function of a slot has read: a payload's, which is not copied."""
    inputs = program.steps[program.makers[slot]].inputs if values else ()
    for read in inputs:
        value = values[read]
        if value is owner or (type(value) is _ndarray and value.base is owner):
            return True
    for read in inputs:
        value = values[read]
        items = (value,) if is_array(value) else _items(value) if _holds_arrays(value) else ()
        if any(is_array(item) and (item is owner or item.base is owner) for item in items):
            return True
    return False


def _is_constant(owner: Any) -> bool:
    """Whether the owner of memory lets nobody write to it: bytes, or a file mapped read-only."""
    try:
        with memoryview(owner) as view:
            return view.readonly
    except Exception:  # it is no buffer, or refuses to be looked at
        return False


def _items(value: Any) -> Any:
    return value.values() if issubclass(type(value), dict) else value


def _holds_arrays(value: Any) -> bool:
    """Whether a tuple, named tuple, list, deque or dict has an array among its items."""
    kind = type(value)
    if kind is not tuple and not issubclass(kind, (list, dict, deque)) and not _is_named_tuple(value):
        return False
    try:
        items = _items(value)
        head = next(iter(items), None)
        if len(value) < LONG or head is None:
            return any(map(is_array, items))
    except Exception:  # its own class refuses to be looked at
        return False
    first = type(head)
    if first not in HARMLESS and not is_array(head):
        HARMLESS.add(first)
    return first not in HARMLESS


def _make(kind: type) -> Any:
    return getattr(kind, "_make", kind)


def _is_named_tuple(value: Any) -> bool:
    return issubclass(type(value), tuple) and hasattr(type(value), "_make")


def writable(value: Any) -> Any:
    """Return a value as an unguarded function gets it: arrays as writable views, or copies of read-only memory."""
    if is_array(value):
        try:
            view = value.view()
            view.flags.writeable = True
        except ValueError:
            view = _view_of_locked(value)
        return view
    made = _own_copy(value)
    return _with_items(made, writable) if _holds_arrays(made) else made


def writable_copy(value: Any) -> Any:
    """Return a value as a function gets it that writes into it: a copy, with copies of the arrays in it."""
    if is_array(value):
        return value.copy()
    made = _own_copy(value)
    return _with_items(made, writable_copy) if _holds_arrays(made) else made


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
    if not re.search("read-?only", str(exception)):
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


def _measure_fresh() -> tuple[int, int, int, int]:
    """Return the reference counts of an object that only its finder knows.

    They are those seen by ``keep``, by its caller, of an array's owner, and by ``keep`` of an item of a new container.
    Measured, since interpreters differ in which references they count.
    """
    holder = _Holder(object())
    owner = holder.base
    result = object()
    (item,) = _with_items([object()], lambda item: _count(item, 0), lambda _: True)
    return _count(result, 0), getrefcount(result), getrefcount(owner), item


FRESH, FRESH_HERE, FRESH_OWNER, _FRESH_ITEM = _measure_fresh()
