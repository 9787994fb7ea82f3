"""Where does each vertex and edge go?

Graphviz places vertices and routes edges (``engine``), but for what it would take minutes over or make unreadable:
many sources or sinks of the same functions (``blocks``), edges along a long chain (``arcs``), and graphs that are too
dense or too large (``rows``). The result is kept: a run with other values, or a graph with other names of the same
lengths, is not laid out again.
"""

from __future__ import annotations

import functools
from typing import Final

from epypes.display.layout.arcs import long_edges, with_arcs
from epypes.display.layout.blocks import fold, unfold
from epypes.display.layout.engine import routed_layout
from epypes.display.layout.geometry import Box, Direction, Edge, Layout
from epypes.display.layout.rows import in_rows
from epypes.display.layout.turn import alike_in_order, in_order, lying, transposed

# Graphviz takes 0.25 s for so many vertices and 0.9 s for twice as many, and beyond them pygraphviz prints a warning.
_MOST_VERTICES: Final = 1000


@functools.lru_cache(maxsize=128)
def lay_out(
    boxes: tuple[Box, ...], edges: tuple[Edge, ...], is_dense: bool = False, direction: Direction = "down"
) -> Layout:
    """Place vertices and edges.

    Parameters
    ----------
    boxes, edges
        The vertices, and pairs of their indices.
    is_dense
        Whether the edges are too many to be followed. Then they are not routed, and the vertices stand in rows: a
        search for few crossings would take Graphviz minutes.
    direction
        Where edges lead.

    Raises
    ------
    LayoutUnavailable
        No engine answered.
    """
    if direction == "right":
        return transposed(_downwards(lying(boxes), edges, is_dense))
    return _downwards(boxes, edges, is_dense)


def _downwards(boxes: tuple[Box, ...], edges: tuple[Edge, ...], is_dense: bool) -> Layout:
    graph = fold(boxes, edges)
    if is_dense or len(graph.boxes) > _MOST_VERTICES:
        return in_rows(boxes, edges)
    unrouted = long_edges(len(graph.boxes), graph.edges)
    routed = [edge for edge in graph.edges if edge not in unrouted]
    layout = in_order(routed_layout(graph.boxes, routed, graph.blocks), graph.edges)
    layout = alike_in_order(layout, graph.boxes, graph.edges, routed)
    arcs = {edge for edge in edges if graph.folded(edge) in unrouted}
    layout = unfold(layout, graph, [edge for edge in edges if edge not in arcs], routed)
    return with_arcs(layout, boxes, edges, arcs)
