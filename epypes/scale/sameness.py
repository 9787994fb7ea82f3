"""Is this the computation that it was? What tells a graph, and the code that it runs, from others."""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterable, Iterator
from functools import lru_cache, partial
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any, Final

from epypes.bundle.requirements import bringing
from epypes.graph import CompGraph, as_switch
from epypes.scale.digests import Untold, digest_of, joined

_OURS: Final = "epypes"
# The folders that pip, and Debian's packages, install into.
_INSTALLED: Final = frozenset({"site-packages", "dist-packages"})
_MUTABLE: Final = (list, dict, set, bytearray)


def computation_of(cg: CompGraph, source: str | None) -> str:
    """Return a digest of what a graph computes.

    Parameters
    ----------
    cg
        The graph.
    source
        What ``to_source`` has made of it; None: it was refused, and the functions' code is looked at.

    Notes
    -----
    Modules count by what is in their files, those of installed distributions by their versions. What is inside of
    objects, lists and dicts that functions use is not looked at: it may change with each call.
    """
    codes = _Codes()
    of_functions = b"" if source is not None else codes.of_graph(cg)
    modules = codes.modules if source is None else set(_imports(source.encode("utf-8", "surrogatepass"), "", False))
    wiring = digest_of({name: repr(io) for name, io in cg.func_io.items()})
    return joined("computation", source or "", of_functions, wiring, *_versions(modules)).hex()


# -- code -------------------------------------------------------------------------------------------------------


class _Codes:
    """Digests of functions, and the modules that they are of."""

    def __init__(self) -> None:
        self.modules: set[str] = set()
        self._seen: set[int] = set()

    def of_graph(self, cg: CompGraph) -> bytes:
        return joined("graph", *(part for name in cg.functions for part in (name, self.of(cg.functions[name]))))

    def of(self, function: Any) -> bytes:
        """Return a digest of what is called; what is being looked at already counts by its name alone."""
        name = f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(function).__qualname__)}"
        if id(function) in self._seen:
            return joined("seen", name)
        self._seen.add(id(function))
        self.modules.add(str(getattr(function, "__module__", "")))
        return joined(name, *self._parts(function))

    def _parts(self, function: Any) -> Iterator[bytes]:
        if isinstance(function, partial):
            yield self.of(function.func)
            yield self._value((*function.args, *sorted(function.keywords.items())))
        elif isinstance(function, MethodType):
            yield self.of(function.__func__)
        elif isinstance(function, FunctionType):
            yield from self._of_function(function)
        elif (switch := as_switch(function)) is not None:
            yield self._value(switch.branches)
        elif isinstance(cg := getattr(function, "cg", None), CompGraph):
            yield self.of_graph(cg)
        elif isinstance(call := getattr(type(function), "__call__", None), FunctionType):  # noqa: B004 - its code
            yield self.of(call)

    def _of_function(self, function: FunctionType) -> Iterator[bytes]:
        yield self._of_code(function.__code__)
        yield self._value(function.__defaults__)
        yield self._value(tuple(sorted((function.__kwdefaults__ or {}).items())))
        for cell in function.__closure__ or ():
            yield self._value(_content(cell))
        for name in sorted(_names(function.__code__)):
            if name in function.__globals__:
                yield joined(name, self._value(function.__globals__[name]))

    def _of_code(self, code: CodeType) -> bytes:
        consts = (self._of_code(one) if isinstance(one, CodeType) else self._value(one) for one in code.co_consts)
        names = repr((code.co_names, code.co_varnames, code.co_freevars))
        return joined("code", code.co_code, names, *consts)

    def _value(self, value: Any) -> bytes:
        if isinstance(value, ModuleType):
            self.modules.add(value.__name__)
            return joined("module", value.__name__)
        if isinstance(value, FunctionType | MethodType | partial):
            return self.of(value)
        if isinstance(value, tuple):
            return joined("tuple", *map(self._value, value))
        if isinstance(value, type):
            self.modules.add(value.__module__)
        try:
            return joined("value", type(value).__name__ if isinstance(value, _MUTABLE) else digest_of(value))
        except Untold:
            return joined("object", type(value).__qualname__)


def _content(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # nothing has been put into it yet
        return None


def _names(code: CodeType) -> set[str]:
    """Return the names that code, and the functions inside of it, may look up."""
    inner = (_names(one) for one in code.co_consts if isinstance(one, CodeType))
    return set(code.co_names).union(*inner)


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
