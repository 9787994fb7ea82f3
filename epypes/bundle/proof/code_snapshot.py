"""What a bundle's functions refer to, as a snapshot of objects that may change: locked arrays, all else compared.

Names and attributes are compared where some of the code can bind them, and locked arrays where some of it can unlock
them; its instructions show that. To wrap every function and compare always takes 5 us per call: 27 % of an event of the
edge graph on an image of 64 x 64.

A value in the cache of an ``lru_cache`` is compared with what it was when it was computed. For that, the cache is
replaced by another one of the same function when the bundle is loaded, wherever a name, an attribute, a dict or a
closure holds it. What can't be compared is forgotten or put back after each call, without a failure: what a cached
property has computed, a cache that is held elsewhere, and the attributes of a node of the user's own class, which may
count its calls. A function that reaches one of these never runs beside another one.

A background model or a filter of OpenCV that outlives the call counts as changed. What a pipeline of the user's own
class has in its attributes is not looked at.

What the code could patch in libraries is compared too: the attributes that its instructions store, or all of the
modules and classes that it names where it stores by text, as ``vars`` and ``setattr`` do.
"""

from __future__ import annotations

import ast
import dis
import functools
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from enum import Enum
from logging import Logger
from typing import Any, Final

from epypes.bundle.private_import import import_module, plain_name
from epypes.bundle.proof.libraries import OF_THE_PROCESS
from epypes.bundle.proof.process_settings import SEED_PARAMETERS, default_generator, global_generator
from epypes.bundle.source.references import (
    attributes_loaded,
    cells_of,
    defaults_of,
    global_names,
    imported_modules,
    is_model_of_cv2,
    meanings_of,
    nested_codes,
)
from epypes.bundle.source.resolve import definition_of
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import WATCH, is_array
from epypes.run.snapshot import (
    Found,
    Record,
    Snapshot,
    array_record,
    as_dict,
    cached_properties,
    is_own,
    is_same,
)

LRU_CACHE: Final = type(functools.cache(len))
# An attribute of an lru_cache: the one that takes its place.
_CHECKED: Final = "__epypes_checked__"
# An attribute of that one: the snapshots of its mutable values.
_VALUES: Final = "__epypes_values__"
# A cache is emptied when it has more values than this that must be compared at each call.
_MOST_VALUES: Final = 1_000
# Code with one of these names or instructions can bind names of its module, of closures, or attributes; code with one
# of the second set can unlock or reshape an array.
_BINDS: Final = frozenset(
    {"globals", "exec", "eval", "vars", "setattr", "delattr", "modules", "f_globals", "__globals__", "__dict__"}
    | {"__setattr__", "__delattr__", "__defaults__", "STORE_ATTR", "DELETE_ATTR", "STORE_GLOBAL", "DELETE_GLOBAL"}
    | {"nonlocal"}
)
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
# How a logger logs changes no value, and depends on other loggers.
_OF_A_LOGGER: Final = frozenset(vars(Logger("")))  # noqa: LOG001 - one that nobody uses
# By these code binds names that its instructions don't say.
_BINDS_BY_TEXT: Final = frozenset({"setattr", "delattr", "vars", "__dict__", "__setattr__", "__delattr__", "patch"})
# Py_TPFLAGS_HEAPTYPE: a class with this flag is no static one of C, which takes no attributes.
_MADE_BY_PYTHON: Final = 1 << 9
_SAME_MODULE: Final = {"posix": "os", "nt": "os", "_locale": "locale", "_decimal": "decimal"}
_PARTS_OF_A_FUNCTION: Final = ("__defaults__", "__kwdefaults__", "__code__")


# -- the objects that code refers to -------------------------------------------------------------------------------


