"""Snapshots of what code refers to: the mutable objects that functions reach, compared after each call.

Names and attributes are compared where some of the code can bind them, and locked arrays where some of it can unlock
them; its instructions show that. To wrap every function and compare always takes 5 us per call: 27 % of an event of the
edge graph on an image of 64 x 64.

A value in the cache of an ``lru_cache`` is compared with what it was when it was computed. For that, the cache is
replaced by another one of the same function when the bundle is loaded, wherever a name, an attribute, a dict or a
closure holds it. What can't be compared is forgotten or put back after each call, without a failure: what a cached
property has computed, a cache that is held elsewhere, and the attributes of a node of the user's own class, which may
count its calls. A function that reaches one of these never runs beside another one.
"""

from __future__ import annotations

import dis
import functools
import gc
import sys
import types
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from enum import Enum
from logging import Logger
from typing import Any, Final

from epypes.bundle.private_import import import_module, plain_name
from epypes.bundle.proof.libraries import OF_THE_PROCESS
from epypes.bundle.proof.process_settings import (
    draws_or_seeds,
)
from epypes.bundle.proof.records import (
    OF_PYTHON,
    Bindings,
    Content,
    HiddenAttributes,
    LibraryBindings,
    always_another,
    bound,
    can_be_patched,
    has_pickling,
    leave,
    pickled,
    read_cell,
    read_getters,
    unreadable_setters,
    write_cell,
)
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
from epypes.pipeline import Node, Pipeline
from epypes.run.guard import WATCH, is_array
from epypes.run.snapshot import (
    Found,
    Record,
    Snapshot,
    array_record,
    as_dict,
    cached_properties,
    is_global_generator,
    is_numpy_scalar,
    is_own,
)

