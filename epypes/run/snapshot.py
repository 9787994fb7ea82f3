"""Snapshots of mutable objects: the contents of everything that some values reach, to compare later and to put back.

The objects are walked once, when the snapshot is taken. A comparison then goes through a flat list of records, each of
which reads the contents of one object as a tuple and compares them with the saved ones by identity, and only where
they differ by value. numpy and pandas are never imported here.

What can't be seen into is left out: objects of C extensions that the garbage collector knows nothing about
(``cv2.ORB``), open files, locks and the modules of installed packages.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import gc
import itertools
import operator
import random
import sys
import types
import warnings
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import date, time, timedelta, tzinfo
from decimal import Decimal
from enum import Enum
from logging import Logger
from pathlib import PurePath
from typing import Any, Final

from epypes.run.guard import is_array

Contents = tuple[Any, ...]
Found = Iterator[tuple[str, Any]]
# How the contents of an object are read and written.
_Way = tuple[Callable[[Any], Contents], Callable[[Any, Contents], object]]
_Kind = tuple[type, Callable[[Any], Contents], Callable[[Any, Contents], object]]

ATOMS: Final = frozenset(
    {int, float, complex, bool, str, bytes, type(None), type(...), type(NotImplemented), range, Decimal}
)
# Values of these kinds never change, although some of them fill caches of their own.
_CONSTANT: Final = (Enum, PurePath, Logger, date, time, timedelta, tzinfo, types.CodeType, types.ModuleType)
_CODE: Final = (type, types.FunctionType)
# Of objects of OpenCV, which the garbage collector knows nothing about.
_ATTRIBUTES_OF_CV2: Final = {
    "KeyPoint": ("angle", "class_id", "octave", "pt", "response", "size"),
    "DMatch": ("distance", "imgIdx", "queryIdx", "trainIdx"),
}
_ATOMIC_ITERATORS: Final = (itertools.count, itertools.repeat)


class Record:
    """One mutable object: how its contents are read and written, and what they were."""

    __slots__ = ("name", "read", "saved", "value", "write")

    def __init__(
        self, name: str, value: Any, read: Callable[[Any], Contents], write: Callable[[Any, Contents], object]
    ) -> None:
        self.name, self.value, self.read, self.write = name, value, read, write
        self.saved = read(value)

    def differs(self) -> bool:
        """Whether the contents are others than they were."""
        try:
            now = self.read(self.value)
        except Exception:  # another thread changes it at this moment, or it was closed
            return True
        saved = self.saved
        if len(now) == len(saved) and all(map(operator.is_, now, saved)):
            return False
        return not self.accepts(now)

    def accepts(self, now: Contents) -> bool:
        """Whether contents that are not identical to the saved ones are equal to them."""
        return is_same(now, self.saved)

    def restore(self) -> None:
        """Put the saved contents back."""
        self.write(self.value, self.saved)


class _Table(Record):
    """A pandas object, compared by its own method."""

    __slots__ = ()

    def accepts(self, now: Contents) -> bool:
        saved, after = self.saved[0], now[0]
        axes = [axis for axis in ("index", "columns") if hasattr(saved, axis)]
        same_axes = all(getattr(after, axis).identical(getattr(saved, axis)) for axis in axes)
        return same_axes and bool(after.equals(saved))


class Snapshot:
    """The contents of all mutable objects that some values reach.

    Parameters
    ----------
    roots
        The values, by the names that :meth:`changed` reports.

    Notes
    -----
    Lists, dicts with their order, sets, deques, bytearrays, arrays, the attributes and slots of objects, random
    generators, iterators, pandas objects, key points and matches of OpenCV are compared; tuples, partials, bound
    methods and C containers are looked through. Functions, classes and modules count as constants, and so do the
    private attributes of a library's objects.

    It holds references to all that it compares, and a copy of every array that can be written to.

    Examples
    --------
    >>> seen = {"a": [1, 2]}
    >>> snapshot = Snapshot({"seen": seen})
    >>> seen["a"].append(3)
    >>> snapshot.changed()
    'seen'
    >>> snapshot.restore()
    >>> seen, snapshot.changed()
    ({'a': [1, 2]}, None)
    """

    def __init__(self, roots: Mapping[str, object]) -> None:
        self.records: list[Record] = []
        # Held, so that no id is used again while the walk goes on.
        self._seen: dict[int, object] = {}
        waiting = [*roots.items()][::-1]
        while waiting:
            name, value = waiting.pop()
            if type(value) in ATOMS or id(value) in self._seen:
                continue
            self._seen[id(value)] = value
            waiting.extend([*self.look_at(name, value)][::-1])
        self._seen.clear()

    def __bool__(self) -> bool:
        """Whether there is anything that could change."""
        return bool(self.records)

    def changed(self) -> str | None:
        """Return the first root that reaches an object whose contents have changed; None if there is none."""
        for record in self.records:
            if record.differs():
                return record.name
        return None

    def restore(self) -> None:
        """Put the contents of every object that has changed back.

        What can't be put back, as an iterator or a buffer that was closed, goes on counting as changed.
        """
        for record in self.records:
            if record.differs():
                with contextlib.suppress(Exception):
                    record.restore()

    def look_at(self, name: str, value: Any) -> Found:
        """Record one object as far as it can change, and give what it refers to; the hook for subclasses."""
        kind = type(value)
        if issubclass(kind, _CONSTANT) or issubclass(kind, _CODE) or is_global_generator(value):
            return
        if is_array(value):
            yield from self.look_at_array(name, value)
            yield from self._attributes(name, value)
            return
        if _is_pandas(kind):
            self.records.append(_Table(name, value, _read_table, _write_table))
            return
        for base, read, write in _KINDS:
            if issubclass(kind, base):
                self.records.append(Record(name, value, read, write))
                break
        state = _state_of(value)
        if state is not None:
            self.records.append(Record(name, value, *state))
            if state[1] is not _leave:
                return
        yield from ((name, part) for part in _parts(value))
        yield from self._attributes(name, value)

    def look_at_array(self, name: str, value: Any) -> Found:
        """Record an array that can be written to."""
        if value.flags.writeable:
            self.records.append(array_record(name, value))
        yield from ((name, part) for part in (value.base, vars(value).get("_mask") if hasattr(value, "mask") else None))
        if value.dtype.hasobject:
            yield from ((name, part) for part in _items_of(value))

    def _attributes(self, name: str, value: Any) -> Found:
        for read, write in _ways_to_attributes(value):
            record = Record(name, value, read, write)
            self.records.append(record)
            yield from ((name, part) for part in record.saved[len(record.saved) // 2 :])


# -- what is equal ------------------------------------------------------------------------------------------------


def is_same(now: Any, saved: Any) -> bool:
    """Whether two values are one, or equal constants of one type, to the last bit."""
    kind = type(now)
    if now is saved or kind is not type(saved):
        return now is saved
    if kind in (float, complex):
        return repr(now) == repr(saved)
    if kind is tuple:
        return len(now) == len(saved) and all(map(is_same, now, saved))
    if kind is frozenset:
        return now == saved and sorted(map(_order, now)) == sorted(map(_order, saved))
    if kind is types.MethodType:
        return now.__self__ is saved.__self__ and now.__func__ is saved.__func__
    if kind in ATOMS:
        return bool(now == saved)
    return is_numpy_scalar(kind) and bool(now.dtype == saved.dtype and now.tobytes() == saved.tobytes())


def _order(value: Any) -> tuple[str, int]:
    """Tell 1 from True, and two objects from each other, whatever their own methods say."""
    return type(value).__name__, 0 if type(value) in ATOMS else id(value)


def is_numpy_scalar(kind: type) -> bool:
    """Whether values of a type are NumPy's numbers or texts, which never change."""
    numpy = sys.modules.get("numpy")
    return numpy is not None and issubclass(kind, numpy.generic) and not issubclass(kind, numpy.object_ | numpy.void)


