"""The place of each vertex and the way of each edge.

Graphviz places vertices and routes edges (``graphviz``), but for what it would take minutes over or make unreadable:
many sources or sinks of the same functions (``blocks``), edges along a long chain (arcs), and graphs that are too dense
or too large (rows). Everything is laid out from top to bottom; a picture from left to right is one of boxes that lie
on their sides, seen from the other side of the diagonal. The result is kept: a run with other values, or a graph with
other names of the same lengths, is not laid out again.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Final

from epypes.display.layout.blocks import fold, unfold
from epypes.display.layout.geometry import Box, Direction, Edge, Layout, Point
from epypes.display.layout.graphviz import routed_layout

# Graphviz takes 0.25 s for so many vertices and 0.9 s for twice as many, and beyond them pygraphviz prints a warning.
_MOST_VERTICES: Final = 1000


@functools.lru_cache(maxsize=128)
def lay_out(
    boxes: tuple[Box, ...],
    edges: tuple[Edge, ...],
    is_dense: bool = False,
    direction: Direction = "down",
    back: tuple[Edge, ...] = (),
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
    back
        Edges that lead back, which no vertex is placed by; their splines come last. None in rows.

    Raises
    ------
    LayoutUnavailable
        No engine answered.
    """
    if direction == "down":
        return _with_back(_downwards(boxes, edges, is_dense), boxes, edges, back)
    turned = tuple(Box(box.shape, box.height, box.width) for box in boxes)
    layout = _with_back(_downwards(turned, edges, is_dense), turned, edges, back)
    return _moved(layout, lambda point: point[::-1], layout.height, layout.width)


def _downwards(boxes: tuple[Box, ...], edges: tuple[Edge, ...], is_dense: bool) -> Layout:
    graph = fold(boxes, edges)
    if is_dense or len(graph.boxes) > _MOST_VERTICES:
        return _in_rows(boxes, edges)
    unrouted = _long_edges(len(graph.boxes), graph.edges)
    routed = [edge for edge in graph.edges if edge not in unrouted]
    layout = _in_order(routed_layout(graph.boxes, routed, graph.blocks), graph.edges)
    layout = _alike_in_order(layout, graph.boxes, graph.edges, routed)
    arcs = {edge for edge in edges if graph.folded(edge) in unrouted}
    layout = unfold(layout, graph, [edge for edge in edges if edge not in arcs], routed)
    return _with_arcs(layout, boxes, edges, arcs) if arcs else layout


def _moved(layout: Layout, move: Callable[[Point], Point], width: float, height: float) -> Layout:
    splines = tuple(tuple(map(move, spline)) for spline in layout.splines)
    return Layout(width, height, tuple(map(move, layout.centres)), splines)


# -- rows ----------------------------------------------------------------------------------------------------------

_GAP_PX: Final = 14.0


def ranks(count: int, edges: Iterable[Edge]) -> list[int]:
    """Return the row of each vertex: the first one below all that lead to it.

    Boxes that stand for several functions may lead to each other. Such a ring is cut at its first vertex.
    """
    heads: list[list[int]] = [[] for _ in range(count)]
    waiting = [0] * count
    for tail, head in edges:
        heads[tail].append(head)
        waiting[head] += 1
    rank, is_placed = [0] * count, [False] * count
    ready = deque(vertex for vertex in range(count) if not waiting[vertex])
    for first in range(count + 1):
        while ready:
            tail = ready.popleft()
            is_placed[tail] = True
            for head in heads[tail]:
                waiting[head] -= 1
                if not is_placed[head]:
                    rank[head] = max(rank[head], rank[tail] + 1)
                    if not waiting[head]:
                        ready.append(head)
        if first < count and not is_placed[first]:
            ready.append(first)
    return rank


def _in_rows(boxes: Sequence[Box], edges: Iterable[Edge]) -> Layout:
    """Place vertices in rows, each below all that lead to it; edges are not routed."""
    rows: dict[int, list[int]] = {}
    for vertex, row in enumerate(ranks(len(boxes), edges)):
        rows.setdefault(row, []).append(vertex)
    widths = {row: sum(boxes[vertex].width + _GAP_PX for vertex in vertices) for row, vertices in rows.items()}
    width, y = max(widths.values(), default=0.0), 0.0
    centres: list[Point] = [(0.0, 0.0)] * len(boxes)
    for row in sorted(rows):
        x, height = (width - widths[row]) / 2, max(boxes[vertex].height for vertex in rows[row])
        for vertex in rows[row]:
            centres[vertex] = (x + boxes[vertex].width / 2, y + height / 2)
            x += boxes[vertex].width + _GAP_PX
        y += height + 3 * _GAP_PX
    return Layout(width, y, tuple(centres), ())


# -- arcs ----------------------------------------------------------------------------------------------------------

# Graphviz puts a point into every row that an edge skips, and takes 0.1 s to place 500 of them, 20 s for 5,000.
_MOST_SKIPPED: Final = 500
_LEAST_BULGE_PX: Final = 20.0
_MOST_BULGE_PX: Final = 160.0
_TIP_PX: Final = 9.0


