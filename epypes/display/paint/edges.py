"""How are the edges of a graph painted as SVG?"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from epypes.display.layout.geometry import Layout, Point
from epypes.display.views.graphview import EdgeView

_OFF: Final = " off"


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
    for is_live, kind in ((False, _OFF), (True, "")):
        places = [place for place, edge in enumerate(edges) if edge.is_live == is_live]
        if places and layout.splines:
            yield _paint_splines([layout.splines[place] for place in places], kind)
        elif places:
            yield _paint_lines([ends[place] for place in places], layout, kind)


def _paint_splines(splines: Iterable[tuple[Point, ...]], kind: str) -> str:
    """Paint edges as one path of curves and one of their tips; each edge is a piece of both that begins with M."""
    curves, tips = [], []
    for *spline, tip in splines:
        # What edges share is not told apart where each is painted whole.
        curves.append(_curves(spline if kind == _OFF else _without_stops(spline)))
        tips.append(f"M{_arrow(spline[-1], tip)}Z")
    if kind == _OFF:
        # Dashes over dashes would be a line.
        curves, tips = _each_once(curves), list(dict.fromkeys(tips))
    return f'<path class="edge{kind}" d="{"".join(map(_path, curves))}"/><path class="tip{kind}" d="{"".join(tips)}"/>'


def _without_stops(spline: Sequence[Point]) -> list[Point]:
    """Let one curve run where several would run straight on: an edge passes many others on its way out of a block."""
    way = list(spline[:1])
    for first in range(0, len(spline) - 1, 3):
        curve = spline[first : first + 4]
        if _is_straight(way[-4:]) and _is_straight(curve) and _are_in_line(way[-4], *curve[::3]):
            way[-2:] = curve[2:]
        else:
            way += curve[1:]
    return way


def _is_straight(curve: Sequence[Point]) -> bool:
    return len(curve) == 4 and curve[0] == curve[1] and curve[2] == curve[3]


def _are_in_line(*points: Point) -> bool:
    return any(len(set(along)) == 1 for along in zip(*points, strict=True))


def _curves(spline: Sequence[Point]) -> list[tuple[str, str]]:
    """Return the curves of a spline: where each starts, and its controls."""
    at = [f"{x:.0f},{y:.0f}" for x, y in spline]
    return [(at[first], " ".join(at[first + 1 : first + 4])) for first in range(0, len(at) - 1, 3)]


def _each_once(splines: Iterable[list[tuple[str, str]]]) -> list[list[tuple[str, str]]]:
    painted: set[tuple[str, str]] = set()
    kept: list[list[tuple[str, str]]] = []
    for curves in splines:
        kept.append([curve for curve in curves if curve not in painted])
        painted.update(curves)
    return kept


def _path(curves: list[tuple[str, str]]) -> str:
    """Return curves as part of a path; where one starts at the end of the last one, that is not said again."""
    path, at = "", ""
    for start, controls in curves:
        path += f" {controls}" if start == at else f"M{start}C{controls}"
        at = controls.rpartition(" ")[2]
    return path


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
