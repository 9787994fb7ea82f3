"""What from outside does a function write into?"""

from __future__ import annotations

import ast
import types
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, Final

from epypes.bundle.source import evaluated
from epypes.bundle.text import definition_of
from epypes.run.guard import is_plain_array

# Methods of lists, dicts, sets, deques and arrays that change them.
CHANGING: Final = frozenset(
    {
        *("append", "appendleft", "extend", "extendleft", "insert", "pop", "popleft", "popitem", "remove", "clear"),
        *("update", "setdefault", "add", "discard", "sort", "reverse", "fill", "itemset", "put", "resize"),
        *("difference_update", "intersection_update", "symmetric_difference_update", "setfield", "setflags"),
    }
)
# Functions of libraries that write into one of their arguments, with its place.
_WRITES: Final = {
    **dict.fromkeys(("accumulate", "accumulateSquare", "accumulateWeighted"), 1),
    "accumulateProduct": 2,
    **dict.fromkeys(("line", "circle", "rectangle", "ellipse", "putText", "polylines", "fillPoly", "drawContours"), 0),
    **dict.fromkeys(("fillConvexPoly", "arrowedLine", "drawMarker", "drawChessboardCorners", "floodFill"), 0),
    **dict.fromkeys(("copyto", "put", "place", "putmask", "fill_diagonal", "at", "shuffle"), 0),
    **dict.fromkeys(("heappush", "heappop", "heapify", "heapreplace", "insort", "insort_left", "insort_right"), 0),
    **dict.fromkeys(("setattr", "delattr", "setitem", "delitem"), 0),
}
_INTO: Final = frozenset(("out", "dst"))
# A function that hands its argument on may do so to another one.
_DEEPEST: Final = 4


def changes(tree: ast.AST, names: Mapping[str, Any], depth: int = _DEEPEST) -> Iterator[tuple[ast.AST, str]]:
    """Return what changes the object that a name means, with the name.

    Parameters
    ----------
    tree
        A function.
    names
        What names mean that it has from outside.
    depth
        How deep functions that it calls are followed.
    """
    aliases = _aliases(tree, names)
    for node in ast.walk(tree):
        for written in _written(node, names, depth):
            root = root_of(written)
            yield node, aliases.get(root, root)
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name) and node.target.id in aliases:
            of = aliases[node.target.id]
            if is_container(names.get(of)):
                yield node, of


def _written(node: ast.AST, names: Mapping[str, Any], depth: int) -> Iterator[ast.expr]:
    """Return the expressions whose objects a part of a function writes into."""
    if isinstance(node, ast.Subscript | ast.Attribute) and isinstance(node.ctx, ast.Store | ast.Del):
        yield node
    if not isinstance(node, ast.Call):
        return
    if isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING:
        of = node.func.value
        if isinstance(of, ast.Name | ast.Subscript) or is_container(evaluated(of, names)):
            yield of
    function = evaluated(node.func, names)
    if isinstance(function, types.FunctionType) and function.__module__ == "__main__" and depth:
        yield from _into_arguments(node, function, depth - 1)
        return
    yield from (part.value for part in node.keywords if part.arg in _INTO)
    place = _WRITES.get(getattr(node.func, "attr", getattr(node.func, "id", "")), len(node.args))
    yield from node.args[place : place + 1]


def _into_arguments(node: ast.Call, function: types.FunctionType, depth: int) -> Iterator[ast.expr]:
    """Return the arguments of a call that a function of the notebook writes into."""
    _, definition = definition_of(function.__code__)
    if definition is None:
        return
    every = (*definition.args.posonlyargs, *definition.args.args)
    # Whatever the arguments are, they count as containers here: the caller's are looked at later.
    own: dict[str, Any] = {argument.arg: [] for argument in (*every, *definition.args.kwonlyargs)}
    written = {root for _, root in changes(definition, {**function.__globals__, **own}, depth)}
    written = {name for name in written if _stores(definition, name) == _augmented(definition, name)}
    by_place = zip(every, node.args, strict=False)
    yield from (given for argument, given in by_place if argument.arg in written)
    yield from (part.value for part in node.keywords if part.arg in written)


def _aliases(tree: ast.AST, names: Mapping[str, Any]) -> dict[str, str]:
    """Return the locals that mean nothing but what a name from outside means, or a part of that."""
    known: dict[str, set[str]] = {}
    for node in ast.walk(tree):
        pairs = [(node.targets[0], node.value)] if isinstance(node, ast.Assign) and len(node.targets) == 1 else []
        pairs += [(node.target, node.iter)] if isinstance(node, ast.For) else []
        for target, value in pairs:
            if isinstance(target, ast.Name):
                known.setdefault(target.id, set()).add(_shared(value, names))
    arguments = {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    once = {
        name: next(iter(of))
        for name, of in known.items()
        if len(of) == 1 and _stores(tree, name) - _augmented(tree, name) == 1 and name not in arguments
    }
    for _ in once:
        once = {name: once.get(of, of) for name, of in once.items()}
    return {name: of for name, of in once.items() if of and of != name}


def _stores(tree: ast.AST, name: str) -> int:
    """Return how often a name is given a value."""
    names = (node for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id == name)
    return sum(isinstance(node.ctx, ast.Store) for node in names)


def _augmented(tree: ast.AST, name: str) -> int:
    parts = (node.target for node in ast.walk(tree) if isinstance(node, ast.AugAssign))
    return sum(isinstance(target, ast.Name) and target.id == name for target in parts)


def _shared(value: ast.expr, names: Mapping[str, Any]) -> str:
    """Return the name whose object an expression shares; "" if it makes another."""
    node = value
    is_sliced = False
    while isinstance(node, ast.Subscript | ast.Attribute):
        is_sliced |= isinstance(node, ast.Subscript) and not isinstance(node.slice, ast.Constant | ast.Name)
        node = node.value
    root = node.id if isinstance(node, ast.Name) else ""
    # A slice of an array shares its memory, one of a list is a copy.
    return "" if is_sliced and not is_plain_array(names.get(root)) else root


def is_container(value: Any) -> bool:
    """Whether a value is of a kind that is written into."""
    return isinstance(value, list | dict | set | bytearray | deque) or is_plain_array(value)


def root_of(node: ast.expr) -> str:
    """Return the name of what a subscript or attribute is of; "" if that is no name."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""
