"""How do the modules of the view become the one that a page can load?

anywidget loads a single ES module from a Blob URL, where ``import "./x.js"`` finds nothing. So the files are joined in
the order of their imports, and the lines that import and export between them are taken away. One scope is left, so a
name may be given once only.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Final

_HERE: Final = Path(__file__).parent
_ENTRY: Final = "main.js"
_IMPORT: Final = re.compile(r"^import\s+\{[^}]*\}\s+from\s+\"\./(?P<file>[\w-]+\.js)\";\n", re.MULTILINE)
_ANY_IMPORT: Final = re.compile(r"^(?:import\b.*|export\s.*\bfrom\b.*)$", re.MULTILINE)
_EXPORT: Final = re.compile(r"^export (?=(?:async )?(?:function|const|let|class)\b)", re.MULTILINE)
_NAME: Final = re.compile(r"^(?:export )?(?:async )?(?:function\*?|const|let|class)\s+(?P<name>[\w$]+)", re.MULTILINE)


@cache
def joined() -> str:
    """Return the view as one ES module, whose default export has ``render``."""
    return join({path.name: path.read_text(encoding="utf-8") for path in sorted(_HERE.glob("*.js"))}, _ENTRY)


@cache
def styles() -> str:
    """Return the view's style sheet."""
    return (_HERE / "view.css").read_text(encoding="utf-8")


def join(modules: Mapping[str, str], entry: str) -> str:
    """Return modules as one, each after those that it imports.

    Parameters
    ----------
    modules
        Source text by file name. Names are imported by ``import { a, b } from "./x.js";`` at the start of a line.
    entry
        The file whose default export stays.

    Raises
    ------
    ValueError
        An import can't be resolved or goes in a circle, or two modules give the same name.
    """
    order = _ordered(modules, entry)
    _refuse_clashes(modules, order)
    return "\n".join(_bare(name, modules[name]) for name in order)


def _ordered(modules: Mapping[str, str], entry: str) -> list[str]:
    order: list[str] = []

    def visit(name: str, path: tuple[str, ...]) -> None:
        if name in path:
            raise ValueError(f"Modules import one another in a circle: {' -> '.join((*path, name))}.")
        if name not in modules:
            raise ValueError(f"{path[-1] if path else 'The view'} needs {name!r}, which is not there.")
        for match in _IMPORT.finditer(modules[name]):
            if match["file"] not in order:
                visit(match["file"], (*path, name))
        order.append(name)

    visit(entry, ())
    return order


def _refuse_clashes(modules: Mapping[str, str], order: list[str]) -> None:
    owners: dict[str, str] = {}
    for file in order:
        for match in _NAME.finditer(modules[file]):
            owner = owners.setdefault(match["name"], file)
            if owner != file:
                raise ValueError(f"Both {owner} and {file} define {match['name']!r}. Rename one of them.")


def _bare(name: str, source: str) -> str:
    bare = _IMPORT.sub("", source)
    if left := _ANY_IMPORT.search(bare):
        raise ValueError(f"{name} has an import that can't be joined: {left[0]}")
    return f"// {name}\n{_EXPORT.sub('', bare)}"
