"""How is a rectangle of a picture shown, which is moved on the picture itself?"""

from __future__ import annotations

from typing import Any

from ipywidgets.widgets.widget_string import HTMLStyle

from epypes.display.previews.short import short_repr
from epypes.hints import Roi
from epypes_widgets.controls.control import Control
from epypes_widgets.controls.look import Look
from epypes_widgets.controls.shown import Words, line_of, said
from epypes_widgets.movable import is_integer
from epypes_widgets.ranges import allows


def roi(name: str, value: Any, param: Roi, first: Any, look: Look, tip: str) -> Control:
    """Return a line that says where the rectangle is; it stays a list if it was one."""
    kind = list if isinstance(value, list) else tuple

    def checked(new: Any) -> Any:
        if new is None and allows(param, None):
            return None
        sides = tuple(new) if isinstance(new, tuple | list) else ()
        if len(sides) != 4 or not all(map(is_integer, sides)) or not allows(param, sides):
            way_out = "Give (x, y, width, height) in whole pixels, none of them negative."
            raise ValueError(f"{name!r} can't be {short_repr(new)}: it is a rectangle. {way_out}")
        return kind(int(side) for side in sides)

    line = line_of(in_words(value), look.words((name,), tip, HTMLStyle))
    return Control((name,), "roi", (param,), line, Words(name, value, line, in_words, checked), first=(first,))


def in_words(value: Any) -> str:
    """Return a rectangle as ``"x 10, y 20, 100 x 80"``."""
    if isinstance(value, tuple | list) and len(value) == 4 and all(map(is_integer, value)):
        x, y, width, height = value
        return f"x {x}, y {y}, {width} x {height}"
    return "the whole picture" if value is None else said(value)
