"""Which names of Python do tokens and pipelines go by?

A token is a string of any kind. It keeps its name wherever that can be a variable that hides nothing.
"""

from __future__ import annotations

import keyword
import re
import unicodedata
from collections.abc import Callable, Iterable
from typing import Final

# Style checkers refuse these as variables, since they look like numbers; nothing can be assigned to __debug__.
_NOT_NAMES: Final = frozenset({"l", "O", "I", "__debug__"})
_LONGEST: Final = 30


def is_word(text: str) -> bool:
    """Whether text can be a variable as it is, and looks the same to Python as to people."""
    if not text.isidentifier() or keyword.iskeyword(text) or text in _NOT_NAMES:
        return False
    return text.isascii() or (unicodedata.normalize("NFKC", text) == text and not _has_marks(text))


def _has_marks(text: str) -> bool:
    """Whether characters are put together from several: how wide they are depends on who shows them."""
    return any(
        unicodedata.category(character)[0] in "MC" or "\u1160" <= character <= "\u11ff" or character > "\uffff"
        for character in text
    )


def words_of(names: Iterable[str], is_taken: Callable[[str], bool]) -> dict[str, str]:
    """Return a variable for each name, each its own; those that can keep their name come first."""
    names = list(names)
    words = {name: name for name in names if is_word(name) and not is_taken(name)}
    used = set(words.values())
    for name in names:
        if name not in words:
            words[name] = word_of(name, lambda word: word in used or is_taken(word))
            used.add(words[name])
    return {name: words[name] for name in names}


def word_of(name: str, is_taken: Callable[[str], bool]) -> str:
    """Return a variable that is not taken, as like a name as can be."""
    if is_word(name) and not is_taken(name):
        return name
    stem = _readable(name)
    if not is_word(stem) or (stem == name and is_taken(stem)):
        stem += "_"
    if not is_taken(stem):
        return stem
    number = 2
    while is_taken(f"{stem.rstrip('_')}_{number}"):
        number += 1
    return f"{stem.rstrip('_')}_{number}"


def _readable(name: str) -> str:
    if is_word(name) or keyword.iskeyword(name):
        return name
    for text in (unicodedata.normalize("NFKC", name), name.encode("ascii", "ignore").decode("ascii")):
        stem = re.sub(r"\W+", "_", text)[:_LONGEST].strip("_")
        stem = f"token_{stem}" if stem[:1].isdecimal() else stem
        if is_word(stem) or keyword.iskeyword(stem) or stem in _NOT_NAMES:
            return stem
    return "token"