CACHED: Final = type(functools.cache(len))
# An attribute of an lru_cache: the one that takes its place.
_CHECKED: Final = "__epypes_checked__"
# An attribute of that one: the snapshots of its mutable values.
_VALUES: Final = "__epypes_values__"
# Another: the names that the code has which may ask for its values.
_WORDS: Final = "__epypes_words__"
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
# Code with one of these notices that an array is locked, and may go on: its arrays are compared instead.
NOTICES_LOCKS: Final = frozenset(
    {"except", "suppress", "__exit__", "exception", "flags", "__array_interface__", "__array_struct__", "ctypes"}
    | {"Thread", "ThreadPoolExecutor", "submit"}
)
# Inference sessions are too large to compare, and their weights change where they are trained alone.
_OF_NETWORKS: Final = frozenset({"onnxruntime", "openvino", "tensorflow", "tflite_runtime", "torch"})
# Objects that Python hands on, such as partials, patterns and locks: what they hold is looked at, or never changes.
_HANDED_ON: Final = frozenset(
    {"_contextvars", "_operator", "_thread", "_weakref", "builtins", "contextvars", "datetime", "epypes", "functools"}
    | {"operator", "re", "threading", "types", "typing", "weakref", "zoneinfo"}
)
# By these code binds names that its instructions don't say.
_BINDS_BY_TEXT: Final = frozenset({"setattr", "delattr", "vars", "__dict__", "__setattr__", "__delattr__"})
_SAME_MODULE: Final = {"posix": "os", "nt": "os", "_locale": "locale", "_decimal": "decimal", "_csv": "csv"}


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
    words
        Names that the code has which gets the values, besides those that are met.

    Attributes
    ----------
    resets
        What puts back or forgets, after each call, what a call may change without a failure.
    nodes
        The nodes and pipelines that were met, by id.
    words
        The names that the code has, its instructions, and the names of the libraries whose objects it names.
    draws, seeds
        The functions of the random generators of the whole process by which the code draws, and whether it seeds one.
    has_code
        Whether code of the user was met.
    """

    def __init__(
        self,
        functions: Mapping[str, object],
        compared: dict[int, object],
        *,
        lock: bool = True,
        words: Collection[str] = (),
    ) -> None:
        self._compared, self._lock = compared, lock
        self.resets: list[Callable[[], object]] = []
        self.nodes: dict[int, Node] = {}
        self._caches: list[tuple[str, Any, list[CodeSnapshot]]] = []
        self.words: set[str] = {*words}
        self.draws: set[str] = set()
        self.seeds = False
        self.has_code = False
        # What is compared or reset if the code has one of the names or instructions.
        self._possible: list[tuple[frozenset[str], Callable[[], object]]] = []
        # The modules, classes and functions of libraries that the code names.
        self._of_libraries: dict[int, tuple[str, Any]] = {}
        super().__init__(functions)
        for needed, add in self._possible:
            if needed & self.words:
                add()
        self._possible.clear()
        for _, cached, _ in self._caches:
            vars(cached).setdefault(_WORDS, set()).update(self.words)
        self._compare_libraries()

    def __bool__(self) -> bool:
        return bool(self.records or self.resets or self._caches)

    def changed(self) -> str | None:
        """Return the first object that has changed, by the name that the code knows it by; None if there is none.

        It is "" where libraries alone have computed something that is put back without a failure.
        """
        is_quiet = False
        for record in self.records:
            if record.differs():
                name = record.changed_name() if isinstance(record, Bindings) else record.name
                if name:
                    return name
                is_quiet = True
        for name, _, values in self._caches:
            for value in values:
                changed = value.changed()
                if changed:
                    return name
                is_quiet |= changed is not None
        return "" if is_quiet else None

    def reset(self) -> None:
        """Put back or forget what a call may change without a failure."""
        for reset in self.resets:
            reset()
        for _, _, values in self._caches:
            for value in values:
                value.reset()

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
        self._note_draw(value)
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
        if kind is CACHED:
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
                self._compare(_BINDS, functools.partial(Bindings, f"{kind.__name__}.{value.name}.", value))
        elif kind is Logger:
            self.records.append(Bindings(f"{name}.", value))
        elif not is_array(value) and type(attributes) is dict:
            # A library's own code may not take read-only arrays.
            self._compared.update((id(part), part) for part in attributes.values() if is_array(part))
        known, may_hide = len(self.records), _may_hide(value)
        if may_hide:
            self._compared.update((id(part), part) for part in gc.get_referents(value) if is_array(part))
        yield from super().look_at(name, value)
        if may_hide and (type(attributes) is dict or len(self.records) == known):
            yield from self._look_at_hidden(name, value)

    def _look_at_hidden(self, name: str, value: Any) -> Found:
        """Look at what an object of a library has in private attributes, or where Python can't see it."""
        kind, attributes = type(value), getattr(value, "__dict__", None)
        is_of_cv2 = str(kind.__module__).partition(".")[0] == "cv2"
        if is_of_cv2 and not is_model_of_cv2(value):
            self.records.append(Content(name, value, read_getters, leave))
            self._compare(unreadable_setters(kind), functools.partial(Content, name, value, always_another, leave))
        elif not is_of_cv2 and pickled(value) and (type(attributes) is not dict or has_pickling(kind)):
            self.records.append(Content(name, value, pickled, leave))
        elif type(attributes) is dict:
            record = HiddenAttributes(f"{name}.", value, self.words)
            self.records.append(record)
            yield from ((name, part) for part in as_dict(record.saved).values())
        else:
            self.records.append(Content(name, value, always_another, leave))

    def look_at_array(self, name: str, value: Any) -> Found:
        """Lock an array, instead of making a copy of it to compare with."""
        if self._lock and id(value) not in self._compared:
            value.setflags(write=False)
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
        _check_caches(known)
        self._compare(_BINDS, functools.partial(Bindings, "", known))
        self._compare(_BINDS, functools.partial(Bindings, f"{function.__name__}.", function))
        for inner in nested_codes(code):
            self._note_instructions(inner)
        for part in attributes_loaded(function):
            self._note_draw(part)
        yield from meanings_of(function, global_names(code)).items()
        for name in imported_modules(function):
            # A module of the bundle is imported now: what it holds when a call imports it could not be put back.
            module = sys.modules.get(name)
            if plain_name(name) != name:
                with suppress(Exception):  # the function raises the same when it is called
                    module = import_module(name)
            yield plain_name(name), module
        for name, cell in cells_of(function).items():
            cell.cell_contents = comparable_cache(cell.cell_contents)
            self._compare(_BINDS, functools.partial(Record, name, cell, read_cell, write_cell))
            yield name, cell.cell_contents
        yield from defaults_of(function).items()
        attributes = function.__dict__.items()
        yield from ((f"{function.__name__}.{name}", value) for name, value in attributes if name != WATCH)

    def _note_draw(self, value: Any) -> None:
        """Note a function that draws from a random generator of the whole process, or seeds it."""
        is_draw, is_seed = draws_or_seeds(value)
        self.draws |= {value.__name__} if is_draw else set()
        self.seeds |= is_seed

    def _note_instructions(self, code: types.CodeType) -> None:
        """Note the names of some code, also those that are texts, and the instructions by which it binds them."""
        self.has_code, handlers = True, 0
        self.words.update(code.co_names, (text for text in code.co_consts if type(text) is str and text.isidentifier()))
        for instruction in dis.get_instructions(code):
            operation, name = instruction.opname, instruction.argval
            handlers += {"PUSH_EXC_INFO": 1, "WITH_EXCEPT_START": -1}.get(operation, 0)
            if operation.startswith(("STORE_", "DELETE_")):
                is_free = operation.endswith("_DEREF") and name in code.co_freevars
                self.words |= {operation, f"{operation} {name}", *(["nonlocal"] if is_free else [])}
        self.words |= {"except"} if handlers > 0 else set()

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
        self._compare(_BINDS, functools.partial(Bindings, prefix, owner))
        yield from ((f"{prefix}{name}", value) for name, value in bound(owner).items() if name not in OF_PYTHON)

    def _look_at_node(self, name: str, node: Node) -> Found:
        """Look into a node of a nested graph; what EPypes itself has in it is no state of the user's."""
        self.nodes[id(node)] = node
        if isinstance(node, Pipeline):
            yield from node.cg.functions.items()
            return
        yield name, node.func
        yield type(node).__name__, type(node)
        if type(node) is not Node:
            record = Bindings(f"{name}.", node)
            self._possible.append((_BINDS, lambda: self.resets.append(record.restore)))
            yield from ((f"{name}.{key}", value) for key, value in bound(node).items())

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
            if can_be_patched(owner, names) and prefix.partition(".")[0] not in OF_THE_PROCESS:
                self.records.append(LibraryBindings(prefix, owner, names))
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


