"""Records: what an object holds, as a copy to compare with and to put back.

An object of a library is compared by its attributes, also private ones: what it computes when it is first asked is put
back without a failure. One that keeps its content in C is compared by what pickle writes of it, one of OpenCV by what
its getters return. What none of these can read, such as a background model or a hash, counts as changed whatever the
call does, so that promotion refuses what refers to it. What a pipeline of the user's own class has in its attributes is
not looked at.
"""

from __future__ import annotations

import functools
import pickle
import types
from collections.abc import Collection
from contextlib import suppress
from logging import Logger
from typing import Any, Final

from epypes.bundle.source.objects import is_unset
from epypes.pipeline import Node
from epypes.run.guard import is_array
from epypes.run.snapshot import (
    Record,
    as_dict,
    cached_properties,
    is_own,
    is_same,
)

# How a class of a library says what pickle writes of its objects.
_PICKLING: Final = ("__getstate__", "__reduce__", "__reduce_ex__")
# Python makes these itself when they are first asked for; an Enum adds combinations of its members then.
OF_PYTHON: Final = frozenset(
    {"__builtins__", "__warningregistry__", "__dict__", "__weakref__", "__doc__", "__abstractmethods__", "_abc_impl"}
    | {"__annotations__", "__annotations_cache__", "__annotate__", "__annotate_func__", "__static_attributes__"}
    | {"_value2member_map_", "__slotnames__"}
)
_OF_A_NODE: Final = frozenset({*vars(Node("", len)), "compute"})
# How a logger logs changes no value, and depends on other loggers.
_OF_A_LOGGER: Final = frozenset(vars(Logger("")))  # noqa: LOG001 - one that nobody uses
# Py_TPFLAGS_HEAPTYPE: a class with this flag is no static one of C, which takes no attributes.
_MADE_BY_PYTHON: Final = 1 << 9
_PARTS_OF_A_FUNCTION: Final = ("__defaults__", "__kwdefaults__", "__code__")


class Content(Record):
    """The content of an object as a copy, which can't be put back."""

    __slots__ = ()


def leave(value: Any, saved: object) -> None:
    """Leave an object as it is: what it holds can't be set."""


def always_another(value: Any) -> tuple[object, ...]:
    """Return contents that differ from those of any other call."""
    return (object(),)


def has_pickling(kind: type) -> bool:
    """Whether a class says itself what pickle writes of its objects."""
    return any(getattr(kind, name, None) is not getattr(object, name, None) for name in _PICKLING)


def pickled(value: Any) -> tuple[bytes, ...]:
    """Return what pickle writes of an object; nothing if it can't."""
    try:
        return (pickle.dumps(value, pickle.HIGHEST_PROTOCOL),)
    except Exception:  # whatever an object raises that can't be pickled
        return ()


@functools.cache
def _getters(kind: Any) -> list[str]:
    """Return the methods and attributes of a class of OpenCV that may say what its objects hold."""
    slots = (name for name in dir(kind) if isinstance(getattr(kind, name), types.GetSetDescriptorType))
    return [*(name for name in dir(kind) if name.startswith(("get", "is")) or name == "empty"), *slots]


def unreadable_setters(kind: Any) -> frozenset[str]:
    """Return the methods of a class of OpenCV that set what no getter returns."""
    known = {name.removeprefix("get").lower() for name in _getters(kind)}
    return frozenset(name for name in dir(kind) if name.startswith("set") and name[3:].lower() not in known)


def read_getters(value: Any) -> tuple[Any, ...]:
    """Return what the getters of an object of OpenCV return."""
    kind: Any = type(value)
    found: list[Any] = []
    for name in _getters(kind):
        with suppress(Exception):  # what takes arguments, or is not there yet
            part = getattr(value, name)
            found.append((name, _plain(part() if callable(part) else part)))
    return tuple(found)


def _plain(value: Any) -> Any:
    """Return what a getter has returned as values that can be compared."""
    if is_array(value):
        return value.shape, value.tobytes()
    if isinstance(value, tuple | list):
        return tuple(map(_plain, value))
    return read_getters(value) if type(value).__module__[:3] == "cv2" else value


# -- names and attributes ------------------------------------------------------------------------------------------


class Bindings(Record):
    """The names of a module, or the attributes of a class, a function or a node, as names followed by values.

    ``name`` is what stands before them in a report. Modules that are imported only when they are needed are no change.
    """

    __slots__ = ()

    def __init__(self, name: str, value: Any) -> None:
        super().__init__(name, value, _read_bindings, _write_bindings)

    def accepts(self, now: tuple[Any, ...]) -> bool:
        """Whether nothing has another value."""
        return not self._others(now)

    def changed_name(self) -> str:
        """Return what has another value."""
        return f"{self.name}{self._others(self.read(self.value))[0]}"

    def _others(self, now: tuple[Any, ...]) -> list[str]:
        before, after = as_dict(self.saved), as_dict(now)
        return [
            name
            for name in [*after, *(before.keys() - after.keys())]
            if name not in OF_PYTHON
            and not is_same(after.get(name, self), before.get(name, self))
            and not (isinstance(after.get(name), types.ModuleType) and before.get(name) is None)
        ]


