"""Does a function change what outlives its call, or ask for what a service has not?"""

from __future__ import annotations

import ast
import dis
import types
from collections.abc import Collection
from typing import Any, Final

from epypes.bundle.changes import changes, is_container
from epypes.bundle.classes import ClassDefinition
from epypes.bundle.source import Definition, Refused
from epypes.bundle.text import nested_codes

_ASKED: Final = {
    "get_ipython": "the notebook itself, as magics and shell escapes do. Write it in Python, or elsewhere",
    "display": "which shows something in the notebook; a service has nobody to show it to. Return it as a token",
    "input": "which asks a person. Make the answer a token",
    "breakpoint": "which waits for a person. Leave it out",
    "exit": "which ends the notebook. Raise an exception",
    "quit": "which ends the notebook. Raise an exception",
    "globals": "all names of the notebook. Use those that you need by name",
    "eval": "which may use any name. Write what it evaluates",
    "exec": "which may use any name. Write what it runs",
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
    for node, name in changes(found.node, found.names):
        if name in names and (not isinstance(node, ast.Call) or _may_change(found.names.get(name))):
            text = f"{what} writes into {name!r}, which outlives the call ({found.place_in(node)})"
            raise Refused(f"{text}: the next event would find it different. Copy it first, or make it a token.")


def _may_change(value: Any) -> bool:
    """Whether a call of a method may have changed a value."""
    return is_container(value) or isinstance(value, type)


def check_asked(name: str, value: Any, found: Definition | ClassDefinition, what: str) -> None:
    """Refuse a name that means something in a notebook alone."""
    if name in _ASKED and not (isinstance(value, types.FunctionType) and value.__module__ == "__main__"):
        raise Refused(f"{what} uses {name!r} ({found.place_of(name)}), {_ASKED[name]}.")
    if name == "vars" and any(map(_asks_for_names, ast.walk(found.node))):
        raise Refused(f"{what} uses 'vars()' ({found.place_of(name)}), all names there are. Use those that you need.")
    if name in _OF_A_MODULE:
        text = f"{what} uses {name!r} ({found.place_of(name)}), which is another one in a bundle"
        raise Refused(f"{text}. Write the value itself, or make it a token.")


def _asks_for_names(node: ast.AST) -> bool:
    """Whether this is ``vars()``, or a module's."""
    is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "vars"
    return isinstance(node, ast.Call) and is_call and not any(isinstance(part, ast.Name) for part in node.args)
