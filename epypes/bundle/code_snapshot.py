"""A snapshot of the mutable objects that code refers to: names, closures, defaults, attributes, classes and caches.

What code can change is read off its instructions: bindings of names and attributes are only compared where some of the
code can set them, and locked arrays only where some of it can unlock them.
"""

from __future__ import annotations

import dis
import functools
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from typing import Any, Final

from epypes.pipeline import Node, Pipeline
from epypes.run.guard import WATCH, is_array
from epypes.run.snapshot import (
    Found,
    Record,
    Snapshot,
    array_record,
    as_dict,
    cached_properties,
    cached_values,
    is_own,
    is_same,
)

CACHED: Final = functools._lru_cache_wrapper
# Code with one of these names can bind the names of its module; with one of the second set, the attributes of any
# object; code that sets an attribute of the third, or calls setflags, can unlock or reshape an array.
_BINDS: Final = frozenset({"globals", "exec", "eval", "vars", "__globals__", "__dict__", "modules", "f_globals"})
_SETS: Final = _BINDS | {"setattr", "delattr", "__setattr__", "__delattr__", "__defaults__"}
_UNLOCKS: Final = frozenset({"setflags", "=writeable", "=shape", "=dtype", "=strides", "=data"})
# Python makes these itself when they are first asked for.
_OF_PYTHON: Final = frozenset(
    {"__builtins__", "__warningregistry__", "__dict__", "__weakref__", "__doc__", "__abstractmethods__", "_abc_impl"}
    | {"__annotations__", "__annotations_cache__", "__annotate__", "__annotate_func__", "__static_attributes__"}
)


