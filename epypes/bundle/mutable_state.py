"""Mutable state that a bundle's functions refer to: locked where it is an array, else compared after each call.

No answer may depend on an earlier event. Promotion refuses functions that plainly write to what outlives their call;
syntax can't show all of it. So each function of a loaded bundle that refers to a mutable object is wrapped: after its
call, a snapshot of these objects is compared; if one has changed, it is put back and the call raises StateChanged.
Functions that refer only to constants, which are most, are not wrapped.

What code can change is read off its instructions: bindings of names and attributes are only compared where some of the
code can set them, and locked arrays only where some of it can unlock them.

A value in the cache of an ``lru_cache`` is compared with what it was when it was computed, and taken out if it has
changed. What a cached property has computed is forgotten after the call. The attributes of a node of the user's own
class are put back without a failure, since it may count its calls; what a pipeline of the user's own class has in its
attributes is not looked at. The global generators of ``random`` and ``numpy.random`` are not compared: a function may
seed them for another one, and the replay finds draws without a seed.

Calls in several threads share the objects. Where a call finds a change and other calls ran meanwhile, any of them may
have made it, or have read it: each of them is called again, alone, on objects that have been put back.
"""

from __future__ import annotations

import dis
import functools
import sys
import threading
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Final

from epypes.errors import StateChanged
from epypes.graph import as_switch, is_placeholder
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import WATCH, WRITTEN, is_array, is_unguarded
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

_CACHED: Final = type(functools.cache(len))
# The attribute of an lru_cache whose values are compared.
_CHECK: Final = "__epypes_check__"
# A cache is emptied when it has computed more values that must be compared at each call.
_MOST_CHECKED: Final = 1_000
# Code with one of these names or instructions can bind the names of its module; with one of the second set, the
# attributes of any object; with one of the third, it can unlock or reshape an array.
_BINDS: Final = frozenset(
    {"globals", "exec", "eval", "vars", "__globals__", "__dict__", "modules", "f_globals"}
    | {"STORE_GLOBAL", "DELETE_GLOBAL"}
)
_SETS: Final = _BINDS | {
    "setattr",
    "delattr",
    "__setattr__",
    "__delattr__",
    "__defaults__",
    "STORE_ATTR",
    "DELETE_ATTR",
}
_UNLOCKS: Final = frozenset(
    {"setflags", *(f"STORE_ATTR {name}" for name in ("writeable", "shape", "dtype", "strides", "data"))}
)
# Python makes these itself when they are first asked for; an Enum adds combinations of its members then.
_OF_PYTHON: Final = frozenset(
    {"__builtins__", "__warningregistry__", "__dict__", "__weakref__", "__doc__", "__abstractmethods__", "_abc_impl"}
    | {"__annotations__", "__annotations_cache__", "__annotate__", "__annotate_func__", "__static_attributes__"}
    | {"_value2member_map_", "__slotnames__"}
)
_OF_A_NODE: Final = frozenset({*vars(Node("", len)), "compute"})
_PARTS_OF_A_FUNCTION: Final = ("__defaults__", "__kwdefaults__", "__code__")


# -- the objects that code refers to -------------------------------------------------------------------------------


