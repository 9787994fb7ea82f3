"""Static checks that name the line: writes to state that outlives a call, monkeypatches, and what only a notebook has.

What syntax can't see is found by the replays, and by the snapshot that guards the functions of a loaded bundle.
"""

from __future__ import annotations

import ast
import builtins
import dis
import sys
import types
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any, Final

from epypes.bundle.notebook_source import (
    definition_of,
    executed_cells,
    names_from_outside,
    nested_codes,
    parsed,
    place_in,
)
from epypes.bundle.resolve import Definition, Importable, Refused, captured_by, evaluated, is_of_notebook
from epypes.run.guard import is_plain_array

# -- writes to what outlives a call ----------------------------------------------------------------------------------

# Methods of lists, dicts, sets, deques and arrays that change them.
CHANGING: Final = frozenset(
    {
        *("append", "appendleft", "extend", "extendleft", "insert", "pop", "popleft", "popitem", "remove", "clear"),
        *("update", "setdefault", "add", "discard", "sort", "reverse", "fill", "itemset", "put", "resize"),
        *("difference_update", "intersection_update", "symmetric_difference_update", "setfield", "setflags"),
    }
)


def check_state(found: Definition) -> None:
    """Refuse a definition of the notebook that changes something outside of it, or has a decorator that does."""
    for decorator, wrapper in found.wrappers:
        called = decorator.func if isinstance(decorator, ast.Call) else decorator
        what = f"{found.what} is wrapped by a decorator, @{ast.unparse(decorator)} ({found.place_in(decorator)}):"
        for function in (evaluated(called, found.names), wrapper):
            node = definition_of(function.__code__)[1] if is_of_notebook(function) else None
            if node is not None:
                _check_function(function, node, f"{what} {node.name!r}")
    if found.function is not None:
        _check_function(found.function, found.node, found.what)
    else:
        _check_names(found.codes(), (), found.node, found.file, found.what)


def _check_function(function: types.FunctionType, node: ast.AST, what: str) -> None:
    code = function.__code__
    codes, names = [*nested_codes(code)], {**function.__globals__, **captured_by(function)}
    _check_names(codes, code.co_freevars, node, code.co_filename, what)
    outside = {*code.co_freevars, *(name for inner in codes for name in names_from_outside(inner))}
    for part in ast.walk(node):
        for written in _written(part):
            name = _root(written)
            is_plain = isinstance(getattr(written, "ctx", None), ast.Store | ast.Del)
            if name in outside and (is_plain or _is_container(written, names)):
                place = place_in(code.co_filename, getattr(part, "lineno", code.co_firstlineno))
                text = f"{what} writes into {name!r}, which outlives the call ({place})"
                raise Refused(f"{text}: the next event would find it different. Copy it first, or make it a token.")


_BINDING: Final = ("STORE_GLOBAL", "DELETE_GLOBAL", "STORE_DEREF", "DELETE_DEREF")


def _check_names(codes: Iterable[types.CodeType], captured: Iterable[str], node: ast.AST, file: str, what: str) -> None:
    """Refuse what gives other values to global names, or to names of the function around it."""
    for one in (one for code in codes for one in dis.get_instructions(code) if one.opname in _BINDING):
        name, is_captured = one.argval, one.argval in captured
        if is_captured or "GLOBAL" in one.opname:
            parts = (part for part in ast.walk(node) if not isinstance(part, ast.Global))
            uses = (part for part in parts if getattr(part, "id", "") == name or name in getattr(part, "names", ()))
            place = place_in(file, getattr(next(uses, node), "lineno", 1))
            text = f"{name!r} of the function around it" if is_captured else f"the global {name!r}"
            raise Refused(
                f"{what} changes {text} ({place}). Return the value. Make it a token if the next event needs it."
            )


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
        yield ast.Attribute(node.args[0], str(getattr(node.args[1], "value", "")), ast.Store())


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