class HiddenAttributes(Bindings):
    """The private attributes of a library's object.

    What begins as None or False, or is not there, the library computes when it is first asked, unless the user's code
    sets it: that is put back without a failure.
    """

    __slots__ = ("words",)

    def __init__(self, name: str, value: Any, words: Collection[str]) -> None:
        self.words = words
        Record.__init__(self, name, value, _read_private, _write_private)

    def changed_name(self) -> str:
        """Return what has another value, "" if the library has computed all of it."""
        before = as_dict(self.saved)
        loud = (
            name
            for name in self._others(self.read(self.value))
            if not is_unset(before.get(name)) or f"STORE_ATTR {name}" in self.words
        )
        return next((f"{self.name}{name}" for name in loud), "")


def _read_private(value: Any) -> tuple[Any, ...]:
    lazy = cached_properties(type(value))
    found = {name: part for name, part in vars(value).items() if name[:1] == "_" and name not in lazy}
    return *found, *found.values()


def _write_private(value: Any, saved: tuple[Any, ...]) -> None:
    before = as_dict(saved)
    for name in as_dict(_read_private(value)).keys() - before.keys():
        del vars(value)[name]
    vars(value).update(before)


class LibraryBindings(Bindings):
    """The names of a library's module, or the attributes of its class or function: all, or those with some names.

    What a library adds itself, such as a part that is loaded when it is first asked for, is no change.
    """

    __slots__ = ("names",)

    def __init__(self, name: str, value: Any, names: frozenset[str] | None) -> None:
        self.names = names
        Record.__init__(self, name, value, self._read, self._write)

    def _read(self, value: Any) -> tuple[Any, ...]:
        found = bound(value) if self.names is None else _some_bound(value, self.names)
        return *found, *found.values()

    def _others(self, now: tuple[Any, ...]) -> list[str]:
        before, after = as_dict(self.saved), as_dict(now)
        return [name for name in super()._others(now) if name in before or not _is_of_library(after[name])]

    def _write(self, value: Any, saved: tuple[Any, ...]) -> None:
        before, now = as_dict(saved), as_dict(self._read(value))
        for name in self._others((*now, *now.values())):
            if name in before:
                setattr(value, name, before[name])
            else:
                delattr(value, name)


def can_be_patched(owner: Any, names: frozenset[str] | None) -> bool:
    """Whether attributes with some names, all without, can be set of a library's module, class or function."""
    if isinstance(owner, type):
        return bool(owner.__flags__ & _MADE_BY_PYTHON)
    return names is None or isinstance(owner, types.ModuleType) or not names.isdisjoint(_PARTS_OF_A_FUNCTION)


def _is_of_library(value: Any) -> bool:
    """Whether a value is a module, class or function that is not the user's."""
    is_code = isinstance(value, types.ModuleType | types.FunctionType | types.BuiltinFunctionType | type)
    return is_code and not is_own(str(getattr(value, "__module__", None) or getattr(value, "__name__", "")))


def _some_bound(value: Any, names: frozenset[str]) -> dict[str, Any]:
    known, parts = vars(value), names.intersection(_PARTS_OF_A_FUNCTION) if type(value) is types.FunctionType else ()
    return {name: known[name] for name in names & known.keys()} | {name: getattr(value, name) for name in parts}


def bound(value: Any) -> dict[str, Any]:
    """Return the names of a module, or the attributes of an object that are the user's."""
    if type(value) is dict:
        return value
    skipped = _OF_A_NODE if isinstance(value, Node) else _OF_A_LOGGER if type(value) is Logger else OF_PYTHON
    found = {name: part for name, part in vars(value).items() if name not in skipped and name[:9] != "__epypes_"}
    if type(value) is types.FunctionType:
        found |= {name: getattr(value, name) for name in _PARTS_OF_A_FUNCTION}
    return found


def _read_bindings(value: Any) -> tuple[Any, ...]:
    found = bound(value)
    return *found, *found.values()


def _write_bindings(value: Any, saved: tuple[Any, ...]) -> None:
    before, now = as_dict(saved), dict(bound(value))
    if type(value) is dict:
        bind, delete = dict.__setitem__, dict.__delitem__
    else:
        owner: Any = type if isinstance(value, type) else object
        bind, delete = owner.__setattr__, owner.__delattr__
    for name in now.keys() - before.keys():
        delete(value, name)
    for name, part in before.items():
        if name not in now or now[name] is not part:
            bind(value, name, part)


def read_cell(cell: types.CellType) -> tuple[Any, ...]:
    """Return what a closure holds in a cell."""
    return (cell.cell_contents,)


def write_cell(cell: types.CellType, saved: tuple[Any, ...]) -> None:
    """Put back what a cell held."""
    (cell.cell_contents,) = saved
