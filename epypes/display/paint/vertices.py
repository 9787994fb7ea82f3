"""Functions, tokens and stages as SVG: their sizes and their elements.

Layouts are kept by the sizes of vertices, so a size depends on the value as little as possible: thumbnails and rows
stand in boxes of one size, and texts in fields that are wide enough for the next value, too. Elements are kept by what
is seen of a vertex and where it stands, so that a picture of other values is the last one with some elements exchanged.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from functools import lru_cache
from itertools import islice
from typing import Final, NamedTuple

from epypes.display.layout import Box, Direction, Point
from epypes.display.previews import Chart, Picture, Preview
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
    shortened,
    wrapped,
    written_length,
)
from epypes.display.views.graphview import FunctionView, StageView, TokenView

# Those of two graphs of 200 functions. Were all of them thumbnails, they would take 7 MB.
_MOST_KEPT: Final = 1_000

# -- all vertices --------------------------------------------------------------------------------------------------

LINE_PX: Final = 16
_CHARACTER_PX: Final = 6.9
_ID_CHARACTERS: Final = 40
# A title has a name in full, unless it is so long that the titles of many vertices would fill the picture.
_TITLE_CHARACTERS: Final = 120
# What is left to edges of the room of a vertex.
_ROOM: Final = CHARACTERS_OF_A_VERTEX - 60
_LEAST_TITLE: Final = 100
_LINE_ROOM: Final = 110
_NOT_PLAIN: Final = re.compile(r"[^A-Za-z0-9_.-]")


class Bounds(NamedTuple):
    """A rectangle, in pixels."""

    left: float
    top: float
    right: float
    bottom: float

    def holding(self, other: Bounds) -> Bounds:
        """Return the smallest rectangle that both are in."""
        return Bounds(*map(min, self[:2], other[:2]), *map(max, self[2:], other[2:]))

    def turned(self) -> Bounds:
        """Return it with x and y exchanged."""
        return Bounds(self.top, self.left, self.bottom, self.right)


def text_width(*lines: str) -> float:
    """Return how wide a vertex must be for lines of text, in pixels."""
    return max(map(len, lines)) * _CHARACTER_PX + 22


def text_lines(lines: Sequence[str], centre: Point) -> str:
    """Write the lines around a centre: the first is the name, the second smaller."""
    top = centre[1] - LINE_PX * (len(lines) - 1) / 2 + 4
    return "".join([
        f'<text class="{"small" if row else "name"}" x="{centre[0]:.0f}" y="{top + row * LINE_PX:.0f}">'
        f"{content(fitted(line, _LINE_ROOM))}</text>"
        for row, line in enumerate(lines)
    ])  # fmt: skip


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
    classes = " ".join([state.replace(" ", "-") for state in (kind, *states)])
    head = f'<g id="{_vertex_id(kind, name)}" class="{classes}">'
    room = max(_ROOM - len(head) - len(body), _LEAST_TITLE) + more
    return f"{head}<title>{content(fitted(title, room))}</title>{body}{thumbnail}</g>"


def _vertex_id(kind: str, name: str) -> str:
    """Return the id of a vertex's element, made from its name so that the same graph has the same ids."""
    plain = _NOT_PLAIN.sub(lambda match: f":{ord(match[0]):x}:", name[:_ID_CHARACTERS])
    if len(name) > _ID_CHARACTERS or len(plain) > _ID_CHARACTERS:
        plain = f"{plain[:_ID_CHARACTERS]}:{zlib.crc32(name.encode(errors='surrogatepass')):x}"
    return f"{kind}-{plain}"


def _classes(state: str) -> tuple[str, ...]:
    """Return the classes of a state: what is skipped looks like what is left out."""
    return ("left out", state) if state in ("skipped", "nothing found") else (state,)


def _polygon(points: Sequence[Point]) -> str:
    return f'<polygon class="shape" points="{" ".join([f"{x:.0f},{y:.0f}" for x, y in points])}"/>'


def _rectangle(x: float, y: float, width: float, height: float, kind: str = "shape", radius: int = 6) -> str:
    return f'<rect class="{kind}" x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{height:.0f}" rx="{radius}"/>'


