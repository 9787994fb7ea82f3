"""Does a function change what outlives its call, or ask for what a service has not?"""

from __future__ import annotations

import ast
import dis
import types
from collections import deque
from collections.abc import Collection, Iterator
from typing import Any, Final

from epypes.bundle.classes import ClassDefinition
from epypes.bundle.source import Definition, Refused
from epypes.bundle.text import nested_codes
from epypes.run.guard import is_plain_array

# Methods of lists, dicts, sets, deques and arrays that change them.
CHANGING: Final = frozenset(
    {
        *("append", "appendleft", "extend", "extendleft", "insert", "pop", "popleft", "popitem", "remove", "clear"),
        *("update", "setdefault", "add", "discard", "sort", "reverse", "fill", "itemset", "put", "resize"),
        *("difference_update", "intersection_update", "symmetric_difference_update", "setfield", "setflags"),
    }
)
_ASKED: Final = {
    "get_ipython": "the notebook itself, as magics and shell escapes do. Write it in Python, or elsewhere",
    "display": "which shows something in the notebook; a service has nobody to show it to. Return it as a token",
    "input": "which asks a person. Make the answer a token",
    "breakpoint": "which waits for a person. Leave it out",
    "exit": "which ends the notebook. Raise an exception",
    "quit": "which ends the notebook. Raise an exception",
    "In": "the notebook's cells. Make the text a token",
    "Out": "what the notebook's cells have shown. Make the value a token",
}
_OF_A_MODULE: Final = frozenset(
    ["__name__", "__file__", "__doc__", "__spec__", "__loader__", "__package__", "__builtins__", "__cached__"]
)


def check_state(found: Definition, names: Collection[str], what: str) -> None:
    """Refuse a function that changes something outside of it.

    Parameters
    ----------
    found
        Its definition.
    names
        The names that it has from outside.
    what
        How to call it in a reason.
    """
    for code in nested_codes(found.function.__code__):
        for instruction in dis.get_instructions(code):
            name = instruction.argval
            if instruction.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
                raise Refused(f"{what} changes the global {name!r} ({found.place_of(name)}). Return the value.")
    for node, name in _changes(found.node):
        if name in names and (not isinstance(node, ast.Call) or _is_container(found.names.get(name))):
            text = f"{what} writes into {name!r}, which outlives the call ({found.place_in(node)})"
            raise Refused(f"{text}: the next event would find it different. Copy it first, or make it a token.")


def _is_container(value: Any) -> bool:
    return isinstance(value, list | dict | set | bytearray | deque) or is_plain_array(value)


def check_asked(name: str, value: Any, found: Definition | ClassDefinition, what: str) -> None:
    """Refuse a name that means something in a notebook alone."""
    if name in _ASKED and not (isinstance(value, types.FunctionType) and value.__module__ == "__main__"):
        raise Refused(f"{what} uses {name!r} ({found.place_of(name)}), {_ASKED[name]}.")
    if name in _OF_A_MODULE:
        text = f"{what} uses {name!r} ({found.place_of(name)}), which is another one in a bundle"
        raise Refused(f"{text}. Write the value itself, or make it a token.")


def _changes(tree: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """Return what changes the object that a name means, with the name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript | ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
            yield node, _root(node)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING:
            yield node, _root(node.func) if isinstance(node.func.value, ast.Name | ast.Subscript) else ""


def _root(node: ast.expr) -> str:
    """Return the name of what a subscript or attribute is of."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""
