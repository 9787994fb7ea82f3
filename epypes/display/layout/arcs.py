"""Which edges are too long to be routed, and how do they go around instead?"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Final

from epypes.display.layout.geometry import Box, Edge, Layout, Point
from epypes.display.layout.rows import ranks

# Graphviz puts a point into every row that an edge skips, and takes 0.1 s to place 500 of them, 20 s for 5,000.
_MOST_SKIPPED: Final = 500
_LEAST_BULGE_PX: Final = 20.0
_MOST_BULGE_PX: Final = 160.0
_TIP_PX: Final = 9.0


def long_edges(count: int, edges: Sequence[Edge]) -> set[Edge]:
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


def with_arcs(layout: Layout, boxes: Sequence[Box], edges: Sequence[Edge], arcs: Collection[Edge]) -> Layout:
    """Add the edges that were not routed, as arcs from side to side; the picture becomes wider by them."""
    if not arcs:
        return layout
    margin = max(_bulge(layout.centres[tail], layout.centres[head]) for tail, head in arcs)
    centres = tuple((x + margin, y) for x, y in layout.centres)
    routed = iter(layout.splines)
    splines = tuple(
        _arc(boxes, centres, edge) if edge in arcs else tuple((x + margin, y) for x, y in next(routed))
        for edge in edges
    )
    return Layout(layout.width + 2 * margin, layout.height, centres, splines)


def _bulge(start: Point, end: Point) -> float:
    return min(_LEAST_BULGE_PX + 0.1 * math.dist(start, end), _MOST_BULGE_PX)


def _arc(boxes: Sequence[Box], centres: Sequence[Point], edge: Edge) -> tuple[Point, ...]:
    tail, head = edge
    side = -1 if centres[tail][0] <= centres[head][0] else 1
    (x0, y0), (x1, y1) = ((centres[end][0] + side * boxes[end].width / 2, centres[end][1]) for end in edge)
    out = side * _bulge(centres[tail], centres[head])
    tip = x1, y1
    end = x1 + side * _TIP_PX, y1
    return (x0, y0), (x0 + out, y0), (end[0] + out, y1), end, tip
