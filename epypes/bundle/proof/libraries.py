"""Libraries as one process has them: what their modules hold, as texts to be compared.

A notebook may patch a library in ways that no syntax shows: by a helper, through ``vars``, or deep
in another module. What it has changed is found by comparison with a process that has imported the same modules and
nothing else. What differs between two such processes too, such as the time of an import, is no change.

A number, text, tuple or array is described by its content; a function by its home, instructions and defaults; a class
by its home, and by its attributes where it is defined; any other object by its type alone. What libraries count and
remember in, private values and names that are neither constants nor named by the bundle, counts only where the notebook
may have changed it: its cells assign to such a name, or have it as a text. Modules that only one of the processes has
loaded are left out.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import re
import sys
import types
from collections.abc import Collection, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from typing import Any, Final

from epypes.bundle.proof.process_settings import OF_NOTEBOOKS
from epypes.run.snapshot import is_own

Attributes = Mapping[str, Mapping[str, str]]

_ATOMS: Final = (int, float, complex, bool, str, bytes, type(None), type(...))
# Longer descriptions are digests.
_MOST_TEXT: Final = 60
_MOST_ENTRIES: Final = 500
_BEGIN_AN_ATOM: Final = tuple("'\"-0123456789")
_MOST_BYTES: Final = 65_536
# They hold the interpreter's own state, which is another one in each kind of process.
OF_THE_PROCESS: Final = frozenset({"sys", "warnings", "threading", "signal", "epypes"})
# A name in modules that pytest has compiled otherwise, as it does with tests and plugins.
_OF_PYTEST: Final = "@pytest_ar"
_OWN: Final = ("__main__.", "unittest.mock.")
# Functions of Python's library that keep an entry, as logging.addLevelName and csv.register_dialect.
_REGISTERS: Final = re.compile("add|register|unregister|set|install|pickle")
_ALWAYS: Final = frozenset({"builtins", "numpy"})


def library_attributes(named: Collection[str], new: Iterable[str]) -> Attributes:
    """Return what the libraries of a bundle hold, by module and attribute.

    Parameters
    ----------
    named
        The modules that the bundle names.
    new
        The modules that it has imported.
    """
    own = {name.partition(".")[0] for name in named}
    packages = own | _ALWAYS | ({name.partition(".")[0] for name in new} - sys.stdlib_module_names)
    packages = {name for name in packages - OF_THE_PROCESS if not name.startswith(("__", "epypes_"))}
    # The user's own modules are looked at by what the functions refer to.
    return attributes_of(name for name in [*sys.modules] if name.partition(".")[0] in packages and not is_own(name))


def attributes_of(modules: Iterable[str]) -> Attributes:
    """Return what modules hold by module and attribute, of those that are loaded."""
    loaded = {name: sys.modules[name] for name in modules if isinstance(sys.modules.get(name), types.ModuleType)}
    return {name: dict(_attributes(module, name)) for name, module in loaded.items() if _OF_PYTEST not in vars(module)}


def changed_attributes(
    here: Attributes, there: Attributes, text: str, named_here: Collection[str], called: AbstractSet[str] = frozenset()
) -> dict[tuple[str, str], tuple[str, str]]:
    """Return by module and attribute what differs here from there, as the descriptions of both.

    Parameters
    ----------
    here, there
        What modules hold in two processes.
    text
        A bundle's code. What is only here counts if it names it.
    named_here
        The names that the notebook may have given another value. Private values, and those that are no constants and
        not named by the bundle, are mostly what libraries count and remember: they count if they are among these.
    called
        The names of the functions that the notebook has called: some of Python's library register entries in dicts.
    """
    mentioned = _mentioned(text)
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for module, described in here.items():
        others = there.get(module, {})
        registers = module in sys.stdlib_module_names and any(
            _REGISTERS.match(one) and one in vars(sys.modules[module]) for one in called
        )
        for name, value in described.items() if others else ():
            other = others.get(name, "")
            if value == other:
                continue
            last = name.rpartition(".")[2]
            if not other:
                # A lazy package gets its modules, and what they are for, when these are first asked for.
                is_lazy = value.startswith((f"{module.partition('.')[0]}.", "module "))
                is_changed = last in mentioned and not is_lazy
            else:
                # Not what a loop over a set has left behind in a module, nor what libraries do to each other.
                is_changed = last.isupper() or "." in name or last in mentioned or f".{last}" in other
                is_changed &= not last.startswith("_") or value.startswith(_OWN)
                is_changed &= "." not in name or not _is_object_of(module, value, other)
                is_changed |= last in named_here and name not in _left_by_loops(module)
                is_changed &= other != "None" or last in named_here
                is_changed &= not value.startswith(OF_NOTEBOOKS)
            # A text or number in a dict of the module: not the members that an enumeration remembers.
            is_entry = (
                registers and "[" in name and "." not in name.partition("[")[0] and value.startswith(_BEGIN_AN_ATOM)
            )
            if is_changed or is_entry:
                found[module, name] = value, other
    return found


@functools.cache
def _left_by_loops(module: str) -> frozenset[str]:
    """Return the names that loops of a module's own code have left behind in it, as ``name`` in scipy.sparse._data."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except Exception:  # no source, or what a module of one's own raises when it is asked for it
        return frozenset()
    parts = (part for loop in tree.body if isinstance(loop, ast.For) for part in ast.walk(loop))
    return frozenset(part.id for part in parts if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store))