def as_dict(contents: Contents) -> dict[Any, Any]:
    """Return names followed by values as a dict."""
    half = len(contents) // 2
    return dict(zip(contents[:half], contents[half:], strict=True))


@functools.cache
def is_own(module: str) -> bool:
    """Whether a module's code is the user's: of no installed package, not of Python's library nor of EPypes."""
    if module.partition(".")[0] in {*sys.stdlib_module_names, *sys.builtin_module_names, "epypes", "epypes_widgets"}:
        return module == "__main__"
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    return not {"site-packages", "dist-packages"} & {*file.replace("\\", "/").split("/")}


# -- how contents are read and written -----------------------------------------------------------------------------


def _mapping(kind: Any) -> _Kind:
    """Return how a dict is read and written, by the methods of its kind: those of dict don't see move_to_end."""

    def write(value: Any, saved: Contents) -> None:
        kind.clear(value)
        kind.update(value, as_dict(saved))

    return kind, lambda value: (*kind.keys(value), *kind.values(value)), write


def _write_set(value: set[Any], saved: Contents) -> None:
    set.clear(value)
    set.update(value, saved[0])


def _write_deque(value: collections.deque[Any], saved: Contents) -> None:
    collections.deque.clear(value)
    collections.deque.extend(value, saved)


_KINDS: Final[tuple[_Kind, ...]] = (
    (list, lambda value: tuple(list.__iter__(value)), lambda value, saved: list.__setitem__(value, slice(None), saved)),
    _mapping(collections.OrderedDict),
    _mapping(dict),
    (set, lambda value: (frozenset(set.__iter__(value)),), _write_set),
    (collections.deque, lambda value: tuple(collections.deque.__iter__(value)), _write_deque),
    (
        bytearray,
        lambda value: (bytes(value),),
        lambda value, saved: bytearray.__setitem__(value, slice(None), saved[0]),
    ),
    (
        array,
        lambda value: (value.tobytes(),),
        lambda value, saved: array.__setitem__(value, slice(None), array(value.typecode, saved[0])),
    ),
)