class CodeSnapshot(Snapshot):
    """The mutable objects that functions refer to, through names, closures, defaults, attributes, classes and caches.

    Parameters
    ----------
    functions
        The functions by name.
    lock
        Whether arrays are locked instead of compared, and caches emptied instead of looked into.
    compared
        Arrays that are not locked in any case, by id.
    """

    def __init__(
        self, functions: Mapping[str, object], *, lock: bool = True, compared: Mapping[int, object] | None = None
    ) -> None:
        self._lock, self._compared = lock, dict(compared or {})
        self.arrays: dict[int, object] = {}
        self._settlers: list[Callable[[], None]] = []
        self._caches: list[_CacheCheck] = []
        self._instructions: set[str] = set()
        # Records of what only some instructions can change.
        self._possible: list[tuple[frozenset[str], Callable[[], Record]]] = []
        super().__init__(functions)
        self.records += [make() for needed, make in self._possible if needed & self._instructions]
        self._possible.clear()

    def __bool__(self) -> bool:
        return bool(self.records or self._settlers or self._caches)

    def changed(self) -> str | None:
        """Return the first object that has changed, by the name that the code knows it by; None if there is none."""
        for record in self.records:
            if record.differs():
                return record.changed_name() if isinstance(record, _Bindings) else record.name
        return next((check.name for check in self._caches if check.is_changed()), None)

    def settle(self) -> None:
        """Put back what a call may change without a failure."""
        for settle in self._settlers:
            settle()

    def must_be_emptied(self) -> bool:
        """Whether a cache has values that are not compared, or too many."""
        return any(check.must_be_emptied() for check in self._caches)

    def restored(self) -> bool:
        """Put everything back, and return whether that was possible."""
        self.restore()
        # Also those whose values are the same: a call that is answered from a cache would not change them again.
        for check in self._caches:
            check.clear()
        return self.changed() is None

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
        if kind is _CACHED:
            return self._look_at_cache(name, value)
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
        """Lock an array, instead of making a copy of it to compare with."""
        self.arrays[id(value)] = value
        if self._lock and id(value) not in self._compared:
            value.setflags(write=False)
            self._possible.append((_UNLOCKS, functools.partial(array_record, name, value)))
        return super().look_at_array(name, value)

    def _look_at_function(self, function: types.FunctionType) -> Found:
        known = function.__globals__
        if not is_own(str(known.get("__name__"))):
            yield from _wrapped_by(function)
            return
        self._may_bind(_BINDS, "", known)
        self._may_bind(_SETS, f"{function.__name__}.", function)
        for name in self._read(function.__code__):
            is_imported = f"IMPORT_NAME {name}" in self._instructions
            yield name, known.get(name, sys.modules.get(name) if is_imported else None)
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            binds = frozenset({f"STORE_DEREF {name}", f"DELETE_DEREF {name}"})
            self._possible.append((binds, functools.partial(Record, name, cell, _read_cell, _write_cell)))
            yield from ((name, value) for value in _read_cell(cell))
        arguments = function.__code__.co_varnames[: function.__code__.co_argcount]
        defaults = function.__defaults__ or ()
        yield from zip(arguments[len(arguments) - len(defaults) :], defaults, strict=True)
        yield from (function.__kwdefaults__ or {}).items()
        attributes = function.__dict__.items()
        yield from ((f"{function.__name__}.{name}", value) for name, value in attributes if name != WATCH)

    def _read(self, code: types.CodeType) -> dict[str, None]:
        """Note the instructions of some code, and return the names that it reads."""
        names = dict.fromkeys(code.co_names)
        for instruction in dis.get_instructions(code):
            if instruction.opname.startswith(("STORE_", "DELETE_", "IMPORT_NAME")):
                self._instructions |= {instruction.opname, f"{instruction.opname} {instruction.argval}"}
        for constant in code.co_consts:
            if isinstance(constant, types.CodeType):
                names |= self._read(constant)
        self._instructions.update(names)
        return names

    def _look_at_class(self, kind: type) -> Found:
        if is_own(str(kind.__module__)):
            self._may_bind(_SETS, f"{kind.__name__}.", kind)
            yield from ((f"{kind.__name__}.{name}", value) for name, value in _bound(kind).items())
            yield from ((base.__name__, base) for base in kind.__bases__)

    def _look_at_module(self, module: types.ModuleType) -> Found:
        if is_own(module.__name__):
            self._may_bind(_SETS, f"{module.__name__}.", vars(module))
            yield from ((name, value) for name, value in vars(module).items() if name not in _OF_PYTHON)

    def _look_at_node(self, name: str, node: Node) -> Found:
        """Look into a node of a nested graph; what EPypes itself has in it is no state of the user's."""
        if isinstance(node, Pipeline):
            yield from node.cg.functions.items()
            return
        yield name, node.func
        yield type(node).__name__, type(node)
        if type(node) is not Node:
            # A component may count its calls. It is put back without a failure: no answer depends on it.
            self._settlers.append(_Bindings(f"{name}.", node).settle)
            yield from ((f"{name}.{key}", value) for key, value in _bound(node).items())

    def _look_at_cache(self, name: str, cached: Any) -> Found:
        """Look into the function behind an lru_cache."""
        if is_own(str(cached.__module__)):
            if self._lock:
                self._caches.append(getattr(cached, _CHECK, None) or _CacheCheck(name, cached, is_complete=False))
            else:
                yield from ((name, value) for value in cached_values(cached))
        yield name, cached.__wrapped__

    def _may_bind(self, needed: frozenset[str], name: str, value: Any) -> None:
        self._possible.append((needed, functools.partial(_Bindings, name, value)))


def _forget(value: Any, lazy: frozenset[str]) -> None:
    """Delete what cached properties have computed: it may be mutable, and is computed again."""
    for name in lazy:
        vars(value).pop(name, None)


