"""What do the marks of functions and tokens have in common?"""

from __future__ import annotations

import re
import zlib
from typing import Final

from epypes.display.layout.geometry import Point
from epypes.display.limits import CHARACTERS_OF_A_VERTEX
from epypes.display.markup import content, fitted

LINE_PX: Final = 16
_CHARACTER_PX: Final = 6.9
_ID_CHARACTERS: Final = 40
# A title tells a name in full, unless it is so long that the titles of many vertices would fill the picture.
TITLE_CHARACTERS: Final = 120
# What is left to edges of the room of a vertex.
_ROOM: Final = CHARACTERS_OF_A_VERTEX - 60
_LEAST_TITLE: Final = 100
LINE_ROOM: Final = 110
_NOT_PLAIN: Final = re.compile(r"[^A-Za-z0-9_.-]")


def text_width(*lines: str) -> float:
    """Return how wide a vertex must be for lines of text, in pixels."""
    return max(len(line) for line in lines) * _CHARACTER_PX + 22


def vertex_id(kind: str, name: str) -> str:
    """Return the id of a vertex's element, made from its name so that the same graph has the same ids."""
    plain = _NOT_PLAIN.sub(lambda match: f":{ord(match[0]):x}:", name[:_ID_CHARACTERS])
    if len(name) > _ID_CHARACTERS or len(plain) > _ID_CHARACTERS:
        plain = f"{plain[:_ID_CHARACTERS]}:{zlib.crc32(name.encode(errors='surrogatepass')):x}"
    return f"{kind}-{plain}"


def vertex(
    kind: str, name: str, states: tuple[str, ...], title: str, body: str, thumbnail: str = "", more: int = 0
) -> str:
    """Paint a vertex: an element with an id, its states as classes, and a title.

    Parameters
    ----------
    title
        Is cut to what is left of a vertex's room.
    thumbnail
        Is painted over the body, and does not count.
    more
        How many characters the title may take above that.
    """
    classes = " ".join(state.replace(" ", "-") for state in (kind, *states))
    head = f'<g id="{vertex_id(kind, name)}" class="{classes}">'
    room = max(_ROOM - len(head) - len(body), _LEAST_TITLE) + more
    return f"{head}<title>{content(fitted(title, room))}</title>{body}{thumbnail}</g>"


def text_lines(lines: tuple[str, ...], centre: Point) -> str:
    """Write the lines around a centre: the first is the name, the second smaller."""
    top = centre[1] - LINE_PX * (len(lines) - 1) / 2 + 4
    kinds = ("name", "small")
    return "".join(
        f'<text class="{kinds[min(row, 1)]}" x="{centre[0]:.0f}" y="{top + row * LINE_PX:.0f}">'
        f"{content(fitted(line, LINE_ROOM))}</text>"
        for row, line in enumerate(lines)
    )
