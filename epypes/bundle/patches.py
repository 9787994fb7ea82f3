"""What has the notebook changed in modules that are not its own? A service has them as they were installed."""

from __future__ import annotations

import ast
import linecache
import sys
import types
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from epypes.bundle.cells import executed_cells, place_in
from epypes.bundle.changes import CHANGING
from epypes.bundle.source import Importable, Refused
from epypes.bundle.text import parsed

if TYPE_CHECKING:
    from epypes.bundle.order import AnyDefinition

Key = tuple[int, str]


def check_patches(found: AnyDefinition, what: str) -> None:
    """Refuse a definition that reads what the notebook has changed in a module."""
    known = _patched()
    for chain in _read(found.node) if known else ():
        key = _key(chain, {**found.names, **_imported(found.node)})
        if key in known:
            _refuse(what, ".".join(chain), known[key])


def check_home(home: Importable, what: str) -> None:
    """Refuse what can be imported only as the notebook has changed it."""
    place = _patched().get((id(sys.modules.get(home.module)), home.qualname.partition(".")[0]))
    if place:
        _refuse(what, f"{home.module}.{home.qualname}", place)


def _refuse(what: str, name: str, place: str) -> None:
    text = f"{what} uses {name!r}, which the notebook has changed ({place}); a service has it as it was installed"
    raise Refused(f"{text}. Call yours by a name of its own, or make the value a token.")


def _patched() -> dict[Key, str]:
    """Return what the notebook has changed, by module and name there, each with its place."""
    names = vars(sys.modules["__main__"])
    texts = executed_cells(names)
    script = names.get("__file__")
    if not texts and isinstance(script, str):
        texts = [(0, "".join(linecache.getlines(script)))]
    found = {}
    for cell, text in texts:
        for chain, line in _written(text):
            key = _key(chain, names)
            if key:
                found[key] = f"cell [{cell}], line {line}" if cell else place_in(str(script), line)
    return found


def _key(chain: tuple[str, ...], names: Mapping[str, Any]) -> Key | None:
    """Return the module of a dotted name, and what is read of it; None for what is of no module."""
    reached = names.get(chain[0])
    for part in chain[1:]:
        if not isinstance(reached, types.ModuleType):
            return None
        inner = getattr(reached, part, None)
        if not isinstance(inner, types.ModuleType):
            return id(reached), part
        reached = inner
    return None


@lru_cache(maxsize=512)  # every function of a graph asks for every cell
def _written(text: str) -> tuple[tuple[tuple[str, ...], int], ...]:
    """Return the dotted names that a cell writes into, with their lines."""
    tree = parsed(text)
    found = [(chain, getattr(node, "lineno", 1)) for node in ast.walk(tree) for chain in _targets(node)] if tree else []
    return tuple(found)


def _targets(node: ast.AST) -> Iterator[tuple[str, ...]]:
    parts: list[ast.AST] = []
    more: tuple[str, ...] = ()
    if isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store | ast.Del):
        parts = [node]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CHANGING:
        parts = [node.func.value]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("setattr", "delattr"):
        parts, name = list(node.args[:1]), node.args[1] if len(node.args) > 1 else None
        more = (str(name.value),) if isinstance(name, ast.Constant) else ()
    chains = (_chain(part) + more for part in parts)
    yield from (chain for chain in chains if len(chain) > 1)


def _chain(node: ast.AST) -> tuple[str, ...]:
    """Return the dotted name that an expression begins with; nothing if it is none."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute | ast.Subscript):
        parts = [node.attr, *parts] if isinstance(node, ast.Attribute) else []
        node = node.value
    return (node.id, *parts) if isinstance(node, ast.Name) else ()


def _read(tree: ast.AST) -> Iterator[tuple[str, ...]]:
    """Give the dotted names that a definition reads, and what it imports from modules."""
    for node in ast.walk(tree):
        chain = _chain(node) if isinstance(node, ast.Attribute) else ()
        if len(chain) > 1:
            yield chain
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((f"from {node.module}", alias.name) for alias in node.names)


def _imported(tree: ast.AST) -> dict[str, Any]:
    """Return the modules that a definition imports itself, by name."""
    found: dict[str, Any] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            found[f"from {node.module}"] = sys.modules.get(node.module)
        for alias in node.names if isinstance(node, ast.Import) else ():
            dotted = alias.name if alias.asname else alias.name.partition(".")[0]
            found[alias.asname or dotted] = sys.modules.get(dotted)
    return found
