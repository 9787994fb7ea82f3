"""How large is a function, and how is it painted?"""

from __future__ import annotations

from typing import Final

from epypes.display.durations import duration_text
from epypes.display.layout.geometry import Box, Direction, Point
from epypes.display.markup import cut_name, short_name, wrapped
from epypes.display.paint.marks import LINE_PX, TITLE_CHARACTERS, text_lines, text_width, vertex
from epypes.display.views.graphview import FunctionView

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
