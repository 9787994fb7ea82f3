"""Fingerprints: digests of a value or a function and of everything that it refers to.

A digest covers a function's code, defaults, closure and attributes and the globals that it reads, and of each object
its class and its state. Installed packages and the standard library count by name; `versions_of` adds their versions.
A value is described as `pickle` would describe it, by its `__reduce_ex__`; in contrast to pickle, functions and classes
of the user count by what they do, also those of modules that a function imports when it is called.

Two things a digest can't cover: an object that pickle can't describe, such as a generator or an object of a C library,
is unknown; and what a function reads from files or the environment is not part of it. The digester names the first of
each, and then equal digests are no proof that nothing has changed.
"""

from __future__ import annotations

import copyreg
import dis
import enum
import functools
import hashlib
import importlib
import importlib.util
import sys
import threading
import types
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.bundle.notebook_source import nested_codes
from epypes.errors import MessageError
from epypes.graph import CompGraph
from epypes.run.guard import is_plain_array
from epypes.run.snapshot import is_own
from epypes.wire.encoder import ValueWriter
from epypes.wire.protobuf import message_class

_DIGEST_BYTES: Final = 16
_OURS: Final = "epypes"
# The folders that pip, and Debian's packages, install into.
_INSTALLED: Final = frozenset({"site-packages", "dist-packages"})
_READS_NAME: Final = frozenset({"LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"})
# Builtins by which code reads what its names don't say.
_BY_TEXT: Final = frozenset({"eval", "exec", "globals", "__import__"})
_ATTRIBUTES_BY_TEXT: Final = frozenset({"getattr", "vars", "__dict__"})
# Names by which code reads files or the environment: of Python, numpy, OpenCV, Pillow, pandas and scikit-image.
_READERS: Final = frozenset(
    {"environ", "environb", "fromfile", "genfromtxt", "getenv", "getenvb", "imread", "imreadmulti", "load", "loadtxt"}
    | {
        "memmap",
        "open",
        "open_memmap",
        "read_bytes",
        "read_csv",
        "read_parquet",
        "read_text",
        "urlopen",
        "VideoCapture",
    }
)
_LOADS_CONSTANT: Final = frozenset({"LOAD_CONST", "LOAD_SMALL_INT"})
_WATCHED: Final = "__epypes_"
_LEAVES: Final = (type(None), bool, float, complex, type(...), type(NotImplemented))
# Objects of these have all their content in what pickle writes of them.
_DATA_MODULES: Final = frozenset({"builtins", "collections", "datetime", "decimal", "fractions", "numpy", "uuid"})
# What these have is no data, whatever it is that has them.
_CODE: Final = (types.FunctionType, type, types.ModuleType)
# Entries of a class that say where it stands, or that Python makes from the others, some when an object is pickled.
_NO_BEHAVIOUR: Final = frozenset(
    {"__annotations_cache__", "__dict__", "__doc__", "__firstlineno__", "__module__", "__slotnames__"}
    | {"__static_attributes__", "__weakref__", "_abc_impl"}
)
# Attributes that an object fills when it is used: caches and counters.
_DERIVED: Final = {
    "numpy.vectorize": {"_ufunc"},
    "epypes.pipeline.node.Node": {"duration_ns", "run_count", "next_count"},
}


def combined_digest(*parts: bytes | memoryview | str) -> bytes:
    """Return a digest of several parts, each with its length, so that no two lists of parts have the same."""
    made = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    _add_parts(made, parts)
    return made.digest()


def file_digest(path: Path) -> str:
    """Return a digest of a file's content, and of its suffix, which decides how it is read; "" if it can't be read."""
    try:
        # To open a named pipe would wait for a process that writes into it.
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            # The fastest one: processors have instructions for it.
            content = hashlib.file_digest(file, "sha256").digest()
    except OSError:
        return ""
    return combined_digest("file", path.suffix.lower(), content).hex()


def _add_parts(made: Any, parts: Iterable[bytes | memoryview | str]) -> None:
    for part in parts:
        raw = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        made.update(b"\0%d:" % len(raw))
        made.update(raw)