def _wrapped_by(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Give the functions that one of a library refers to: it may be a decorator's."""
    registry = function.__dict__.get("registry")
    held = [function.__dict__.get("__wrapped__")]
    held += registry.values() if isinstance(registry, types.MappingProxyType) else []
    held += [value for cell in function.__closure__ or () for value in _read_cell(cell)]
    yield from ((function.__name__, value) for value in held if callable(value) and not isinstance(value, type))


# -- names and attributes ------------------------------------------------------------------------------------------


class _Bindings(Record):
    """The names of a module, or the attributes of a class, a function or a node, as names followed by values.

    ``name`` is what stands before them in a report. Modules that are imported only when they are needed are no change.
    """

    __slots__ = ()

    def __init__(self, name: str, value: Any) -> None:
        super().__init__(name, value, _read_bindings, _write_bindings)

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


def _bound(value: Any) -> dict[str, Any]:
    """Return the names of a module, or the attributes of an object that are the user's."""
    if type(value) is dict:
        return value
    skipped = _OF_A_NODE if isinstance(value, Node) else _OF_PYTHON
    found = {name: part for name, part in vars(value).items() if name not in skipped and name[:9] != "__epypes_"}
    if type(value) is types.FunctionType:
        found |= {name: getattr(value, name) for name in _PARTS_OF_A_FUNCTION}
    return found


def _read_bindings(value: Any) -> tuple[Any, ...]:
    found = _bound(value)
    return *found, *found.values()


def _write_bindings(value: Any, saved: tuple[Any, ...]) -> None:
    before, now = as_dict(saved), dict(_bound(value))
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


def _read_cell(cell: types.CellType) -> tuple[Any, ...]:
    return () if cell == types.CellType() else (cell.cell_contents,)


def _write_cell(cell: types.CellType, saved: tuple[Any, ...]) -> None:
    if saved:
        cell.cell_contents = saved[0]
    else:
        del cell.cell_contents


# -- caches --------------------------------------------------------------------------------------------------------


class _CacheCheck:
    """What the values of an lru_cache were when they were computed.

    Parameters
    ----------
    name
        What the code calls the cache.
    cached
        The cache.
    is_complete
        Whether each value was added here; else no mutable one may stay in it after a call.
    """

    def __init__(self, name: str, cached: Any, *, is_complete: bool) -> None:
        self.name, self._cached, self._is_complete = name, cached, is_complete
        self._misses = 0
        self._snapshots: list[CodeSnapshot] = []

    def add(self, value: Any) -> None:
        """Lock the arrays in a value that was computed, and note what else can change in it."""
        snapshot = CodeSnapshot({self.name: value})
        if snapshot:
            self._snapshots.append(snapshot)

    def is_changed(self) -> bool:
        """Whether a value is not what it was."""
        return any(snapshot.changed() is not None for snapshot in self._snapshots)

    def must_be_emptied(self) -> bool:
        """Whether there are values that are not compared, or too many."""
        if self._is_complete:
            return len(self._snapshots) > _MOST_CHECKED
        misses = self._cached.cache_info().misses
        if misses != self._misses and CodeSnapshot({self.name: (*cached_values(self._cached),)}, lock=False):
            return True
        self._misses = misses
        return False

    def clear(self) -> None:
        """Empty the cache."""
        self._cached.cache_clear()
        self._snapshots.clear()
        self._misses = 0


def check_caches(names: dict[str, Any]) -> None:
    """Have each lru_cache of a module note what its function returns."""
    made: dict[int, tuple[Any, Any]] = {}
    for name, cached, put in _caches_of(names):
        if id(cached) not in made:
            made[id(cached)] = cached, _checked(name, cached)
        put(made[id(cached)][1])


def _caches_of(names: dict[str, Any]) -> Iterator[tuple[str, Any, Callable[[Any], object]]]:
    """Give the caches among the names of a module, in its dicts, classes and closures, and what replaces each."""
    for value in [names, *names.values()]:
        found: list[tuple[str, Any, Callable[[Any], object]]] = []
        if type(value) is dict:
            found = [(str(key), part, functools.partial(value.__setitem__, key)) for key, part in value.items()]
        elif not is_own(str(getattr(value, "__module__", ""))):
            continue
        elif isinstance(value, type):
            put = functools.partial(type.__setattr__, value)
            found = [
                (f"{value.__name__}.{name}", part, functools.partial(put, name)) for name, part in vars(value).items()
            ]
        elif isinstance(value, types.FunctionType):
            cells = zip(value.__code__.co_freevars, value.__closure__ or (), strict=True)
            found = [
                (name, part, functools.partial(setattr, cell, "cell_contents"))
                for name, cell in cells
                for part in _read_cell(cell)
            ]
        yield from (each for each in found if type(each[1]) is _CACHED and is_own(str(each[1].__module__)))


def _checked(name: str, cached: Any) -> Any:
    """Return a new cache of the same function, whose values are compared."""
    function = cached.__wrapped__

    def compute(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        check.add(result)
        return result

    again = functools.update_wrapper(functools.lru_cache(**cached.cache_parameters())(compute), function)
    check = _CacheCheck(name, again, is_complete=True)
    setattr(again, _CHECK, check)
    return again


# -- calls ---------------------------------------------------------------------------------------------------------

# The turns of the guarded call under way. What that calls, also in helper threads, is part of it.
_under_way: ContextVar[object] = ContextVar("_under_way", default=None)


class MutableState:
    """Guards the functions of one loaded bundle.

    Parameters
    ----------
    functions
        All of them, by name; nested pipelines are looked through.
    """

    def __init__(self, functions: Mapping[str, Callable[..., Any]]) -> None:
        self._turns = _Turns()
        self._compared: dict[int, object] = {}
        for name, function in _with_inner(functions):
            if is_unguarded(function):
                # It rejects read-only arrays.
                self._compared |= CodeSnapshot({name: function}, lock=False).arrays

    def guarded(self, functions: Mapping[str, Callable[..., Any]]) -> dict[str, Callable[..., Any]]:
        """Have runners and nodes call what compares the state of these functions; return them, odd kinds wrapped.

        Nodes, and those of nested pipelines, are changed in place.
        """
        return {name: self._guarded(name, function) for name, function in functions.items()}

    def _guarded(self, name: str, function: Any) -> Any:
        if is_placeholder(function) or as_switch(function) is not None:
            return function
        if isinstance(function, Pipeline):
            self.guarded(function.network.nodes)
            return function
        snapshot = CodeSnapshot({name: function}, compared=self._compared)
        if not snapshot:
            return function
        if type(function) in (types.FunctionType, functools.partial, _CACHED):
            # It stays what the module defines, so that it can be promoted again.
            setattr(function, WATCH, functools.partial(self._guarded_call, function=function, snapshot=snapshot))
            return function
        if not isinstance(function, Node):
            return self._guarded_call(name, function, snapshot)
        if type(function).compute is Node.compute:
            function.func = self._guarded_call(name, function.func, snapshot)
        else:
            function.compute = self._guarded_call(name, function.compute, snapshot)  # type: ignore[method-assign]
        return function

    def _guarded_call(self, name: str, function: Callable[..., Any], snapshot: CodeSnapshot) -> Callable[..., Any]:
        turns = self._turns

        def attempt(args: Any, kwargs: Any) -> tuple[Any, BaseException | None]:
            token = _under_way.set(turns)
            try:
                return function(*args, **kwargs), None
            except BaseException as error:
                return None, error
            finally:
                _under_way.reset(token)
                snapshot.settle()

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if _under_way.get() is turns:
                return function(*args, **kwargs)
            entered, is_restored = turns.enter(), True
            result, error = attempt(args, kwargs)
            changed = snapshot.changed()
            must_restore = changed is not None or snapshot.must_be_emptied()
            with turns.changed:
                try:
                    is_alone = turns.was_alone(entered)
                    if must_restore and is_alone:
                        is_restored = snapshot.restored()
                finally:
                    turns.leave()
            if must_restore and not is_alone:
                with turns.alone():
                    snapshot.restored()
                    result, error = attempt(args, kwargs)
                    changed = snapshot.changed()
                    is_restored = snapshot.restored()
            try:
                if error is not None:
                    raise error
                if changed is not None:
                    raise StateChanged(name, changed, is_restored)
                return result
            finally:
                # The exception refers to this frame, which refers to the exception, and to the images of the call.
                del error, result

        vars(call).pop(WATCH, None)
        setattr(call, WRITTEN, function)
        return call


class _Turns:
    """The calls under way: each learns whether others ran meanwhile, and may run alone."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self._running = self._entered = 0
        self._is_taken = False

    def enter(self) -> int:
        """Begin a call; return its number, or 0 if others are running."""
        with self.changed:
            while self._is_taken:
                self.changed.wait()
            self._running += 1
            self._entered += 1
            return self._entered if self._running == 1 else 0

    def was_alone(self, entered: int) -> bool:
        """Whether no other call ran since this one has begun; to be asked with ``changed`` held."""
        return entered == self._entered

    def leave(self) -> None:
        """End a call, with ``changed`` held."""
        self._running -= 1
        if self._is_taken:
            self.changed.notify_all()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Wait for the others to end, and let none begin until the block ends."""
        with self.changed:
            while self._is_taken:
                self.changed.wait()
            self._is_taken = True
            while self._running:
                self.changed.wait()
        try:
            yield
        finally:
            with self.changed:
                self._is_taken = False
                self.changed.notify_all()


def _with_inner(functions: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Give functions, and those of nested pipelines instead of the pipelines."""
    for name, function in functions.items():
        if isinstance(function, Pipeline):
            yield from _with_inner(function.cg.functions)
        else:
            yield name, function