def _items_of(value: Any) -> list[Any]:
    """Return the objects in an array of objects, or the tuples of one whose fields are some."""
    return list(value.ravel().tolist())


def _read_array(value: Any) -> Contents:
    data = tuple(_items_of(value)) if value.dtype.hasobject else value.tobytes()
    return value.shape, value.dtype, value.flags.writeable, data


def array_record(name: str, value: Any) -> Record:
    """Return the record of an array: its bytes, its shape and whether it can be written to."""
    return Record(name, value, _read_array, _write_array)


def _write_array(value: Any, saved: Contents) -> None:
    shape, dtype, writeable, data = saved
    if not value.flags.writeable:
        value.setflags(write=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of NumPy 2.5; it was set by others first
        if value.dtype != dtype:
            value.dtype = dtype
        if value.shape != shape:
            value.shape = shape
    if dtype.hasobject:
        value.reshape(-1)[:] = data if dtype.names else [*data]
    else:
        value[...] = sys.modules["numpy"].frombuffer(data, dtype).reshape(shape)
    if not writeable:
        value.setflags(write=False)


def cached_properties(kind: type) -> frozenset[str]:
    """Return the attributes of a class that are computed when they are first read."""
    found = {
        name for base in kind.__mro__ for name in vars(base) if type(vars(base)[name]) is functools.cached_property
    }
    return frozenset(found)


def _slots(kind: type) -> dict[str, types.MemberDescriptorType]:
    """Return the slots of a class that Python code has made."""
    bases = [vars(base) for base in kind.__mro__ if "__slots__" in vars(base)]
    slots = (slot for base in bases for slot in base.values() if type(slot) is types.MemberDescriptorType)
    return {slot.__name__: slot for slot in slots}


def _ways_to_attributes(value: Any) -> Iterator[_Way]:
    """Give how the attributes and the slots of an object are read and written, as names followed by values.

    Left out are cached properties, and the private attributes of objects of libraries, which are mostly caches.
    """
    kind = type(value)
    own, lazy = is_own(str(kind.__module__)) or kind is types.SimpleNamespace, cached_properties(kind)

    def counts(name: object) -> bool:
        return name not in lazy and (own or not str(name).startswith("_"))

    def read_attributes(value: Any) -> Contents:
        found = vars(value) if own and not lazy else {name: part for name, part in vars(value).items() if counts(name)}
        return *found, *found.values()

    def write_attributes(value: Any, saved: Contents) -> None:
        found, before = vars(value), as_dict(saved)
        for name in [name for name in found if counts(name) and name not in before]:
            del found[name]
        found.update(before)

    # The functions of C libraries have attributes that are all private.
    if type(getattr(value, "__dict__", None)) is dict and (own or not callable(value) or read_attributes(value)):
        yield read_attributes, write_attributes
    slots = {name: slot for name, slot in _slots(kind).items() if counts(name)}

    def read_slots(value: Any) -> Contents:
        found = {}
        for name, slot in slots.items():
            with contextlib.suppress(AttributeError):
                found[name] = slot.__get__(value)
        return *found, *found.values()

    def write_slots(value: Any, saved: Contents) -> None:
        before = as_dict(saved)
        for name, slot in slots.items():
            if name in before:
                slot.__set__(value, before[name])
            else:
                with contextlib.suppress(AttributeError):
                    slot.__delete__(value)

    if slots:
        yield read_slots, write_slots


def _is_pandas(kind: type) -> bool:
    pandas = sys.modules.get("pandas")
    known = (getattr(pandas, name, None) for name in ("DataFrame", "Series", "Index"))
    return any(isinstance(base, type) and issubclass(kind, base) for base in known)


def _read_table(value: Any) -> Contents:
    return (value.copy(deep=True),)


def _write_table(value: Any, saved: Contents) -> None:
    vars(value).clear()
    vars(value).update(vars(saved[0].copy(deep=True)))


# -- objects with a state of their own -----------------------------------------------------------------------------


def _state_of(value: Any) -> _Way | None:
    """Return how the state of a random generator, a buffer, an iterator or an object of OpenCV is read and written."""
    kind, numbers = type(value), sys.modules.get("numpy.random")
    if kind.__module__ == "cv2" and kind.__name__ in _ATTRIBUTES_OF_CV2:
        return _ways_to(_ATTRIBUTES_OF_CV2[kind.__name__])
    if issubclass(kind, random.Random):
        return lambda value: (value.getstate(),), lambda value, saved: value.setstate(saved[0])
    if numbers is not None and issubclass(kind, numbers.RandomState):
        drawn = value.get_state(legacy=False)
        return lambda value: (_flat(value.get_state(legacy=False)),), lambda value, saved: value.set_state(drawn)
    if numbers is not None and issubclass(kind, numbers.BitGenerator):
        state = value.state
        return lambda value: (_flat(value.state),), lambda value, saved: setattr(value, "state", state)
    if hasattr(kind, "getvalue") and hasattr(kind, "__setstate__") and kind.__module__ == "_io":
        return lambda value: value.__getstate__()[:-1], lambda value, saved: value.__setstate__((*saved, None))
    if issubclass(kind, types.GeneratorType | types.CoroutineType | types.AsyncGeneratorType):
        return None if _frame(value) is None else (_read_generator, _leave)
    if callable(getattr(kind, "__next__", None)) and kind.__module__ in ("builtins", "itertools", "collections"):
        return _read_iterator, _leave
    return None


def _ways_to(names: Sequence[str]) -> _Way:
    """Return how attributes are read and written."""

    def write(value: Any, saved: Contents) -> None:
        for name, part in zip(names, saved, strict=True):
            setattr(value, name, part)

    return operator.attrgetter(*names), write


def is_global_generator(value: Any) -> bool:
    """Whether this is the generator behind the functions of ``random`` or ``numpy.random``."""
    numbers = sys.modules.get("numpy.random")
    return value is random._inst or (numbers is not None and value is numbers.mtrand._rand)


def _flat(state: Any) -> Any:
    if isinstance(state, dict):
        return tuple((name, _flat(part)) for name, part in state.items())
    return state.tobytes() if is_array(state) else state


def _leave(value: Any, saved: Contents) -> None:
    """Leave an iterator as it is: none can be set back."""


def _frame(value: Any) -> types.FrameType | None:
    found = (getattr(value, name, None) for name in ("gi_frame", "cr_frame", "ag_frame"))
    return next((frame for frame in found if frame is not None), None)


def _read_generator(value: Any) -> Contents:
    frame = _frame(value)
    return () if frame is None else (frame.f_lasti, *_locals(value), *_locals(value).values())


def _read_iterator(value: Any) -> Contents:
    """Return how far an iterator has come, as far as it can be seen; nothing is taken from it."""
    if type(value) in _ATOMIC_ITERATORS:
        return (repr(value),) if type(value) is itertools.count else (operator.length_hint(value, -1),)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made, *parts = value.__reduce__()
    except TypeError:
        return (operator.length_hint(value, -1),)
    return made, *(_positions(part) for part in parts)


def _positions(part: Any) -> Any:
    """Return what of an iterator's ``__reduce__`` can be compared: its numbers, and the iterators in it."""
    if type(part) is tuple:
        return tuple(map(_positions, part))
    if type(part) in ATOMS:
        return part
    return len(part) if type(part) is list else type(part)


# -- what an object refers to --------------------------------------------------------------------------------------


def _parts(value: Any) -> Iterable[Any]:
    """Return the objects that one refers to; its attributes are not among them."""
    kind = type(value)
    if issubclass(kind, dict):
        return (*dict.keys(value), *dict.values(value))
    if issubclass(kind, list | tuple | set | frozenset | collections.deque):
        return [part for part in value if type(part) not in ATOMS]
    if kind is types.MappingProxyType:
        return [*value.values()]
    if kind is functools._lru_cache_wrapper:
        return cached_values(value)
    if kind is memoryview:
        return (value.obj,)
    if is_array(value):
        return ()
    # Of partials, bound methods, cells, iterators and the like the garbage collector knows what they hold. It names the
    # attributes and slots too, or the dict in which they are.
    own = getattr(value, "__dict__", None)
    known = {id(kind), id(own), *map(id, own.values() if type(own) is dict else ())}
    for slot in _slots(kind).values():
        with contextlib.suppress(AttributeError):
            known.add(id(slot.__get__(value)))
    held = [part for part in gc.get_referents(value) if id(part) not in known and type(part) is not types.FrameType]
    return [*held, *_locals(value).values()]


def cached_values(cached: Any) -> list[Any]:
    """Return what the cache of ``functools.lru_cache`` holds, its keys among it where it is bounded."""
    own = vars(cached)
    found: list[Any] = []
    for part in gc.get_referents(cached):
        if type(part) is dict and part is not own:
            found += part.values()
        elif part is not own:
            found.append(part)
    return found


def _locals(value: Any) -> Mapping[str, Any]:
    frame = _frame(value)
    return {} if frame is None else frame.f_locals