class Digester:
    """The digest of a value and of all that it refers to, in an order that is the same in every process.

    An object that comes again counts by the number that it got the first time, so cycles end, and the time is linear
    in what there is. Immutable values are written each time: whether equal ones are one object differs from process to
    process.

    Parameters
    ----------
    of_data
        Whether objects of installed packages are unknown unless they are plain data or a message can carry them: what
        pickle writes of a shared memory or a stored array is its name, and not its content.
    path
        Names on the way to the value, for `unknown`.

    Attributes
    ----------
    code, state
        Two digests: of functions, classes and immutable values; and of what is in lists, dicts, arrays and objects,
        which a call may change.
    modules, state_modules
        The names of the modules that were met in each of the two.
    unknown
        The first object that pickle can't describe, as text; "" if there is none.
    reader
        The first name by which a function reads files or the environment; "" if there is none.
    """

    def __init__(self, *, of_data: bool = False, path: list[str] | None = None) -> None:
        self.code = hashlib.blake2b(digest_size=_DIGEST_BYTES)
        self.state = hashlib.blake2b(digest_size=_DIGEST_BYTES)
        self.modules: set[str] = set()
        self.state_modules: set[str] = set()
        self.unknown = ""
        self.reader = ""
        self._into = self.code
        # With the objects themselves, so that no other gets the identity of one.
        self._numbers: dict[int, tuple[int, Any]] = {}
        self._path = [] if path is None else path
        self._of_data = of_data

    def digest(self) -> bytes:
        """Return one digest of code and state."""
        return combined_digest(self.code.digest(), self.state.digest())

    def add(self, value: Any) -> None:
        """Add a value, and all that it refers to."""
        try:
            self._add(value)
        except RecursionError:
            self._add_unknown(value)

    def _put(self, *parts: str | bytes | memoryview) -> None:
        _add_parts(self._into, parts)

    def _meet(self, module: str) -> None:
        (self.modules if self._into is self.code else self.state_modules).add(module)

    def _add_unknown(self, value: Any, what: str = "") -> None:
        kind = type(value).__qualname__
        self._put("unknown", kind)
        place = f" as {self._path[-1]!r}" if self._path else ""
        self.unknown = self.unknown or (what or f"a {kind!r}") + place

    @contextmanager
    def _in_state(self) -> Iterator[None]:
        before, self._into = self._into, self.state
        try:
            yield
        finally:
            self._into = before

    def _add(self, value: Any) -> None:
        kind = type(value)
        if kind in _LEAVES:
            self._put(kind.__name__, repr(value))
        elif kind is int:
            # Python refuses to write very long numbers as decimals.
            self._put("int", hex(value))
        elif kind in (str, bytes, bytearray):
            self._put(kind.__name__, value)
        elif isinstance(value, PurePath):
            self._put(kind.__name__, str(value), file_digest(Path(value)))
        elif is_plain_array(value) and not value.dtype.hasobject:
            self._add_array(value)
        elif kind is tuple:
            self._add_all("tuple", value)
        elif kind in (set, frozenset):
            self._add_set(value)
        elif name := self._installed_name(value):
            self._put("installed", name)
        elif id(value) in self._numbers:
            self._put("again", str(self._numbers[id(value)][0]))
        else:
            self._numbers[id(value)] = len(self._numbers), value
            of_data, self._of_data = self._of_data, self._of_data and not isinstance(value, _CODE)
            next((way for kinds, way in _WAYS if isinstance(value, kinds)), Digester._add_object)(self, value)
            self._of_data = of_data

    # -- containers -------------------------------------------------------------------------------------------------

    def _add_all(self, kind: str, values: Iterable[Any]) -> None:
        values = list(values)
        self._put(kind, str(len(values)))
        for value in values:
            self._add(value)

    def _add_named(self, values: Mapping[str, Any]) -> None:
        self._put("names", str(len(values)))
        for name in sorted(values):
            self._put(name)
            self._path.append(name)
            self._add(values[name])
            self._path.pop()

    def _add_list(self, found: list[Any]) -> None:
        if type(found) is not list:
            self._add_object(found)
            return
        with self._in_state():
            self._add_all("list", found)

    def _add_dict(self, found: Mapping[Any, Any]) -> None:
        if type(found) not in (dict, types.MappingProxyType):
            self._add_object(found)
            return
        with self._in_state():
            self._add_all("dict", (part for item in list(found.items()) for part in item))

    def _add_set(self, found: Iterable[Any]) -> None:
        """Add the members in the order of digests of their own: the set's order is another one in each process."""
        members = []
        for member in list(found):
            own = Digester(of_data=self._of_data, path=self._path)
            own.add(member)
            (self.modules if self._into is self.code else self.state_modules).update(own.modules, own.state_modules)
            self.unknown = self.unknown or own.unknown
            self.reader = self.reader or own.reader
            members.append(own.digest())
        with self._in_state() if type(found) is set else nullcontext():
            self._put("set", *sorted(members))

    def _add_array(self, array: Any) -> None:
        import numpy as np

        content = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data if array.nbytes else b""
        with self._in_state():
            self._put("array", repr(array.dtype.descr), repr(array.shape), content)

    # -- code -------------------------------------------------------------------------------------------------------

    def add_graph(self, cg: CompGraph) -> None:
        """Add the functions of a graph, and how they are connected."""
        self._put("graph", str(len(cg.functions)))
        for name, function in cg.functions.items():
            self._put(name, repr(cg.func_io[name]))
            self._add_named({name: function})

    def _add_function(self, function: types.FunctionType) -> None:
        code = function.__code__
        self._meet(str(function.__module__))
        self._put("function", function.__qualname__)
        self._add_code(code)
        self._add(function.__defaults__)
        self._add_named(function.__kwdefaults__ or {})
        self._add_named(_annotations(function))
        cells = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
        if code in _SINGLE_DISPATCH:
            # Beside its registry it has a cache, which each call may fill.
            self._add_named({"registry": cells.get("registry", vars(function).get("registry"))})
        else:
            self._add_attributes(function)
            self._add_named(cells)
        if not _is_installed(str(function.__globals__.get("__name__", ""))):
            self._add_named(self._globals(function))

    def _globals(self, function: types.FunctionType) -> dict[str, Any]:
        """Return the globals that a function reads, and of modules of the user's what is read of them, by name."""
        found = function.__globals__
        codes = list(nested_codes(function.__code__))
        attributes = {name for code in codes for name in code.co_names}
        names = {one.argval for code in codes for one in dis.get_instructions(code) if one.opname in _READS_NAME}
        by_text = sorted(_BY_TEXT.intersection(names) - found.keys())
        if by_text or "import_module" in attributes:
            self._add_unknown(function, f"a call of {(by_text or ['import_module'])[0]!r}")
        read: dict[str, Any] = {}
        seen: set[str] = set()
        waiting = [(name, found[name]) for name in names if name in found]
        for name in _imported_within(codes, found.get("__package__") or ""):
            if _is_installed(name):
                self._meet(name)
            else:
                with suppress(Exception):  # the function raises the same when it is called
                    waiting.append((name, importlib.import_module(name)))
        while waiting:
            name, value = waiting.pop()
            read[name] = value
            if isinstance(value, types.ModuleType) and value.__name__ not in seen and not _is_installed(value.__name__):
                seen.add(value.__name__)
                own = vars(value)
                of_it = set(own) if _ATTRIBUTES_BY_TEXT & (names | attributes) else attributes.intersection(own)
                waiting += [(f"{name}.{one}", own[one]) for one in sorted(of_it) if not one.startswith("__")]
        own_functions = {name.rpartition(".")[2] for name, one in read.items() if isinstance(one, types.FunctionType)}
        self.reader = self.reader or min(_READERS & (names | attributes) - own_functions, default="")
        return read

    def _add_attributes(self, function: Any) -> None:
        """Add the attributes of a function but for those by which EPypes watches it."""
        self._add_named({name: value for name, value in vars(function).items() if not name.startswith(_WATCHED)})

    def _add_code(self, code: types.CodeType) -> None:
        counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        self._put("code", code.co_code, code.co_exceptiontable, repr((counts, names)))
        self._add_all("constants", code.co_consts)

    def _add_cell(self, cell: types.CellType) -> None:
        try:
            content = cell.cell_contents
        except ValueError:  # nothing has been assigned yet
            self._put("empty cell")
            return
        self._add(content)

    def _add_module(self, module: types.ModuleType) -> None:
        self._meet(module.__name__)
        self._put("module", module.__name__)
        if module.__name__ == "__main__":
            self._add_unknown(module)

    def _add_class(self, found: type) -> None:
        self._meet(found.__module__)
        self._put("class", found.__qualname__)
        self._add(type(found))
        self._add(found.__bases__)
        own = {name: value for name, value in vars(found).items() if name not in _NO_BEHAVIOUR}
        if isinstance(found, enum.EnumMeta):
            # Beside the members an enumeration has tables of them, which may grow when it is used.
            members: Mapping[str, Any] = found.__members__
            own = {
                name: own[name] for name in own if name not in members and not (name[0] == name[-1] == "_" != name[1])
            }
            self._add_all("members", ((name, member.name, member.value) for name, member in members.items()))
        self._add_named(own)

    # -- objects ----------------------------------------------------------------------------------------------------

    def _add_member(self, member: enum.Enum) -> None:
        self._add_all("member", (type(member), member.name, member.value))
        self._add_named({name: value for name, value in vars(member).items() if name[0] != "_"})

    def _add_object(self, value: Any) -> None:
        """Add the class and the state of an object, as it would be pickled; of an own class all attributes as well."""
        cg = getattr(value, "cg", None)
        self._add(type(value))
        if isinstance(cg, CompGraph):  # a runner or a pipeline, which also counts its runs
            self.add_graph(cg)
            self._add_named(getattr(getattr(value, "runner", value), "hyperparameters", {}))
            if _is_installed(type(value).__module__):
                return
        module = type(value).__module__
        with nullcontext() if isinstance(value, types.BuiltinFunctionType) else self._in_state():
            if self._of_data and _is_installed(module) and module.partition(".")[0] not in _DATA_MODULES:
                self._add_unpicklable(value)
            else:
                self._add_content(value)

    def _add_content(self, value: Any) -> None:
        kind = type(value)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                reduce = copyreg.dispatch_table.get(kind)
                reduced: Any = reduce(value) if reduce else value.__reduce_ex__(4)
        except Exception:  # whatever a class raises that can't be pickled
            self._add_unpicklable(value)
            return
        if isinstance(reduced, str):
            self._add_global(value, reduced)
        else:
            make, arguments, state, items, pairs = (*reduced, *(None,) * 5)[:5]
            state = _lasting_state(value, state)
            self._add_all("object", (make, arguments, state, *map(list, filter(None, (items, pairs)))))
        if not _is_installed(kind.__module__):
            self._add_all("attributes", (_lasting_state(value, object.__getstate__(value)),))

    def _add_global(self, value: Any, name: str) -> None:
        module = getattr(value, "__module__", None)
        module = module or next((module for module in list(sys.modules) if _found(module, name) is value), "__main__")
        self._meet(module)
        self._put("global", module, name)
        if _found(module, name) is not value:
            self._add_unknown(value)

    def _add_unpicklable(self, value: Any) -> None:
        """Add an object such as a key point of OpenCV, which travels as a message."""
        message, writer = message_class("epypes.v1.Value")(), ValueWriter()
        try:
            writer.write_named(message, value, "value")
        except MessageError:
            self._add_unknown(value)
            return
        self._put("message", message.SerializeToString(deterministic=True))
        self._add_all("payloads", (payload.data for payload in writer.payloads))

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
        self._meet(module)
        return f"{module}.{name}"


