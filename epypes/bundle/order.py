"""The order of definitions: that of the notebook, but each after what it needs when the module is imported."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from epypes.bundle.classes import ClassDefinition
from epypes.bundle.definitions import Definition
from epypes.bundle.notebook_source import cell_of, parsed, statements_of

AnyDefinition = Definition | ClassDefinition
# The number of the cell, that of the file, the line.
Position = tuple[int, ...]


class Positions:
    """Where definitions stand: in cells and lines; without a notebook, in files as they were met, and lines."""

    def __init__(self) -> None:
        self._files: dict[str, int] = {}
        self._first: AnyDefinition | None = None

    def learn(self, found: AnyDefinition) -> None:
        """Take the notebook's names from the first definition."""
        self._first = self._first or found

    @property
    def notebook(self) -> Mapping[str, Any]:
        """The names of the notebook; none before anything of it was found."""
        return self._first.names if self._first else {}

    def names_with(self, kind: type) -> Mapping[str, Any]:
        """Return the names of the notebook that has a class."""
        return self.notebook if self.notebook.get(kind.__name__) is kind else vars(sys.modules["__main__"])

    def of_definition(self, found: AnyDefinition) -> Position:
        """Return where a function or class was defined."""
        cell = cell_of(found.file, found.names)
        return cell, 0 if cell else self._files.setdefault(found.file, len(self._files)), found.line

    def of_name(self, name: str) -> Position:
        """Return where the notebook gave a name its value, () if its text does not say."""
        given = next(statements_of(name, self.notebook, self._first.file if self._first else ""), None)
        return (given.cell, 0, given.node.lineno) if given else ()


def ordered(
    texts: Mapping[str, str], positions: Mapping[str, Position], reads: Mapping[str, frozenset[str]]
) -> list[str]:
    """Return the names of definitions in the order in which they stand in a module.

    Parameters
    ----------
    texts
        The definitions by name, in an order in which they could stand but for those that need each other.
    positions
        Where they stand in the notebook, as far as that is known; others stand before what needs them, or at the end.
    reads
        The names that definitions read from outside, as far as that is known; of others, all that they mention.
    """
    trees = {name: parsed(text) or ast.Module([], []) for name, text in texts.items()}
    mentioned = {name: reads[name] if name in reads else _names(ast.walk(tree)) for name, tree in trees.items()}
    needs = {name: _needs(name, tree, mentioned) for name, tree in trees.items()}
    found: dict[str, None] = {}
    begun: set[str] = set()
    pending = sorted(texts, key=lambda name: (name not in positions, positions.get(name, ())))[::-1]
    rank = {name: number for number, name in enumerate(pending)}
    while pending:
        if pending[-1] in begun:
            found[pending.pop()] = None
            continue
        begun.add(pending[-1])
        pending += sorted(needs[pending[-1]] - begun, key=rank.__getitem__)
    return list(found)


def _needs(name: str, tree: ast.Module, mentioned: Mapping[str, frozenset[str]]) -> set[str]:
    """Return the definitions that importing one reads; what it calls may read all that it mentions."""
    read = [part for statement in tree.body for part in _read_at_import(statement)]
    found = set(_names(iter(read)) & mentioned.keys())
    if any(isinstance(part, ast.Call | ast.ClassDef) or getattr(part, "decorator_list", []) for part in read):
        pending = list(found)
        while pending:
            more = (mentioned[pending.pop()] & mentioned.keys()) - found
            found |= more
            pending += more
    return found - {name}


def _names(parts: Iterator[ast.AST]) -> frozenset[str]:
    return frozenset(part.id for part in parts if isinstance(part, ast.Name))


def _read_at_import(node: ast.AST) -> Iterator[ast.AST]:
    """Give the parts of a statement that are executed at import, which the bodies of functions are not."""
    yield node
    for name, value in ast.iter_fields(node):
        if name == "body" and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST):
                yield from _read_at_import(part)
