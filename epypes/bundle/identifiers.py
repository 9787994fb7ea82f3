"""Identifiers: the Python variables that stand for tokens, functions and pipelines, whose names are any text."""

from __future__ import annotations

import itertools
import keyword
import re
import unicodedata
from collections.abc import Callable, Iterable
from typing import Final

# Style checkers refuse these as variables, since they look like numbers; nothing can be assigned to __debug__.
_NOT_NAMES: Final = frozenset({"l", "O", "I", "__debug__"})
_LONGEST: Final = 30


def is_identifier(text: str) -> bool:
    """Whether text can be a variable as it is: Python itself normalizes some characters."""
    is_usable = text.isidentifier() and not keyword.iskeyword(text) and text not in _NOT_NAMES
    return is_usable and unicodedata.normalize("NFKC", text) == text


def identifiers_of(names: Iterable[str], is_taken: Callable[[str], bool]) -> dict[str, str]:
    """Return a variable for each name, each its own; names that can be kept come first."""
    names = list(names)
    found = {name: str.__str__(name) for name in names if is_identifier(name) and not is_taken(name)}
    used = set(found.values())
    for name in names:
        if name not in found:
            found[name] = identifier_of(name, lambda text: text in used or is_taken(text))
            used.add(found[name])
    return found


def identifier_of(name: str, is_taken: Callable[[str], bool]) -> str:
    """Return a variable that is not taken, as like a name as can be."""
    stem = str.__str__(name)
    if not is_identifier(name):
        stem = re.sub(r"\W+", "_", name.encode("ascii", "ignore").decode())[:_LONGEST].strip("_") or "token"
        stem = f"token_{stem}" if stem[0].isdecimal() else stem
    if is_identifier(stem) and not is_taken(stem):
        return stem
    numbered = (f"{stem}_{number}" for number in itertools.count(2))
    return next(text for text in itertools.chain([f"{stem}_"], numbered) if not is_taken(text))