# -- functions -----------------------------------------------------------------------------------------------------

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
_FAILURE_CHARACTERS: Final = 600


@lru_cache(_MOST_KEPT)
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


@lru_cache(_MOST_KEPT)
def paint_function(function: FunctionView, box: Box, centre: Point, direction: Direction = "down") -> str:
    """Paint a function as an element with its title."""
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    if function.kind == "switch":
        body = _trapezium(x, y, box, direction)
    elif function.kind == "group":
        # Those behind stick out below, so that edges end at the front one's sides.
        height, outs = box.height - 2 * _STACK_PX, (2 * _STACK_PX, _STACK_PX)
        body = "".join(_rectangle(x + out, y + out, box.width - 2 * out, height, "shape inner") for out in outs)
        body += _rectangle(x, y, box.width, height)
        centre = centre[0], centre[1] - _STACK_PX
    else:
        body = _rectangle(x, y, box.width, box.height)
    if function.kind == "pipeline":
        # So far away from its border that the bar stands between them.
        inside = x + _INSIDE_PX, y + _INSIDE_PX, box.width - 2 * _INSIDE_PX, box.height - 2 * _INSIDE_PX
        body += _rectangle(*inside, "shape inner", 4)
    if function.state == "ran":
        body += _time_bar(function, box, centre, direction)
        centre = centre[0], centre[1] - _ABOVE_BAR_PX
    body += text_lines(_function_lines(function), centre)
    text = "; ".join(filter(None, (_state_text(function), *function.notes, function.message)))
    title = f"{function.kind} {cut_name(function.name, _TITLE_CHARACTERS)}: {text}"
    kind = () if function.kind == "function" else (function.kind,)
    states = (*kind, *(("redefined",) if function.is_redefined else ()), *_classes(function.state))
    more = _FAILURE_CHARACTERS if function.state == "failed" else 0
    return vertex("function", function.name, states, title, body, more=more)


def _function_lines(function: FunctionView) -> tuple[str, ...]:
    """Return the name, the notes, and the state where that is more than its shape and its notes say."""
    lines: tuple[str, ...] = (function.state,)
    if function.state in ("static", "missing") or (function.kind == "placeholder" and function.state == "not run"):
        lines = ()
    elif function.state == "ran" and function.duration_ns is not None:
        lines = (f"{duration_text(function.duration_ns)}, {function.share:.0%}",)
    elif function.state == "failed":
        lines = ("failed", *wrapped(function.message, _MESSAGE_CHARACTERS, _MESSAGE_LINES))
    elif function.state == "planned":
        lines = "to run", *wrapped(function.message, _REASON_CHARACTERS, _REASON_LINES)
    return (short_name(function.name), *function.notes, *lines)


def _state_text(function: FunctionView) -> str:
    """Return the state in words, with the time that was spent."""
    if function.duration_ns is None:
        return function.state
    share = f", {function.share:.0%}" if function.state == "ran" else ""
    return f"{function.state}; {duration_text(function.duration_ns)}{share}"


def _time_bar(function: FunctionView, box: Box, centre: Point, direction: Direction) -> str:
    """Draw which part of the run's time a function took, as a bar on its track below its text."""
    across, down = _extra(function, direction)
    length = box.width - across - 2 * _BAR_INSET_PX
    left, y = centre[0] - length / 2, centre[1] + (box.height - down) / 2 - 6
    return (
        f'<path class="track" d="M{left:.0f},{y:.0f}h{length:.0f}"/><rect class="bar" x="{left - 1.5:.1f}" '
        f'y="{y - 1.5:.0f}" width="{(length + 3) * min(function.share, 1):.1f}" height="3" rx="1.5"/>'
    )


def _trapezium(x: float, y: float, box: Box, direction: Direction) -> str:
    right, bottom = x + box.width, y + box.height
    if direction == "down":
        return _polygon(((x, y), (right, y), (right - _SLOPE_PX, bottom), (x + _SLOPE_PX, bottom)))
    return _polygon(((x, y), (right, y + _SLANT_PX), (right, bottom - _SLANT_PX), (x, bottom)))


