"""How is a GraphView painted as SVG?

Graphviz gives the geometry only; every mark is painted here, so that names, values, thumbnails and states change
without a new layout, and colours follow the page's theme.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from epypes.display.layout.geometry import Box, Layout
from epypes.display.layout.place import lay_out
from epypes.display.markup import escape, fitted, short_name
from epypes.display.paint.edges import paint_edges
from epypes.display.paint.functionmarks import function_box, paint_function
from epypes.display.paint.stages import paint_around
from epypes.display.paint.style import STYLE
from epypes.display.paint.tokenmarks import paint_token, token_box
from epypes.display.views.graphview import GraphView
from epypes.display.views.groups import function_count
from epypes.wording import counted

# Beyond this many edges, and this many for each vertex, curves and arrows can't be followed by the eye, would take
# Graphviz minutes and would fill the picture.
_MANY_EDGES: Final = 150
_DENSE: Final = 1.6
_CAPTION_ROOM: Final = 400
_MARGIN: Final = 6
# A page may shrink a picture that is too wide to this part of its size; smaller, its text could not be read, so it
# is scrolled.
# No text in an attribute has a quote of its own.
_LEAST_WIDTH: Final = re.compile('" style="min-width:([0-9]+)px">')
_LEAST_SCALE: Final = 0.75


def paint_svg(graph: GraphView) -> str:
    """Paint a graph; the same view gives the same text.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    functions = len(graph.functions)
    boxes = (
        *(function_box(function, graph.direction) for function in graph.functions),
        *map(token_box, graph.tokens),
    )
    edges = tuple(
        (functions + edge.token, edge.function) if edge.is_input else (edge.function, functions + edge.token)
        for edge in graph.edges
    )
    is_dense = len(edges) > max(_MANY_EDGES, _DENSE * len(boxes))
    layout = lay_out(boxes, edges, is_dense, graph.direction)
    around, bounds = paint_around(graph, layout)
    width, height = bounds.right - bounds.left + 2 * _MARGIN, bounds.bottom - bounds.top + 2 * _MARGIN
    size = f"{width:.0f}", f"{height:.0f}"
    box = f"{bounds.left - _MARGIN:.4g} {bounds.top - _MARGIN:.4g} {size[0]} {size[1]}"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="epypes-graph" role="figure" '
        f'aria-label="{escape(alt_text(graph))}" width="{size[0]}" height="{size[1]}" viewBox="{box}" '
        f'style="min-width:{_LEAST_SCALE * width:.0f}px">'
    )
    parts = [head, f"<style>{STYLE}</style>", *around]
    if graph.draws_edges:
        parts += paint_edges(graph.edges, edges, layout)
    parts += _paint_vertices(graph, boxes, layout)
    parts.append("</svg>")
    return "\n".join(parts)


def least_width(svg: str) -> str:
    """Return the width in pixels that a painted graph asks for at least; 0 if it does not ask."""
    found = _LEAST_WIDTH.search(svg)
    return found[1] if found else "0"


def alt_text(graph: GraphView) -> str:
    """Return the graph in one sentence, for screen readers."""
    order = ", ".join(short_name(function.name) for function in graph.functions[:12])
    more = ", ..." if len(graph.functions) > 12 else ""
    functions = counted(function_count(graph), "function")
    said = f"Computational graph of {functions}: {order}{more}. {fitted(graph.caption, _CAPTION_ROOM)}".strip()
    if not graph.title:
        return said
    stages = [short_name(stage.name) for stage in graph.before] + ["the graph"] * bool(graph.before or graph.after)
    stages += [short_name(stage.name) for stage in graph.after]
    through = f", events go through {', '.join(stages)}" if stages else ""
    return f"Pipeline {short_name(graph.title)}{through}. {said}"


def _paint_vertices(graph: GraphView, boxes: tuple[Box, ...], layout: Layout) -> Iterable[str]:
    functions = len(graph.functions)
    for function, box, centre in zip(graph.functions, boxes, layout.centres, strict=False):
        yield paint_function(function, box, centre, graph.direction)
    for token, box, centre in zip(graph.tokens, boxes[functions:], layout.centres[functions:], strict=True):
        yield paint_token(token, box, centre)
