"""What tells a metric from any other one?

Not its name, nor its source alone: what it computes follows as well from the values that it has from outside.
"""

from __future__ import annotations

import dis
import enum
import functools
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from epypes.bundle.text import nested_codes
from epypes.scale.digests import Untold, digest_of, joined

# Packages of an environment beneath this one are in another folder of that name.
_INSTALLED: Final = frozenset({"site-packages", "dist-packages"})
_OWN_METHODS: Final = (staticmethod, classmethod)
_BUILT_IN: Final = types.BuiltinFunctionType
_LAYOUT: Final = (types.MemberDescriptorType, types.GetSetDescriptorType)


def function_digest(function: Callable[..., Any]) -> str:
    """Return what tells a function from others: its code, and the values of its closure, defaults and globals.

    So for what it calls, but for what is installed: that is known by its name.

    Raises
    ------
    Untold
        It is, or has from outside, something of which nobody can say what is in it, such as an object of a class.
    """
    return _Teller().of(function).hex()


class _Teller:
    """Digests values; those in the midst of which it is are known by their depth, so functions may call themselves."""

    def __init__(self) -> None:
        self._within: list[int] = []
        self._ways: tuple[tuple[Any, Callable[[Any], bytes]], ...] = (
            (types.FunctionType, self._of_function),
            (functools.partial, self._of_partial),
            (functools._lru_cache_wrapper, lambda cached: self.of(cached.__wrapped__)),
            (types.MethodType, lambda method: self._of_all("method", (method.__self__, method.__func__))),
            (_BUILT_IN, lambda method: self._of_all(f"method {method.__name__}", (method.__self__,))),
            (_OWN_METHODS, lambda method: self._of_all(type(method).__name__, (method.__func__,))),
            (property, lambda found: self._of_all("property", (found.fget, found.fset))),
            (types.ModuleType, lambda module: joined("module", module.__name__)),
            (enum.EnumMeta, lambda found: self._of_all("enumeration", list(found))),
            (type, self._of_class),
        )

    def of(self, value: Any) -> bytes:
        """Return the digest of a value."""
        if id(value) in self._within:
            return joined("again", str(self._within.index(id(value))))
        name = _installed_name(value)
        if name:
            return joined("installed", name)
        self._within.append(id(value))
        try:
            return self._way(value)(value)
        finally:
            self._within.pop()

    def _way(self, value: Any) -> Callable[[Any], bytes]:
        if type(value) in (list, tuple):
            return lambda found: self._of_all(type(found).__name__, found)
        if type(value) is dict:
            return lambda found: self._of_all("dict", (part for item in found.items() for part in item))
        return next((way for kind, way in self._ways if isinstance(value, kind)), _of_value)

    def _of_all(self, kind: str, values: Iterable[Any]) -> bytes:
        return joined(kind, *map(self.of, values))

    def _of_function(self, function: types.FunctionType) -> bytes:
        code = function.__code__
        cells = zip(code.co_freevars, function.__closure__ or (), strict=True)
        outside = {**dict(_globals_of(function)), **{name: cell.cell_contents for name, cell in cells if _is_set(cell)}}
        defaults = function.__defaults__, function.__kwdefaults__
        return joined("function", *map(_code_digest, nested_codes(code)), self.of(defaults), self._of_named(outside))

    def _of_partial(self, partial: functools.partial[Any]) -> bytes:
        return joined("partial", self.of(partial.func), self.of(partial.args), self._of_named(partial.keywords))

    def _of_class(self, found: type) -> bytes:
        own = {
            name: value
            for name, value in vars(found).items()
            if isinstance(value, types.FunctionType) or not (name.startswith("__") or isinstance(value, _LAYOUT))
        }
        return joined("class", found.__qualname__, self.of(found.__bases__), self._of_named(own))

    def _of_named(self, values: Mapping[str, Any]) -> bytes:
        parts: list[bytes | str] = []
        for name in sorted(values):
            try:
                parts += [name, self.of(values[name])]
            except Untold as error:
                raise Untold(f"{error} as {name!r}") from error
        return joined("names", *parts)


def _of_value(value: Any) -> bytes:
    return bytes.fromhex(digest_of(value))


def _globals_of(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Give the globals that a function reads; of a module that is the user's, what is read of it."""
    for code in nested_codes(function.__code__):
        for instruction in dis.get_instructions(code):
            name = instruction.argval
            if instruction.opname not in ("LOAD_GLOBAL", "LOAD_NAME") or name not in function.__globals__:
                continue
            value = function.__globals__[name]
            yield name, value
            if isinstance(value, types.ModuleType) and not _is_installed(value.__name__):
                read = [attribute for attribute in code.co_names if attribute in vars(value)]
                yield from ((f"{name}.{attribute}", vars(value)[attribute]) for attribute in read)


def _code_digest(code: types.CodeType) -> bytes:
    constants = [_constant(value) for value in code.co_consts if not isinstance(value, types.CodeType)]
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    return joined("code", code.co_code, code.co_exceptiontable, repr((names, counts)), *constants)


def _constant(value: Any) -> str:
    # The order of a set is another one in each process.
    return f"set {sorted(map(repr, value))}" if isinstance(value, frozenset) else f"{type(value).__name__} {value!r}"


def _is_set(cell: types.CellType) -> bool:
    try:
        _ = cell.cell_contents
    except ValueError:  # what is assigned later
        return False
    return True


def _installed_name(value: Any) -> str:
    """Return the name by which a function or class of an installed package is imported; "" for any other value."""
    if not callable(value):
        return ""
    owner = getattr(value, "__self__", None)
    module = owner.__name__ if isinstance(owner, types.ModuleType) else getattr(value, "__module__", None)
    module = module or type(value).__module__
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    if not isinstance(name, str) or not isinstance(module, str) or not _is_installed(module):
        return ""
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return f"{module}.{name}" if found is value else ""


def _is_installed(module: str) -> bool:
    root = module.partition(".")[0]
    if root in sys.stdlib_module_names or root == __name__.partition(".")[0]:
        return True
    file = getattr(sys.modules.get(root), "__file__", None)
    return file is not None and not _INSTALLED.isdisjoint(Path(file).parts)
