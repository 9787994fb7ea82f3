"""How large is a function, and how is it painted?"""

from __future__ import annotations

from typing import Final

from epypes.display.durations import duration_text
from epypes.display.layout.geometry import Box, Point
from epypes.display.markup import cut, cut_name, short_name
from epypes.display.paint.marks import LINE_PX, TITLE_CHARACTERS, text_lines, text_width, vertex
from epypes.display.views.graphview import FunctionView

_MESSAGE_CHARACTERS: Final = 48
# A switch is drawn like a multiplexer, narrower at its output, by this much on each side.
_SLOPE_PX: Final = 14
# Between the two borders of a pipeline.
_INSIDE_PX: Final = 3
# From the border of a function to the bar of its time.
_BAR_INSET_PX: Final = 10
_TOLD_CHARACTERS: Final = 600


def function_box(function: FunctionView) -> Box:
    """Return the shape and size of a function."""
    lines = _function_lines(function)
    # The widest time is reserved for, so that another run's times do not move anything.
    widest = "000.0 ms, 100%" if len(lines) > 1 and function.state != "failed" else ""
    slope = 2 * _SLOPE_PX if function.kind == "switch" else 0
    return Box("box", max(text_width(*lines, widest), 64) + slope, LINE_PX * len(lines) + 14)


def paint_function(function: FunctionView, box: Box, centre: Point) -> str:
    """Paint a function as an element with its title."""
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    slope = _SLOPE_PX if function.kind == "switch" else 0
    if slope:
        body = f'<polygon class="shape" points="{_trapezium(x, y, box)}"/>'
    else:
        body = f'<rect class="shape" x="{x:.1f}" y="{y:.1f}" width="{box.width:.1f}" height="{box.height:.1f}" rx="6"/>'
    if function.kind == "pipeline":
        body += _inner_border(x, y, box)
    if function.state == "ran":
        body += _time_bar(x + slope, y, box.width - 2 * slope, box.height, min(function.share, 1))
    body += text_lines(_function_lines(function), centre)
    said = "; ".join(filter(None, (*_said_state(function), *function.notes, function.message[:_TOLD_CHARACTERS])))
    title = f"{function.kind} {cut_name(function.name, TITLE_CHARACTERS)}: {said}"
    return vertex("function", function.name, _classes(function), title, body)


def _function_lines(function: FunctionView) -> tuple[str, ...]:
    return (short_name(function.name), *function.notes, *_state_line(function))


def _state_line(function: FunctionView) -> tuple[str, ...]:
    """Say in which state a function is, where that is more than its shape and its notes say."""
    if function.state in ("static", "not run", "missing"):
        return ()
    if function.state == "ran" and function.duration_ns is not None:
        return (f"{duration_text(function.duration_ns)}, {function.share:.0%}",)
    if function.state == "failed":
        return (cut(function.message, _MESSAGE_CHARACTERS),)
    return ("to run" if function.state == "planned" else function.state,)


def _said_state(function: FunctionView) -> tuple[str, ...]:
    """Say the state in words, with the time that was spent."""
    if function.duration_ns is None:
        return (function.state,)
    share = f", {function.share:.0%}" if function.state == "ran" else ""
    return function.state, f"{duration_text(function.duration_ns)}{share}"


def _time_bar(x: float, y: float, width: float, height: float, share: float) -> str:
    """Draw which part of the run's time a function took, as a bar on its track near the lower border."""
    left, across = x + _BAR_INSET_PX, width - 2 * _BAR_INSET_PX
    return (
        f'<path class="track" d="M{left:.0f},{y + height - 6:.0f}h{across:.0f}"/>'
        f'<rect class="bar" x="{left - 1.5:.1f}" y="{y + height - 7.5:.1f}" '
        f'width="{(across + 3) * share:.1f}" height="3" rx="1.5"/>'
    )


def _inner_border(x: float, y: float, box: Box) -> str:
    """Draw a second border inside that of a pipeline, so far away that the bar stands between them."""
    width, height = box.width - 2 * _INSIDE_PX, box.height - 2 * _INSIDE_PX
    at = f'x="{x + _INSIDE_PX:.1f}" y="{y + _INSIDE_PX:.1f}"'
    return f'<rect class="shape inner" {at} width="{width:.1f}" height="{height:.1f}" rx="4"/>'


def _classes(function: FunctionView) -> tuple[str, ...]:
    kind = () if function.kind == "function" else (function.kind,)
    return (*kind, *(("redefined",) if function.is_redefined else ()), function.state)


def _trapezium(x: float, y: float, box: Box) -> str:
    right, bottom = x + box.width, y + box.height
    points = ((x, y), (right, y), (right - _SLOPE_PX, bottom), (x + _SLOPE_PX, bottom))
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
