"""How large is a stage of a pipeline, how is it painted, and how is it told in words?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from statistics import fmean
from typing import Final

from epypes.display.layout.geometry import Layout, Point
from epypes.display.paint.vertices import LINE_PX, text_lines, text_width, vertex
from epypes.display.text import content, fitted, short_name, wrapped
from epypes.display.views.graphview import GraphView, StageView

# Beside the text: the slots of a queue, the arrow of a loop.
_QUEUE_PX: Final = 26
_LOOP_PX: Final = 24
_SLOT_PX: Final = 7
_NOTE_CHARACTERS: Final = 30
_NOTE_LINES: Final = 2
_MOST_LINES: Final = 8
_TOLD_CHARACTERS: Final = 300
# Counts grow while somebody looks: a few digits more are not to move anything.
_WIDTH_STEP: Final = 4
_WORDS: Final = {
    ("loop", "running"): "listening",
    ("loop", "stopped"): "stopped",
    ("function", "running"): "running",
    ("function", "failed"): "failed",
    ("queue", "running"): "put waits for room",
}


def stage_words(stage: StageView) -> tuple[str, ...]:
    """Return the state of a stage, where there is something to be said, and its notes."""
    said = _WORDS.get((stage.kind, stage.state), "" if stage.state == "static" else stage.state)
    return (said, *stage.notes) if said else stage.notes


def stage_size(stage: StageView) -> tuple[float, float]:
    """Return the width and height of a stage, in pixels."""
    lines = _lines(stage)
    widest = max(map(len, lines))
    widest += -widest % _WIDTH_STEP
    extra = {"queue": _QUEUE_PX, "loop": _LOOP_PX}.get(stage.kind, 0)
    return text_width(" " * widest) + extra, LINE_PX * len(lines) + 14


def paint_stage(stage: StageView, size: tuple[float, float], centre: Point) -> str:
    """Paint a stage as an element with its title."""
    width, height = size
    x, y = centre[0] - width / 2, centre[1] - height / 2
    body, middle = {"queue": _queue, "loop": _loop}.get(stage.kind, _call)(x, y, width, height)
    body += text_lines(_lines(stage), (middle, centre[1]))
    kind = "call" if stage.kind == "function" else stage.kind
    title = f"{stage.kind} {stage.name}: {'; '.join(stage_words(stage))}"
    return vertex("stage", stage.name, (kind, stage.state), title, body, more=_TOLD_CHARACTERS)


def _lines(stage: StageView) -> tuple[str, ...]:
    words = (line for said in stage_words(stage) for line in wrapped(said, _NOTE_CHARACTERS, _NOTE_LINES))
    return short_name(stage.name), *islice(words, _MOST_LINES)


def _queue(x: float, y: float, width: float, height: float) -> tuple[str, float]:
    """Draw a queue, open at its ends, with slots where its items leave; give the middle of what is left for text."""
    right, bottom = x + width, y + height
    slots = "".join(f"M{right - place * _SLOT_PX - 1:.1f},{y:.1f}v{height:.1f}" for place in range(3))
    body = (
        f'<rect class="shape open" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"/>'
        f'<path class="mark" d="M{x:.1f},{y:.1f}H{right:.1f}M{x:.1f},{bottom:.1f}H{right:.1f}{slots}"/>'
    )
    return body, x + (width - _QUEUE_PX) / 2 + 3


def _loop(x: float, y: float, width: float, height: float) -> tuple[str, float]:
    """Draw a loop, round at its ends, with an arrow that runs in a circle."""
    radius = height / 2
    left, middle = x + 21, y + height / 2
    body = (
        f'<rect class="shape" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="{radius:.1f}"/>'
        f'<path class="mark" d="M{left + 6:.1f},{middle - 4:.1f}a7,7 0 1 0 1.2,4"/>'
        f'<path class="tip" d="M{left + 8.5:.1f},{middle - 8:.1f}v6h-6z"/>'
    )
    return body, x + width / 2 + _LOOP_PX / 2 - 2


def _call(x: float, y: float, width: float, height: float) -> tuple[str, float]:
    body = f'<rect class="shape" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" rx="3"/>'
    return body, x + width / 2


_PADDING_PX: Final = 16.0
_TITLE_PX: Final = 22.0
_TITLE_ROOM: Final = 600
# Between stages, and between them and the frame.
_GAP_PX: Final = 26.0
_TIP_PX: Final = 8.0


@dataclass(frozen=True, slots=True)
class Bounds:
    """A rectangle, in pixels."""

    left: float
    top: float
    right: float
    bottom: float

    def holding(self, other: Bounds) -> Bounds:
        """Return the smallest rectangle that both are in."""
        return Bounds(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )

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
    frame = _frame(graph.title, inside)
    label = Bounds(*_label(graph.title, frame))
    parts = [*_paint_frame(graph.title, frame, label)]
    covered = frame.holding(label)
    starts, ends = _source_and_sink_centres(graph, layout)
    for stages, centres, is_before in ((graph.before, starts, True), (graph.after, ends, False)):
        if stages:
            row = _Row(stages, frame, label, centres, is_before, graph.direction == "right")
            parts += row.paint()
            covered = covered.holding(row.bounds)
    return parts, covered


def _frame(title: str, inside: Bounds) -> Bounds:
    width = text_width(short_name(title)) + 2 * _PADDING_PX + 2 * _GAP_PX
    more = max(width - inside.right - 2 * _PADDING_PX, 0.0) / 2 + _PADDING_PX
    return Bounds(-more, -_PADDING_PX - _TITLE_PX / 2, inside.right + more, inside.bottom + _PADDING_PX)


def _label(title: str, frame: Bounds) -> tuple[float, float, float, float]:
    left, top = frame.left + _PADDING_PX, frame.top - _TITLE_PX / 2
    return left, top, left + text_width(short_name(title)), top + _TITLE_PX


def _paint_frame(title: str, frame: Bounds, label: Bounds) -> Iterator[str]:
    """Paint the frame, and the title on a label that lies on its upper border."""
    yield (
        f'<rect class="frame" x="{frame.left:.1f}" y="{frame.top:.1f}" width="{frame.right - frame.left:.1f}" '
        f'height="{frame.bottom - frame.top:.1f}" rx="8"/>'
    )
    if title:
        width, left = label.right - label.left, label.left
        told = content(fitted(f"pipeline {title}", _TITLE_ROOM))
        yield (
            f'<g class="label"><title>{told}</title><rect class="shape" x="{left:.1f}" y="{label.top:.1f}" '
            f'width="{width:.1f}" height="{_TITLE_PX:.0f}" rx="5"/>'
            f'<text class="name" x="{left + width / 2:.1f}" y="{frame.top + LINE_PX / 4:.1f}">'
            f"{content(short_name(title))}</text></g>"
        )


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
        sizes = [stage_size(stage)[:: -1 if is_turned else 1] for stage in stages]
        self._depth = max(depth for _, depth in sizes)
        self._widths = [width for width, _ in sizes]
        at = [point[is_turned] for point in tokens]
        # An arrow from above must not hit the title.
        self._free_from = label.right if is_before and not is_turned else self._frame.left
        self._lefts = self._placed(fmean(at) if at else (self._frame.left + self._frame.right) / 2)
        self._y = (
            self._frame.top - _GAP_PX - self._depth if is_before else self._frame.bottom + _GAP_PX
        ) - _TITLE_PX / 2 * (is_before and not is_turned)
        self.bounds = self._turn(
            Bounds(self._lefts[0], self._y, self._lefts[-1] + self._widths[-1], self._y + self._depth)
        )

    def _placed(self, over: float) -> list[float]:
        """Return where each stage begins: that beside the frame over the tokens, or moved so that all are over it."""
        frame, nearest = self._frame, -1 if self._is_before else 0
        length = sum(self._widths) + _GAP_PX * (len(self._widths) - 1)
        half = self._widths[nearest] / 2
        least, most = self._free_from + _PADDING_PX, frame.right - _PADDING_PX
        leftmost, rightmost = frame.left + length - half, frame.right - length + half
        if self._is_before and leftmost <= most:
            least = max(least, leftmost)
        elif not self._is_before and rightmost >= least:
            most = min(most, rightmost)
        middle = min(max(over, least), most)
        left = middle + half - length if self._is_before else middle - half
        lefts = []
        for width in self._widths:
            lefts.append(left)
            left += width + _GAP_PX
        return lefts

    def _turn(self, bounds: Bounds) -> Bounds:
        return bounds.turned() if self._is_turned else bounds

    def paint(self) -> Iterator[str]:
        """Give the arrows, then the stages."""
        middle = self._y + self._depth / 2
        arrows = [((left - _GAP_PX, middle), (left, middle)) for left in self._lefts[1:]]
        if self._is_before:
            x = self._lefts[-1] + self._widths[-1] / 2
            arrows.append(((x, self._y + self._depth), (x, self._frame.top)))
        else:
            x = self._lefts[0] + self._widths[0] / 2
            arrows.append(((x, self._frame.bottom), (x, self._y)))
        yield self._paint_arrows(arrows)
        for stage, left, width in zip(self._stages, self._lefts, self._widths, strict=True):
            placed = self._turn(Bounds(left, self._y, left + width, self._y + self._depth))
            size = placed.right - placed.left, placed.bottom - placed.top
            yield paint_stage(stage, size, ((placed.left + placed.right) / 2, (placed.top + placed.bottom) / 2))

    def _paint_arrows(self, arrows: Sequence[tuple[Point, Point]]) -> str:
        lines, tips = "", ""
        for start, end in arrows:
            (x0, y0), (x1, y1) = (start[::-1], end[::-1]) if self._is_turned else (start, end)
            lines += f"M{x0:.1f},{y0:.1f}L{x1:.1f},{y1:.1f}"
            tips += _tip(x1, y1, is_across=x0 != x1)
        return f'<path class="edge around" d="{lines}"/><path class="tip around" d="{tips}"/>'


def _tip(x: float, y: float, is_across: bool) -> str:
    """Draw the tip of an arrow to the right, or down."""
    sides = f"l-{_TIP_PX:.0f},-3.5v7z" if is_across else f"l-3.5,-{_TIP_PX:.0f}h7z"
    return f"M{x:.1f},{y:.1f}{sides}"
