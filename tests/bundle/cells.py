"""How is text run as a notebook's cell is, without a notebook?"""

from __future__ import annotations

import itertools
import linecache

_NUMBERS = itertools.count(1)


def cell(source: str, names: dict | None = None) -> dict:
    """Run source as a cell: compiled under a file name of its own, in ``__main__``; return the notebook's names."""
    name = f"<test cell {next(_NUMBERS)}>"
    linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
    names = {"__name__": "__main__"} if names is None else names
    exec(compile(source, name, "exec", dont_inherit=True), names)
    return names
