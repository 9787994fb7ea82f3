"""What a stored result is keyed by, and which results of a series need not be computed again."""

from __future__ import annotations

import ast
import copyreg
import datetime
import decimal
import dis
import enum
import fractions
import functools
import hashlib
import sys
import threading
import types
import uuid
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path, PurePath
from time import monotonic
from types import MappingProxyType
from typing import Any, Final, Self
from warnings import warn

from epypes.batch.items import Item
from epypes.batch.results import Outcome
from epypes.bundle import to_source
from epypes.bundle.requirements import bringing
from epypes.bundle.text import nested_codes
from epypes.errors import MessageError, PlaceholderNeeded, ScaleError, SourceRefused, StoreError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.run.guard import is_array, is_plain_array
from epypes.store import Series, Store
from epypes.wire.encoder import ValueWriter
from epypes.wire.protobuf import message_class

_OURS: Final = "epypes"
# The folders that pip, and Debian's packages, install into.
_INSTALLED: Final = frozenset({"site-packages", "dist-packages"})
_READS_NAME: Final = frozenset({"LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"})
# Builtins by which code reaches what its names don't say.
_BY_TEXT: Final = frozenset({"eval", "exec", "globals", "__import__"})
_ATTRIBUTES_BY_TEXT: Final = frozenset({"getattr", "vars", "__dict__"})
_LEAVES: Final = (
    type(None),
    bool,
    int,
    float,
    complex,
    str,
    bytes,
    bytearray,
    type(...),
    type(NotImplemented),
    PurePath,
)
_LOCKS: Final = (type(threading.Lock()), type(threading.RLock()))
_LAYOUT: Final = (types.MemberDescriptorType, types.GetSetDescriptorType)
_BUILT_IN_METHODS: Final = (types.BuiltinFunctionType, types.MethodWrapperType)
# Entries of a class that say where it stands, or that Python makes from the others, some when an object is pickled.
_NO_BEHAVIOUR: Final = frozenset(
    [
        "__annotations_cache__",
        "__dict__",
        "__doc__",
        "__firstlineno__",
        "__module__",
        "__slotnames__",
        "__static_attributes__",
        "__weakref__",
        "_abc_impl",
    ]
)
# Attributes that an object fills when it is used: caches and accounts.
_DERIVED: Final = {
    "numpy.vectorize": {"_ufunc"},
    "epypes.pipeline.node.Node": {"duration_ns", "run_count", "next_count"},
}
_SINGLE_DISPATCH: Final = frozenset(nested_codes(functools.singledispatch.__code__))


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """What tells a computation from others.

    Attributes
    ----------
    code
        A digest of functions, classes, modules and immutable values: changes when code is edited.
    state
        A digest of what is in lists, dicts, arrays and objects that functions reach: a call may change it.
    unknown
        The first thing that can't be seen through, in words; "" if there is none. A computation with one may be
        another one although the digests are the same.
    """

    code: str
    state: str
    unknown: str


def graph_fingerprint(cg: CompGraph, source: str | None) -> Fingerprint:
    """Return the fingerprint of what a graph computes.

    Parameters
    ----------
    cg
        The graph.
    source
        What ``to_source`` has made of it, which says how objects are made that can't be seen through. None: refused.

    Notes
    -----
    Modules count by what is in their files as well, those of installed distributions by their versions.
    """
    walk = _Walk()
    walk.graph(cg)
    modules = walk.modules | (set(_imports(source.encode("utf-8", "surrogatepass"), "", False)) if source else set())
    code = combined_digest("computation", source or "", walk.code.digest(), sys.version, *_versions(modules)).hex()
    return Fingerprint(code, walk.state.hexdigest(), walk.unknown if source is None else "")


def function_digest(function: Callable[..., Any]) -> str:
    """Return the digest of a function; what is installed counts by its name.

    Raises
    ------
    Untold
        It reaches something that can't be seen through.
    """
    walk = _Walk()
    walk.value(function)
    if walk.unknown:
        raise NoDigest(walk.unknown)
    return walk.digest().hex()