_WAYS: Final[tuple[tuple[Any, Callable[[Digester, Any], None]], ...]] = (
    (types.FunctionType, Digester._add_function),
    (types.CodeType, Digester._add_code),
    (types.CellType, Digester._add_cell),
    (types.ModuleType, Digester._add_module),
    (enum.Enum, Digester._add_member),
    (type, Digester._add_class),
    (list, Digester._add_list),
    ((dict, types.MappingProxyType), Digester._add_dict),
    (types.MethodType, lambda into, found: into._add_all("method", (found.__self__, found.__func__))),
    ((staticmethod, classmethod), lambda into, found: into._add_all(type(found).__name__, (found.__func__,))),
    (property, lambda into, found: into._add_all("property", (found.fget, found.fset, found.fdel))),
    (functools._lru_cache_wrapper, Digester._add_attributes),
    # The class that has them is met before them.
    ((types.MemberDescriptorType, types.GetSetDescriptorType), lambda into, found: into._put("slot", found.__name__)),
    # They have no state but that of this moment.
    ((type(threading.Lock()), type(threading.RLock())), lambda into, found: into._put("lock")),
    (CompGraph, Digester.add_graph),
)


_SINGLE_DISPATCH: Final = frozenset(nested_codes(functools.singledispatch.__code__))


