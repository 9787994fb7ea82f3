"""What did the notebook say, and in which cell?

The cells that were executed are the text; of a script, it is the script.
"""

from __future__ import annotations

import ast
import linecache
import sys
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from epypes.bundle.text import parsed

_CELL_MAGIC: Final = "get_ipython().run_cell_magic("
_EXECUTING: Final = ("capture", "time", "prun")


@dataclass(frozen=True, slots=True)
class Statement:
    """A statement that gives names their values.

    Attributes
    ----------
    node
        Its syntax tree.
    lines
        The lines of its cell.
    cell
        The number of its cell, 0 in a script.
    """

    node: ast.stmt
    lines: tuple[str, ...]
    cell: int


def executed_cells(names: Mapping[str, Any]) -> list[tuple[int, str]]:
    """Return the cells that a notebook has executed, each with its number; none outside of notebooks."""
    cells = names.get("In")
    if not isinstance(cells, list):
        return []
    texts = ((number, _without_magic(cell)) for number, cell in enumerate(cells) if isinstance(cell, str))
    return [(number, text) for number, text in texts if text.strip()]


@lru_cache(maxsize=512)
def _without_magic(cell: str) -> str:
    """Return what a cell magic such as %%capture or %%time has executed of its cell, on the same lines."""
    tree = parsed(cell) if cell.lstrip().startswith(_CELL_MAGIC) else None
    call = getattr(tree.body[0], "value", None) if tree and len(tree.body) == 1 else None
    constants = (part.value for part in getattr(call, "args", ()) if isinstance(part, ast.Constant))
    texts = [value for value in constants if isinstance(value, str)]
    return f"\n{texts[2]}" if len(texts) == 3 and texts[0] in _EXECUTING else cell


def cell_of(file: str, names: Mapping[str, Any]) -> int:
    """Return the number of the cell that Python knows as a file, the last one of that text; 0 outside of notebooks."""
    source = "".join(linecache.getlines(file)).strip()
    numbers = (number for number, cell in executed_cells(names) if source and cell.strip() == source)
    return max(numbers, default=0)


def place_of(code: types.CodeType) -> str:
    """Return where code stands: the cell's number, if it is from a notebook, and the line."""
    return place_in(code.co_filename, code.co_firstlineno)


def place_in(file: str, number: int) -> str:
    """Return a place in a file or cell: the cell's number, if it is from a notebook, and the line."""
    names = vars(sys.modules["__main__"])
    cell = cell_of(file, names)
    # What a cell magic has executed begins on the second line.
    below = any(known == cell and text.startswith("\n") for known, text in executed_cells(names))
    return f"cell [{cell}], line {number + below}" if cell else f"{file}, line {number}"


def statements_of(name: str, names: Mapping[str, Any], file: str = "") -> Iterator[Statement]:
    """Return the statements that have given a name its value, the last one first.

    Parameters
    ----------
    name
        A global name.
    names
        The notebook's names.
    file
        Without a notebook, the text is that of this file.
    """
    texts = executed_cells(names)
    if not texts and file:
        texts = [(0, "".join(linecache.getlines(file)))]
    for cell, text in reversed(texts):
        for node in reversed(_givers(text).get(name, ())):
            yield Statement(node, tuple(text.split("\n")), cell)


@lru_cache(maxsize=512)  # every constant of a graph asks for every cell
def _givers(text: str) -> dict[str, tuple[ast.stmt, ...]]:
    """Return the statements of a cell by the global names that they give a value."""
    found: dict[str, tuple[ast.stmt, ...]] = {}
    tree = parsed(text)
    for node in _statements(tree.body) if tree else ():
        for name in dict.fromkeys(_given(node)):
            found[name] = (*found.get(name, ()), node)
    return found


def _statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Return statements and those inside of them, but not inside of functions and classes."""
    for node in body:
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            for field in ("body", "orelse", "finalbody"):
                yield from _statements(getattr(node, field, []))


def _given(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        for target in targets:
            parts = (part for part in ast.walk(target) if isinstance(part, ast.Name))
            yield from (part.id for part in parts if isinstance(part.ctx, ast.Store))
    elif isinstance(node, ast.Import | ast.ImportFrom):
        yield from (alias.asname or alias.name for alias in node.names)


def names_of(value: object, names: Mapping[str, Any]) -> list[str]:
    """Return the names that a notebook has given to an object, but those that hold what cells have shown."""
    return [name for name, known in names.items() if known is value and not name.startswith("_")]


def place_of_object(value: object, names: Mapping[str, Any], key: str = "") -> str:
    """Return where the notebook made an object, as far as its text says; "" if it does not.

    Parameters
    ----------
    value
        The object.
    names
        The notebook's names.
    key
        The name that the object has in a dict, as functions of a graph have.
    """
    for name in names_of(value, names):
        for statement in statements_of(name, names):
            return f"cell [{statement.cell}], line {statement.node.lineno}"
    for cell, text in reversed(executed_cells(names)):
        line = _line_of_key(text, key)
        if line:
            return f"cell [{cell}], line {line}"
    return ""


@lru_cache(maxsize=512)
def _line_of_key(text: str, key: str) -> int:
    """Return the last line of a cell where a dict has a key; 0 if none has."""
    tree = parsed(text)
    lines = [0]
    for node in ast.walk(tree) if tree and key else ():
        if isinstance(node, ast.Dict):
            lines += [part.lineno for part in node.keys if isinstance(part, ast.Constant) and part.value == key]
    return max(lines)