class _Walk:
    """One digest of all that is reached, in an order that is the same in every process.

    An object that is reached again counts by the number that it got the first time, so cycles end, and the walk takes
    time linear in what there is. Immutable values are written each time: whether equal ones are one object differs
    from process to process.
    """

    def __init__(self) -> None:
        self.code = hashlib.blake2b(digest_size=16)
        self.state = hashlib.blake2b(digest_size=16)
        self._into = self.code
        # With the objects themselves, so that no other gets the identity of one.
        self._numbers: dict[int, tuple[int, Any]] = {}
        self._path: list[str] = []
        self.modules: set[str] = set()
        self.unknown = ""

    def digest(self) -> bytes:
        return combined_digest("", self.code.digest(), self.state.digest())

    def graph(self, cg: CompGraph) -> None:
        self._put("graph", str(len(cg.functions)))
        for name, function in cg.functions.items():
            self._put(name, repr(cg.func_io[name]))
            self._named({name: function})

    def value(self, value: Any) -> None:
        """Add a value, and all that it reaches."""
        try:
            self._value(value)
        except RecursionError:
            self._opaque(value)

    def _put(self, *texts: str | bytes) -> None:
        self._into.update(combined_digest("", *texts))

    def _opaque(self, value: Any, why: str = "") -> None:
        kind = type(value).__qualname__
        self._put("unknown", kind)
        place = f" as {self._path[-1]!r}" if self._path else ""
        self.unknown = self.unknown or (why or f"a {kind!r}") + place

    def _value(self, value: Any) -> None:
        kind = type(value)
        if kind in _LEAVES or (isinstance(value, PurePath) and _is_installed(kind.__module__)):
            self._put("value", value_digest(value))
        elif kind is tuple:
            self._all("tuple", value)
        elif kind in (set, frozenset):
            self._set(value)
        elif name := self._installed_name(value):
            self._put("installed", name)
        elif id(value) in self._numbers:
            self._put("again", str(self._numbers[id(value)][0]))
        else:
            self._numbers[id(value)] = len(self._numbers), value
            self._new(value)

    @contextmanager
    def _in_state(self) -> Iterator[None]:
        before, self._into = self._into, self.state
        try:
            yield
        finally:
            self._into = before

    def _new(self, value: Any) -> None:
        way = next((way for kind, way in _WAYS if isinstance(value, kind)), None)
        if way is not None:
            way(self, value)
        elif is_array(value):
            self._array(value)
        elif isinstance(cg := getattr(value, "cg", None), CompGraph):
            self._runner(value, cg)
        else:
            self._object(value)

    # -- containers -------------------------------------------------------------------------------------------------

    def _all(self, kind: str, values: Iterable[Any]) -> None:
        values = list(values)
        self._put(kind, str(len(values)))
        for value in values:
            self._value(value)

    def _list(self, found: list[Any]) -> None:
        if type(found) is list:
            with self._in_state():
                self._all("list", found)
        else:
            self._object(found)

    def _dict(self, found: Mapping[Any, Any]) -> None:
        if type(found) in (dict, types.MappingProxyType):
            with self._in_state():
                self._all("dict", (part for item in list(found.items()) for part in item))
        else:
            self._object(found)

    def _set(self, found: Iterable[Any]) -> None:
        """Add the members in the order of digests of their own: the set's order is another one in each process."""
        walks = []
        for member in list(found):
            walk = _Walk()
            walk._path = self._path
            walk.value(member)
            self.modules |= walk.modules
            self.unknown = self.unknown or walk.unknown
            walks.append(walk.digest())
        with self._in_state() if type(found) is set else nullcontext():
            self._put("set", *sorted(walks))

    def _named(self, values: Mapping[str, Any]) -> None:
        self._put("names", str(len(values)))
        for name in sorted(values):
            self._put(name)
            self._path.append(name)
            self._value(values[name])
            self._path.pop()

    # -- code -------------------------------------------------------------------------------------------------------

    def _function(self, function: types.FunctionType) -> None:
        code = function.__code__
        self.modules.add(str(function.__module__))
        self._put("function", function.__qualname__)
        self._code(code)
        self._value(function.__defaults__)
        self._named(function.__kwdefaults__ or {})
        self._named(_annotations(function))
        cells = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
        if code in _SINGLE_DISPATCH:
            # Beside its registry it keeps a cache, which each call may fill.
            self._named({"registry": cells.get("registry", function.__dict__.get("registry"))})
        else:
            self._named(vars(function))
            self._named(cells)
        if not _is_installed(str(function.__globals__.get("__name__", ""))):
            self._named(self._globals(function))

    def _globals(self, function: types.FunctionType) -> dict[str, Any]:
        """Return the globals that a function reads, and of modules of the user's what is read of them, by name."""
        found = function.__globals__
        codes = list(nested_codes(function.__code__))
        attributes = {name for code in codes for name in code.co_names}
        instructions = (one for code in codes for one in dis.get_instructions(code) if one.opname in _READS_NAME)
        names = {one.argval for one in instructions}
        by_text = sorted(_BY_TEXT.intersection(names) - found.keys())
        if by_text or "import_module" in attributes:
            self._opaque(function, f"a call of {(by_text or ['import_module'])[0]!r}")
        read: dict[str, Any] = {}
        seen: set[str] = set()
        waiting = [(name, found[name]) for name in names if name in found]
        while waiting:
            name, value = waiting.pop()
            read[name] = value
            if isinstance(value, types.ModuleType) and value.__name__ not in seen and not _is_installed(value.__name__):
                seen.add(value.__name__)
                own = vars(value)
                of_it = set(own) if _ATTRIBUTES_BY_TEXT & (names | attributes) else attributes.intersection(own)
                waiting += [(f"{name}.{one}", own[one]) for one in sorted(of_it) if not one.startswith("__")]
        return read

    def _code(self, code: types.CodeType) -> None:
        counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        self._put("code", code.co_code, code.co_exceptiontable, repr((counts, names)))
        self._all("constants", code.co_consts)

    def _partial(self, found: functools.partial[Any]) -> None:
        self._all("partial", (type(found), found.func, found.args))
        self._named(found.keywords)
        self._named(vars(found))

    def _cell(self, cell: types.CellType) -> None:
        try:
            content = cell.cell_contents
        except ValueError:  # nothing has been assigned yet
            self._put("empty cell")
            return
        self._value(content)

    def _module(self, module: types.ModuleType) -> None:
        self.modules.add(module.__name__)
        self._put("module", module.__name__)
        if module.__name__ == "__main__":
            self._opaque(module)

    # -- objects ----------------------------------------------------------------------------------------------------

    def _class(self, found: type) -> None:
        self.modules.add(found.__module__)
        self._put("class", found.__qualname__)
        self._value(type(found))
        self._value(found.__bases__)
        own = {name: value for name, value in vars(found).items() if name not in _NO_BEHAVIOUR}
        if isinstance(found, enum.EnumMeta):
            # Beside the members an enumeration has tables of them, which may grow when it is used.
            members: Mapping[str, Any] = found.__members__
            own = {
                name: own[name] for name in own if name not in members and not (name[0] == name[-1] == "_" != name[1])
            }
            self._all("members", ((name, member.name, member.value) for name, member in members.items()))
        self._named(own)

    def _member(self, member: enum.Enum) -> None:
        self._all("member", (type(member), member.name, member.value))
        self._named({name: value for name, value in vars(member).items() if name[0] != "_"})

    def _array(self, array: Any) -> None:
        try:
            with self._in_state():
                self._put("array", value_digest(array))
        except NoDigest:  # of objects that are no plain values
            self._object(array)

    def _runner(self, runner: Any, cg: CompGraph) -> None:
        """Add what a runner or a pipeline computes; beside that, it keeps accounts of each run."""
        self._value(type(runner))
        self.graph(cg)
        self._named(getattr(getattr(runner, "runner", runner), "hyperparameters", {}))
        if not _is_installed(type(runner).__module__):
            self._object(runner)

    def _object(self, value: Any) -> None:
        """Add the class and the state of an object, as it would be pickled, and of an own class all attributes."""
        self._value(type(value))
        with self._in_state():
            self._content(value)

    def _content(self, value: Any) -> None:
        kind = type(value)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reduce = copyreg.dispatch_table.get(kind)
                reduced: Any = reduce(value) if reduce else value.__reduce_ex__(4)
        except Exception:  # whatever a class raises that can't be pickled
            self._unpicklable(value)
            return
        if isinstance(reduced, str):
            self._by_name(value, reduced)
        else:
            make, arguments, state, items, pairs = (*reduced, *(None,) * 5)[:5]
            self._all(
                "object", (make, arguments, self._lasting_state(value, state), *map(list, filter(None, (items, pairs))))
            )
        if not _is_installed(kind.__module__):
            self._all("attributes", (self._lasting_state(value, object.__getstate__(value)),))

    def _lasting_state(self, value: Any, state: Any) -> Any:
        """Return a state without what is computed from the rest when it is first needed, or counts calls."""
        if isinstance(state, tuple) and len(state) == 2 and isinstance(state[0], dict):
            return self._lasting_state(value, state[0]), state[1]
        if not isinstance(state, dict):
            return state
        kinds = [f"{one.__module__}.{one.__qualname__}" for one in type(value).__mro__]
        derived = {name for kind in kinds for name in _DERIVED.get(kind, ())}
        derived |= {
            name
            for one in type(value).__mro__
            for name, found in vars(one).items()
            if isinstance(found, functools.cached_property)
        }
        return {name: state[name] for name in sorted(state, key=str) if name not in derived}

    def _by_name(self, value: Any, name: str) -> None:
        module = getattr(value, "__module__", None) or _module_of(value, name)
        self.modules.add(module)
        self._put("global", module, name)
        if _found(module, name) is not value:
            self._opaque(value)

    def _unpicklable(self, value: Any) -> None:
        try:
            # Such as key points of OpenCV, which travel as messages.
            self._put("value", value_digest(value))
        except NoDigest:
            self._opaque(value)

    def _installed_name(self, value: Any) -> str:
        """Return the name by which a function or class of an installed package is imported; "" for any other value."""
        if not callable(value):
            return ""
        owner = getattr(value, "__self__", None)
        module = owner.__name__ if isinstance(owner, types.ModuleType) else getattr(value, "__module__", None)
        module = module or type(value).__module__
        name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
        if not isinstance(name, str) or not isinstance(module, str) or not _is_installed(module):
            return ""
        if _found(module, name) is not value:
            return ""
        self.modules.add(module)
        return f"{module}.{name}"


