"""How do a graph and a table look where nothing but text can be shown?"""

from __future__ import annotations

from epypes.display.durations import duration_text
from epypes.display.markup import cut
from epypes.display.paint.rows import Table
from epypes.display.paint.stagemarks import stage_words
from epypes.display.paint.tables import CELL_CHARACTERS
from epypes.display.previews.short import reason
from epypes.display.views.graphview import FunctionView, GraphView, StageView

_MOST_LINES = 40
_REPR_CHARACTERS = 99
_STATES = {
    "planned": "[to run]",
    "reused": "[reused]",
    "stale": "[stale]",
    "left out": "[left out]",
    "running": "[running]",
    "failed": "[failed]",
}


def paint_text(graph: GraphView) -> str:
    """Paint a graph as one line per function, in run order: ``canny(image_blurred, canny_lo, canny_hi) -> edges``."""
    lines = [f"pipeline {graph.title}"] if graph.title else []
    lines += map(_stage_line, graph.before)
    for (inputs, outputs), function in zip(graph.io(), graph.functions[:_MOST_LINES], strict=False):
        line = f"{function.name}({', '.join(inputs)}) -> {', '.join(outputs) or 'nothing'}"
        lines.append("  ".join(filter(None, (line, _state(function), *function.notes, function.message))))
    if len(graph.functions) > _MOST_LINES:
        lines.append(f"... and {len(graph.functions) - _MOST_LINES} functions more")
    lines += map(_stage_line, graph.after)
    values = [
        f"{token.name} = {token.preview.text}{f' (first {token.first})' * bool(token.first)}"
        for token in graph.tokens
        if token.role == "hyperparameter" and token.preview
    ]
    missing = [token.name for token in graph.tokens if token.state == "missing"]
    for start, names in (("with", values), ("missing", missing)):
        if names:
            lines.append(f"{start} {', '.join(names[:_MOST_LINES])}")
    return "\n".join(lines)


def text_table(table: Table) -> str:
    """Write a table as aligned lines: its caption, its head, its rows."""
    if not table.head:
        return table.caption
    lines = [[_printable(cut(cell, CELL_CHARACTERS)) for cell in cells] for cells in (table.head, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    aligned = [
        "  ".join(
            cell.ljust(width) if column < table.texts else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ).rstrip()
        for cells in lines
    ]
    return "\n".join([*([_printable(table.caption)] if table.caption else []), *aligned])


def _printable(text: str) -> str:
    """Return text without what would steer a terminal."""
    return "".join(character if character.isprintable() else "\ufffd" for character in text)


def _stage_line(stage: StageView) -> str:
    return f"{stage.kind} {stage.name}  [{'; '.join(stage_words(stage))}]"


def _state(function: FunctionView) -> str:
    if function.duration_ns is not None:
        return f"[{duration_text(function.duration_ns)}]"
    return _STATES.get(function.state, "")


def repr_text(shown: object) -> str:
    """Return the repr of what is shown, which in a subclass may be of any length, or raise."""
    try:
        return cut(repr(shown), _REPR_CHARACTERS)
    except Exception as error:
        return f"<{type(shown).__name__}: no repr: {reason(error)}>"