def _lasting_state(value: Any, state: Any) -> Any:
    """Return a state without what is computed from the rest when it is first needed, or counts calls."""
    if isinstance(state, tuple) and len(state) == 2 and isinstance(state[0], dict):
        return _lasting_state(value, state[0]), state[1]
    if not isinstance(state, dict):
        return state
    derived: set[str] = set()
    for kind in type(value).__mro__:
        derived |= _DERIVED.get(f"{kind.__module__}.{kind.__qualname__}", set())
        derived |= {name for name, found in vars(kind).items() if isinstance(found, functools.cached_property)}
    return {name: state[name] for name in sorted(state, key=str) if name not in derived}


def _found(module: str, name: str) -> Any:
    first, *rest = name.split(".")
    # Not by getattr, which would run the module's own __getattr__.
    found: Any = getattr(sys.modules.get(module), "__dict__", {}).get(first)
    for part in rest:
        found = getattr(found, part, None)
    return found


def _annotations(function: types.FunctionType) -> Mapping[str, Any]:
    try:
        return function.__annotations__
    except NameError:  # from Python 3.14 on they are evaluated when they are read
        return {}


# -- modules --------------------------------------------------------------------------------------------------------


def _is_installed(module: str) -> bool:
    top = module.partition(".")[0]
    if module == "__main__" or top in sys.modules:
        # Without its cache: a module may be loaded again from another place.
        return module != "__main__" and not is_own.__wrapped__(top)
    with suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(top)
        return spec is not None and not _INSTALLED.isdisjoint(Path(spec.origin or "").parts)
    return False


