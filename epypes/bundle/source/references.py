"""References: the names that a function reads, and what they mean to it.

A name means what the function has captured, else a global of its module, else a builtin. The slice, the descriptions of
objects, the mutable state, the fingerprints and the static checks all resolve names here.
"""

from __future__ import annotations

import ast
import builtins
import dis
import importlib.util
import types
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Final

from epypes.bundle.private_import import loaded_module, name_meant

# A class reads the name of the module around it, whichever that is, and has its own annotations.
_OF_EVERY_CLASS: Final = frozenset({"__name__", "__annotations__"})
_LOADS_CONSTANT: Final = frozenset({"LOAD_CONST", "LOAD_SMALL_INT"})
_MODELS_OF_CV2: Final = frozenset({"BackgroundSubtractor", "KalmanFilter", "Tracker", "VideoCapture", "VideoWriter"})


def nested_codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """Give code, and that of all that is defined in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from nested_codes(constant)


def global_names(code: types.CodeType) -> list[str]:
    """Return the global names that code and all code in it read, each once, in order.

    Names to which the body of a class has given a meaning before are not global there.
    """
    found: dict[str, None] = {}
    for inner in nested_codes(code):
        own = {*_OF_EVERY_CLASS}
        for instruction in dis.get_instructions(inner):
            if instruction.opname == "STORE_NAME":
                own.add(instruction.argval)
            elif instruction.opname in ("LOAD_GLOBAL", "LOAD_FROM_DICT_OR_GLOBALS") or (
                instruction.opname == "LOAD_NAME" and instruction.argval not in own
            ):
                found[instruction.argval] = None
    return [*found]


def imported_modules(function: types.FunctionType) -> list[str]:
    """Return the names of all modules that a function may import when it runs, as Python knows them, sorted."""
    return imports_of(function.__code__, function.__globals__)


def imports_of(code: types.CodeType, names: Mapping[str, Any]) -> list[str]:
    """Return the names of all modules that code may import, as Python knows them, sorted; ``names`` are its own."""
    package = names.get("__package__") or ""
    found: set[str] = set()
    for inner in nested_codes(code):
        # Before each import statement, its level and the names that it takes are loaded.
        steps = [one for one in dis.get_instructions(inner) if one.opname in {*_LOADS_CONSTANT, "IMPORT_NAME"}]
        for level, taken, step in zip(steps, steps[1:], steps[2:], strict=False):
            if step.opname == "IMPORT_NAME":
                with suppress(ImportError):  # a relative import beyond the package
                    name = importlib.util.resolve_name("." * level.argval + step.argval, package)
                    name = name if level.argval else name_meant(name, names)
                    # A name that is taken from a package may be a module of it.
                    found |= {name, *(f"{name}.{one}" for one in taken.argval or ())}
    return sorted(found)


def module_of_import(node: ast.Import | ast.ImportFrom, alias: ast.alias, names: Mapping[str, Any]) -> str:
    """Return the module that an import statement names; an ImportError is raised where it is beyond the package."""
    if isinstance(node, ast.Import):
        return name_meant(alias.name, names)
    if not node.level:
        return name_meant(node.module or "", names)
    return importlib.util.resolve_name("." * node.level + (node.module or ""), names.get("__package__") or "")


def is_main_guard(node: ast.stmt) -> bool:
    """Whether a statement is executed only where its file is run as a program."""
    test = ast.unparse(node.test).replace('"', "'") if isinstance(node, ast.If) else ""
    return test in ("__name__ == '__main__'", "'__main__' == __name__")


def cells_of(function: types.FunctionType) -> dict[str, types.CellType]:
    """Return the variables that a function has captured, by name; not those without a value."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return {name: cell for name, cell in cells if cell != types.CellType()}


def captured_by(function: types.FunctionType) -> dict[str, Any]:
    """Return the values that a function has captured, by name."""
    return {name: cell.cell_contents for name, cell in cells_of(function).items()}


def namespace_of(function: types.FunctionType) -> dict[str, Any]:
    """Return all names that a function may read but for the builtins."""
    return {**function.__globals__, **captured_by(function)}


def is_of_ipython(name: str, value: object) -> bool:
    """Whether a global stands for a builtin of its name: in notebooks, IPython has put its own ``open`` there."""
    home = getattr(value, "__globals__", {}).get("__name__", "")
    return hasattr(builtins, name) and home.startswith("IPython.")


def meanings_of(function: types.FunctionType, names: Iterable[str]) -> dict[str, Any]:
    """Return what names mean to a function; those that mean nothing are left out."""
    captured, free = captured_by(function), function.__code__.co_freevars
    found: dict[str, Any] = {}
    for name in names:
        if name in free:
            found |= {name: captured[name]} if name in captured else {}
        elif name in function.__globals__ and not is_of_ipython(name, function.__globals__[name]):
            found[name] = function.__globals__[name]
        elif hasattr(builtins, name):
            found[name] = getattr(builtins, name)
    return found


def reads_of(function: types.FunctionType) -> dict[str, Any]:
    """Return what the names that a function reads mean to it, in order of the names, as in any other process."""
    return meanings_of(function, sorted({*function.__code__.co_freevars, *global_names(function.__code__)}))


def defaults_of(function: types.FunctionType) -> dict[str, Any]:
    """Return the defaults of a function by parameter, as they are by now."""
    given, code = function.__defaults__ or (), function.__code__
    names = code.co_varnames[: code.co_argcount]
    return dict(zip(names[len(names) - len(given) :], given, strict=True)) | (function.__kwdefaults__ or {})


def attributes_loaded(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Give the attributes that a function loads, by name; what a module has under the name, None for other objects."""
    for code in nested_codes(function.__code__):
        known, value = meanings_of(function, code.co_names + code.co_freevars), None
        for step in dis.get_instructions(code):
            operation, name = step.opname, step.argval
            if operation in ("LOAD_ATTR", "LOAD_METHOD", "IMPORT_FROM"):
                # NumPy loads its generators when they are first asked for; other parts are left as they are.
                found = getattr(value, name, None) if name == "random" else getattr(value, "__dict__", {}).get(name)
                found = found if isinstance(value, types.ModuleType) else None
                yield name, found
                value = value if operation == "IMPORT_FROM" else found
            elif operation == "IMPORT_NAME":
                value = loaded_module(name)
            elif operation == "STORE_FAST":
                known[name] = value
            elif operation.startswith(("LOAD_FAST", "LOAD_GLOBAL", "LOAD_NAME", "LOAD_DEREF")):
                value = known.get(name) if isinstance(name, str) else None
            elif operation not in ("PUSH_NULL", "CACHE", "NOP"):
                value = None


def is_model_of_cv2(value: Any) -> bool:
    """Whether an object of OpenCV remembers what it is given, where Python can't see it."""
    bases = (base.__name__ for base in type(value).__mro__ if base.__module__[:3] == "cv2")
    return not _MODELS_OF_CV2.isdisjoint(bases)


def may_remember(value: Any) -> bool:
    """Whether an object most likely keeps something from call to call: of a user's class, an iterator, such a model."""
    return type(value).__module__ == "__main__" or hasattr(type(value), "__next__") or is_model_of_cv2(value)