_ASKED: Final = {
    "get_ipython": "the notebook itself, as magics and shell escapes do. Write it in Python, or elsewhere",
    "display": "which shows something in the notebook; a service shows nothing. Return it as a token",
    "input": "which asks a person. Make the answer a token",
    "breakpoint": "which waits for a person. Leave it out",
    "globals": "all names of the notebook. Use those that you need by name",
    "eval": "which may use any name. Write what it evaluates",
    "exec": "which may use any name. Write what it runs",
} | dict.fromkeys(
    ("__name__", "__file__", "__doc__", "__spec__", "__loader__", "__package__", "__builtins__", "__cached__"),
    "which is another one in a bundle. Write the value itself, or make it a token",
)


def check_asked(name: str, found: Definition) -> None:
    """Refuse a name that means something in a notebook alone."""
    if name in _ASKED and not is_of_notebook(found.names.get(name)):
        raise Refused(f"{found.what} uses {name!r} ({found.place_of(name)}), {_ASKED[name]}.")


# -- monkeypatches ---------------------------------------------------------------------------------------------------


def check_patches(found: Definition) -> None:
    """Refuse a definition that reads what the notebook has changed in a module or in a class of a library."""
    known = _patches()
    of_classes = {name: (owner, name) for owner, name in known if isinstance(owner, type)}
    for owner, name in _read_by(found):
        if not isinstance(owner, types.ModuleType):  # the class of an object can't be seen
            owner, name = of_classes.get(name, (None, name))
        if (owner, name) in known:
            _refuse(owner, name, known[owner, name], found.what)


def check_home(home: Importable, what: str) -> None:
    """Refuse what can be imported only as the notebook has changed it."""
    key = sys.modules[home.module], home.qualname.partition(".")[0]
    place = _patches().get(key)
    if place:
        _refuse(*key, place, what)


def _refuse(owner: Any, name: str, place: str, what: str) -> None:
    spelled = name if owner is builtins else f"{owner.__name__}.{name}"
    text = f"{what} uses {spelled!r}, which the notebook has changed ({place}); a service has it as it was installed"
    raise Refused(f"{text}. Call yours by a name of its own, or make the value a token.")


def _patches() -> dict[tuple[Any, str], str]:
    """Return what the notebook has changed, by module or class of a library and name there, each with its place."""
    names, found = vars(sys.modules["__main__"]), dict[tuple[Any, str], str]()
    script = str(names.get("__file__") or "")
    for cell, text in executed_cells(names, script):
        for written, line in _written_in(text):
            node = written
            while isinstance(node, ast.Attribute | ast.Subscript):
                owner = evaluated(node.value, names)
                is_of_library = isinstance(owner, type) and owner.__module__ != "__main__"
                if isinstance(node, ast.Attribute) and (is_of_library or isinstance(owner, types.ModuleType)):
                    found[owner, node.attr] = f"cell [{cell}], line {line}" if cell else f"{script}, line {line}"
                    break
                node = node.value
    return found


@lru_cache(maxsize=512)  # every function of a graph asks for every cell
def _written_in(text: str) -> list[tuple[ast.expr, int]]:
    tree = parsed(text)
    nodes = ast.walk(tree) if tree else ()
    return [(written, getattr(node, "lineno", 1)) for node in nodes for written in _written(node)]


def _read_by(found: Definition) -> Iterator[tuple[Any, str]]:
    """Give the attributes that a definition reads, also by an import or by getattr, each with what it reads it of."""
    names = {**sys.modules, **found.names}  # it may import modules itself
    for node in ast.walk(found.node):
        if isinstance(node, ast.ImportFrom):
            yield from ((sys.modules.get(node.module or ""), alias.name) for alias in node.names)
        for read in (node, *_attribute_of(node, "getattr")):
            if isinstance(read, ast.Attribute):
                yield evaluated(read.value, names), read.attr
            elif isinstance(read, ast.Name):
                yield builtins, read.id