# -- tokens --------------------------------------------------------------------------------------------------------

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
_CORNER_PX: Final = 10.0
_INT: Final = re.compile(r"-?\d+")
_FLOAT: Final = re.compile(r"-?(\d+\.\d*|\d*\.\d+)(e[-+]?\d+)?|-?\d+e[-+]?\d+|nan|-?inf")
_COUNT: Final = re.compile(r"\b\d+\b")


@lru_cache(_MOST_KEPT)
def token_box(token: TokenView) -> Box:
    """Return the shape and size of a token."""
    name, kind = short_name(token.name), _kind(token)
    if kind == "thumbnail":
        return Box("box", max(THUMB_WIDTH + 12, text_width(name)), THUMB_HEIGHT + 2 * LINE_PX + 16)
    if kind == "rows":
        return Box("box", max(_ROWS_WIDTH + 12, text_width(name)), _ROWS * _ROW_PX + 2 * LINE_PX + 16)
    second = _second_line(token, kind)
    if kind == "hyperparameter":
        return Box("hexagon", text_width(f"{name} = {'0' * _field(second)}") + 14, LINE_PX + 12)
    lines = (name, "0" * (_field(second) if token.preview else len(second))) if second else (name,)
    return Box("ellipse", text_width(*lines) * 1.18, LINE_PX * len(lines) + 16)


@lru_cache(_MOST_KEPT)
def paint_token(token: TokenView, box: Box, centre: Point) -> str:
    """Paint a token as an element with its title."""
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    name, kind, thumbnail = short_name(token.name), _kind(token), ""
    second = _second_line(token, kind)
    if box.shape == "box":
        body = _rectangle(x, y, box.width, box.height, radius=10)
        body += text_lines((name, second), (centre[0], y + LINE_PX + 4))
        top = centre[0], y + 2 * LINE_PX + 8
        if token.preview is not None and kind == "thumbnail":
            thumbnail = paint_thumbnail(token.preview, top)
        elif token.preview is not None:
            body += _rows(token.preview, x + 8, top[1] + 8)
    elif box.shape == "hexagon":
        right, bottom, middle = x + box.width, y + box.height, y + box.height / 2
        left_corner, right_corner = x + _CORNER_PX, right - _CORNER_PX
        upper, lower = ((left_corner, y), (right_corner, y)), ((right_corner, bottom), (left_corner, bottom))
        body = _polygon(((x, middle), *upper, (right, middle), *lower)) + text_lines((f"{name} = {second}",), centre)
    else:
        body = (
            f'<ellipse class="shape" cx="{centre[0]:.0f}" cy="{centre[1]:.0f}" '
            f'rx="{box.width / 2:.0f}" ry="{box.height / 2:.0f}"/>'
        ) + text_lines((name, second) if second else (name,), centre)
    detail = token.preview.detail if token.preview else "no value"
    state = "" if token.state == "static" else f": {detail}, {token.state}"
    if token.first:
        # A dot, since a line of text would change the size of the box with the value.
        body += f'<circle class="dot" cx="{x + box.width - 11:.0f}" cy="{y + 3:.0f}" r="3.5"/>'
        state += f", first {token.first}"
    states = (token.role, *_classes(token.state), *(("changed",) if token.first else ()))
    noun = "hyperparameter token" if token.role == "hyperparameter" else "token"
    delayed = f", the value of {cut_name(token.delayed, _TITLE_CHARACTERS)!r} in the run before" * bool(token.delayed)
    title = f"{noun} {cut_name(token.name, _TITLE_CHARACTERS)}{delayed}{state}"
    return vertex("token", token.name, states, title, body, thumbnail)


def _kind(token: TokenView) -> str:
    """Return what is painted of a token beside its name."""
    shown = token.preview
    if shown is not None and (shown.picture is not None or shown.chart is not None):
        return "thumbnail"
    if token.role == "hyperparameter" and shown is not None:
        return "hyperparameter"
    return "rows" if shown is not None and shown.rows and token.state not in ("missing", "left out") else "text"


