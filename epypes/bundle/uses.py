"""Which names and modules from outside does a function use?"""

from __future__ import annotations

import ast
import dis
import types
from collections.abc import Iterator, Mapping
from typing import Any

from epypes.bundle.source import Definition, Refused
from epypes.bundle.text import nested_codes


def global_names(found: Definition, what: str) -> Iterator[str]:
    """Return the global names that a function reads when it is called or defined, each once, in order of use."""
    names: dict[str, None] = {}
    for code in nested_codes(found.code):
        for instruction in dis.get_instructions(code):
            if instruction.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
                raise Refused(f"{what} changes the global {instruction.argval!r} ({found.place}). Return the value.")
        names.update(dict.fromkeys(names_from_outside(code)))
    arguments = found.node.args
    every = (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg)
    outside = [argument.annotation for argument in every if argument] + [found.node.returns]
    outside += [*arguments.defaults, *arguments.kw_defaults]
    for expression in (*outside, *found.node.decorator_list):
        for node in ast.walk(expression) if expression else ():
            if isinstance(node, ast.Name):
                names[node.id] = None
    return iter(names)


def names_from_outside(code: types.CodeType) -> Iterator[str]:
    """Return the names that code reads, but for those that the body of a class has given a meaning before."""
    own = {"__name__"}  # a class reads the module's, whichever that is
    for instruction in dis.get_instructions(code):
        if instruction.opname == "STORE_NAME":
            own.add(instruction.argval)
        elif instruction.opname == "LOAD_GLOBAL" or (
            instruction.opname == "LOAD_NAME" and instruction.argval not in own
        ):
            yield instruction.argval


def submodules(tree: ast.AST, name: str, module: types.ModuleType) -> tuple[str, ...]:
    """Return the submodules that are reached as attributes (``skimage.filters``): each needs an import of its own."""
    found: dict[str, None] = {}
    for node in ast.walk(tree):
        chain = _chain(node)
        if chain and chain[0] == name:
            reached: Any = module
            dotted = name
            for part in chain[1:]:
                reached = getattr(reached, part, None)
                if not isinstance(reached, types.ModuleType) or reached.__name__ != f"{dotted}.{part}":
                    break
                dotted = f"{dotted}.{part}"
            if dotted != name:
                found[dotted] = None
    return tuple(found)


def in_module(expression: ast.AST, names: Mapping[str, Any]) -> Any:
    """Return what a dotted name means that starts with a module (``cv2.NORM_HAMMING``); None for anything else."""
    chain = _chain(expression)
    reached = names.get(chain[0]) if chain else None
    if not isinstance(reached, types.ModuleType) or reached.__name__ == "__main__":
        return None
    for part in chain[1:]:
        reached = getattr(reached, part, None)
    return reached


def _chain(node: ast.AST) -> list[str]:
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return [node.id, *reversed(parts)] if isinstance(node, ast.Name) and parts else []
