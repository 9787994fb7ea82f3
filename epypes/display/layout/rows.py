"""In which row does each vertex stand, and where, without a search for few crossings?"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from epypes.display.layout.geometry import Box, Edge, Layout, Point

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
    for tail in _topological(heads, waiting, is_placed):
        for head in heads[tail]:
            if not is_placed[head]:
                rank[head] = max(rank[head], rank[tail] + 1)
    return rank


def _topological(heads: Sequence[Sequence[int]], waiting: list[int], is_placed: list[bool]) -> Iterator[int]:
    """Give each vertex after all that lead to it, or, where that can't be, the first that is left."""
    ready = deque(vertex for vertex, count in enumerate(waiting) if not count)
    # -1: at first, those that nothing leads to.
    for first in (-1, *range(len(heads))):
        if first >= 0 and not is_placed[first]:
            ready.append(first)
        while ready:
            tail = ready.popleft()
            is_placed[tail] = True
            yield tail
            for head in heads[tail]:
                waiting[head] -= 1
                if not waiting[head] and not is_placed[head]:
                    ready.append(head)


def in_rows(boxes: Sequence[Box], edges: Iterable[Edge]) -> Layout:
    """Place vertices in rows, each below all that lead to it; edges are not routed."""
    rows: dict[int, list[int]] = {}
    for vertex, row in enumerate(ranks(len(boxes), edges)):
        rows.setdefault(row, []).append(vertex)
    widths = {row: sum(boxes[vertex].width + _GAP_PX for vertex in vertices) for row, vertices in rows.items()}
    width, y = max(widths.values(), default=0.0), 0.0
    centres: dict[int, Point] = {}
    for row in sorted(rows):
        x, height = (width - widths[row]) / 2, max(boxes[vertex].height for vertex in rows[row])
        for vertex in rows[row]:
            centres[vertex] = (x + boxes[vertex].width / 2, y + height / 2)
            x += boxes[vertex].width + _GAP_PX
        y += height + 3 * _GAP_PX
    return Layout(width, y, tuple(centres[vertex] for vertex in range(len(boxes))), ())
