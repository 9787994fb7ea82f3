"""Text of a picture: escaped, cut to what it may take, and measured in the bytes of a page.

A saved notebook keeps every picture twice, and is read, compared and sent: so many functions take so much room, as SVG
and as HTML, and no more.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final

# Of a page, with its script and style.
CHARACTERS: Final = 30_000
CHARACTERS_OF_A_VERTEX: Final = 600
# All thumbnails of a picture. Base64 makes four characters of three bytes.
THUMBNAIL_CHARACTERS: Final = 80_000
# All pictures that a page keeps beside them, to be looked at closely.
KEPT_CHARACTERS: Final = 150_000
# More are no overview.
MOST_THUMBNAILS: Final = 24

# detect_and_describe_features_1, of the paper's figure 13, is to fit.
_NAME_CHARACTERS: Final = 32
# What such a name takes at most in a page.
_NAME_ROOM: Final = 110
# What XML 1.0 allows; a control character or half a surrogate pair in a name would make the whole picture unreadable.
_NOT_XML: Final = re.compile("[^\\t\\n\\r\\x20-\\ud7ff\\ue000-\\ufffd\\U00010000-\\U0010ffff]")
# What takes more characters in a page, where a picture is part of an address: an ampersand stands there as "%26amp;".
_LONGER: Final = {"&": 7, "<": 6, ">": 6, '"': 5, "%": 3, "#": 3}
_LONG: Final = re.compile(r"[&<>\"%#]|[^\x20-\x7e]")
# A quote in a text. In a page, where a picture is part of an address, it takes less room than its other name.
QUOTE: Final = "&#34;"
_CONTENT: Final = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': QUOTE})
_ATTRIBUTE: Final = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "'": "&#x27;"})


def escape(text: str) -> str:
    """Return text for attributes of SVG and HTML; what XML forbids shows as a replacement mark."""
    return (text if text.isprintable() else _NOT_XML.sub("\ufffd", text)).translate(_ATTRIBUTE)


def content(text: str) -> str:
    """Return text as the content of an element of SVG and HTML, where an apostrophe is nothing special."""
    return (text if text.isprintable() else _NOT_XML.sub("\ufffd", text)).translate(_CONTENT)


def size(text: str) -> int:
    """Return how many bytes a text takes in a file."""
    return len(text) if text.isascii() else len(text.encode(errors="replace"))


def written_length(text: str) -> int:
    """Return how many bytes a text takes in a page at most."""
    longer = _LONG.findall(text)
    return (
        len(text)
        + sum([_LONGER.get(sign) or len(_NOT_XML.sub("\ufffd", sign).encode()) for sign in longer])
        - len(longer)
    )


def shortened(text: str, characters: int) -> str:
    """Return text of at most so many characters, with its blanks."""
    return text if len(text) <= characters else text[: characters - 1] + "…"


def cut(text: str, characters: int) -> str:
    """Return text on one line, of at most so many characters."""
    text = " ".join(text.split())
    return text if len(text) <= characters else shortened(text, characters)


def listed(names: Sequence[str], most: int) -> str:
    """Return the first of some names: ``"a, b and 3 more"``."""
    more = f" and {len(names) - most} more" * (len(names) > most)
    return ", ".join(names[:most]) + more


def fitted(text: str, room: int) -> str:
    """Return text on one line, cut to what takes at most so many bytes in a page."""
    text = cut(text, room)
    if _LONG.search(text) is None:
        return text
    while len(text) > 1 and written_length(text) > room:
        text = cut(text, max(len(text) * room // written_length(text) - 1, 1))
    return text


def wrapped(text: str, characters: int, lines: int) -> tuple[str, ...]:
    """Return text on at most so many lines, each of at most so many characters."""
    beginning = cut(text[: 4 * characters * lines], 2 * characters * lines)
    return tuple(textwrap.wrap(beginning, characters, max_lines=lines, placeholder="…"))


def cut_name(name: str, characters: int) -> str:
    """Return a name on one line, of at most so many characters; its end is kept, since names may differ there only."""
    name = " ".join(name.split())
    if len(name) <= characters:
        return name
    end = characters // 3
    return f"{name[: characters - end - 1]}…{name[len(name) - end :]}"


@lru_cache(maxsize=1_000)
def short_name(name: str) -> str:
    """Return a name as it stands on a vertex."""
    short, characters = cut_name(name, _NAME_CHARACTERS), _NAME_CHARACTERS
    while _LONG.search(short) and written_length(short) > _NAME_ROOM:
        characters = characters * 3 // 4
        short = cut_name(name, characters)
    return short


def overhead_text(side_by_side: bool) -> str:
    """Return what graph overhead is called; where functions ran side by side it is another quantity."""
    return "graph overhead (wall time less critical path)" if side_by_side else "graph overhead"


def duration_text(duration_ns: int) -> str:
    """Return a duration with its unit, to three digits.

    Examples
    --------
    >>> duration_text(5_230_000), duration_text(740)
    ('5.23 ms', '740 ns')
    """
    return _with_unit(duration_ns, {"s": 1e9, "ms": 1e6, "µs": 1e3}, "ns")


def memory_text(size: int) -> str:
    """Return a number of bytes with its unit, to three digits."""
    return _with_unit(size, {"GB": 1e9, "MB": 1e6, "kB": 1e3}, "B")


def _with_unit(value: int, units: Mapping[str, float], smallest: str) -> str:
    for unit, size in units.items():
        if abs(value) >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value} {smallest}"
