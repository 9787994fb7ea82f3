"""Functions and tokens as SVG: their sizes and their elements."""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Sequence
from typing import Final

from epypes.display.layout.geometry import Box, Direction, Point
from epypes.display.previews.encoding import Picture
from epypes.display.previews.model import Chart, Preview
from epypes.display.previews.short import float_text
from epypes.display.text import (
    CHARACTERS_OF_A_VERTEX,
    content,
    cut,
    cut_name,
    duration_text,
    escape,
    fitted,
    short_name,
    wrapped,
    written_length,
)
from epypes.display.views.graphview import FunctionView, TokenView

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


THUMB_WIDTH: Final = 128
THUMB_HEIGHT: Final = 96
# So that lines and dots at the ends of a chart stay within it.
_INSET_PX: Final = 4
_WIDEST_BAR_PX: Final = 12.0


def paint_thumbnail(shown: Preview, top: Point) -> str:
    """Paint what a preview has, below the middle of the upper edge of its frame."""
    if shown.picture is not None:
        return _picture(shown.picture, top)
    return _chart(shown.chart, top) if shown.chart is not None else ""


def _picture(picture: Picture, top: Point) -> str:
    scale = min(THUMB_WIDTH / picture.width, THUMB_HEIGHT / picture.height)
    width, height = picture.width * scale, picture.height * scale
    data = base64.b64encode(picture.data).decode()
    return (
        f'<image x="{top[0] - width / 2:.1f}" y="{top[1] + (THUMB_HEIGHT - height) / 2:.1f}" width="{width:.1f}" '
        f'height="{height:.1f}" href="data:{escape(picture.media_type)};base64,{data}"/>'
    )


def _chart(chart: Chart, top: Point) -> str:
    left, floor = top[0] - THUMB_WIDTH / 2 + _INSET_PX, top[1] + THUMB_HEIGHT - _INSET_PX
    width, height = THUMB_WIDTH - 2 * _INSET_PX, THUMB_HEIGHT - 2 * _INSET_PX
    series = [[(left + x * width, floor - y * height) for x, y in points] for points in chart.series]
    at = f'x="{top[0] - THUMB_WIDTH / 2:.1f}" y="{top[1]:.1f}"'
    frame = f'<rect class="paper" {at} width="{THUMB_WIDTH}" height="{THUMB_HEIGHT}"/>'
    if chart.kind == "line":
        return f'<g class="chart">{frame}{"".join(map(_line, series))}</g>'
    if chart.kind == "points":
        # A line without length has round ends: a dot in fewer characters than a circle.
        dots = "".join(f"M{x:.1f} {y:.1f}h0" for points in series for x, y in points)
        return f'<g class="chart">{frame}<path class="dots" d="{dots}"/></g>'
    bars = "".join(f"M{x:.1f} {floor:.1f}V{y:.1f}" for points in series for x, y in points)
    thickness = min(0.8 * width / max(map(len, series), default=1), _WIDEST_BAR_PX) if any(series) else 1
    return f'<g class="chart">{frame}<path class="bars" style="stroke-width:{thickness:.1f}" d="{bars}"/></g>'


def _line(points: Sequence[Point]) -> str:
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{places}"/>'


_MESSAGE_CHARACTERS: Final = 36
_MESSAGE_LINES: Final = 3
_REASON_CHARACTERS: Final = 30
_REASON_LINES: Final = 2
# A switch is drawn like a multiplexer, narrower at its output, by this much on each side.
_SLOPE_PX: Final = 14
# In a picture from left to right, where its height matters, by less.
_SLANT_PX: Final = 7
# Between the two borders of a pipeline.
_INSIDE_PX: Final = 3
# How far each box behind that of a group sticks out.
_STACK_PX: Final = 4
# By so much text makes room for the bar below it.
_ABOVE_BAR_PX: Final = 2
# From the border of a function to the bar of its time.
_BAR_INSET_PX: Final = 10
_TOLD_CHARACTERS: Final = 600


def function_box(function: FunctionView, direction: Direction = "down") -> Box:
    """Return the shape and size of a function."""
    lines = _function_lines(function)
    # The widest time is reserved for, so that another run's times do not move anything.
    widest = "000.0 ms, 100%" if len(lines) > 1 and function.state != "failed" else ""
    across, down = _extra(function, direction)
    return Box("box", max(text_width(*lines, widest), 64) + across, LINE_PX * len(lines) + 14 + down)


def _extra(function: FunctionView, direction: Direction) -> Point:
    """Return how much wider and higher than its text and bar a function is, for its shape's sake."""
    if function.kind == "switch":
        return (2 * _SLOPE_PX, 0) if direction == "down" else (0, 2 * _SLANT_PX)
    return (0, 2 * _STACK_PX) if function.kind == "group" else (0, 0)