def _long_edges(count: int, edges: Sequence[Edge]) -> set[Edge]:
    """Return edges that skip so many rows, taken together, that Graphviz would search minutes for their ways.

    Those of a hyperparameter that each function of a long chain takes: all but the one to the first of them.
    """
    rank = ranks(count, edges)
    first = dict.fromkeys(range(count), max(rank, default=0))
    for tail, head in edges:
        first[tail] = min(first[tail], rank[head] - 1)
    skipped: dict[int, int] = dict.fromkeys(range(count), 0)
    for tail, head in edges:
        skipped[tail] += rank[head] - 1 - first[tail]
    total, worst = sum(skipped.values()), set()
    # All of a vertex or none, so that the eye takes them for one thing.
    for tail in sorted(skipped, key=lambda tail: -skipped[tail]):
        if total <= _MOST_SKIPPED:
            break
        total -= skipped[tail]
        worst.add(tail)
    return {(tail, head) for tail, head in edges if tail in worst and rank[head] - 1 > first[tail]}


def _with_arcs(layout: Layout, boxes: Sequence[Box], edges: Sequence[Edge], arcs: Collection[Edge]) -> Layout:
    """Add the edges that were not routed, as arcs from side to side; the picture becomes wider by them."""
    margin = max(_bulge(layout.centres[tail], layout.centres[head]) for tail, head in arcs)
    layout = _moved(layout, lambda point: (point[0] + margin, point[1]), layout.width + 2 * margin, layout.height)
    routed = iter(layout.splines)
    splines = tuple(_arc(boxes, layout.centres, edge) if edge in arcs else next(routed) for edge in edges)
    return Layout(layout.width, layout.height, layout.centres, splines)


def _with_back(layout: Layout, boxes: Sequence[Box], edges: Sequence[Edge], back: Collection[Edge]) -> Layout:
    if not back or not layout.splines:
        return layout
    return _with_arcs(layout, boxes, (*edges, *back), back)


def _bulge(start: Point, end: Point) -> float:
    return min(_LEAST_BULGE_PX + 0.1 * math.dist(start, end), _MOST_BULGE_PX)


def _crossed(boxes: Sequence[Box], centres: Sequence[Point], edge: Edge, side: int) -> int:
    """Return how many vertices stand beside the ends of an edge, where its arc would leave or come."""
    reach = _bulge(*(centres[end] for end in edge))
    return sum(
        0 < side * (x - centres[end][0]) < (boxes[end].width + box.width) / 2 + reach
        and abs(y - centres[end][1]) < box.height / 2
        for end in edge
        for (x, y), box in zip(centres, boxes, strict=True)
    )


def _arc(boxes: Sequence[Box], centres: Sequence[Point], edge: Edge) -> tuple[Point, ...]:
    tail, head = edge
    usual = -1 if centres[tail][0] <= centres[head][0] else 1
    side = min((usual, -usual), key=lambda side: _crossed(boxes, centres, edge, side))
    (x0, y0), (x1, y1) = ((centres[end][0] + side * boxes[end].width / 2, centres[end][1]) for end in edge)
    out, end = side * _bulge(centres[tail], centres[head]), x1 + side * _TIP_PX
    return (x0, y0), (x0 + out, y0), (end + out, y1), (end, y1), (x1, y1)


# -- order ---------------------------------------------------------------------------------------------------------


def _in_order(layout: Layout, edges: Sequence[Edge]) -> Layout:
    """Exchange left and right, if the neighbours of vertices stand in the reverse of the edges' order.

    Graphviz cares for few crossings, not for what stands left and what right. What counts is how far it is from the
    first neighbour of a vertex to its last, summed up: so two branches, which stand far from each other, have more
    weight than the hyperparameters beside a function.
    """
    neighbours: dict[tuple[str, int], list[float]] = {}
    for tail, head in edges:
        neighbours.setdefault(("above", head), []).append(layout.centres[tail][0])
        neighbours.setdefault(("below", tail), []).append(layout.centres[head][0])
    if sum(xs[-1] - xs[0] for xs in neighbours.values()) >= 0:
        return layout
    return _moved(layout, lambda point: (layout.width - point[0], point[1]), layout.width, layout.height)


def _alike_in_order(layout: Layout, boxes: Sequence[Box], edges: Sequence[Edge], routed: Sequence[Edge]) -> Layout:
    """Let vertices of one size that have the same neighbours stand from left to right in their order.

    Parameters
    ----------
    routed
        The edges in the order of the layout's splines.
    """
    neighbours: list[set[tuple[bool, int]]] = [set() for _ in boxes]
    for tail, head in edges:
        neighbours[tail].add((True, head))
        neighbours[head].add((False, tail))
    alike: dict[tuple[Box, frozenset[tuple[bool, int]]], list[int]] = {}
    for vertex, box in enumerate(boxes):
        alike.setdefault((box, frozenset(neighbours[vertex])), []).append(vertex)
    # By vertex, whose place it takes.
    place = list(range(len(boxes)))
    for vertices in alike.values():
        for vertex, other in zip(vertices, sorted(vertices, key=lambda each: layout.centres[each]), strict=True):
            place[vertex] = other
    spline = dict(zip(routed, layout.splines, strict=True))
    splines = tuple(spline[place[tail], place[head]] for tail, head in routed)
    return Layout(layout.width, layout.height, tuple(layout.centres[vertex] for vertex in place), splines)
