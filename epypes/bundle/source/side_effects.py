"""Static checks that name the line: writes to state that outlives a call, monkeypatches, and what only a notebook has.

What syntax can't see is found by the replays, by the comparison of libraries with those of a fresh process, and by the
snapshot that guards the functions of a loaded bundle.
"""

from __future__ import annotations

import ast
import builtins
import gc
import inspect
import os
import sys
import types
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any, Final

from epypes.bundle.private_import import loaded_module
from epypes.bundle.proof.process_settings import global_generator
from epypes.bundle.source.references import global_names, module_of_import, namespace_of
from epypes.bundle.source.resolve import (
    Definition,
    Refused,
    definition_of,
    evaluated,
    executed_cells,
    functions_of,
    is_of_notebook,
    parsed,
    place_in,
)
from epypes.run.guard import is_plain_array
from epypes.wording import keep_as_state

# By module or class of a library and the name there: the place in the notebook that changes it.
Patches = Mapping[tuple[Any, str], str]

# -- writes to what outlives a call ----------------------------------------------------------------------------------

# What begins as a literal of its type without content.
_EMPTY: Final = frozenset({bool, int, float, str, list, dict, tuple})
# Methods of lists, dicts, sets, deques and arrays that change them.
CHANGING: Final = frozenset(
    {
        *("append", "appendleft", "extend", "extendleft", "insert", "pop", "popleft", "popitem", "remove", "clear"),
        *("update", "setdefault", "add", "discard", "sort", "reverse", "fill", "itemset", "put", "resize"),
        *("difference_update", "intersection_update", "symmetric_difference_update", "setfield", "setflags"),
        "register",
    }
)
# Methods that make an object.
_MAKING: Final = frozenset({"__init__", "__post_init__", "__new__", "__init_subclass__"})
# By these a function reads the environment; by these calls a cell changes it.
_READS_ENVIRONMENT: Final = (os.environ, os.getenv, os.path.expandvars)
_SETS_ENVIRONMENT: Final = frozenset({"putenv", "unsetenv", "load_dotenv"})


def check_state(found: Definition) -> None:
    """Refuse a definition of the notebook that changes something outside of it, or has a decorator that does."""
    for decorator, wrapper in found.wrappers:
        called = decorator.func if isinstance(decorator, ast.Call) else decorator
        what = f"{found.what} is wrapped by a decorator, @{ast.unparse(decorator)} ({found.place_in(decorator)}):"
        for function in (evaluated(called, found.names), wrapper):
            node = definition_of(function.__code__)[1] if is_of_notebook(function) else None
            if node is not None:
                _check_writes(node, function.__code__.co_filename, function, f"{what} {function.__code__.co_name!r}")
    _check_writes(found.node, found.file, found.function, found.what)


def _check_writes(node: ast.AST, file: str, function: types.FunctionType | None, what: str) -> None:
    """Refuse writes to names and objects from outside of a function; of a class, to global names alone."""
    outside, names = set[str](), dict[str, Any]()
    if function is not None:
        names = namespace_of(function)
        outside = {*function.__code__.co_freevars, *global_names(function.__code__)}
    parts = [*ast.walk(node)]
    stored = {part.id: part for part in parts if isinstance(part, ast.Name) and not isinstance(part.ctx, ast.Load)}
    for part in parts:
        if isinstance(part, ast.Global | ast.Nonlocal):
            for name in filter(stored.__contains__, part.names):
                if isinstance(part, ast.Global):
                    place = place_in(file, stored[name].lineno)
                    raise Refused(f"{what} changes the global {name!r} ({place}). Return it. {_as_state(name, names)}")
                if name in outside:
                    text = f"{what} changes {name!r} of the function around it ({place_in(file, part.lineno)})"
                    raise Refused(f"{text}: the next call would find it different. Return it. {_as_state(name, names)}")
        for written in _written(part):
            name = _root(written)
            is_plain = isinstance(getattr(written, "ctx", None), ast.Store | ast.Del)
            if name in outside and (is_plain or _is_container(written, names)):
                text = f"{what} writes into {name!r}, which outlives the call ({place_in(file, written.lineno)})"
                text = f"{text}: the next event would find it different. Write into a copy of it."
                raise Refused(f"{text} {_as_state(name, names)}")