_WAYS: Final[tuple[tuple[Any, Callable[[_Walk, Any], None]], ...]] = (
    (types.FunctionType, _Walk._function),
    (types.CodeType, _Walk._code),
    (types.CellType, _Walk._cell),
    (types.ModuleType, _Walk._module),
    (enum.Enum, _Walk._member),
    (type, _Walk._class),
    (list, _Walk._list),
    ((dict, types.MappingProxyType), _Walk._dict),
    (types.MethodType, lambda walk, found: walk._all("method", (found.__self__, found.__func__))),
    (_BUILT_IN_METHODS, lambda walk, found: walk._all("method", (found.__name__, found.__self__))),
    ((staticmethod, classmethod), lambda walk, found: walk._all(type(found).__name__, (found.__func__,))),
    (property, lambda walk, found: walk._all("property", (found.fget, found.fset, found.fdel))),
    (functools._lru_cache_wrapper, lambda walk, found: walk._named(vars(found))),
    (functools.partial, _Walk._partial),
    (_LAYOUT, lambda walk, found: walk._put("slot", found.__name__)),
    # They have no state but that of this moment.
    (_LOCKS, lambda walk, found: walk._put("lock")),
    (CompGraph, _Walk.graph),
)


def _found(module: str, name: str) -> Any:
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def _module_of(value: Any, name: str) -> str:
    """Return the module in which a name stands for a value that doesn't say where it was made."""
    return next((module for module in list(sys.modules) if _found(module, name) is value), "__main__")


