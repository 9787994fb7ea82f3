"""How are the edges of a graph painted as SVG?"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from epypes.display.layout.geometry import Layout, Point
from epypes.display.views.graphview import EdgeView


def paint_edges(edges: Sequence[EdgeView], ends: Sequence[tuple[int, int]], layout: Layout) -> Iterator[str]:
    """Paint the edges, those that no run uses first and dashed.

    All of one kind are one path: a graph has many.

    Parameters
    ----------
    edges
        What is to be seen of them.
    ends
        By edge, the indices of the vertices that it joins.
    layout
        Without splines in a dense graph.
    """
    for is_live, kind in ((False, " off"), (True, "")):
        places = [place for place, edge in enumerate(edges) if edge.is_live == is_live]
        if places and layout.splines:
            yield _paint_splines([layout.splines[place] for place in places], kind)
        elif places:
            yield _paint_lines([ends[place] for place in places], layout, kind)


def _paint_splines(splines: Iterable[tuple[Point, ...]], kind: str) -> str:
    """Paint edges as one path of curves and one of their tips."""
    painted: set[str] = set()
    curves: list[str] = []
    tips: dict[str, None] = {}
    for *spline, tip in splines:
        curves += _curves(spline, painted)
        tips[f"M{_arrow(spline[-1], tip)}Z"] = None
    return f'<path class="edge{kind}" d="{"".join(curves)}"/><path class="tip{kind}" d="{"".join(tips)}"/>'


def _curves(spline: Sequence[Point], painted: set[str]) -> Iterator[str]:
    """Give the curves of a spline but for those that are painted already: dashes over dashes would be a line."""
    at = ""
    for first in range(0, len(spline) - 1, 3):
        start, *controls = (f"{x:.1f},{y:.1f}" for x, y in spline[first : first + 4])
        curve = " ".join(controls)
        if f"{start} {curve}" in painted:
            continue
        painted.add(f"{start} {curve}")
        yield f" {curve}" if start == at else f"M{start}C{curve}"
        at = controls[-1]


def _paint_lines(ends: Iterable[tuple[int, int]], layout: Layout, kind: str) -> str:
    """Paint edges as one path of straight lines between centres, under the vertices."""
    at = layout.centres
    lines = (f"M{at[a][0]:.0f},{at[a][1]:.0f}L{at[b][0]:.0f},{at[b][1]:.0f}" for a, b in ends)
    return f'<path class="edge dense{kind}" d="{"".join(lines)}"/>'


def _arrow(end: Point, tip: Point) -> str:
    """Return a triangle from the end of a spline to its tip."""
    dx, dy = tip[0] - end[0], tip[1] - end[1]
    length = math.hypot(dx, dy) or 1.0
    across = (-dy / length * 3.5, dx / length * 3.5)
    corners = (tip, (end[0] + across[0], end[1] + across[1]), (end[0] - across[0], end[1] - across[1]))
    return "L".join(f"{x:.1f},{y:.1f}" for x, y in corners)
