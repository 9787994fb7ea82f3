"""Constants of the notebook in the module: spelled as they were, with the comment above or beside them."""

from __future__ import annotations

import ast
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from epypes.bundle.formatting import LINE, laid_out
from epypes.bundle.literal import UNKNOWN, is_data, is_same_data, literal_value
from epypes.bundle.notebook_source import Statement, is_comment, statements_of
from epypes.bundle.order import Position
from epypes.run.guard import is_plain_array


@dataclass(frozen=True, slots=True)
class Remark:
    """What the notebook has written about a constant.

    Attributes
    ----------
    position
        Where it stands.
    above, beside
        Lines of comment.
    statement
        The assignment as it stands there, if it makes the same value wherever it stands; else "".
    """

    position: Position
    above: tuple[str, ...] = ()
    beside: str = ""
    statement: str = ""


def imported_as(name: str, value: Any, names: Mapping[str, Any], file: str) -> tuple[str, str]:
    """Return the module from which a notebook imported a value, and what it is called there; else empty strings."""
    for statement in statements_of(name, names, file):
        node = statement.node
        if not isinstance(node, ast.ImportFrom) or node.level or not node.module:
            return "", ""
        own = next((alias.name for alias in node.names if (alias.asname or alias.name) == name), name)
        there = getattr(sys.modules.get(node.module), own, UNKNOWN)
        return (node.module, own) if _is_same(there, value) else ("", "")
    stars = (statement.node for statement in statements_of("*", names, file))
    modules = (node.module for node in stars if isinstance(node, ast.ImportFrom) and not node.level)
    found = (module for module in modules if _is_same(getattr(sys.modules.get(module or ""), name, UNKNOWN), value))
    return next(((module, name) for module in found if module), ("", ""))


def _is_same(one: Any, other: Any) -> bool:
    return one is other or is_same_data(one, other)


def remark_on(name: str, value: Any, source: str, names: Mapping[str, Any], file: str) -> Remark | None:
    """Return what a notebook says where it last gave a name this value; None if it does not say it.

    Parameters
    ----------
    name, value, source
        The constant, and the expression that makes it again.
    names
        The notebook's names.
    file
        The file of a function that reads it.
    """
    for statement in statements_of(name, names, file):
        given = getattr(statement.node, "value", None)
        if not isinstance(given, ast.expr):
            continue
        written = literal_value(given) if _is_assignment_to(name, statement.node) else UNKNOWN
        if written is UNKNOWN or is_same_data(written, value):
            return _remark(name, value, source, given, statement, written is not UNKNOWN)
    return None


def _is_assignment_to(name: str, node: ast.stmt) -> bool:
    """Whether a statement gives one name the value of one expression."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    plain = isinstance(node, ast.Assign | ast.AnnAssign) and len(targets) == 1
    return plain and isinstance(targets[0], ast.Name) and targets[0].id == name


def _remark(name: str, value: Any, source: str, given: ast.expr, statement: Statement, is_known: bool) -> Remark:
    node, lines = statement.node, statement.lines
    position = (statement.cell, 0, node.lineno)
    if not _is_assignment_to(name, node):
        return Remark(position)
    first = number = node.lineno - 1
    while first and is_comment(lines[first - 1], first):
        first -= 1
    rest = lines[(node.end_lineno or 1) - 1].encode()[node.end_col_offset :].decode().strip()
    above = tuple(line.strip() for line in lines[first:number])
    beside = rest if rest.startswith("#") else ""
    if is_known:
        text = ast.get_source_segment("\n".join(lines), node) if isinstance(node, ast.Assign) else ""
        return Remark(position, above, beside, text or f"{name} = {ast.unparse(given)}")
    is_computed = is_data(value) or is_plain_array(value)
    if not beside and is_computed and ast.unparse(ast.parse(source)) != ast.unparse(given):
        beside = f"# {ast.unparse(given)} in the notebook"
        beside = beside if len(beside) <= LINE else ""
    return Remark(position, above, beside)


def constant_lines(name: str, source: str, remark: Remark | None) -> list[str]:
    """Return the lines of a constant, with the comments of the notebook."""
    known = remark or Remark(())
    lines = known.statement.split("\n") if known.statement else laid_out(source, before=f"{name} = ")
    whole = f"{lines[-1]}  {known.beside}"
    if known.beside and (known.statement or len(lines) == 1) and len(whole) <= LINE:
        return [*known.above, *lines[:-1], whole]
    return [*known.above, *[known.beside][: bool(known.beside)], *lines]