def _annotations(function: types.FunctionType) -> Mapping[str, Any]:
    try:
        return function.__annotations__
    except NameError:  # from Python 3.14 on they are evaluated when they are read
        return {}


def _is_installed(module: str) -> bool:
    root = module.partition(".")[0]
    if root == "__main__":
        return False
    if root in sys.stdlib_module_names or root == _OURS:
        return True
    file = getattr(sys.modules.get(root), "__file__", None)
    return file is not None and not _INSTALLED.isdisjoint(Path(file).parts)


# -- modules ----------------------------------------------------------------------------------------------------


def _versions(modules: Iterable[str]) -> list[str]:
    """Return a line for each module that these need, and each of its own kind that those import."""
    waiting, found = sorted(modules), dict[str, str]()
    seen: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        top = name.partition(".")[0]
        if top in sys.stdlib_module_names:
            found["python"] = sys.version
        elif top == _OURS:
            found[top] = metadata.version(_OURS)
        elif (spec := _spec(name)) is not None and spec.origin is not None:
            installed = _installed(top, spec.origin)
            if installed:
                found[top] = installed
            else:
                content = _bytes(spec.origin)
                found[name] = hashlib.sha256(content).hexdigest()
                is_package = spec.submodule_search_locations is not None
                waiting += _imports(content if spec.origin.endswith(".py") else b"", name, is_package)
    return sorted(f"{name} {version}" for name, version in found.items())


