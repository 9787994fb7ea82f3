"""Where in the notebook does what a module defines stand?"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from epypes.bundle.cells import cell_of, statements_of
from epypes.bundle.classes import ClassDefinition
from epypes.bundle.order import Position
from epypes.bundle.source import Definition

AnyDefinition = Definition | ClassDefinition


class Positions:
    """Cells and lines; without a notebook, files in the order in which they were met, and lines."""

    def __init__(self) -> None:
        self._files: dict[str, int] = {}
        self._first: AnyDefinition | None = None

    def learn(self, found: AnyDefinition) -> None:
        """Note whose names are those of the notebook."""
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
        """Return where the notebook gave a name its value, () if it does not say."""
        given = next(statements_of(name, self.notebook, self._first.file if self._first else ""), None)
        return (given.cell, 0, given.node.lineno) if given else ()
