"""What is painted around the graph of a pipeline: a frame with its name, and the stages that events pass.

The graph stays where the layout has put it, with its corner at (0, 0); what is around it has negative coordinates too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from statistics import fmean
from typing import Final, NamedTuple

from epypes.display.layout import Layout, Point
from epypes.display.paint.vertices import LINE_PX, text_lines, text_width, vertex
from epypes.display.text import content, fitted, short_name, wrapped
from epypes.display.views.graphview import GraphView, StageView

# -- one stage -----------------------------------------------------------------------------------------------------

# Beside the text: the slots of a queue, the arrow of a loop.
_QUEUE_PX: Final = 26
_LOOP_PX: Final = 24
_SLOT_PX: Final = 7
_NOTE_CHARACTERS: Final = 30
_NOTE_LINES: Final = 2
_MOST_LINES: Final = 8
_TITLE_CHARACTERS: Final = 300
# Counts grow from picture to picture: a few digits more are not to move anything.
_WIDTH_STEP: Final = 4
_STATES: Final = {
    ("loop", "running"): "listening",
    ("loop", "stopped"): "stopped",
    ("function", "running"): "running",
    ("function", "failed"): "failed",
    ("queue", "running"): "put waits for room",
}


def stage_words(stage: StageView) -> tuple[str, ...]:
    """Return the state of a stage, where it has one, and its notes."""
    state = _STATES.get((stage.kind, stage.state), "" if stage.state == "static" else stage.state)
    return (state, *stage.notes) if state else stage.notes


def _stage_lines(stage: StageView) -> tuple[str, ...]:
    words = (line for text in stage_words(stage) for line in wrapped(text, _NOTE_CHARACTERS, _NOTE_LINES))
    return short_name(stage.name), *islice(words, _MOST_LINES)


def _stage_size(stage: StageView) -> Point:
    lines = _stage_lines(stage)
    widest = max(map(len, lines))
    widest += -widest % _WIDTH_STEP
    extra = {"queue": _QUEUE_PX, "loop": _LOOP_PX}.get(stage.kind, 0)
    return text_width(" " * widest) + extra, LINE_PX * len(lines) + 14


def _paint_stage(stage: StageView, bounds: Bounds) -> str:
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
        body += f'<path class="mark" d="M{left + 6:.1f},{middle - 4:.1f}a7,7 0 1 0 1.2,4"/>'
        body += f'<path class="tip" d="M{left + 8.5:.1f},{middle - 8:.1f}v6h-6z"/>'
        text_middle = x + width / 2 + _LOOP_PX / 2 - 2
    else:
        body, text_middle = f'<rect class="shape" {at} rx="3"/>', x + width / 2
    body += text_lines(_stage_lines(stage), (text_middle, middle))
    kind = "call" if stage.kind == "function" else stage.kind
    title = f"{stage.kind} {stage.name}: {'; '.join(stage_words(stage))}"
    return vertex("stage", stage.name, (kind, stage.state), title, body, more=_TITLE_CHARACTERS)


# -- around the graph ----------------------------------------------------------------------------------------------

_PADDING_PX: Final = 16.0
_TITLE_PX: Final = 22.0
_TITLE_ROOM: Final = 600
# Between stages, and between them and the frame.
_GAP_PX: Final = 26.0
_TIP_PX: Final = 8.0


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


def paint_around(graph: GraphView, layout: Layout) -> tuple[list[str], Bounds]:
    """Paint what is around a graph, if there is anything.

    Returns
    -------
    tuple
        The elements, and what they and the graph cover.
    """
    inside = Bounds(0.0, 0.0, layout.width, layout.height)
    if not (graph.title or graph.before or graph.after):
        return [], inside
    title_px = text_width(short_name(graph.title))
    more = max(title_px + 2 * _GAP_PX - inside.right, 0.0) / 2 + _PADDING_PX
    frame = Bounds(-more, -_PADDING_PX - _TITLE_PX / 2, inside.right + more, inside.bottom + _PADDING_PX)
    left, top = frame.left + _PADDING_PX, frame.top - _TITLE_PX / 2
    label = Bounds(left, top, left + title_px, top + _TITLE_PX)
    parts, covered = _paint_frame(graph.title, frame, label), frame.holding(label)
    sources, sinks = _source_and_sink_centres(graph, layout)
    for stages, centres, is_before in ((graph.before, sources, True), (graph.after, sinks, False)):
        if stages:
            row = _Row(stages, frame, label, centres, is_before, graph.direction == "right")
            parts += row.paint()
            covered = covered.holding(row.bounds)
    return parts, covered


def _paint_frame(title: str, frame: Bounds, label: Bounds) -> list[str]:
    """Paint the frame, and the title on a label that lies on its upper border."""
    size = f'width="{frame.right - frame.left:.1f}" height="{frame.bottom - frame.top:.1f}"'
    parts = [f'<rect class="frame" x="{frame.left:.1f}" y="{frame.top:.1f}" {size} rx="8"/>']
    if title:
        width = label.right - label.left
        parts.append(
            f'<g class="label"><title>{content(fitted(f"pipeline {title}", _TITLE_ROOM))}</title>'
            f'<rect class="shape" x="{label.left:.1f}" y="{label.top:.1f}" width="{width:.1f}" '
            f'height="{_TITLE_PX:.0f}" rx="5"/>'
            f'<text class="name" x="{label.left + width / 2:.1f}" y="{frame.top + LINE_PX / 4:.1f}">'
            f"{content(short_name(title))}</text></g>"
        )
    return parts


def _source_and_sink_centres(graph: GraphView, layout: Layout) -> tuple[list[Point], list[Point]]:
    """Return where the free source tokens and the sink tokens are."""
    made = {edge.token for edge in graph.edges if not edge.is_input}
    taken = {edge.token for edge in graph.edges if edge.is_input}
    centres = layout.centres[len(graph.functions) :]
    places = [place for place, token in enumerate(graph.tokens) if token.role == "payload"]
    return (
        [centres[place] for place in places if place not in made],
        [centres[place] for place in places if place not in taken],
    )


class _Row:
    """The stages before a graph, or after it, side by side across the direction of flow.

    Everything is computed for a flow from top to bottom, and turned for one from left to right.
    """

    def __init__(
        self,
        stages: Sequence[StageView],
        frame: Bounds,
        label: Bounds,
        tokens: Sequence[Point],
        is_before: bool,
        is_turned: bool,
    ) -> None:
        self._stages, self._is_before, self._is_turned = stages, is_before, is_turned
        self._frame = frame.turned() if is_turned else frame
        sizes = [_stage_size(stage)[:: -1 if is_turned else 1] for stage in stages]
        self._widths, depth = [width for width, _ in sizes], max(depth for _, depth in sizes)
        # An arrow from above must not hit the title.
        free_from = label.right if is_before and not is_turned else self._frame.left
        at = [point[is_turned] for point in tokens]
        self._lefts = self._placed(
            fmean(at) if at else (self._frame.left + self._frame.right) / 2, free_from + _PADDING_PX
        )
        above = self._frame.top - _GAP_PX - depth - (0.0 if is_turned else _TITLE_PX / 2)
        self._top = above if is_before else self._frame.bottom + _GAP_PX
        self._bottom = self._top + depth
        self.bounds = self._turn(Bounds(self._lefts[0], self._top, self._lefts[-1] + self._widths[-1], self._bottom))

    def _placed(self, over: float, least: float) -> list[float]:
        """Return where each stage begins: that beside the frame over the tokens, or moved so that all are over it."""
        frame, half = self._frame, self._widths[-1 if self._is_before else 0] / 2
        length, most = sum(self._widths) + _GAP_PX * (len(self._widths) - 1), frame.right - _PADDING_PX
        leftmost, rightmost = frame.left + length - half, frame.right - length + half
        if self._is_before and leftmost <= most:
            least = max(least, leftmost)
        elif not self._is_before and rightmost >= least:
            most = min(most, rightmost)
        middle = min(max(over, least), most)
        lefts = [middle + half - length if self._is_before else middle - half]
        for width in self._widths[:-1]:
            lefts.append(lefts[-1] + width + _GAP_PX)
        return lefts

    def _turn(self, bounds: Bounds) -> Bounds:
        return bounds.turned() if self._is_turned else bounds

    def paint(self) -> Iterator[str]:
        """Give the arrows, then the stages."""
        middle, nearest = (self._top + self._bottom) / 2, -1 if self._is_before else 0
        arrows = [((left - _GAP_PX, middle), (left, middle)) for left in self._lefts[1:]]
        x = self._lefts[nearest] + self._widths[nearest] / 2
        down = (self._bottom, self._frame.top) if self._is_before else (self._frame.bottom, self._top)
        arrows.append(((x, down[0]), (x, down[1])))
        yield self._paint_arrows(arrows)
        for stage, left, width in zip(self._stages, self._lefts, self._widths, strict=True):
            yield _paint_stage(stage, self._turn(Bounds(left, self._top, left + width, self._bottom)))

    def _paint_arrows(self, arrows: Sequence[tuple[Point, Point]]) -> str:
        lines, tips = "", ""
        for start, end in arrows:
            (x0, y0), (x1, y1) = (start[::-1], end[::-1]) if self._is_turned else (start, end)
            lines += f"M{x0:.1f},{y0:.1f}L{x1:.1f},{y1:.1f}"
            sides = f"l-{_TIP_PX:.0f},-3.5v7z" if x0 != x1 else f"l-3.5,-{_TIP_PX:.0f}h7z"
            tips += f"M{x1:.1f},{y1:.1f}{sides}"
        return f'<path class="edge around" d="{lines}"/><path class="tip around" d="{tips}"/>'