class CodeSnapshot(Snapshot):
    """The mutable objects that functions refer to, through names, closures, defaults, attributes, classes and caches.

    Parameters
    ----------
    functions
        The functions by name.
    lock
        Whether arrays are locked instead of compared.
    compared
        Arrays that are not locked in any case, by id.
    caches
        The checks of caches, by id, that snapshots of functions of one bundle share.
    """

    def __init__(
        self,
        functions: Mapping[str, object],
        *,
        lock: bool = True,
        compared: Mapping[int, object] | None = None,
        caches: dict[int, CacheCheck] | None = None,
    ) -> None:
        self._lock, self._compared = lock, dict(compared or {})
        self._caches = {} if caches is None else caches
        self.arrays: dict[int, object] = {}
        self._settlers: list[Callable[[], None]] = []
        self._checks: list[CacheCheck] = []
        self._instructions: set[str] = set()
        self._imported: set[str] = set()
        # What is only recorded if some of the code can change it.
        self._bound: list[_Bindings] = []
        self._set: list[_Bindings] = []
        self._locked: list[tuple[str, Any]] = []
        super().__init__(functions)
        if self._instructions & _BINDS or "STORE_GLOBAL" in self._instructions:
            self.records += self._bound
        if self._instructions & _SETS or "STORE_ATTR" in self._instructions:
            self.records += self._set
        if self._instructions & _UNLOCKS:
            for name, value in self._locked:
                self.records.append(array_record(name, value))

    def __bool__(self) -> bool:
        return bool(self.records or self._settlers)

    def changed(self) -> str | None:
        """Return the first object that has changed, by the name that the code knows it by; None if there is none."""
        for record in self.records:
            if record.differs():
                return record.changed_name() if isinstance(record, _Bindings) else record.name
        return None

    def settle(self) -> None:
        """Put back what a call may change without a failure."""
        for settle in self._settlers:
            settle()

    def restore(self) -> None:
        """Put everything back; a call that is answered from a cache would not change it again."""
        super().restore()
        for check in self._checks:
            check.clear()

    def restored(self) -> bool:
        """Put everything back, and return whether that was possible."""
        self.restore()
        return self.changed() is None

    @property
    def emptied(self) -> int:
        """How often caches have been emptied, since a value in them could be changed."""
        return sum(check.emptied for check in self._checks)

    # -- the walk ---------------------------------------------------------------------------------------------------

    def look_at(self, name: str, value: Any) -> Found:
        """Look into code too."""
        kind = type(value)
        if kind is types.FunctionType:
            return self._look_at_function(value)
        if issubclass(kind, type):
            return self._look_at_class(value)
        if kind is types.ModuleType:
            return self._look_at_module(value)
        if issubclass(kind, Node):
            return self._look_at_node(name, value)
        if kind is CACHED:
            return self._look_at_cache(value)
        return self._look_at_object(name, value)

    def _look_at_object(self, name: str, value: Any) -> Found:
        kind = type(value)
        if is_own(str(kind.__module__)):
            yield kind.__name__, kind
            lazy = cached_properties(kind)
            if lazy:
                self._settlers.append(functools.partial(_forget, value, lazy))
        elif not is_array(value) and type(getattr(value, "__dict__", None)) is dict:
            # A library's own code may not take read-only arrays.
            self._compared.update((id(part), part) for part in vars(value).values() if is_array(part))
        yield from super().look_at(name, value)

    def look_at_array(self, name: str, value: Any) -> Found:
        """Lock an array, instead of keeping a copy of it."""
        self.arrays[id(value)] = value
        if self._lock and id(value) not in self._compared:
            value.setflags(write=False)
            self._locked.append((name, value))
        return super().look_at_array(name, value)

    def _look_at_function(self, function: types.FunctionType) -> Found:
        if not is_own(str(function.__globals__.get("__name__"))):
            yield from _wrapped_by(function)
            return
        names, stored = self._read(function.__code__)
        known = function.__globals__
        self._bound.append(_Bindings("", known, _read_names, _write_names))
        self._set.append(_Bindings(f"{function.__name__}.", function, _read_function, _write_function))
        for name in names:
            yield name, known.get(name, sys.modules.get(name) if name in self._imported else None)
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            if name in stored:
                self.records.append(Record(name, cell, _read_cell, _write_cell))
            yield from ((name, value) for value in _read_cell(cell))
        arguments = function.__code__.co_varnames[: function.__code__.co_argcount]
        defaults = function.__defaults__ or ()
        yield from zip(arguments[len(arguments) - len(defaults) :], defaults, strict=True)
        yield from (function.__kwdefaults__ or {}).items()
        attributes = function.__dict__.items()
        yield from ((f"{function.__name__}.{name}", value) for name, value in attributes if name != WATCH)

    def _read(self, code: types.CodeType) -> tuple[dict[str, None], set[str]]:
        """Return the names that some code reads, and the variables of enclosing functions that it binds."""
        names, stored = dict.fromkeys(code.co_names), set()
        for instruction in dis.get_instructions(code):
            if instruction.opname in ("STORE_DEREF", "DELETE_DEREF"):
                stored.add(instruction.argval)
            elif instruction.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
                self._instructions.add("STORE_GLOBAL")
            elif instruction.opname == "IMPORT_NAME":
                self._imported.add(instruction.argval)
            elif instruction.opname in ("STORE_ATTR", "DELETE_ATTR"):
                self._instructions |= {"STORE_ATTR", f"={instruction.argval}"}
        self._instructions.update(code.co_names)
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                inner, inner_stored = self._read(constant)
                names |= inner
                stored |= inner_stored
        return names, stored

    def _look_at_class(self, kind: type) -> Found:
        if is_own(str(kind.__module__)):
            self._set.append(_Bindings(f"{kind.__name__}.", kind, _read_class, _write_class))
            found = as_dict(_read_class(kind))
            yield from ((f"{kind.__name__}.{name}", value) for name, value in found.items())
            yield from ((base.__name__, base) for base in kind.__bases__)

    def _look_at_module(self, module: types.ModuleType) -> Found:
        if is_own(module.__name__):
            self._set.append(_Bindings(f"{module.__name__}.", vars(module), _read_names, _write_names))
            yield from ((name, value) for name, value in vars(module).items() if name not in _OF_PYTHON)

    def _look_at_node(self, name: str, node: Node) -> Found:
        """Look into a node of a nested graph; what EPypes itself keeps in it is no state of the user's."""
        if isinstance(node, Pipeline):
            yield from node.cg.functions.items()
            return
        yield name, node.func
        yield type(node).__name__, type(node)
        if type(node) is not Node:
            # A component may count its calls. It is put back without a failure: no answer depends on it.
            self._settlers.append(_Bindings(f"{name}.", node, _read_node, _write_node).settle)
            yield from ((f"{name}.{key}", value) for key, value in as_dict(_read_node(node)).items())

    def _look_at_cache(self, cached: Any) -> Found:
        """Look into the function behind an lru_cache, whose cache is emptied of what can be changed."""
        if is_own(str(cached.__module__)):
            cached.cache_clear()
            check = self._caches.get(id(cached)) or self._caches.setdefault(id(cached), CacheCheck(cached))
            self._settlers.append(check.settle)
            self._checks.append(check)
        yield cached.__name__, cached.__wrapped__


