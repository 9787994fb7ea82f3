"""What do the marks of functions and tokens have in common?"""

from __future__ import annotations

import re
import zlib
from typing import Final

from epypes.display.layout.geometry import Point
from epypes.display.markup import content

LINE_PX: Final = 16
_CHARACTER_PX: Final = 6.9
_ID_CHARACTERS: Final = 40
# A title tells a name in full, unless it is so long that the titles of many vertices would fill the picture.
TITLE_CHARACTERS: Final = 120


def text_width(*lines: str) -> float:
    """Return how wide a vertex must be for lines of text, in pixels."""
    return max(len(line) for line in lines) * _CHARACTER_PX + 22


def vertex_id(kind: str, name: str) -> str:
    """Return the id of a vertex's element, made from its name so that the same graph has the same ids."""
    plain = re.sub(r"[^A-Za-z0-9_.-]", lambda match: f":{ord(match[0]):x}:", name[:_ID_CHARACTERS])
    if len(name) > _ID_CHARACTERS:
        plain += f":{zlib.crc32(name.encode(errors='surrogatepass')):x}"
    return f"{kind}-{plain}"


def vertex(kind: str, name: str, states: tuple[str, ...], title: str, body: str) -> str:
    """Paint a vertex: an element with an id, its states as classes, and a title."""
    classes = " ".join(state.replace(" ", "-") for state in (kind, *states))
    return f'<g id="{vertex_id(kind, name)}" class="{classes}"><title>{content(title)}</title>{body}</g>'


def text_lines(lines: tuple[str, ...], centre: Point) -> str:
    """Write the lines around a centre: the first is the name, the second smaller."""
    top = centre[1] - LINE_PX * (len(lines) - 1) / 2 + 4
    kinds = ("name", "small")
    return "".join(
        f'<text class="{kinds[min(row, 1)]}" x="{centre[0]:.0f}" y="{top + row * LINE_PX:.0f}">{content(line)}</text>'
        for row, line in enumerate(lines)
    )
