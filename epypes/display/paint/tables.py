"""How does a graph look as a table for screen readers, and how is any table written for a page?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from epypes.display.markup import cut, escape
from epypes.display.paint.rows import Table
from epypes.display.paint.stagemarks import stage_words
from epypes.display.views.graphview import GraphView, StageView

_LEFT: Final = ' style="text-align:left"'
_TWIN_CHARACTERS: Final = 200
CELL_CHARACTERS: Final = 60
_HIDDEN: Final = "position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap"


def paint_twin(graph: GraphView, title: str) -> str:
    """Paint a graph as a table for screen readers; it also stays where a page strips the picture."""
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell[:_TWIN_CHARACTERS])}</td>" for cell in cells) + "</tr>"
        for cells in (
            *map(_stage_cells, graph.before),
            *(
                (function.name, ", ".join(inputs), ", ".join(outputs), "; ".join((function.state, *function.notes)))
                for (inputs, outputs), function in zip(graph.io(), graph.functions, strict=True)
            ),
            *map(_stage_cells, graph.after),
        )
    )
    return (
        f'<table style="{_HIDDEN}"><caption>{escape(title)}</caption>'
        f"<tr><th>function</th><th>inputs</th><th>outputs</th><th>state</th></tr>{rows}</table>"
    )


def _stage_cells(stage: StageView) -> tuple[str, ...]:
    return f"{stage.kind} {stage.name}", "", "", "; ".join(stage_words(stage))


def paint_table(table: Table) -> str:
    """Write a table; what holds words stands to the left, where JupyterLab has everything to the right."""
    above = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    lines = (_row("td", [escape(cut(cell, CELL_CHARACTERS)) for cell in cells], table.texts) for cells in table.rows)
    return f"<table>{above}{_row('th', table.head, table.texts)}{''.join(lines)}</table>"


def _row(tag: str, cells: Sequence[str], texts: int) -> str:
    written = (f"<{tag}{_LEFT * (column < texts)}>{cell}</{tag}>" for column, cell in enumerate(cells))
    return f"<tr>{''.join(written)}</tr>"
