"""In which order do functions, classes and constants stand?"""

from __future__ import annotations

import ast
from collections.abc import Iterator

from epypes.bundle.constants import constant_lines, constants_text
from epypes.bundle.slicer import Slice


def early_constants(needed: Slice) -> str:
    """Return the constants that need none of the module's functions and classes; they stand before these."""
    early = {name: source for name, source in needed.constants.items() if not _needs(needed, name)}
    return "\n".join(constants_text(early, needed.remarks))


def _constant(needed: Slice, name: str) -> list[str]:
    return constant_lines(name, needed.constants[name], needed.remarks.get(name))


def _needs(needed: Slice, constant: str) -> set[str]:
    """Return the definitions that a constant is made with."""
    read = {node.id for node in ast.walk(ast.parse(needed.constants[constant])) if isinstance(node, ast.Name)}
    return read & needed.definitions.keys()


def definitions(needed: Slice) -> Iterator[str]:
    """Give functions and classes, each followed by the constants that are made with it."""
    waiting = {name: _needs(needed, name) for name in needed.constants}
    waiting = {name: needs for name, needs in waiting.items() if needs}
    there: set[str] = set()
    for name, found in needed.definitions.items():
        yield found.text.rstrip()
        there.add(name)
        ready = [constant for constant, needs in waiting.items() if needs <= there]
        for constant in ready:
            del waiting[constant]
        if ready:
            yield "\n".join(line for constant in ready for line in _constant(needed, constant))