def _may_hide(value: Any) -> bool:
    """Whether a value is an object of a library, which may have content that no other way of comparing sees."""
    kind = type(value)
    home = str(kind.__module__).partition(".")[0]
    if is_own(str(kind.__module__)) or home in _HANDED_ON | _OF_NETWORKS or is_numpy_scalar(kind):
        return False
    is_container = isinstance(value, tuple | list | dict | set | Logger | Enum) or is_array(value)
    is_of_pandas = home == "pandas" and hasattr(value, "equals")
    is_executor = any(base.__name__ in ("Executor", "dnn_Net") for base in kind.__mro__)
    is_known = is_container or is_of_pandas or is_executor or is_global_generator(value)
    return not is_known and not (callable(value) and hasattr(value, "__name__"))


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


# -- caches --------------------------------------------------------------------------------------------------------


def _check_caches(owner: Any) -> None:
    """Replace each lru_cache among the values of a dict or the attributes of a class by one that is compared."""
    names = owner if type(owner) is dict else vars(owner)
    for name, part in [*names.items()]:
        checked = comparable_cache(part)
        if checked is not part and isinstance(owner, type):
            type.__setattr__(owner, name, checked)
        elif checked is not part:
            names[name] = checked


def comparable_cache(cached: Any) -> Any:
    """Return a cache of the same function whose values are compared; what is no lru_cache of the user's as it is."""
    if type(cached) in (staticmethod, classmethod):
        checked = comparable_cache(cached.__func__)
        return cached if checked is cached.__func__ else type(cached)(checked)
    if type(cached) is not CACHED or not is_own(str(cached.__module__)):
        return cached
    if _CHECKED in vars(cached):
        return vars(cached)[_CHECKED]
    function = cached.__wrapped__
    values: list[CodeSnapshot] = []

    def compute(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        words = vars(made).get(_WORDS, frozenset())
        snapshot = CodeSnapshot({"its value": result}, {}, lock=not NOTICES_LOCKS & words, words=words)
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