def _bytes(file: str) -> bytes:
    try:
        return Path(file).read_bytes()
    except OSError:
        return b""


def _spec(name: str) -> ModuleSpec | None:
    """Return where a module is, without importing it: what is computed is the same before and after."""
    path: Any = None
    spec = None
    parts = name.split(".")
    for end in range(1, len(parts) + 1):
        full = ".".join(parts[:end])
        try:
            spec = getattr(sys.modules.get(full), "__spec__", None) or PathFinder.find_spec(full, path)
        except (ImportError, KeyError, ValueError):  # of a folder without __init__.py that is not imported yet
            return None
        if spec is None:
            return None
        path = spec.submodule_search_locations
    return spec


def _installed(top: str, file: str) -> str:
    """Return the versions of the distributions that have brought a file; "" if none has, or from an editable folder."""
    if _INSTALLED.isdisjoint(Path(file).parts):
        return ""
    return ", ".join(f"{name}=={metadata.version(name)}" for name in bringing(top))


@lru_cache(512)
def _imports(source: bytes, module: str, is_package: bool) -> tuple[str, ...]:
    """Return the names of all that a module may import, wherever in it."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return ()
    package = module if is_package else module.rpartition(".")[0]
    found: set[str] = {package} - {""}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= _from(node, package)
    return tuple(sorted(found))


def _from(node: ast.ImportFrom, package: str) -> set[str]:
    parts = package.split(".")
    above = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
    origin = ".".join(filter(None, (above, node.module)))
    # A name that is taken from a package may be a module of it.
    return {origin, *(f"{origin}.{alias.name}" for alias in node.names)} - {""}


_BYTES: Final = 16
_SHOWN: Final = 60
_SCALARS: Final = (type(None), bool, int, float, complex, str)
# Their repr says all that is in them.
_SAID: Final = (
    datetime.date,
    datetime.time,
    datetime.datetime,
    datetime.timedelta,
    datetime.timezone,
    decimal.Decimal,
    fractions.Fraction,
    uuid.UUID,
    range,
    type(...),
)


class NoDigest(TypeError):
    """A value of which nobody can say what is in it."""


def value_digest(value: Any) -> str:
    """Return what tells a value from others: arrays of any kind, containers, enumerations, numbers, texts, files.

    A path stands for what is in its file. Beside these, all that `epypes.wire` has a codec for.

    Raises
    ------
    Untold
        It is, or holds, something of which that can't be said; or a file that can't be read.
    """
    try:
        return _digest(value).hex()
    except RecursionError as error:
        raise NoDigest(f"a {type(value).__name__!r} that holds itself") from error


def told(value: Any) -> str:
    """Return a value as a person reads it, with its digest if that does not say all.

    Raises
    ------
    Untold
        As for `digest_of`.
    """
    digest = value_digest(value)
    if _is_short(value) and len(text := repr(value)) <= _SHOWN:
        return text
    what = f"{value.dtype} {value.shape}" if is_plain_array(value) else type(value).__name__
    return f"{value} {digest}" if isinstance(value, enum.Enum) else f"{what} {digest}"


def combined_digest(kind: str, *parts: bytes | memoryview | str) -> bytes:
    """Return a digest of several parts, each of which is told from its neighbours."""
    made = hashlib.blake2b(kind.encode(), digest_size=_BYTES)
    for part in parts:
        raw = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        made.update(b"\0%d:" % len(raw))
        made.update(raw)
    return made.digest()


def _is_short(value: Any) -> bool:
    if type(value) in (tuple, list):
        return len(value) <= _SHOWN and all(map(_is_short, value))
    # A long number takes long to write, and of one that is too long Python refuses to.
    return type(value) in _SCALARS and not (type(value) is int and value.bit_length() > _SHOWN * 4)


def _digest(value: Any) -> bytes:
    plain = _BY_TYPE.get(type(value))
    if plain is not None:
        return plain(value)
    if is_array(value):
        return _of_array(value)
    found = next((way for kind, way in _BY_CLASS if isinstance(value, kind)), None)
    if found is not None:
        return found(value)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return _of_items(value)
    return _of_scalar(value) if _is_numpy_scalar(value) else _of_wire(value)


def _kind(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _of_text(value: Any) -> bytes:
    return combined_digest(_kind(value), repr(value))


def _of_int(value: int) -> bytes:
    # In time linear in its length; and Python refuses to write very long ones as decimals.
    return combined_digest("int", hex(value))


def _of_str(value: str) -> bytes:
    return combined_digest("str", value)


def _of_bytes(value: Any) -> bytes:
    return combined_digest(_kind(value), bytes(value))


def _of_view(value: memoryview) -> bytes:
    return combined_digest("memoryview", repr(value.format), repr(value.shape), value.tobytes())


def _of_items(value: Iterable[Any]) -> bytes:
    return combined_digest(_kind(value), *map(_digest, value))


def _of_set(value: Iterable[Any]) -> bytes:
    return combined_digest(_kind(value), *sorted(map(_digest, value)))


def _of_dict(value: Mapping[Any, Any]) -> bytes:
    return combined_digest(_kind(value), *(_digest(part) for item in value.items() for part in item))


def _of_member(value: enum.Enum) -> bytes:
    return combined_digest(_kind(value), str(value.name), _digest(value.value))


def _of_class(value: type) -> bytes:
    return combined_digest("type", f"{value.__module__}.{value.__qualname__}")


def file_digest(path: Path) -> str:
    """Return a digest of what is in a file, and of the end of its name, which decides how it is read.

    Raises
    ------
    Untold
        There is no such file, or it can't be read.
    """
    try:
        # Who opens a pipe waits for somebody who writes into it.
        if not path.is_file():
            raise NoDigest(f"{str(path)!r}, which is no file")
        with path.open("rb") as file:
            # The fastest one that there is: processors compute it themselves.
            found = hashlib.file_digest(file, "sha256").digest()
    except OSError as error:
        raise NoDigest(f"{str(path)!r}, which can't be read: {error.strerror}") from error
    return combined_digest("file", path.suffix.lower(), found).hex()


def _of_path(value: PurePath) -> bytes:
    """Return a digest of a path that is handed on as it is: of the name, and of the file if there is one."""
    try:
        return combined_digest("path", str(value), file_digest(Path(value)))
    except NoDigest:
        return combined_digest("path", str(value))


def _is_numpy_scalar(value: Any) -> bool:
    return getattr(value, "shape", None) == () and hasattr(value, "dtype") and hasattr(value, "tobytes")


# NumPy's long doubles have bytes that mean nothing.
_PADDED: Final = "gG"


def _of_scalar(value: Any) -> bytes:
    content = repr(value) if value.dtype.char in _PADDED else value.tobytes()
    return combined_digest(_kind(value), repr(value.dtype.descr), content)


def _of_array(array: Any) -> bytes:
    import numpy as np

    plain = np.asarray(array)
    described = _kind(array), repr(plain.dtype.descr), repr(plain.shape)
    if plain.dtype.hasobject or plain.dtype.char in _PADDED:
        content: bytes | memoryview = _digest(plain.tolist())
    else:
        content = np.ascontiguousarray(plain).reshape(-1).view(np.uint8).data if plain.nbytes else b""
    if isinstance(array, np.ma.MaskedArray):
        more = _digest((np.ma.getmaskarray(array), array.fill_value, bool(array.hardmask)))
    else:
        # What a class of somebody's own keeps beside the numbers, such as a unit.
        more = _digest(dict(getattr(array, "__dict__", {}))) if type(array) is not np.memmap else b""
    return combined_digest("array", *described, content, more)


def _of_wire(value: Any) -> bytes:
    message, writer = message_class("epypes.v1.Value")(), ValueWriter()
    try:
        writer.write_named(message, value, "value")
    except MessageError as error:
        raise NoDigest(f"a {type(value).__name__!r}") from error
    beside = (_digest(payload.data) for payload in writer.payloads)
    return combined_digest(_kind(value), message.SerializeToString(deterministic=True), *beside)


_BY_TYPE: Final[Mapping[type, Callable[[Any], bytes]]] = {
    int: _of_int,
    str: _of_str,
    bytes: _of_bytes,
    bytearray: _of_bytes,
    memoryview: _of_view,
    list: _of_items,
    tuple: _of_items,
    dict: _of_dict,
    set: _of_set,
    frozenset: _of_set,
    type: _of_class,
    **dict.fromkeys((type(None), bool, float, complex, *_SAID), _of_text),
}
_BY_CLASS: Final[tuple[tuple[type, Callable[[Any], bytes]], ...]] = (
    (enum.Enum, _of_member),
    (PurePath, _of_path),
    (type, _of_class),
)


# What is lost at most if the process is killed; to write each outcome by itself would take longer than to make it.
_WRITE_EVERY_S: Final = 0.5
_NONE: Final[Mapping[str, Any]] = MappingProxyType({})


def series_of(
    store: Store, kind: str, runner: CompGraphRunner, name: str | None, varied: Collection[str] = ()
) -> tuple[Series, Fingerprint]:
    """Return the series in which outcomes of a runner are kept, and the fingerprint of its graph.

    Parameters
    ----------
    store
        Where it is.
    kind
        ``"map"``, or what else made the outcomes.
    runner
        Its graph and hyperparameters are what the series is of.
    name
        What it is called; a digest of graph and hyperparameters without.
    varied
        The hyperparameters that each outcome has its own values of.

    Warns
    -----
    UserWarning
        A function uses something that can't be seen through, so nothing that is stored counts.

    Raises
    ------
    ScaleError
        There is no name and the graph can't be written as text; or the series is of another graph or of other
        hyperparameters.
    """
    fixed = {token: value for token, value in runner.hyperparameters.items() if token not in varied}
    source, hyperparameters = _source_of(runner), _hyperparameters(fixed)
    found = graph_fingerprint(runner.cg, source)
    if name is None:
        if source is None:
            text = "What this graph computes can't be written as text, which would tell it from others. Give name=."
            raise ScaleError(text)
        name = combined_digest("", found.code, repr(hyperparameters)).hex()[:16]
    about = {"graph": found.code, "hyperparameters": hyperparameters}
    series = store.series(kind, name, about=about)
    _check_same(series, about)
    if found.unknown:
        text = f"The graph uses {found.unknown}, and nothing tells whether that has changed: every item is run again."
        warn(f"{text} Use functions, numbers, texts, arrays, or objects that can be pickled.", stacklevel=4)
    return series, found


def _source_of(runner: CompGraphRunner) -> str | None:
    try:
        return to_source(runner.cg)
    except (SourceRefused, PlaceholderNeeded):
        return None


def _texts_of(values: Mapping[str, Any]) -> dict[str, str]:
    return {token: told(value) for token, value in values.items()}


def _hyperparameters(values: Mapping[str, Any]) -> dict[str, str]:
    found: dict[str, str] = {}
    for token in values:
        try:
            found |= _texts_of({token: values[token]})
        except NoDigest as error:
            text = f"Hyperparameter {token!r} is or holds {error}: nothing tells it from others, as a store has to."
            raise ScaleError(f"{text} Make it of numbers, texts, arrays, lists or dicts.") from error
    return found


def _check_same(series: Series, about: Mapping[str, Any]) -> None:
    before = series.about
    was, now = before.get("hyperparameters", {}), about["hyperparameters"]
    changed = [token for token in {**was, **now} if was.get(token) != now.get(token)]
    if not changed and before.get("graph") == about["graph"]:
        return
    told = ", ".join(f"{token} was {was.get(token, 'free')} and is {now.get(token, 'free')}" for token in changed)
    raise ScaleError(
        f"Series {series.name!r} in the store is of another computation: {told or 'the graph has changed'}. "
        "Give another name=, or none."
    )


class StoredOutcomes:
    """The outcomes of a series; new ones are written a few at a time.

    Parameters
    ----------
    series
        The series.
    how
        What else decides about an outcome, such as the tokens of which thumbnails are made.
    are_whole
        Whether all that is wanted of an outcome is in the store; whole values of tokens are not.
    fingerprint
        That of the graph. Outcomes of another state don't count, and none does if it has an unknown.

    Notes
    -----
    An item is known again by its name and by what is in its files and values. One that holds something of which nobody
    can say what is in it is run each time, and not written.
    """

    def __init__(
        self, series: Series, how: str = "", are_whole: bool = True, fingerprint: Fingerprint | None = None
    ) -> None:
        self._series, self._how = series, how
        if fingerprint is not None:
            self._how = f"{how} state={fingerprint.state}"
            are_whole = are_whole and not fingerprint.unknown
        self._known = series.keys() if are_whole else frozenset()
        self._keys: dict[tuple[int, int], str] = {}
        self._of_item: tuple[int, str | None] = -1, None
        # With the settings themselves, so that no other has the identity of one.
        self._of_settings: dict[int, tuple[Mapping[str, Any], str | None]] = {id(_NONE): (_NONE, "")}
        self._waiting: list[tuple[str, dict[str, Any]]] = []
        self._written_s = monotonic()

    def recall(self, item: Item, setting: Mapping[str, Any] = _NONE) -> Outcome | None:
        """Return the outcome of an item, under a setting, that was run before; None if it has to be run."""
        of_item, of_setting = self._item_text(item), self._setting_text(setting)
        if of_item is None or of_setting is None:
            return None
        key = f"{of_item} {self._how}{of_setting}"
        found = self._series.get(key) if key in self._known else None
        if found is None:
            self._keys[item.number, id(setting or _NONE)] = key
            return None
        return replace(Outcome.from_json(found), number=item.number, name=item.name, setting=setting)

    def _item_text(self, item: Item) -> str | None:
        if self._of_item[0] != item.number:
            self._of_item = item.number, _told(lambda: f"{item.name} {payload_digest(item.payload)}")
        return self._of_item[1]

    def _setting_text(self, setting: Mapping[str, Any]) -> str | None:
        setting = setting or _NONE
        if id(setting) not in self._of_settings:
            self._of_settings[id(setting)] = setting, _told(lambda: f" {_texts_of(setting)}")
        return self._of_settings[id(setting)][1]

    def add(self, outcomes: Iterable[Outcome]) -> None:
        """Take outcomes of items that had to be run."""
        for outcome in outcomes:
            key = self._keys.pop((outcome.number, id(outcome.setting or _NONE)), None)
            # A file that could not be read may be there the next time.
            if key is not None and (outcome.error_info is None or outcome.error_info.function):
                self._waiting.append((key, outcome.to_json()))
        if monotonic() - self._written_s >= _WRITE_EVERY_S:
            self.write()

    def write(self) -> None:
        """Write what waits.

        Raises
        ------
        StoreError
            The store can't be written; then it still waits.
        """
        try:
            self._series.append_all(self._waiting)
            self._waiting.clear()
        except TypeError:
            # All or none are written, and one of them can't be.
            self._write_each()
        self._written_s = monotonic()

    def _write_each(self) -> None:
        while self._waiting:
            try:
                self._series.append(*self._waiting[0])
            except TypeError as error:
                warn(f"{error} It is run again the next time.", stacklevel=2)
            del self._waiting[0]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Write what waits; if something else has gone wrong before, that is what is raised."""
        try:
            self.write()
        except StoreError as failed:
            if error is None:
                raise
            if error is not failed:
                error.add_note(f"What waited to be stored could not be: {failed}")


def _told(what: Callable[[], str]) -> str | None:
    try:
        return what()
    except NoDigest:
        return None


def payload_digest(payload: Mapping[str, Any]) -> str:
    """Return what tells a payload from others: of every token the file's contents, or the value.

    Raises
    ------
    Untold
        A file can't be read, or nobody can say what is in a value.
    """
    parts = (
        (token, file_digest(value) if isinstance(value, Path) else value_digest(value))
        for token, value in sorted(payload.items())
    )
    return combined_digest("payload", *(text for part in parts for text in part)).hex()
