"""In which order do definitions stand in a module?

In that of the notebook, but each after what it needs when the module is imported.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from epypes.bundle.text import parsed

Position = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Reads:
    """The names that a definition reads: when it is imported, and at all; and whether importing it calls something."""

    at_once: frozenset[str]
    ever: frozenset[str]
    calls: bool


def arranged(
    texts: Mapping[str, str], positions: Mapping[str, Position], known_reads: Mapping[str, frozenset[str]]
) -> list[str]:
    """Return the names of definitions in the order in which they stand in a module.

    Parameters
    ----------
    texts
        The definitions by name, in an order in which they could stand but for those that need each other.
    positions
        Where they stand in the notebook, as far as that is known; others stand before what needs them.
    known_reads
        The names that definitions read from outside, as far as that is known; of others, all that they mention.
    """
    reads = {name: _reads(text, known_reads.get(name)) for name, text in texts.items()}
    known = sorted((name for name in texts if name in positions), key=lambda name: positions[name])
    rank = {name: number for number, name in enumerate([*known, *(name for name in texts if name not in positions)])}
    done: dict[str, None] = {}
    for name in rank:
        if name in positions:
            _place(name, reads, rank, done)
    for name in rank:
        _place(name, reads, rank, done)
    return list(done)


def _place(name: str, reads: Mapping[str, _Reads], rank: Mapping[str, int], done: dict[str, None]) -> None:
    """Put a definition after those that it needs, which may need others."""
    pending, begun = [name], set()
    while pending:
        current = pending[-1]
        if current in done or current in begun:
            done[pending.pop()] = None
            continue
        begun.add(current)
        needed = [need for need in _needs(current, reads) if need not in done and need not in begun]
        pending += sorted(needed, key=lambda need: -rank[need])


def _needs(name: str, reads: Mapping[str, _Reads]) -> set[str]:
    """Return the definitions that must be there when one is imported: what is called then needs all that it reads."""
    found = set(reads[name].at_once & reads.keys())
    if reads[name].calls:
        pending = list(found)
        while pending:
            more = (reads[pending.pop()].ever & reads.keys()) - found
            found |= more
            pending += more
    return found - {name}


def _reads(text: str, ever: frozenset[str] | None) -> _Reads:
    tree = parsed(text)
    node = tree.body[0] if tree and tree.body else None
    if node is None:
        return _Reads(frozenset(), frozenset(), False)
    at_once = frozenset(_names(_at_once(node)))
    calls = isinstance(node, ast.ClassDef) or any(isinstance(part, ast.Call) for part in _at_once(node))
    calls = calls or bool(getattr(node, "decorator_list", []))
    return _Reads(at_once, frozenset(_names(ast.walk(node))) if ever is None else ever, calls)


def _names(parts: Iterator[ast.AST]) -> Iterator[str]:
    return (part.id for part in parts if isinstance(part, ast.Name))


def _at_once(node: ast.AST) -> Iterator[ast.AST]:
    """Return the parts of a statement that are read when it is, which the bodies of functions are not."""
    yield node
    for name, value in ast.iter_fields(node):
        if name == "body" and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST):
                yield from _at_once(part)
