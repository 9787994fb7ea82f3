"""A graph as SVG.

Graphviz gives the geometry only; every mark is painted here, so that names, values, thumbnails and states change
without a new layout, and colours follow the page's theme.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from statistics import fmean
from typing import Final

from epypes.display.layout import FRAME_PX, Box, Edge, Layout, Point, lay_out
from epypes.display.paint.style import STYLE
from epypes.display.paint.vertices import (
    LINE_PX,
    Bounds,
    function_box,
    paint_function,
    paint_stage,
    paint_token,
    stage_size,
    text_width,
    token_box,
)
from epypes.display.text import content, escape, fitted, short_name
from epypes.display.views.graphview import EdgeView, FrameView, GraphView, StageView
from epypes.display.views.groups import function_count
from epypes.wording import counted

_OFF: Final = " off"
# Here, not in the style, which every picture has.
_BACK: Final = ' back" stroke-dasharray="6 3'


@lru_cache(maxsize=128)
def paint_edges(edges: tuple[EdgeView, ...], ends: tuple[Edge, ...], layout: Layout) -> str:
    """Paint the edges, those that no run uses first and dashed, those to the next run last.

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
    painted = []
    for is_live, kind in ((False, _OFF), (True, "")):
        places = [place for place, edge in enumerate(edges) if edge.is_live == is_live]
        if places and layout.splines:
            painted.append(_paint_splines([layout.splines[place] for place in places], kind))
        elif places:
            painted.append(_paint_lines([ends[place] for place in places], layout, kind))
    if len(layout.splines) > len(edges):
        painted.append(_paint_splines(layout.splines[len(edges) :], _BACK))
    return "\n".join(painted)


def _paint_splines(splines: Iterable[tuple[Point, ...]], kind: str) -> str:
    """Paint edges as one path of curves and one of their tips; each edge is a piece of both that begins with M."""
    curves, tips = [], []
    for *spline, tip in splines:
        # What edges share looks like one line where each is painted whole.
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
        are_straight = all(len(each) == 4 and each[0] == each[1] and each[2] == each[3] for each in (way[-4:], curve))
        if are_straight and any(len(set(along)) == 1 for along in zip(way[-4], *curve[::3], strict=True)):
            way[-2:] = curve[2:]
        else:
            way += curve[1:]
    return way


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
    """Return curves as part of a path; where one starts at the end of the last one, that is not repeated."""
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


# -- around the graph ----------------------------------------------------------------------------------------------
#
# A pipeline has a frame with its name, and the stages that events pass. The graph stays where the layout has put it,
# with its corner at (0, 0); what is around it has negative coordinates too.

_PADDING_PX: Final = 16.0
_TITLE_PX: Final = 22.0
_TITLE_ROOM: Final = 600
# Between stages, and between them and the frame.
_GAP_PX: Final = 26.0
_TIP_PX: Final = 8.0


def _paint_around(graph: GraphView, layout: Layout) -> tuple[list[str], Bounds]:
    """Paint what is around a graph, if there is anything.

    Returns
    -------
    tuple
        The elements, and what they and the graph cover.
    """
    inside = Bounds(0.0, 0.0, layout.width, layout.height)
    if not (graph.title or graph.before or graph.after):
        return [], inside
    title_px, is_turned = text_width(short_name(graph.title)), graph.direction == "right"
    more = max(title_px + 2 * _GAP_PX - inside.right, 0.0) / 2 + _PADDING_PX
    frame = Bounds(-more, -_PADDING_PX - _TITLE_PX / 2, inside.right + more, inside.bottom + _PADDING_PX)
    left, top = frame.left + _PADDING_PX, frame.top - _TITLE_PX / 2
    label = Bounds(left, top, left + title_px, top + _TITLE_PX)
    parts, covered = _paint_frame(graph.title, frame, label), frame.holding(label)
    payload = [place for place, token in enumerate(graph.tokens) if token.role == "payload"]
    for stages, is_before in ((graph.before, True), (graph.after, False)):
        if stages:
            # Those at the free source tokens, or at the sink tokens.
            inner = {edge.token for edge in graph.edges if edge.is_input != is_before}
            centres = [layout.centres[len(graph.functions) + place] for place in payload if place not in inner]
            # An arrow from above must not hit the title.
            free_from = label.right if is_before and not is_turned else None
            painted, taken = _paint_stages(stages, frame, centres, free_from, is_before, is_turned)
            parts += painted
            covered = covered.holding(taken)
    return parts, covered