def paint_function(function: FunctionView, box: Box, centre: Point, direction: Direction = "down") -> str:
    """Paint a function as an element with its title."""
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    if function.kind == "switch":
        body = f'<polygon class="shape" points="{_trapezium(x, y, box, direction)}"/>'
    elif function.kind == "group":
        body = _stack(x, y, box)
        centre = centre[0], centre[1] - _STACK_PX
    else:
        body = _rectangle(x, y, box.width, box.height)
    if function.kind == "pipeline":
        body += _inner_border(x, y, box)
    if function.state == "ran":
        body += _time_bar(function, box, centre, direction)
        centre = centre[0], centre[1] - _ABOVE_BAR_PX
    body += text_lines(_function_lines(function), centre)
    said = "; ".join(filter(None, (*_said_state(function), *function.notes, function.message)))
    title = f"{function.kind} {cut_name(function.name, TITLE_CHARACTERS)}: {said}"
    more = _TOLD_CHARACTERS if function.state == "failed" else 0
    return vertex("function", function.name, _classes(function), title, body, more=more)


def _function_lines(function: FunctionView) -> tuple[str, ...]:
    return (short_name(function.name), *function.notes, *_state_line(function))


def _state_line(function: FunctionView) -> tuple[str, ...]:
    """Say in which state a function is, where that is more than its shape and its notes say."""
    is_said = function.kind == "placeholder" and function.state == "not run"
    if is_said or function.state in ("static", "missing"):
        return ()
    if function.state == "ran" and function.duration_ns is not None:
        return (f"{duration_text(function.duration_ns)}, {function.share:.0%}",)
    if function.state == "failed":
        return ("failed", *wrapped(function.message, _MESSAGE_CHARACTERS, _MESSAGE_LINES))
    if function.state == "planned":
        return "to run", *wrapped(function.message, _REASON_CHARACTERS, _REASON_LINES)
    return (function.state,)


def _rectangle(x: float, y: float, width: float, height: float, kind: str = "shape") -> str:
    return f'<rect class="{kind}" x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{height:.0f}" rx="6"/>'


def _stack(x: float, y: float, box: Box) -> str:
    """Draw three boxes behind each other; those behind stick out below, so that edges end at the front one's sides."""
    height = box.height - 2 * _STACK_PX
    behind = (
        _rectangle(x + out, y + out, box.width - 2 * out, height, "shape inner") for out in (2 * _STACK_PX, _STACK_PX)
    )
    return "".join(behind) + _rectangle(x, y, box.width, height)


def _said_state(function: FunctionView) -> tuple[str, ...]:
    """Say the state in words, with the time that was spent."""
    if function.duration_ns is None:
        return (function.state,)
    share = f", {function.share:.0%}" if function.state == "ran" else ""
    return function.state, f"{duration_text(function.duration_ns)}{share}"


def _time_bar(function: FunctionView, box: Box, centre: Point, direction: Direction) -> str:
    """Draw which part of the run's time a function took, as a bar on its track below its text."""
    across, down = _extra(function, direction)
    length = box.width - across - 2 * _BAR_INSET_PX
    left, y = centre[0] - length / 2, centre[1] + (box.height - down) / 2 - 6
    return (
        f'<path class="track" d="M{left:.0f},{y:.0f}h{length:.0f}"/><rect class="bar" x="{left - 1.5:.1f}" '
        f'y="{y - 1.5:.0f}" width="{(length + 3) * min(function.share, 1):.1f}" height="3" rx="1.5"/>'
    )


def _inner_border(x: float, y: float, box: Box) -> str:
    """Draw a second border inside that of a pipeline, so far away that the bar stands between them."""
    width, height = box.width - 2 * _INSIDE_PX, box.height - 2 * _INSIDE_PX
    at = f'x="{x + _INSIDE_PX:.0f}" y="{y + _INSIDE_PX:.0f}"'
    return f'<rect class="shape inner" {at} width="{width:.0f}" height="{height:.0f}" rx="4"/>'


def _classes(function: FunctionView) -> tuple[str, ...]:
    kind = () if function.kind == "function" else (function.kind,)
    return (*kind, *(("redefined",) if function.is_redefined else ()), function.state)


def _trapezium(x: float, y: float, box: Box, direction: Direction) -> str:
    right, bottom = x + box.width, y + box.height
    if direction == "down":
        points = ((x, y), (right, y), (right - _SLOPE_PX, bottom), (x + _SLOPE_PX, bottom))
    else:
        points = ((x, y), (right, y + _SLANT_PX), (right, bottom - _SLANT_PX), (x, bottom))
    return " ".join(f"{a:.0f},{b:.0f}" for a, b in points)


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
