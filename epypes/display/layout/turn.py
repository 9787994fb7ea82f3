"""Which way round does a layout lie?

Everything is laid out from top to bottom; a picture from left to right is one of boxes that lie on their sides, seen
from the other side of the diagonal. Graphviz cares for few crossings, not for what stands left and what right, so a
layout whose inputs mostly stand in the wrong order is turned over, and vertices that may change places do so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from epypes.display.layout.geometry import Box, Edge, Layout, Point


def lying(boxes: Iterable[Box]) -> tuple[Box, ...]:
    """Return boxes with their widths and heights exchanged."""
    return tuple(Box(box.shape, box.height, box.width) for box in boxes)


def transposed(layout: Layout) -> Layout:
    """Exchange right and down."""
    return Layout(
        layout.height,
        layout.width,
        tuple((y, x) for x, y in layout.centres),
        tuple(tuple((y, x) for x, y in spline) for spline in layout.splines),
    )


def in_order(layout: Layout, edges: Sequence[Edge]) -> Layout:
    """Exchange left and right, if the neighbours of vertices stand in the reverse of the edges' order.

    What counts is how far it is from the first neighbour of a vertex to its last, summed up: so two branches, which
    stand far from each other, have more weight than the hyperparameters beside a function.
    """
    above: dict[int, list[float]] = {}
    below: dict[int, list[float]] = {}
    for tail, head in edges:
        above.setdefault(head, []).append(layout.centres[tail][0])
        below.setdefault(tail, []).append(layout.centres[head][0])
    to_the_right = sum(xs[-1] - xs[0] for xs in (*above.values(), *below.values()))
    return _mirrored(layout) if to_the_right < 0 else layout


def _mirrored(layout: Layout) -> Layout:
    def over(points: Iterable[Point]) -> tuple[Point, ...]:
        return tuple((layout.width - x, y) for x, y in points)

    return Layout(layout.width, layout.height, over(layout.centres), tuple(map(over, layout.splines)))


def alike_in_order(layout: Layout, boxes: Sequence[Box], edges: Sequence[Edge], routed: Sequence[Edge]) -> Layout:
    """Let vertices of one size that have the same neighbours stand from left to right in their order.

    Parameters
    ----------
    routed
        The edges in the order of the layout's splines.
    """
    takes_place_of = _exchanges(layout, boxes, edges)
    if not takes_place_of:
        return layout
    spline = dict(zip(routed, layout.splines, strict=True))
    place = [takes_place_of.get(vertex, vertex) for vertex in range(len(boxes))]
    return Layout(
        layout.width,
        layout.height,
        tuple(layout.centres[vertex] for vertex in place),
        tuple(spline[place[tail], place[head]] for tail, head in routed),
    )


def _exchanges(layout: Layout, boxes: Sequence[Box], edges: Sequence[Edge]) -> dict[int, int]:
    """Return by vertex whose place it takes."""
    neighbours: dict[int, set[tuple[bool, int]]] = {vertex: set() for vertex in range(len(boxes))}
    for tail, head in edges:
        neighbours[tail].add((True, head))
        neighbours[head].add((False, tail))
    alike: dict[tuple[Box, frozenset[tuple[bool, int]]], list[int]] = {}
    for vertex, box in enumerate(boxes):
        alike.setdefault((box, frozenset(neighbours[vertex])), []).append(vertex)
    return {
        vertex: place
        for vertices in alike.values()
        if len(vertices) > 1
        for vertex, place in zip(vertices, sorted(vertices, key=lambda each: layout.centres[each]), strict=True)
    }
