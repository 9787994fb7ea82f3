"""The text of a module: imports, constants with their comments, definitions in the order of the notebook."""

from __future__ import annotations

import ast
import itertools
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from epypes.bundle.notebook_source import Statement, is_comment, parsed, statements_of
from epypes.bundle.syntax import LINE, UNKNOWN, is_data, is_same_data, laid_out, literal_value
from epypes.run.guard import is_plain_array

if TYPE_CHECKING:
    from epypes.bundle.slice import Slice

# The number of the cell, the line.
Position = tuple[int, ...]


def ordered(
    texts: Mapping[str, str],
    positions: Mapping[str, Position],
    reads: Mapping[str, frozenset[str]],
    closures: Collection[str],
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
    closures
        The names of closures: what makes them calls nothing of what it is given.
    """
    trees = {name: parsed(text) or ast.Module([], []) for name, text in texts.items()}
    mentioned = {name: reads[name] if name in reads else _names(ast.walk(tree)) for name, tree in trees.items()}
    needs = {name: _needs(name, tree, mentioned, name in closures) for name, tree in trees.items()}
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


def _needs(name: str, tree: ast.Module, mentioned: Mapping[str, frozenset[str]], is_closure: bool) -> set[str]:
    """Return the definitions that importing one reads; what it calls may read all that it mentions."""
    read = [part for statement in tree.body for part in _read_at_import(statement)]
    found = set(_names(iter(read)) & mentioned.keys())
    if not is_closure and any(
        isinstance(part, ast.Call | ast.ClassDef) or getattr(part, "decorator_list", []) for part in read
    ):
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
        if isinstance(given, ast.expr):
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
    position = (statement.cell, node.lineno)
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


def module_text(head: Sequence[str], needed: Slice, tail: Sequence[str]) -> str:
    """Return the text of a module: what stands at its head, what its functions need, and what stands behind that."""
    texts = {name: text.rstrip() for name, text in needed.definitions.items()}
    positions = {**needed.positions, **{name: remark.position for name, remark in needed.remarks.items()}}
    early: list[str] = []
    for name in sorted(needed.constants, key=lambda name: (name not in needed.remarks, positions.get(name, ()))):
        lines = constant_lines(name, needed.constants[name], needed.remarks.get(name))
        read = {node.id for node in ast.walk(ast.parse(needed.constants[name])) if isinstance(node, ast.Name)}
        if read & needed.definitions.keys():
            texts[name] = "\n".join(lines)
        else:
            early += [*[""][: bool(early) and lines[0].startswith("#")], *lines]
    reader = needed.arrays.reader(needed)
    imports = [_import_lines(needed.imports.values())] if needed.imports else []
    constants = ["\n".join(early)] if early else []
    sections = ["\n\n".join([*head, *imports, *([] if reader else constants)])]
    if reader:
        sections += [reader, *constants]
    names = ordered(texts, positions, needed.reads, needed.closures)
    for are_constants, group in itertools.groupby(names, needed.constants.__contains__):
        found = [texts[name] for name in group]
        sections += ["\n".join(found)] if are_constants else found
    return "\n\n\n".join([*filter(None, sections), *tail]) + "\n"


def _import_lines(statements: Iterable[str]) -> str:
    """Return imports in order: Python's own first, whole modules before names from modules."""
    in_order = sorted(dict.fromkeys(statements), key=lambda text: (text.startswith("from"), text.lower(), text))
    first = [text for text in in_order if text.startswith("from __future__")]
    others = [text for text in in_order if text.split()[1].partition(".")[0] not in sys.stdlib_module_names]
    own = [text for text in in_order if text not in first and text not in others]
    return "\n\n".join("\n".join(part) for part in (first, own, others) if part)
