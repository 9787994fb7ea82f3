"""In which order do imports stand?

As linters want it: Python's own first, then all others; in each part whole modules before names from modules, and the
names from one module together.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence


def ordered_imports(statements: Sequence[str]) -> list[str]:
    """Return the lines of imports, with an empty one between Python's own and all others."""
    found = sorted(_joined(dict.fromkeys(statements)), key=_place)
    first = [statement for statement in found if statement.startswith("from __future__")]
    own = [statement for statement in found if _is_of_python(statement) and statement not in first]
    others = [statement for statement in found if not _is_of_python(statement)]
    parts = [part for part in (first, own, others) if part]
    return [line for part in parts for line in ("", *part)][1:]


def _joined(statements: Sequence[str] | dict[str, None]) -> list[str]:
    """Join names from one module; those with another name here stay apart."""
    plain: dict[str, list[str]] = {}
    found: list[str] = []
    for statement in statements:
        match = re.fullmatch(r"from (\S+) import (\w+)", statement)
        if match is None:
            found.append(statement)
        else:
            plain.setdefault(match[1], []).append(match[2])
    names = {module: ", ".join(sorted(known, key=_rank)) for module, known in plain.items()}
    return [*found, *(f"from {module} import {known}" for module, known in names.items())]


def _rank(name: str) -> tuple[int, str, str]:
    """Return what sorts constants before classes before functions."""
    kind = 0 if name.isupper() and len(name) > 1 else 1 if name[:1].isupper() else 2
    return kind, name.lower(), name


def _place(statement: str) -> tuple[bool, str, str, bool, str]:
    module = statement.split()[1]
    return statement.startswith("from"), module.lower(), module, " as " in statement, statement


def _is_of_python(statement: str) -> bool:
    return statement.split()[1].partition(".")[0] in sys.stdlib_module_names