def _members(frame: FrameView, places: Mapping[str, int]) -> tuple[int, ...]:
    names = (*(f"function {name}" for name in frame.function_names), *(f"token {name}" for name in frame.token_names))
    return tuple(places[name] for name in names if name in places)


def _paint_inside(title: str, boxes: Sequence[Box], layout: Layout, members: Sequence[int]) -> tuple[list[str], Bounds]:
    """Paint the frame around what is inside a pipeline; return what it covers, too."""
    sizes = [(*layout.centres[at], boxes[at].width / 2 + _TITLE_PX / 2, boxes[at].height / 2) for at in members]
    frame = Bounds(
        min(x - across for x, _, across, _ in sizes),
        min(y - down for _, y, _, down in sizes) - FRAME_PX + _TITLE_PX / 2,
        max(x + across for x, _, across, _ in sizes),
        max(y + down for _, y, _, down in sizes) + _TITLE_PX / 2,
    )
    left, top = frame.left + _PADDING_PX, frame.top - _TITLE_PX / 2
    label = Bounds(left, top, left + text_width(short_name(title)), top + _TITLE_PX)
    frame = frame.holding(Bounds(frame.left, frame.top, label.right + _PADDING_PX, frame.bottom))
    return _paint_frame(title, frame, label), frame.holding(label)


def _paint_frame(title: str, frame: Bounds, label: Bounds) -> list[str]:
    """Paint the frame, and the title on a label that lies on its upper border."""
    size = f'width="{frame.right - frame.left:.1f}" height="{frame.bottom - frame.top:.1f}"'
    parts = [f'<rect class="frame" x="{frame.left:.1f}" y="{frame.top:.1f}" {size} rx="8"/>']
    if title:
        width = label.right - label.left
        parts.append(
            f'<g class="label"><title>{content(fitted(f"pipeline {title}", _TITLE_ROOM))}</title>'
            f'<rect class="shape" x="{label.left:.1f}" y="{label.top:.1f}" width="{width:.1f}" '
            f'height="{_TITLE_PX:.0f}" rx="5"/>'
            f'<text class="name" x="{label.left + width / 2:.1f}" y="{frame.top + LINE_PX / 4:.1f}">'
            f"{content(short_name(title))}</text></g>"
        )
    return parts


def _paint_stages(
    stages: Sequence[StageView],
    frame: Bounds,
    tokens: Sequence[Point],
    free_from: float | None,
    is_before: bool,
    is_turned: bool,
) -> tuple[list[str], Bounds]:
    """Paint arrows and stages, side by side across the direction of flow; return what they cover, too.

    Everything is computed for a flow from top to bottom, and turned for one from left to right.
    """
    frame = frame.turned() if is_turned else frame
    sizes = [stage_size(stage)[:: -1 if is_turned else 1] for stage in stages]
    widths, depth = [width for width, _ in sizes], max(depth for _, depth in sizes)
    above = frame.top - _GAP_PX - depth - (0.0 if is_turned else _TITLE_PX / 2)
    top = above if is_before else frame.bottom + _GAP_PX
    bottom = top + depth
    # The stage beside the frame is over the tokens, or moved so that all are over the frame.
    nearest, length = -1 if is_before else 0, sum(widths) + _GAP_PX * (len(widths) - 1)
    half, least, most = widths[nearest] / 2, (free_from or frame.left) + _PADDING_PX, frame.right - _PADDING_PX
    leftmost, rightmost = frame.left + length - half, frame.right - length + half
    if is_before and leftmost <= most:
        least = max(least, leftmost)
    elif not is_before and rightmost >= least:
        most = min(most, rightmost)
    x = fmean(point[is_turned] for point in tokens) if tokens else (frame.left + frame.right) / 2
    x = min(max(x, least), most)
    lefts = [x + half - length if is_before else x - half]
    for width in widths[:-1]:
        lefts.append(lefts[-1] + width + _GAP_PX)
    arrows = [((left - _GAP_PX, (top + bottom) / 2), (left, (top + bottom) / 2)) for left in lefts[1:]]
    start, end = (bottom, frame.top) if is_before else (frame.bottom, top)
    arrows.append(((x, start), (x, end)))
    parts, covered = [_paint_arrows(arrows, is_turned)], Bounds(lefts[0], top, lefts[-1] + widths[-1], bottom)
    for stage, left, width in zip(stages, lefts, widths, strict=True):
        box = Bounds(left, top, left + width, bottom)
        parts.append(paint_stage(stage, box.turned() if is_turned else box))
    return parts, covered.turned() if is_turned else covered


