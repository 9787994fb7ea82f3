"""What do the bundle's functions import while they run, apart from what EPypes imports for itself?"""

from __future__ import annotations

import ast
import builtins
import contextlib
import importlib.util
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, Final, Self

_OURS: Final = "epypes"


class ImportWatch:
    """While its block runs, every import statement is noted: which module imports which.

    A module that is loaded without a statement, as by ``importlib.import_module``, is known by its being new since
    ``mark``.
    """

    def __init__(self) -> None:
        self._edges: set[tuple[str, str]] = set()
        self._before: frozenset[str] = frozenset(sys.modules)

    def __enter__(self) -> Self:
        self._import = builtins.__import__
        builtins.__import__ = self._noting(builtins.__import__)
        return self

    def __exit__(self, *exception: object) -> None:
        builtins.__import__ = self._import

    def mark(self) -> None:
        """Take what is loaded now for what EPypes needs itself."""
        self._before = frozenset(sys.modules)

    def import_all_of(self, text: str, name: str) -> None:
        """Import what the statements of a module say, also those that no sample has come to.

        What can't be imported is passed over: the module may have two ways, of which this machine has one.

        Parameters
        ----------
        text
            The module's source.
        name
            The module's name.
        """
        for node in ast.walk(ast.parse(text)):
            for module, items in _statements(node):
                with contextlib.suppress(Exception):
                    builtins.__import__(module, {"__name__": name}, None, items, 0)

    def imported_by(self, root: str, owner: Callable[[str], str]) -> frozenset[str]:
        """Return the names of the modules that a module needs, and that those need.

        Parameters
        ----------
        root
            The name of the bundle's module.
        owner
            Returns what a module belongs to; modules of one owner are taken as one.
        """
        needed: dict[str, set[str]] = {}
        modules: dict[str, set[str]] = {}
        for importer, imported in self._edges:
            needed.setdefault(owner(importer), set()).add(owner(imported))
            modules.setdefault(owner(imported), set()).add(imported)
        ours = _reached(needed, [_OURS])
        new = frozenset(sys.modules) - self._before
        for name in new:
            modules.setdefault(owner(name), set()).add(name)
        # A bundle may import EPypes, for its annotations; what that imports is not the bundle's.
        theirs = {place: others for place, others in needed.items() if place != _OURS}
        reached = _reached(theirs, {owner(root), *({owner(name) for name in new} - ours)})
        return frozenset(name for place in reached for name in modules.get(place, ()))

    def _noting(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def note(
            name: str,
            globals: Mapping[str, Any] | None = None,  # noqa: A002 - as Python calls it
            locals: Mapping[str, Any] | None = None,  # noqa: A002
            fromlist: Collection[str] | None = (),
            level: int = 0,
        ) -> Any:
            found = original(name, globals, locals, fromlist or (), level)
            importer = str((globals or {}).get("__name__", ""))
            if importer.partition(".")[0] in sys.stdlib_module_names:
                # Python's own modules need nothing that is installed; importlib imports for others.
                return found
            whole = name if level == 0 else _absolute(name, globals or {}, level)
            self._edges.add((importer, whole))
            for item in fromlist or ():
                if f"{whole}.{item}" in sys.modules:
                    self._edges.add((importer, f"{whole}.{item}"))
            return found

        return note


def _statements(node: ast.AST) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Give the modules that a statement imports, and what from each."""
    if isinstance(node, ast.Import):
        yield from ((alias.name, ()) for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield node.module, tuple(alias.name for alias in node.names)


def _absolute(name: str, names: Mapping[str, Any], level: int) -> str:
    package = str(names.get("__package__") or names.get("__name__", ""))
    try:
        return importlib.util.resolve_name("." * level + name, package)
    except ImportError:
        return package


def _reached(edges: Mapping[str, set[str]], start: Collection[str]) -> set[str]:
    found, waiting = set(start), list(start)
    while waiting:
        new = edges.get(waiting.pop(), set()) - found
        found |= new
        waiting += new
    return found
