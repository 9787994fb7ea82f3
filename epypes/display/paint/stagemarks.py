"""How large is a stage of a pipeline, how is it painted, and how is it told in words?"""

from __future__ import annotations

from itertools import islice
from typing import Final

from epypes.display.layout.geometry import Point
from epypes.display.markup import short_name, wrapped
from epypes.display.paint.marks import LINE_PX, text_lines, text_width, vertex
from epypes.display.views.graphview import StageView

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