def _rows(shown: Preview, left: float, top: float) -> str:
    """Paint rows with their blanks, which keep columns apart, in what they may take."""
    rows = [shortened(row, _ROW_CHARACTERS) for row in shown.rows[:_ROWS]]
    return "".join(
        f'<text class="row" x="{left:.0f}" y="{top + place * _ROW_PX:.0f}">'
        f"{content(row if written_length(row) <= _ROW_ROOM else fitted(row, _ROW_ROOM))}</text>"
        for place, row in enumerate(rows)
    )


def _second_line(token: TokenView, kind: str) -> str:
    """Return what is written of the value, or of the state."""
    if token.state in ("missing", "left out") and not (token.role == "hyperparameter" and token.preview):
        return token.state
    if token.preview is None:
        return ""
    text = token.preview.text
    if kind in ("thumbnail", "rows"):
        return cut(text, _SECOND_LINE_CHARACTERS)
    return float_text(float(text), _FLOAT_DIGITS) if _FLOAT.fullmatch(text) else cut(text, _VALUE_CHARACTERS)


def _field(text: str) -> int:
    """Return how many characters are kept free for a value, so that the next one does not move anything."""
    if _INT.fullmatch(text) and len(text) <= _INT_FIELD:
        return _INT_FIELD
    if _FLOAT.fullmatch(text) and len(text) <= _FLOAT_FIELD:
        return _FLOAT_FIELD
    counted = _COUNT.sub(lambda count: count[0].rjust(_COUNT_DIGITS), text)
    return max(len(text), min(-(-len(counted) // _FIELD) * _FIELD, _VALUE_CHARACTERS))


# -- thumbnails ----------------------------------------------------------------------------------------------------

THUMB_WIDTH: Final = 128
THUMB_HEIGHT: Final = 96
# So that lines and dots at the ends of a chart stay within it.
_INSET_PX: Final = 4
_WIDEST_BAR_PX: Final = 12.0


def paint_thumbnail(shown: Preview, top: Point) -> str:
    """Paint the encoded picture or the chart of a preview, below the middle of the upper edge of its frame."""
    if shown.picture is not None:
        return _picture(shown.picture, top)
    return _chart(shown.chart, top) if shown.chart is not None else ""


def _picture(picture: Picture, top: Point) -> str:
    scale = min(THUMB_WIDTH / picture.width, THUMB_HEIGHT / picture.height)
    width, height = picture.width * scale, picture.height * scale
    return (
        f'<image x="{top[0] - width / 2:.1f}" y="{top[1] + (THUMB_HEIGHT - height) / 2:.1f}" width="{width:.1f}" '
        f'height="{height:.1f}" href="{escape(picture.uri)}"/>'
    )


def _chart(chart: Chart, top: Point) -> str:
    left, floor = top[0] - THUMB_WIDTH / 2 + _INSET_PX, top[1] + THUMB_HEIGHT - _INSET_PX
    width, height = THUMB_WIDTH - 2 * _INSET_PX, THUMB_HEIGHT - 2 * _INSET_PX
    series = [[(left + x * width, floor - y * height) for x, y in points] for points in chart.series]
    at = f'x="{top[0] - THUMB_WIDTH / 2:.1f}" y="{top[1]:.1f}"'
    frame = f'<rect class="paper" {at} width="{THUMB_WIDTH}" height="{THUMB_HEIGHT}"/>'
    if chart.kind == "line":
        lines = (" ".join(f"{x:.1f},{y:.1f}" for x, y in points) for points in series)
        marks = "".join(f'<polyline points="{line}"/>' for line in lines)
    elif chart.kind == "points":
        # A line without length has round ends: a dot in fewer characters than a circle.
        dots = "".join(f"M{x:.1f} {y:.1f}h0" for points in series for x, y in points)
        marks = f'<path class="dots" d="{dots}"/>'
    else:
        bars = "".join(f"M{x:.1f} {floor:.1f}V{y:.1f}" for points in series for x, y in points)
        thickness = min(0.8 * width / max(map(len, series), default=1), _WIDEST_BAR_PX) if any(series) else 1
        marks = f'<path class="bars" style="stroke-width:{thickness:.1f}" d="{bars}"/>'
    return f'<g class="chart">{frame}{marks}</g>'


# -- stages --------------------------------------------------------------------------------------------------------

# Beside the text: the slots of a queue, the arrow of a loop.
_QUEUE_PX: Final = 26
_LOOP_PX: Final = 24
_SLOT_PX: Final = 7
_STAGE_NOTE_CHARACTERS: Final = 30
_STAGE_NOTE_LINES: Final = 2
_STAGE_LINES: Final = 8
_STAGE_TITLE_CHARACTERS: Final = 300
# The arrow of a loop: nine tenths of a circle.
_CIRCLE: Final = (
    "c-1.9,-2.9 -5.7,-3.9 -8.8,-2.4c-3.1,1.5 -4.7,5.0 -3.7,8.3c1.0,3.3 4.3,5.4 7.7,4.9c3.4,-0.5 6.0,-3.4 6.0,-6.9"
)
# Counts grow from picture to picture: a few digits more are not to move anything.
_WIDTH_STEP: Final = 4
_STAGE_STATES: Final = {
    ("loop", "running"): "listening",
    ("loop", "stopped"): "stopped",
    ("function", "running"): "running",
    ("function", "failed"): "failed",
    ("queue", "running"): "put waits for room",
}


def stage_words(stage: StageView) -> tuple[str, ...]:
    """Return the state of a stage, where it has one, and its notes."""
    state = _STAGE_STATES.get((stage.kind, stage.state), "" if stage.state == "static" else stage.state)
    return (state, *stage.notes) if state else stage.notes


def _stage_lines(stage: StageView) -> tuple[str, ...]:
    words = (line for text in stage_words(stage) for line in wrapped(text, _STAGE_NOTE_CHARACTERS, _STAGE_NOTE_LINES))
    return short_name(stage.name), *islice(words, _STAGE_LINES)


def stage_size(stage: StageView) -> Point:
    """Return the width and height of a stage."""
    lines = _stage_lines(stage)
    widest = max(map(len, lines))
    widest += -widest % _WIDTH_STEP
    extra = {"queue": _QUEUE_PX, "loop": _LOOP_PX}.get(stage.kind, 0)
    return text_width(" " * widest) + extra, LINE_PX * len(lines) + 14


def paint_stage(stage: StageView, bounds: Bounds) -> str:
    """Paint a stage as an element with its title."""
    x, y, right, bottom = bounds
    width, height, middle = right - x, bottom - y, (y + bottom) / 2
    at = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"'
    if stage.kind == "queue":
        # Open at its ends, with slots where its items leave.
        slots = "".join(f"M{right - place * _SLOT_PX - 1:.1f},{y:.1f}v{height:.1f}" for place in range(3))
        body = f'<rect class="shape open" {at}/><path class="mark" d="M{x:.1f},{y:.1f}H{right:.1f}'
        body += f'M{x:.1f},{bottom:.1f}H{right:.1f}{slots}"/>'
        text_middle = x + (width - _QUEUE_PX) / 2 + 3
    elif stage.kind == "loop":
        # Round at its ends, with an arrow that runs in a circle.
        left = x + 21
        body = f'<rect class="shape" {at} rx="{height / 2:.1f}"/>'
        body += f'<path class="mark" d="M{left + 6:.1f},{middle - 4:.1f}{_CIRCLE}"/>'
        body += f'<path class="tip" d="M{left + 8.5:.1f},{middle - 8:.1f}v6h-6z"/>'
        text_middle = x + width / 2 + _LOOP_PX / 2 - 2
    else:
        body, text_middle = f'<rect class="shape" {at} rx="3"/>', x + width / 2
    body += text_lines(_stage_lines(stage), (text_middle, middle))
    kind = "call" if stage.kind == "function" else stage.kind
    title = f"{stage.kind} {stage.name}: {'; '.join(stage_words(stage))}"
    return vertex("stage", stage.name, (kind, stage.state), title, body, more=_STAGE_TITLE_CHARACTERS)