def _is_object_of(module: str, *values: str) -> bool:
    """Whether these describe objects or classes of a module's own package, as its own functions exchange them."""
    return all(value.startswith(f"{module.partition('.')[0]}.") and " " not in value for value in values)


def _mentioned(text: str) -> set[str]:
    """Return the names that a module asks objects for: attributes, imported names and texts."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.ImportFrom):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return found


def _attributes(owner: Any, home: str, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Give the attributes of a module or class with their descriptions."""
    for name, value in [*vars(owner).items()]:
        is_function = isinstance(value, (type, *_FUNCTIONS)) or type(value) in _INNER
        if name.startswith("_repr_") or (name.startswith("__") and (not prefix or not is_function)):
            continue
        yield f"{prefix}{name}", _described(value)
        if isinstance(value, type) and value.__module__ == home and value.__qualname__ == f"{prefix}{name}":
            yield from _attributes(value, home, f"{prefix}{name}.")
        elif type(value) is dict and len(value) <= _MOST_ENTRIES:
            entries = ((key, entry) for key, entry in value.items() if type(key) in (str, int))
            yield from ((f"{prefix}{name}[{key!r}]", _described(entry)) for key, entry in entries)


def _described(value: Any) -> str:
    """Describe a value by a short text that is the same in each process."""
    try:
        text = _text(value)
    except Exception:  # whatever an object raises that is made only to be imported
        return "unknown"
    if len(text) <= _MOST_TEXT:
        return text
    digest = _digest(text.encode("utf-8", "surrogatepass"))
    return digest if isinstance(value, _ATOMS) else f"{text.partition(' ')[0]} {digest}"


def _text(value: Any) -> str:
    kind = type(value)
    if kind in _ATOMS:
        return repr(value)
    if isinstance(value, types.ModuleType):
        return f"module {vars(value).get('__name__')}"
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}"
    if kind is types.FunctionType:
        home = f"{value.__globals__.get('__name__')}.{value.__qualname__}"
        # The wrappers of networkx, some of which are objects, get code and attributes when they are first called.
        wrapped = inspect.unwrap(value, stop=lambda one: one is not value and isinstance(one, types.FunctionType))
        if wrapped is not value and isinstance(wrapped, types.FunctionType):
            return f"{home} {_text(wrapped)}"
        # Without objects such as sys.stdout; of functions the name, since they may refer to each other.
        given = [*enumerate(value.__defaults__ or ()), *sorted((value.__kwdefaults__ or {}).items())]
        defaults = [
            (key, _name(default) if callable(default) else default)
            for key, default in given
            if callable(default) or isinstance(default, (*_ATOMS, tuple, frozenset))
        ]
        return f"{home} {_code_text(value.__code__)} {_text(tuple(defaults))}"
    if inner := _INNER.get(kind) or (("_implementation",) if kind.__name__ == "_ArrayFunctionDispatcher" else ()):
        return f"{' '.join(_text(getattr(value, name)) for name in inner)} {kind.__name__}"
    if kind in (tuple, frozenset):
        # Many tuples of names are made of sets.
        is_ordered = kind is tuple and not all(isinstance(part, str) for part in value)
        parts = [*map(_text, value)]
        return f"{kind.__name__} {parts if is_ordered else sorted(parts)}"
    if kind.__module__ == "numpy" and kind.__name__ == "ndarray" and not value.dtype.hasobject:
        content = _digest(value.tobytes()) if value.nbytes <= _MOST_BYTES else ""
        return f"array {value.dtype} {value.shape} {content}"
    return f"{_text(kind)} .{_name(value)}" if callable(value) else _text(kind)


def _name(value: Any) -> str:
    """Return the name of a function of a C library; not its module, which NumPy sets when another one is imported."""
    try:
        return str(getattr(value, "__name__", ""))
    except Exception:  # whatever an object raises that imports or connects when it is asked for an attribute
        return ""


def _code_text(code: types.CodeType) -> str:
    constants = [_code_text(part) if isinstance(part, types.CodeType) else _text(part) for part in code.co_consts]
    return _digest(code.co_code + repr((code.co_names, constants)).encode("utf-8", "surrogatepass"))


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=8).hexdigest()


_FUNCTIONS: Final = (types.FunctionType, types.BuiltinFunctionType)
# What objects that stand for a function have it in.
_INNER: Final[Mapping[type, tuple[str, ...]]] = {
    types.MethodType: ("__func__",),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
    property: ("fget", "fset"),
    functools.partial: ("func", "args"),
    functools._lru_cache_wrapper: ("__wrapped__",),
}
