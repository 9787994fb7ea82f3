"""How does a graph look as a table for screen readers, and how is any table written for a page?"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from epypes.display.durations import duration_text
from epypes.display.markup import content, cut, cut_name, fitted, size
from epypes.display.paint.rows import Table
from epypes.display.paint.stagemarks import stage_words
from epypes.display.views.graphview import FunctionView, GraphView, StageView, TokenView

_LEFT: Final = ' style="text-align:left"'
CELL_CHARACTERS: Final = 60
_CELL_ROOM: Final = 100
_TWIN_CHARACTERS: Final = 200
# What is kept for saying how many rows do not fit.
_LAST_ROW: Final = 60
_HIDDEN: Final = "position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap"


def paint_twin(graph: GraphView, title: str, room: int) -> str:
    """Paint a graph as tables for screen readers; they also stay where a page strips the picture.

    First the functions, with the stages around them, then the tokens, so many of them as fit in ``room`` characters;
    how many don't is said.
    """
    functions = (
        (function.name, ", ".join(inputs), ", ".join(outputs), "; ".join((*_state(function), *function.notes)))
        for (inputs, outputs), function in zip(graph.io(), graph.functions, strict=True)
    )
    rows = (*map(_stage_cells, graph.before), *functions, *map(_stage_cells, graph.after))
    tokens = ((token.name, *_value(token)) for token in graph.tokens)
    start, end = f'<div style="{_HIDDEN}">', "</div>"
    room -= size(start) + size(end)
    first = _twin(title, ("function", "inputs", "outputs", "state"), rows, room)
    return start + first + _twin("Its tokens", ("token", "value", "state"), tokens, room - size(first)) + end


def _twin(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], room: int) -> str:
    start = f"<table><caption>{content(caption)}</caption>{_row('th', head, 0)}"
    room -= size(start) + _LAST_ROW
    kept: list[str] = []
    left_out = 0
    for cells in rows:
        row = _row("td", [content(cut_name(cell, _TWIN_CHARACTERS)) for cell in cells], 0)
        room -= size(row)
        if room >= 0 and not left_out:
            kept.append(row)
        else:
            left_out += 1
    more = _row("td", [f"and {left_out} more"], 0) if left_out else ""
    return f"{start}{''.join(kept)}{more}</table>" if kept else ""


def _state(function: FunctionView) -> Iterable[str]:
    yield function.state
    if function.duration_ns is not None:
        yield duration_text(function.duration_ns)
    if function.message:
        yield function.message


def _value(token: TokenView) -> tuple[str, str]:
    return token.preview.detail if token.preview else "", f"{token.role}, {token.state}"


def _stage_cells(stage: StageView) -> tuple[str, ...]:
    return f"{stage.kind} {stage.name}", "", "", "; ".join(stage_words(stage))


def paint_table(table: Table) -> str:
    """Write a table; what holds words stands to the left, where JupyterLab has everything to the right."""
    above = f"<caption>{content(table.caption)}</caption>" if table.caption else ""
    lines = (_row("td", list(map(_cell, cells)), table.texts) for cells in table.rows)
    return f"<table>{above}{_row('th', table.head, table.texts)}{''.join(lines)}</table>"


def _cell(text: str) -> str:
    return content(fitted(cut(text, CELL_CHARACTERS), _CELL_ROOM))


def _row(tag: str, cells: Sequence[str], texts: int) -> str:
    written = (f"<{tag}{_LEFT * (column < texts)}>{cell}</{tag}>" for column, cell in enumerate(cells))
    return f"<tr>{''.join(written)}</tr>"