def _paint_arrows(arrows: Sequence[tuple[Point, Point]], is_turned: bool) -> str:
    lines, tips = "", ""
    for start, end in arrows:
        (x0, y0), (x1, y1) = (start[::-1], end[::-1]) if is_turned else (start, end)
        lines += f"M{x0:.1f},{y0:.1f}L{x1:.1f},{y1:.1f}"
        tips += f"M{x1:.1f},{y1:.1f}" + (f"l-{_TIP_PX:.0f},-3.5v7z" if x0 != x1 else f"l-3.5,-{_TIP_PX:.0f}h7z")
    return f'<path class="edge around" d="{lines}"/><path class="tip around" d="{tips}"/>'


# -- the whole -----------------------------------------------------------------------------------------------------

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
    functions, direction = len(graph.functions), graph.direction
    function_boxes = [function_box(function, direction) for function in graph.functions]
    boxes = (*function_boxes, *map(token_box, graph.tokens))
    ends = tuple([
        (functions + token, function) if is_input else (function, functions + token)
        for function, token, is_input, _ in graph.edges
    ])  # fmt: skip
    place = {token.name: functions + index for index, token in enumerate(graph.tokens)}
    back = tuple((place[token], place[to]) for token, to in graph.delays if token in place and to in place)
    places = {f"function {each.name}": index for index, each in enumerate(graph.functions)}
    places |= {f"token {name}": at for name, at in place.items()}
    frames = tuple(filter(None, (_members(frame, places) for frame in graph.frames)))
    layout = lay_out(boxes, ends, len(ends) > max(_MANY_EDGES, _DENSE * len(boxes)), direction, back, frames)
    around, bounds = _paint_around(graph, layout)
    for frame, members in zip(graph.frames, frames, strict=False):
        painted, taken = _paint_inside(frame.name, boxes, layout, members)
        around, bounds = around + painted, bounds.holding(taken)
    width, height = bounds.right - bounds.left + 2 * _MARGIN, bounds.bottom - bounds.top + 2 * _MARGIN
    size = f"{width:.0f}", f"{height:.0f}"
    box = f"{bounds.left - _MARGIN:.4g} {bounds.top - _MARGIN:.4g} {size[0]} {size[1]}"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="epypes-graph" role="figure" '
        f'aria-label="{escape(alt_text(graph))}" width="{size[0]}" height="{size[1]}" viewBox="{box}" '
        f'style="min-width:{_LEAST_SCALE * width:.0f}px">'
    )
    parts = [head, f"<style>{STYLE}</style>", *around]
    if graph.draws_edges and ends:
        parts.append(paint_edges(graph.edges, ends, layout))
    centres = layout.centres
    parts += [
        paint_function(function, *placed, direction)
        for function, placed in zip(graph.functions, zip(boxes, centres, strict=True), strict=False)
    ]
    parts += map(paint_token, graph.tokens, boxes[functions:], centres[functions:])
    return "\n".join([*parts, "</svg>"])


def least_width(svg: str) -> str:
    """Return the width in pixels that a painted graph asks for at least; 0 if it does not ask."""
    found = _LEAST_WIDTH.search(svg)
    return found[1] if found else "0"


def alt_text(graph: GraphView) -> str:
    """Return the graph in one sentence, for screen readers."""
    order = ", ".join(map(short_name, [function.name for function in graph.functions[:12]]))
    more = ", ..." if len(graph.functions) > 12 else ""
    functions = counted(function_count(graph), "function")
    text = f"Computational graph of {functions}: {order}{more}. {fitted(graph.caption, _CAPTION_ROOM)}".strip()
    if not graph.title:
        return text
    stages = [short_name(stage.name) for stage in graph.before] + ["the graph"] * bool(graph.before or graph.after)
    stages += [short_name(stage.name) for stage in graph.after]
    through = f", events go through {', '.join(stages)}" if stages else ""
    return f"Pipeline {short_name(graph.title)}{through}. {text}"