class CodeSnapshot(Snapshot):
    """The mutable objects that functions refer to, through names, closures, defaults, attributes, classes and caches.

    Parameters
    ----------
    functions
        The functions by name.
    compared
        The arrays that are not locked but compared, by id; those of libraries' objects are added.
    lock
        Whether all others are locked; else they are added too.

    Attributes
    ----------
    resets
        What puts back or forgets, after each call, what a call may change without a failure.
    nodes
        The nodes and pipelines that were met, by id.
    words
        The names that the code has, its instructions, and the names of the libraries whose objects it names.
    draws, seeds
        The names by which the code draws from random generators of the whole process, each with whose that is; and
        those that it seeds.
    has_code
        Whether code of the user was met.
    is_unlocking
        Whether the arrays are unlocked for each call, which then must be alone, and compared after it.
    """

    def __init__(self, functions: Mapping[str, object], compared: dict[int, object], *, lock: bool = True) -> None:
        self._compared, self._lock = compared, lock
        self.resets: list[Callable[[], object]] = []
        self.nodes: dict[int, Node] = {}
        self._caches: list[tuple[str, Any, list[CodeSnapshot]]] = []
        self.words: set[str] = set()
        self.draws: dict[str, str] = {}
        self.seeds: set[str] = set()
        self.has_code = False
        self.is_unlocking = False
        self._locked: list[tuple[str, Any]] = []
        # The user's functions; what draws unless it is given a seed or generator, by name, and whether one is given.
        self._functions: list[types.FunctionType] = []
        self._draws_by_default: dict[str, str] = {}
        self._gives_seed = False
        # What is compared or reset if the code has one of the names or instructions.
        self._possible: list[tuple[frozenset[str], Callable[[], object]]] = []
        # The modules, classes and functions of libraries that the code names.
        self._of_libraries: dict[int, tuple[str, Any]] = {}
        super().__init__(functions)
        for needed, add in self._possible:
            if needed & self.words:
                add()
        self._possible.clear()
        own = {function.__name__ for function in self._functions}
        by_default = {name: home for name, home in self._draws_by_default.items() if name not in own}
        unseeded = self._called_without_seed() if self._gives_seed and by_default else by_default.keys()
        self.draws |= {name: home for name, home in by_default.items() if name in unseeded}
        self._compare_libraries()

    def __bool__(self) -> bool:
        return bool(self.records or self.resets or self._caches)

    def changed(self) -> str | None:
        """Return the first object that has changed, by the name that the code knows it by; None if there is none."""
        for record in self.records:
            if record.differs():
                return record.changed_name() if isinstance(record, _Bindings) else record.name
        for name, _, values in self._caches:
            for value in values:
                if value.changed() is not None:
                    return name
        return None

    def reset(self) -> None:
        """Put back or forget what a call may change without a failure."""
        for reset in self.resets:
            reset()
        for _, _, values in self._caches:
            for value in values:
                value.reset()

    def begin_unlocking(self) -> None:
        """Unlock the arrays for each call from now on: compiled code of libraries may take no read-only ones."""
        self.is_unlocking = True
        self.records += [array_record(name, array) for name, array in self._locked]

    def set_locks(self, is_locked: bool) -> None:
        """Lock or unlock the arrays, as far as their memory can be written to."""
        for _, array in self._locked if is_locked else reversed(self._locked):  # a view after its base
            with suppress(ValueError):
                array.setflags(write=not is_locked)

    def restored(self) -> bool:
        """Put everything back, and return whether that was possible."""
        self.restore()
        # Also values that have not changed: they may be computed from what has, and a call that is answered from a
        # cache would not make the same change again.
        for _, cached, values in self._caches:
            cached.cache_clear()
            values.clear()
        return self.changed() is None

    def look_at(self, name: str, value: Any) -> Found:
        """Look into code too."""
        kind = type(value)
        home = value.__name__ if kind is types.ModuleType else getattr(value, "__module__", None)
        if callable(value):
            self._note_generator(name, value)
        if isinstance(home, str):
            top = home.partition(".")[0]
            self.words |= {_SAME_MODULE.get(top, top), str(getattr(value, "__name__", top))}
        if kind is types.FunctionType:
            return self._look_at_function(value)
        if issubclass(kind, type):
            return self._look_at_class(value)
        if kind is types.ModuleType:
            return self._look_at_module(value)
        if issubclass(kind, Node):
            return self._look_at_node(name, value)
        if kind is LRU_CACHE:
            return self._look_at_cache(name, value)
        return self._look_at_object(name, value)

    def _look_at_object(self, name: str, value: Any) -> Found:
        kind, attributes = type(value), getattr(value, "__dict__", None)
        if kind is dict:
            _check_caches(value)
        elif is_own(str(kind.__module__)):
            yield kind.__name__, kind
            if type(attributes) is dict:
                _check_caches(attributes)
            lazy = cached_properties(kind)
            if lazy:
                self.resets.append(functools.partial(_forget, value, lazy))
            if issubclass(kind, Enum):
                self._compare(_BINDS, functools.partial(_Bindings, f"{kind.__name__}.{value.name}.", value))
        elif kind is Logger:
            self.records.append(_Bindings(f"{name}.", value))
        elif is_model_of_cv2(value):
            self.records.append(Record(name, value, _always_another, lambda value, saved: None))
        elif not is_array(value) and type(attributes) is dict:
            # A library's own code may not take read-only arrays.
            self._compared.update((id(part), part) for part in attributes.values() if is_array(part))
        yield from super().look_at(name, value)

    def look_at_array(self, name: str, value: Any) -> Found:
        """Lock an array, instead of making a copy of it to compare with."""
        if self._lock and id(value) not in self._compared:
            value.setflags(write=False)
            self._locked.append((name, value))
            self._compare(_UNLOCKS, functools.partial(array_record, name, value))
        else:
            self._compared[id(value)] = value
        return super().look_at_array(name, value)

    def _look_at_function(self, function: types.FunctionType) -> Found:
        known, code = function.__globals__, function.__code__
        if not is_own(str(known.get("__name__"))):
            self._of_libraries[id(function)] = f"{function.__name__}.", function
            yield from _wrapped_by(function)
            return
        self._functions.append(function)
        _check_caches(known)
        self._compare(_BINDS, functools.partial(_Bindings, "", known))
        self._compare(_BINDS, functools.partial(_Bindings, f"{function.__name__}.", function))
        for inner in nested_codes(code):
            self._note_instructions(inner)
        for name, value in attributes_loaded(function):
            self._note_generator(name, value)
        yield from meanings_of(function, global_names(code)).items()
        for name in imported_modules(function):
            # A module of the bundle is imported now: what it holds when a call imports it could not be put back.
            module = sys.modules.get(name)
            if plain_name(name) != name:
                with suppress(Exception):  # the function raises the same when it is called
                    module = import_module(name)
            yield plain_name(name), module
        for name, cell in cells_of(function).items():
            cell.cell_contents = checked_cache(cell.cell_contents)
            self._compare(_BINDS, functools.partial(Record, name, cell, _read_cell, _write_cell))
            yield name, cell.cell_contents
        yield from defaults_of(function).items()
        attributes = function.__dict__.items()
        yield from ((f"{function.__name__}.{name}", value) for name, value in attributes if name != WATCH)

    def _note_instructions(self, code: types.CodeType) -> None:
        """Note the names of some code, also those that are texts, and the instructions by which it binds them."""
        self.has_code = True
        self.words.update(code.co_names, (text for text in code.co_consts if type(text) is str and text.isidentifier()))
        keywords = {word for part in code.co_consts if type(part) is tuple for word in part}
        self._gives_seed |= not SEED_PARAMETERS.isdisjoint(keywords)
        for instruction in dis.get_instructions(code):
            operation, name = instruction.opname, instruction.argval
            if operation.startswith(("STORE_", "DELETE_")):
                is_free = operation.endswith("_DEREF") and name in code.co_freevars
                self.words |= {operation, f"{operation} {name}", *(["nonlocal"] if is_free else [])}

    def _note_generator(self, name: str, function: Any) -> None:
        """Note a function if it draws from a generator of the whole process, or seeds it."""
        home, is_seed = global_generator(name, function)
        if home and is_seed:
            self.seeds.add(home)
        elif home:
            (self._draws_by_default if function is None else self.draws)[name] = home
        elif home := default_generator(function):
            self._draws_by_default[name] = home

    def _called_without_seed(self) -> set[str]:
        """Return the names by which the user's functions call something without a seed."""
        nodes = (definition_of(function.__code__)[1] for function in self._functions)
        calls = (part for node in nodes if node for part in ast.walk(node) if isinstance(part, ast.Call))
        without = (call for call in calls if {None, *SEED_PARAMETERS}.isdisjoint(each.arg for each in call.keywords))
        return {getattr(call.func, "attr", getattr(call.func, "id", "")) for call in without}

    def _look_at_class(self, kind: type) -> Found:
        if is_own(str(kind.__module__)):
            yield from self._look_at_names(f"{kind.__name__}.", kind)
            yield from ((base.__name__, base) for base in kind.__bases__)
        else:
            self._of_libraries[id(kind)] = f"{kind.__name__}.", kind

    def _look_at_module(self, module: types.ModuleType) -> Found:
        if not is_own(module.__name__):
            self._of_libraries[id(module)] = f"{module.__name__}.", module
            return iter(())
        return self._look_at_names(f"{plain_name(module.__name__)}.", vars(module))

    def _look_at_names(self, prefix: str, owner: Any) -> Found:
        _check_caches(owner)
        self._compare(_BINDS, functools.partial(_Bindings, prefix, owner))
        yield from ((f"{prefix}{name}", value) for name, value in _bound(owner).items() if name not in _OF_PYTHON)

    def _look_at_node(self, name: str, node: Node) -> Found:
        """Look into a node of a nested graph; what EPypes itself has in it is no state of the user's."""
        self.nodes[id(node)] = node
        if isinstance(node, Pipeline):
            yield from node.cg.functions.items()
            return
        yield name, node.func
        yield type(node).__name__, type(node)
        if type(node) is not Node:
            record = _Bindings(f"{name}.", node)
            self._possible.append((_BINDS, lambda: self.resets.append(record.restore)))
            yield from ((f"{name}.{key}", value) for key, value in _bound(node).items())

    def _look_at_cache(self, name: str, cached: Any) -> Found:
        """Have the values of an lru_cache compared, and look into the function behind it."""
        if is_own(str(cached.__module__)):
            values = vars(cached).get(_VALUES)
            if values is None:
                self.resets.append(cached.cache_clear)
            else:
                self._caches.append((name, cached, values))
        yield name, cached.__wrapped__

    def _compare_libraries(self) -> None:
        """Compare what the code may bind in the libraries that it names: all of it, or what its instructions say."""
        stored = frozenset(word.partition(" ")[2] for word in self.words if word[:10] in ("STORE_ATTR", "DELETE_ATT"))
        names = None if _BINDS_BY_TEXT & self.words else stored
        waiting = [*self._of_libraries.values()] if names is None or names else []
        while waiting:
            prefix, owner = waiting.pop()
            if _can_be_patched(owner, names) and prefix.partition(".")[0] not in OF_THE_PROCESS:
                self.records.append(_LibraryBindings(prefix, owner, names))
            if isinstance(owner, types.ModuleType):
                for name in self.words & vars(owner).keys():
                    part = vars(owner)[name]
                    is_new = id(part) not in self._of_libraries
                    if is_new and isinstance(part, types.ModuleType | types.FunctionType | type):
                        self._of_libraries[id(part)] = found = f"{prefix}{name}.", part
                        waiting.append(found)
        self._of_libraries.clear()

    def _compare(self, needed: frozenset[str], make: Callable[[], Record]) -> None:
        """Compare an object if the code has one of the names or instructions."""
        self._possible.append((needed, lambda: self.records.append(make())))