def versions_of(modules: Iterable[str]) -> list[str]:
    """Return a line for each of these modules: the versions of its distributions, or the digest of its own file."""
    found = {"python": sys.version}
    for name in modules:
        top = name.partition(".")[0]
        if top == _OURS:
            found[top] = metadata.version(_OURS)
        elif _is_installed(name) and top not in sys.stdlib_module_names:
            found[top] = ", ".join(f"{one}=={metadata.version(one)}" for one in _distributions().get(top, ()))
        elif file := getattr(sys.modules.get(name), "__file__", None):
            found[name] = file_digest(Path(file))
    return sorted(f"{name} {version}" for name, version in found.items())


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    # A distribution is listed once for each of its files' folders.
    return {name: sorted(set(found)) for name, found in metadata.packages_distributions().items()}


def _imported_within(codes: Iterable[types.CodeType], package: str) -> set[str]:
    """Return the names of all that code in a package may import when it runs."""
    found: set[str] = set()
    for code in codes:
        # Before each import statement, its level and the names that it takes are loaded.
        steps = [one for one in dis.get_instructions(code) if one.opname in {*_LOADS_CONSTANT, "IMPORT_NAME"}]
        for level, taken, step in zip(steps, steps[1:], steps[2:], strict=False):
            if step.opname == "IMPORT_NAME":
                with suppress(ImportError):  # a relative import beyond the package
                    name = importlib.util.resolve_name("." * level.argval + step.argval, package)
                    # A name that is taken from a package may be a module of it.
                    found |= {name, *(f"{name}.{one}" for one in taken.argval or ())}
    return found