def changes_itself(kind: type) -> bool:
    """Whether methods of a user's class write into its objects, or into the class, after these have been made."""
    own = [base for base in kind.__mro__ if base.__module__ == kind.__module__]
    for name, function in (method for base in own for method in functions_of(base).items()):
        node, first = definition_of(function.__code__)[1], function.__code__.co_varnames[:1]
        parts = ast.walk(node) if node is not None and name not in _MAKING else ()
        for base in (written for part in parts for written in _written(part)):
            while isinstance(base, ast.Subscript | ast.Attribute):
                base = base.value
            if any(isinstance(part, ast.Name) and part.id in first for part in ast.walk(base)):
                return True
    return False


def _as_state(name: str, names: Mapping[str, Any]) -> str:
    """Return how to keep the value of a name from event to event; it begins empty, as it most likely did."""
    value = names.get(name)
    kind: type[Any] = type(value)
    return f"{keep_as_state(name, repr(kind()) if kind in _EMPTY else 'None')}."


def _written(node: ast.AST) -> Iterator[ast.expr]:
    """Give the expressions whose objects a part of a program writes into, if they are containers or attributes."""
    if isinstance(node, ast.Subscript | ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
        yield node
    if isinstance(node, ast.Call):
        yield from _attribute_of(node, "setattr", "delattr")
        yield from (part.value for part in node.keywords if part.arg in ("out", "dst"))
        if isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING:
            yield node.func.value


def _attribute_of(node: ast.AST, *functions: str) -> Iterator[ast.expr]:
    """Give the attribute that getattr, setattr or delattr is called with."""
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") in functions and len(node.args) > 1:
        attribute = ast.Attribute(node.args[0], str(getattr(node.args[1], "value", "")), ast.Store())
        yield ast.copy_location(attribute, node)


def _is_container(node: ast.expr, names: Mapping[str, Any]) -> bool:
    """Whether an expression is of a kind that is written into; of no dotted name, whether that which it is of is."""
    value = evaluated(node, names)
    value = names.get(_root(node)) if value is None else value
    return isinstance(value, list | dict | set | bytearray | deque) or is_plain_array(value)


def _root(node: ast.expr) -> str:
    """Return the name of what a subscript or attribute is of; "" if that is no name."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


# -- what only a notebook has ----------------------------------------------------------------------------------------

_NAMES_OF_NOTEBOOKS: Final = {
    "get_ipython": "the notebook itself, as magics and shell escapes do. Write it in Python, or elsewhere",
    "display": "which shows something in the notebook; a service shows nothing. Return it as a token",
    "input": "which asks a person. Make the answer a token",
    "breakpoint": "which waits for a person. Leave it out",
    "globals": "all names of the notebook. Use those that you need by name",
    "exit": "which ends the notebook. Raise an exception",
    "quit": "which ends the notebook. Raise an exception",
    "In": "the notebook's cells. Make the text a token",
    "Out": "what the notebook's cells have shown. Make the value a token",
    "eval": "which may use any name. Write what it evaluates",
    "exec": "which may use any name. Write what it runs",
    "__import__": "which imports what no statement says. Write an import statement",
} | dict.fromkeys(
    ("__name__", "__file__", "__doc__", "__spec__", "__loader__", "__package__", "__builtins__", "__cached__"),
    "which is another one in a bundle. Write the value itself, or make it a token",
)


def check_notebook_name(name: str, found: Definition) -> None:
    """Refuse a name that means something in a notebook alone."""
    if name in _NAMES_OF_NOTEBOOKS and not is_of_notebook(found.names.get(name)):
        raise Refused(f"{found.what} uses {name!r} ({found.place_of(name)}), {_NAMES_OF_NOTEBOOKS[name]}.")


# By these a function reaches what no name in it says: a namespace, or whatever a text evaluates to.
_REFLECTING: Final = (
    *(builtins.eval, builtins.exec, sys.modules, sys._getframe, inspect.currentframe, inspect.stack),
    *(gc.get_objects, gc.get_referents, gc.get_referrers),
)
_REFLECTING_ATTRIBUTES: Final = frozenset(
    {"__globals__", "__builtins__", "f_globals", "f_locals", "f_builtins", "f_back"}
)


def _check_reflection(found: Definition, names: Mapping[str, Any]) -> None:
    """Refuse a definition that reads the notebook's names otherwise than by name."""
    for node in ast.walk(found.node):
        for read in (node, *_attribute_of(node, "getattr")):
            value = evaluated(read, names) if isinstance(read, ast.Name | ast.Attribute) else None
            is_main = isinstance(read, ast.Constant) and read.value == "__main__"
            is_reflecting = any(value is one for one in _REFLECTING)
            if is_main or is_reflecting or getattr(read, "attr", "") in _REFLECTING_ATTRIBUTES:
                text = f"{found.what} uses {ast.unparse(read)!r} ({found.place_in(node)}), by which it reaches"
                raise Refused(f"{text} what no name in it says. Use what you need by its name, or make it a token.")


# -- monkeypatches ---------------------------------------------------------------------------------------------------


def check_reads(found: Definition, known: Patches) -> None:
    """Refuse a definition that reads by reflection, or what the notebook has changed in a library's module or class."""
    names = {**sys.modules, **found.names, **imported_by(found)}
    _check_reflection(found, names)
    # A module or class by itself, as in getattr(module, name), may be asked for any name.
    dotted = {id(node.value) for node in ast.walk(found.node) if isinstance(node, ast.Attribute)}
    changed = {id(owner): (owner, name, place) for (owner, name), place in known.items()}
    place = known.get((os, "environ"), "")
    changed |= {id(one): (os, "environ", place) for one in _READS_ENVIRONMENT if place}
    for node in ast.walk(found.node):
        if isinstance(node, ast.Name | ast.Attribute) and (
            id(node) not in dotted or evaluated(node, names) is os.environ
        ):
            owner, name, place = changed.get(id(evaluated(node, names)), (None, "", ""))
            if owner is not None:
                raise _patched(found.what, f"{owner.__name__}.{name}", place)
    of_classes = {name: (owner, name) for owner, name in known if isinstance(owner, type)}
    home = loaded_module(str(found.names.get("__name__")))
    for owner, name in (*_read_by(found.node, names), *((home, name) for name in found.reads())):
        if not isinstance(owner, types.ModuleType):  # the class of an object can't be seen
            owner, name = of_classes.get(name, (None, name))
        place = _place_of_patch(known, owner, name, found.place_in(found.node))
        if place:
            raise _patched(found.what, name if owner is builtins else f"{owner.__name__}.{name}", place)


def check_home(module: str, qualname: str, what: str, known: Patches) -> None:
    """Refuse an object that can be imported only as the notebook has changed it."""
    name = qualname.partition(".")[0]
    place = _place_of_patch(known, loaded_module(module), name, "by a name that no text has")
    if place:
        raise _patched(what, f"{module}.{qualname}", place)


def _patched(what: str, name: str, place: str) -> Refused:
    if name == "os.environ":
        text = f"{what} reads the environment, which the notebook has changed ({place}); a service has its own"
        return Refused(f"{text}. Read it in the notebook, and make the value a token.")
    text = f"{what} uses {name!r}, which the notebook has changed ({place}); a service has it as it was installed"
    return Refused(f"{text}. Call yours by a name of its own, or make the value a token.")


def imported_by(found: Definition) -> dict[str, Any]:
    """Return what a definition imports itself, by name; refuse the notebook as a module."""
    names: dict[str, Any] = {}
    for node in (node for node in ast.walk(found.node) if isinstance(node, ast.Import | ast.ImportFrom)):
        for alias in node.names:
            try:
                source = module_of_import(node, alias, found.names)
            except ImportError:  # the function raises the same when it is called
                continue
            if "__main__" in (source, alias.name):
                text = f"{found.what} imports the notebook itself, as '__main__' ({found.place_in(node)})"
                raise Refused(f"{text}. Use what it has by its own name, without the module.")
            module = loaded_module(source)
            part = getattr(module, alias.name, loaded_module(f"{source}.{alias.name}"))
            names[alias.asname or alias.name] = part if isinstance(node, ast.ImportFrom) else module
    return names


def _place_of_patch(known: Patches, owner: Any, name: str, otherwise: str) -> str:
    """Return where the notebook has changed what a module or class has; "" if it has not, ``otherwise`` if unknown."""
    return known.get((owner, name), "") or (otherwise if _is_patched(owner, name) else "")


def _is_patched(owner: Any, name: str) -> bool:
    """Whether a module has a function, class or mock of the notebook, in whatever way that was put there."""
    is_library = isinstance(owner, types.ModuleType) and owner.__name__ not in ("__main__", "unittest.mock")
    value = vars(owner).get(name) if is_library else None
    is_own = isinstance(value, types.FunctionType) and value.__globals__.get("__name__") == "__main__"
    homes = (getattr(value, "__module__", ""), type(value).__module__)
    return is_own or not {"__main__", "unittest.mock"}.isdisjoint(home for home in homes if isinstance(home, str))


def patches_in_notebook() -> Patches:
    """Return what the notebook has changed, by module or class of a library and name there, each with its place."""
    return patches_in(_cells(), vars(sys.modules["__main__"]))


def environment_changed() -> str:
    """Return where cells have changed the environment; "" if they have not."""
    return patches_in_notebook().get((os, "environ"), "")


def patches_in(texts: Iterable[tuple[str, str]], names: Mapping[str, Any]) -> Patches:
    """Return what texts change in libraries; each comes with its name in a place, and ``names`` are what it reads."""
    found = dict[tuple[Any, str], str]()
    for cell, text in texts:
        for written in _written_in(text):
            node = written
            while isinstance(node, ast.Attribute | ast.Subscript):
                owner = evaluated(node.value, names) if isinstance(node, ast.Attribute) else None
                is_of_library = isinstance(owner, type) and owner.__module__ != "__main__"
                is_of_library |= isinstance(owner, types.ModuleType)
                if isinstance(node, ast.Attribute) and node.attr and is_of_library:
                    found[owner, node.attr] = f"{cell}, line {written.lineno}"
                    break
                node = node.value
            if _sets_environment(written) or evaluated(node, names) is os.environ:
                found[os, "environ"] = f"{cell}, line {written.lineno}"
    return found


def _sets_environment(node: ast.expr) -> bool:
    """Whether a call, also of a magic, sets variables of the environment."""
    if not isinstance(node, ast.Call):
        return False
    name, first = ast.unparse(node.func).rpartition(".")[2], getattr(next(iter(node.args), None), "value", "")
    return name in _SETS_ENVIRONMENT or (name == "run_line_magic" and first in ("env", "set_env"))


def _cells() -> Iterator[tuple[str, str]]:
    """Give the text of each cell that was executed, or of the script, after its name in a place."""
    names = vars(sys.modules["__main__"])
    script = str(names.get("__file__") or "")
    return ((f"cell [{cell}]" if cell else script, text) for cell, text in executed_cells(names, script))


@lru_cache(maxsize=512)  # every function of a graph asks for every cell
def _written_in(text: str) -> list[ast.expr]:
    tree = parsed(text)
    nodes = [*ast.walk(tree)] if tree else []
    calls = [node for node in nodes if isinstance(node, ast.Call) and _sets_environment(node)]
    return [*calls, *(written for node in nodes for written in _written(node))]


def _read_by(tree: ast.AST, names: Mapping[str, Any]) -> Iterator[tuple[Any, str]]:
    """Give the attributes that a definition reads, also by an import or by getattr, each with what it reads it of."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from ((sys.modules.get(node.module or ""), alias.name) for alias in node.names)
        for read in (node, *_attribute_of(node, "getattr")):
            if isinstance(read, ast.Attribute):
                yield evaluated(read.value, names), read.attr
            elif isinstance(read, ast.Name):
                yield builtins, read.id


def seeds_in_notebook() -> dict[str, str]:
    """Return the random generators of the whole process that the cells seed outside of functions, with the places."""
    found, names = dict[str, str](), {**sys.modules, **vars(sys.modules["__main__"])}
    for cell, text in _cells():
        waiting: list[ast.AST] = [*filter(None, [parsed(text)])]
        while waiting:
            node = waiting.pop()
            if isinstance(node, ast.Call) and (function := evaluated(node.func, names)) is not None:
                home, is_seed = global_generator("", function)
                found |= {home: f"{cell}, line {node.lineno}"} if home and is_seed else {}
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Lambda):
                waiting += ast.iter_child_nodes(node)
    return found


def places_of_change() -> tuple[dict[str, str], dict[str, str]]:
    """Return the last places in the cells that may have changed attributes of libraries, and that call functions.

    The first are by the names of attributes, to which something is assigned or which a text or keyword names; the
    second by the names of the functions.
    """
    named: dict[str, str] = {}
    called: dict[str, str] = {}
    for cell, text in _cells():
        tree = parsed(text)
        nodes: list[Any] = [*ast.walk(tree)] if tree else []
        read = {id(node.slice) for node in nodes if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load)}
        calls = [node for node in nodes if isinstance(node, ast.Call)]
        read |= {id(argument) for call in calls if getattr(call.func, "id", "") == "getattr" for argument in call.args}
        called |= {getattr(call.func, "attr", ""): f"{cell}, line {call.lineno}" for call in calls}
        for node in nodes:
            is_written = isinstance(node, ast.Attribute) and not isinstance(node.ctx, ast.Load)
            name = getattr(node, "attr" if is_written else "arg" if isinstance(node, ast.keyword) else "value", None)
            if isinstance(name, str) and id(node) not in read:
                named[name.rpartition(".")[2]] = f"{cell}, line {node.lineno}"
    return named, called