def _always_another(value: Any) -> tuple[object, ...]:
    """Return contents that differ from those of any other call."""
    return (object(),)


def _forget(value: Any, lazy: frozenset[str]) -> None:
    """Delete what cached properties have computed: it may be mutable, and is computed again."""
    for name in lazy:
        vars(value).pop(name, None)


def _wrapped_by(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Give the functions that one of a library refers to: it may be a decorator's."""
    registry = function.__dict__.get("registry")
    held = [function.__dict__.get("__wrapped__")]
    held += registry.values() if isinstance(registry, types.MappingProxyType) else []
    held += [cell.cell_contents for cell in cells_of(function).values()]
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

    def _others(self, now: tuple[Any, ...]) -> list[str]:
        before, after = as_dict(self.saved), as_dict(now)
        return [
            name
            for name in [*after, *(before.keys() - after.keys())]
            if name not in _OF_PYTHON
            and not is_same(after.get(name, self), before.get(name, self))
            and not (isinstance(after.get(name), types.ModuleType) and before.get(name) is None)
        ]


class _LibraryBindings(_Bindings):
    """The names of a library's module, or the attributes of its class or function: all, or those with some names.

    What a library adds itself, such as a part that is loaded when it is first asked for, is no change.
    """

    __slots__ = ("names",)

    def __init__(self, name: str, value: Any, names: frozenset[str] | None) -> None:
        self.names = names
        Record.__init__(self, name, value, self._read, self._write)

    def _read(self, value: Any) -> tuple[Any, ...]:
        found = _bound(value) if self.names is None else _some_bound(value, self.names)
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


def _can_be_patched(owner: Any, names: frozenset[str] | None) -> bool:
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


def _bound(value: Any) -> dict[str, Any]:
    """Return the names of a module, or the attributes of an object that are the user's."""
    if type(value) is dict:
        return value
    skipped = _OF_A_NODE if isinstance(value, Node) else _OF_A_LOGGER if type(value) is Logger else _OF_PYTHON
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
    return (cell.cell_contents,)


def _write_cell(cell: types.CellType, saved: tuple[Any, ...]) -> None:
    (cell.cell_contents,) = saved


# -- caches --------------------------------------------------------------------------------------------------------


def _check_caches(owner: Any) -> None:
    """Replace each lru_cache among the values of a dict or the attributes of a class by one that is compared."""
    names = owner if type(owner) is dict else vars(owner)
    for name, part in [*names.items()]:
        checked = checked_cache(part)
        if checked is not part and isinstance(owner, type):
            type.__setattr__(owner, name, checked)
        elif checked is not part:
            names[name] = checked


def checked_cache(cached: Any) -> Any:
    """Return a cache of the same function whose values are compared; what is no lru_cache of the user's as it is."""
    if type(cached) in (staticmethod, classmethod):
        checked = checked_cache(cached.__func__)
        return cached if checked is cached.__func__ else type(cached)(checked)
    if type(cached) is not LRU_CACHE or not is_own(str(cached.__module__)):
        return cached
    if _CHECKED in vars(cached):
        return vars(cached)[_CHECKED]
    function = cached.__wrapped__
    values: list[CodeSnapshot] = []

    def compute(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        snapshot = CodeSnapshot({"": result}, {})  # locks its arrays
        if snapshot:
            if len(values) >= _MOST_VALUES:
                made.cache_clear()
                # Other threads may put the last values into the cache only now.
                del values[: _MOST_VALUES // 2]
            values.append(snapshot)
        return result

    made: Any = functools.lru_cache(**cached.cache_parameters())(compute)
    functools.update_wrapper(made, function)
    vars(made)[_VALUES] = values
    vars(cached)[_CHECKED] = vars(made)[_CHECKED] = made
    return made