class _Bindings(Record):
    """The names of a module, or the attributes of a class or a function, as names followed by values.

    ``name`` is what stands before them in a report. Modules that are imported only when they are needed are no change.
    """

    __slots__ = ()

    def accepts(self, now: tuple[Any, ...]) -> bool:
        return not self._others(now)

    def changed_name(self) -> str:
        """Return what has another value."""
        return f"{self.name}{self._others(self.read(self.value))[0]}"

    def settle(self) -> None:
        """Put back what is bound otherwise."""
        if self.differs():
            self.restore()

    def _others(self, now: tuple[Any, ...]) -> list[str]:
        before, after = as_dict(self.saved), as_dict(now)
        return [
            name
            for name in [*after, *(before.keys() - after.keys())]
            if name not in _OF_PYTHON
            and not is_same(after.get(name, self), before.get(name, self))
            and not (isinstance(after.get(name), types.ModuleType) and before.get(name) is None)
        ]


class CacheCheck:
    """Empties an lru_cache whenever a call has left a value in it that can be changed."""

    def __init__(self, cached: Any) -> None:
        self._cached, self._misses, self.emptied = cached, 0, 0
        # The function and the like, of a cache that is empty.
        self._ours = set(map(id, cached_values(cached)))

    def settle(self) -> None:
        """Look at the cache if a value has been added."""
        misses = self._cached.cache_info().misses
        if misses != self._misses:
            self._misses = misses
            values = tuple(value for value in cached_values(self._cached) if id(value) not in self._ours)
            if CodeSnapshot({"": values}, lock=False):
                self.clear()

    def clear(self) -> None:
        """Empty the cache."""
        self._cached.cache_clear()
        self._misses = 0
        self.emptied += 1


def _forget(value: Any, lazy: frozenset[str]) -> None:
    """Delete what cached properties have computed: it may be mutable, and is computed again."""
    for name in lazy:
        vars(value).pop(name, None)


def _wrapped_by(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Give the functions that one of a library holds: it may be a decorator's."""
    held = [function.__dict__.get("__wrapped__"), *_registered(function)]
    held += [value for cell in function.__closure__ or () for value in _read_cell(cell)]
    yield from ((function.__name__, value) for value in held if callable(value) and not isinstance(value, type))


def _registered(function: types.FunctionType) -> list[Any]:
    registry = function.__dict__.get("registry")
    return [*registry.values()] if isinstance(registry, types.MappingProxyType) else []


# -- how bindings are read and written -----------------------------------------------------------------------------


def _read_names(names: dict[str, Any]) -> tuple[Any, ...]:
    return *names, *names.values()


def _write_names(names: dict[str, Any], saved: tuple[Any, ...]) -> None:
    before = as_dict(saved)
    for name in [name for name in names if name not in before and not isinstance(names[name], types.ModuleType)]:
        del names[name]
    names.update(before)


_OURS: Final = frozenset({*vars(Node("", len)), "compute"})


def _read_node(node: Node) -> tuple[Any, ...]:
    found = {name: value for name, value in vars(node).items() if name not in _OURS}
    return *found, *found.values()


def _write_node(node: Node, saved: tuple[Any, ...]) -> None:
    for name in as_dict(_read_node(node)):
        del vars(node)[name]
    vars(node).update(as_dict(saved))


def _read_class(kind: type) -> tuple[Any, ...]:
    found = {name: value for name, value in vars(kind).items() if name not in _OF_PYTHON}
    if issubclass(kind, Enum):
        # It adds combinations of its members when they are asked for.
        found.pop("_value2member_map_")
    return *found, *found.values()


def _write_class(kind: type, saved: tuple[Any, ...]) -> None:
    before, now = as_dict(saved), as_dict(_read_class(kind))
    for name in now.keys() - before.keys():
        type.__delattr__(kind, name)
    for name, value in before.items():
        if name not in now or now[name] is not value:
            type.__setattr__(kind, name, value)


_PARTS_OF_A_FUNCTION: Final = ("__defaults__", "__kwdefaults__", "__code__")


def _read_function(function: types.FunctionType) -> tuple[Any, ...]:
    found = {name: value for name, value in function.__dict__.items() if not name.startswith("__epypes_")}
    found |= {name: getattr(function, name) for name in _PARTS_OF_A_FUNCTION}
    return *found, *found.values()


def _write_function(function: types.FunctionType, saved: tuple[Any, ...]) -> None:
    before = as_dict(saved)
    for name in _PARTS_OF_A_FUNCTION:
        setattr(function, name, before.pop(name))
    for name in [name for name in function.__dict__ if name not in before and not name.startswith("__epypes_")]:
        del function.__dict__[name]
    function.__dict__.update(before)


def _read_cell(cell: types.CellType) -> tuple[Any, ...]:
    return () if cell == types.CellType() else (cell.cell_contents,)


def _write_cell(cell: types.CellType, saved: tuple[Any, ...]) -> None:
    if saved:
        cell.cell_contents = saved[0]
    else:
        del cell.cell_contents
