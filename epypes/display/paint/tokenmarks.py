"""How large is a token, and how is it painted?

Layouts are kept by the sizes of vertices, so a size depends on the value as little as possible: thumbnails and rows
stand in boxes of one size, and texts in fields that are wide enough for the next value, too.
"""

from __future__ import annotations

import re
from typing import Final

from epypes.display.layout.geometry import Box, Point
from epypes.display.markup import content, cut, cut_name, fitted, short_name, written_length
from epypes.display.paint.marks import LINE_PX, TITLE_CHARACTERS, text_lines, text_width, vertex
from epypes.display.paint.thumbnails import THUMB_HEIGHT, THUMB_WIDTH, paint_thumbnail
from epypes.display.previews.short import float_text
from epypes.display.views.graphview import TokenView

_ROW_PX: Final = 13
_ROWS: Final = 4
_ROW_CHARACTERS: Final = 26
_ROW_ROOM: Final = 50
# What a row of 10 px monospace text takes.
_ROWS_WIDTH: Final = _ROW_CHARACTERS * 6.1
_SECOND_LINE_CHARACTERS: Final = 26
_VALUE_CHARACTERS: Final = 18
_INT_FIELD: Final = 5
_FLOAT_FIELD: Final = 8
_FLOAT_DIGITS: Final = 4
_FIELD: Final = 6
# A count that is shorter takes as much room, since the next one may be longer.
_COUNT_DIGITS: Final = 4
_INT: Final = re.compile(r"-?\d+")
_FLOAT: Final = re.compile(r"-?(\d+\.\d*|\d*\.\d+)(e[-+]?\d+)?|-?\d+e[-+]?\d+|nan|-?inf")
_COUNT: Final = re.compile(r"\b\d+\b")


def token_box(token: TokenView) -> Box:
    """Return the shape and size of a token."""
    name, kind = short_name(token.name), _kind(token)
    if kind == "thumbnail":
        return Box("box", max(THUMB_WIDTH + 12, text_width(name)), THUMB_HEIGHT + 2 * LINE_PX + 16)
    if kind == "rows":
        return Box("box", max(_ROWS_WIDTH + 12, text_width(name)), _ROWS * _ROW_PX + 2 * LINE_PX + 16)
    second = _second(token)
    if kind == "hyperparameter":
        return Box("hexagon", text_width(f"{name} = {'0' * _field(second)}") + 14, LINE_PX + 12)
    lines = (name, "0" * (_field(second) if token.preview else len(second))) if second else (name,)
    return Box("ellipse", text_width(*lines) * 1.18, LINE_PX * len(lines) + 16)


def paint_token(token: TokenView, box: Box, centre: Point) -> str:
    """Paint a token as an element with its title."""
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    thumbnail = ""
    if box.shape == "box":
        body = (
            f'<rect class="shape" x="{x:.0f}" y="{y:.0f}" width="{box.width:.0f}" height="{box.height:.0f}" rx="10"/>'
        )
        body += text_lines((short_name(token.name), _second(token)), (centre[0], y + LINE_PX + 4))
        top = centre[0], y + 2 * LINE_PX + 8
        thumbnail, rows = _inside(token, box, top)
        body += rows
    elif box.shape == "hexagon":
        body = f'<polygon class="shape" points="{_hexagon(x, y, box)}"/>' + text_lines(_token_lines(token), centre)
    else:
        body = (
            f'<ellipse class="shape" cx="{centre[0]:.0f}" cy="{centre[1]:.0f}" '
            f'rx="{box.width / 2:.0f}" ry="{box.height / 2:.0f}"/>'
        ) + text_lines(_token_lines(token), centre)
    detail = token.preview.detail if token.preview else "no value"
    state = "" if token.state == "static" else f": {detail}, {token.state}"
    if token.first:
        # A dot, since a line of text would change the size of the box with the value.
        body += f'<circle class="dot" cx="{x + box.width - 11:.0f}" cy="{y + 3:.0f}" r="3.5"/>'
        state += f", first {token.first}"
    states = (token.role, token.state, *(("changed",) if token.first else ()))
    return vertex("token", token.name, states, _title(token, state), body, thumbnail)


def _kind(token: TokenView) -> str:
    """Return what is painted of a token beside its name."""
    shown = token.preview
    if shown is not None and (shown.picture is not None or shown.chart is not None):
        return "thumbnail"
    if token.role == "hyperparameter" and shown is not None:
        return "hyperparameter"
    is_hidden = token.state in ("missing", "left out")
    return "rows" if shown is not None and shown.rows and not is_hidden else "text"


def _inside(token: TokenView, box: Box, top: Point) -> tuple[str, str]:
    """Paint the thumbnail or the rows of a token below its two lines."""
    if token.preview is None:
        return "", ""
    if _kind(token) == "thumbnail":
        return paint_thumbnail(token.preview, top), ""
    left = top[0] - box.width / 2 + 8
    return "", "".join(
        f'<text class="row" x="{left:.0f}" y="{top[1] + row * _ROW_PX + 8:.0f}">{content(_fitted_row(text))}</text>'
        for row, text in enumerate(token.preview.rows[:_ROWS])
    )


def _fitted_row(text: str) -> str:
    """Return a row with its blanks, which keep columns apart, in what it may take."""
    text = text if len(text) <= _ROW_CHARACTERS else text[: _ROW_CHARACTERS - 1] + "…"
    return text if written_length(text) <= _ROW_ROOM else fitted(text, _ROW_ROOM)


def _token_lines(token: TokenView) -> tuple[str, ...]:
    name, second = short_name(token.name), _second(token)
    if _kind(token) == "hyperparameter":
        return (f"{name} = {second}",)
    return (name, second) if second else (name,)


def _second(token: TokenView) -> str:
    """Return what is written of the value, or of the state."""
    if token.state in ("missing", "left out") and not (token.role == "hyperparameter" and token.preview):
        return token.state
    if token.preview is None:
        return ""
    if _kind(token) in ("thumbnail", "rows"):
        return cut(token.preview.text, _SECOND_LINE_CHARACTERS)
    text = token.preview.text
    return float_text(float(text), _FLOAT_DIGITS) if _FLOAT.fullmatch(text) else cut(text, _VALUE_CHARACTERS)


def _field(text: str) -> int:
    """Return how many characters are kept free for a value, so that the next one does not move anything."""
    if _INT.fullmatch(text) and len(text) <= _INT_FIELD:
        return _INT_FIELD
    if _FLOAT.fullmatch(text) and len(text) <= _FLOAT_FIELD:
        return _FLOAT_FIELD
    counted = _COUNT.sub(lambda count: count[0].rjust(_COUNT_DIGITS), text)
    return max(len(text), min(-(-len(counted) // _FIELD) * _FIELD, _VALUE_CHARACTERS))


def _title(token: TokenView, state: str) -> str:
    kind = "hyperparameter token" if token.role == "hyperparameter" else "token"
    return f"{kind} {cut_name(token.name, TITLE_CHARACTERS)}{state}"


def _hexagon(x: float, y: float, box: Box) -> str:
    corner = 10.0
    right, bottom, middle = x + box.width, y + box.height, y + box.height / 2
    points = (
        (x, middle),
        (x + corner, y),
        (right - corner, y),
        (right, middle),
        (right - corner, bottom),
        (x + corner, bottom),
    )
    return " ".join(f"{a:.0f},{b:.0f}" for a, b in points)
