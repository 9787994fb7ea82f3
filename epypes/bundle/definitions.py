"""In which order do functions, classes and constants stand?"""

from __future__ import annotations

import ast
from collections.abc import Iterator

from epypes.bundle.lines import assignment, piece_of
from epypes.bundle.slicer import Slice


def early_constants(needed: Slice) -> str:
    """Return the constants that need none of the module's functions and classes; they stand before these."""
    early = [name for name in needed.constants if not _needs(needed, name)]
    return "\n".join(line for name in early for line in _constant(needed, name))


def _constant(needed: Slice, name: str) -> list[str]:
    return assignment([name], True, piece_of(needed.constants[name]), 0)


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
