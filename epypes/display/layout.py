"""The place of each vertex and the way of each edge.

Graphviz places vertices and routes edges, but for what it would take minutes over or make unreadable: many sources or
sinks of the same functions (blocks), edges along a long chain (arcs), and graphs that are too dense or too large
(rows). Everything is laid out from top to bottom; a picture from left to right is one of boxes that lie on their sides,
seen from the other side of the diagonal. The result is kept: a run with other values, or a graph with other names of
the same lengths, is not laid out again.
"""

from __future__ import annotations

import functools
import json
import math
import shutil
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

from epypes.errors import LayoutUnavailable

Direction = Literal["down", "right"]
Shape = Literal["box", "ellipse", "hexagon"]
Point = tuple[float, float]
Edge = tuple[int, int]
Way = tuple[Point, ...]


class Box(NamedTuple):
    """A vertex to be placed: its shape and size, in pixels."""

    shape: Shape
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Layout:
    """A laid-out graph; all lengths in pixels, y downwards.

    Attributes
    ----------
    width, height
        Of the whole picture.
    centres
        By vertex.
    splines
        By edge: the control points of a cubic Bézier spline, then the tip of the arrow; none in a dense graph.
    """

    width: float
    height: float
    centres: tuple[Point, ...]
    splines: tuple[Way, ...]

    def __hash__(self) -> int:
        # Of a kept layout. To hash thousands of numbers takes longer than to paint them.
        return id(self)

    def moved(self, move: Callable[[Point], Point], width: float, height: float) -> Layout:
        """Return a layout of another size in which each point is moved."""
        splines = tuple(tuple(map(move, spline)) for spline in self.splines)
        return Layout(width, height, tuple(map(move, self.centres)), splines)


# What JupyterLab has for an output, in a window of 1440 pixels with its file browser open.
_PAGE_PX: Final = 1_000.0
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
        Edges that lead back, which set no vertex below another; their splines come last. None in rows.

    Raises
    ------
    LayoutUnavailable
        No engine answered.
    """
    if direction == "down":
        layout = _downwards(boxes, edges, back, is_dense)
        narrow = _downwards(boxes, edges, back, is_dense, is_narrow=True) if layout.width > _PAGE_PX else layout
        return narrow if narrow.width < layout.width else layout
    layout = _downwards(tuple(Box(box.shape, box.height, box.width) for box in boxes), edges, back, is_dense)
    return layout.moved(lambda point: point[::-1], layout.height, layout.width)


def _downwards(
    boxes: tuple[Box, ...], edges: tuple[Edge, ...], back: tuple[Edge, ...], is_dense: bool, *, is_narrow: bool = False
) -> Layout:
    graph = fold(boxes, edges, {end for edge in back for end in edge}, is_narrow=is_narrow)
    if is_dense or len(graph.boxes) > _MOST_VERTICES:
        return _in_rows(boxes, edges)
    small_back = [graph.folded(edge) for edge in back]
    unrouted = _long_edges(len(graph.boxes), graph.edges, small_back)
    routed = [edge for edge in graph.edges if edge not in unrouted]
    routed_back = [edge for edge in small_back if edge not in unrouted]
    layout = _in_order(routed_layout(graph.boxes, routed, graph.blocks, routed_back), graph.edges)
    routed += routed_back
    layout = _alike_in_order(layout, graph.boxes, [*graph.edges, *small_back], routed)
    arcs = {edge for edge in (*edges, *back) if graph.folded(edge) in unrouted}
    layout = _unfolded(layout, graph, [edge for edge in (*edges, *back) if edge not in arcs], routed)
    return _with_arcs(layout, boxes, (*edges, *back), arcs) if arcs else layout


# -- Graphviz ------------------------------------------------------------------------------------------------------

_POINTS_PER_INCH: Final = 72.0
_DOT_TIMEOUT_S: Final = 30.0
# How much straighter than a hyperparameter's edges those of the data are drawn. If all were alike, each hyperparameter
# beside a chain would push the rest of it aside, and a picture of 19 functions would be half as wide again.
_FLOW_WEIGHT: Final = "8"
# Graphviz keeps global state, so only one thread may be in it.
_engine_lock = threading.Lock()


def routed_layout(
    boxes: Sequence[Box], edges: Sequence[Edge], blocks: Collection[int] = (), back: Sequence[Edge] = ()
) -> Layout:
    """Return the layout of Graphviz, with a spline for every edge, those that lead back last.

    The graphviz package writes the DOT source, which holds sizes and edges but no names and no values. pygraphviz has
    Graphviz inside its wheel; where it is missing, ``dot`` on the PATH serves.

    Parameters
    ----------
    blocks
        The vertices that edges leave and enter in the middle. An edge into a block has no tip, since it goes on inside:
        its last control point stands there twice.

    Raises
    ------
    LayoutUnavailable
        No engine answered.
    """
    source, tried = _dot_source(boxes, edges, blocks, back), []
    for name, engine in (("pygraphviz", _pygraphviz), ("dot on the PATH", _dot_on_path)):
        try:
            return _read(json.loads(engine(source)), len(boxes), (*edges, *back))
        except Exception as error:  # an engine that is broken is as good as none
            tried.append(f"{name} ({type(error).__name__}: {error!s:.200})")
    raise LayoutUnavailable(tried)


def _dot_source(boxes: Sequence[Box], edges: Sequence[Edge], blocks: Collection[int], back: Sequence[Edge]) -> str:
    try:
        import graphviz
    except ImportError as error:
        raise LayoutUnavailable([f"graphviz ({error})"]) from error
    dot = graphviz.Digraph(
        graph_attr={"rankdir": "TB", "nodesep": "0.22", "ranksep": "0.28", "margin": "0"},
        # Labels are painted later: without them no font is looked for, and no layout depends on the machine's fonts.
        node_attr={"label": "", "fixedsize": "true"},
    )
    for index, box in enumerate(boxes):
        dot.node(
            f"v{index}",
            # Graphviz's hexagon has its tips left and right, but ours may lie; an ellipse is inside it either way, so
            # that no edge begins before it.
            shape="box" if box.shape == "box" else "ellipse",
            width=f"{box.width / _POINTS_PER_INCH:.4f}",
            height=f"{box.height / _POINTS_PER_INCH:.4f}",
        )
    for tail, head in edges:
        # The edges of a block leave or enter it where those of its members meet.
        ends = f"v{tail}:s" if tail in blocks else f"v{tail}", f"v{head}:n" if head in blocks else f"v{head}"
        weight = None if tail in blocks or boxes[tail].shape == "hexagon" else _FLOW_WEIGHT
        dot.edge(*ends, arrowhead="none" if head in blocks else None, weight=weight)
    for tail, head in back:
        dot.edge(f"v{tail}", f"v{head}", constraint="false")
    return str(dot.source)


def _pygraphviz(source: str) -> str:
    import pygraphviz

    with _engine_lock:
        drawn: bytes = pygraphviz.AGraph(string=source).draw(format="json0", prog="dot")
    return drawn.decode()


def _dot_on_path(source: str) -> str:
    dot = shutil.which("dot")
    if dot is None:
        raise FileNotFoundError("not found")
    done = subprocess.run(  # noqa: S603 - the program is Graphviz's, its input is numbers only
        [dot, "-Tjson0"],
        input=source,
        capture_output=True,
        check=True,
        timeout=_DOT_TIMEOUT_S,
        encoding="utf-8",
    )
    return done.stdout


def _read(drawn: dict[str, Any], vertices: int, edges: Sequence[Edge]) -> Layout:
    _, _, width, height = map(float, drawn["bb"].split(","))
    centres = [(0.0, 0.0)] * vertices
    number: dict[int, int] = {}
    for node in drawn.get("objects", ()):
        index = int(node["name"][1:])
        x, y = map(float, node["pos"].split(","))
        centres[index] = (x, height - y)
        number[node["_gvid"]] = index
    found = {
        (number[edge["tail"]], number[edge["head"]]): _spline(edge["pos"], height) for edge in drawn.get("edges", ())
    }
    return Layout(width, height, tuple(centres), tuple(found[edge] for edge in edges))


def _spline(position: str, height: float) -> Way:
    """Read Graphviz's ``e,TIP P0 P1 ... Pn`` as control points with the tip last."""
    tip: list[Point] = []
    points: list[Point] = []
    for part in position.split():
        words = part.split(",")
        into = tip if words[0] == "e" else points
        x, y = words[-2:]
        into.append((float(x), height - float(y)))
    return (*points, *(tip or points[-1:]))


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
    return layout.moved(lambda point: (layout.width - point[0], point[1]), layout.width, layout.height)


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
_ARC_TIP_PX: Final = 9.0


def _long_edges(count: int, edges: Sequence[Edge], back: Sequence[Edge]) -> set[Edge]:
    """Return edges that skip so many rows, taken together, that Graphviz would search minutes for their ways.

    Those of a hyperparameter that each function of a long chain takes: all but the one to the first of them.
    """
    rank = ranks(count, edges)
    first = dict.fromkeys(range(count), max(rank, default=0))
    for tail, head in edges:
        first[tail] = min(first[tail], rank[head] - 1)
    long = [(edge, rank[edge[1]] - 1 - first[edge[0]]) for edge in edges]
    long += [(edge, abs(rank[edge[1]] - rank[edge[0]])) for edge in back]
    skipped: dict[int, int] = dict.fromkeys(range(count), 0)
    for (tail, _), rows in long:
        skipped[tail] += rows
    total, worst = sum(skipped.values()), set()
    # All of a vertex or none, so that the eye takes them for one thing.
    for tail in sorted(skipped, key=lambda tail: -skipped[tail]):
        if total <= _MOST_SKIPPED:
            break
        total -= skipped[tail]
        worst.add(tail)
    return {edge for edge, rows in long if rows > 0 and edge[0] in worst}


def _with_arcs(layout: Layout, boxes: Sequence[Box], edges: Sequence[Edge], arcs: Collection[Edge]) -> Layout:
    """Add the edges that were not routed, as arcs from side to side; the picture becomes wider by them."""
    margin = max(_bulge(layout.centres[tail], layout.centres[head]) for tail, head in arcs)
    layout = layout.moved(lambda point: (point[0] + margin, point[1]), layout.width + 2 * margin, layout.height)
    routed = iter(layout.splines)
    splines = tuple(_arc(boxes, layout.centres, edge) if edge in arcs else next(routed) for edge in edges)
    return Layout(layout.width, layout.height, layout.centres, splines)


def _bulge(start: Point, end: Point) -> float:
    return min(_LEAST_BULGE_PX + 0.1 * math.dist(start, end), _MOST_BULGE_PX)


def _arc(boxes: Sequence[Box], centres: Sequence[Point], edge: Edge) -> Way:
    tail, head = edge
    side = -1 if centres[tail][0] <= centres[head][0] else 1
    (x0, y0), (x1, y1) = ((centres[end][0] + side * boxes[end].width / 2, centres[end][1]) for end in edge)
    out, end = side * _bulge(centres[tail], centres[head]), x1 + side * _ARC_TIP_PX
    return (x0, y0), (x0 + out, y0), (end + out, y1), (end, y1), (x1, y1)


# -- blocks --------------------------------------------------------------------------------------------------------
#
# A function with nine hyperparameters would have them all in one row, so wide that a page shrinks the picture until
# nothing can be read. Sources that lead to exactly the same vertices stand in a block instead: a row whose edges meet
# below it, or, if that is too wide, pairs of columns, each around a lane in which their edges run down together. Sinks
# that come from exactly the same vertices stand in such a block turned upside down. For Graphviz a block is one vertex.

# The edges of so many can still be followed.
_MOST_APART: Final = 4
# In a narrow picture so many stand one below the other: as high as a thumbnail and what is around it.
_MOST_STACKED: Final = 5
# What fits into this width stands in one row.
_ROW_PX: Final = 500.0
# Under a row, where its edges meet.
_FUNNEL_PX: Final = 30.0
# More would be wider than a page.
_MOST_BLOCK_PX: Final = 830.0
# How much wider a block is than high, if its members are not: they are read in rows.
_ASPECT: Final = 3.5
_LANE_PX: Final = 30.0
_ROW_GAP_PX: Final = 9.0
_COLUMN_GAP_PX: Final = 14.0
_BEND_PX: Final = 10.0
# Under the last row, where the lanes of a block meet.
_MEETING_PX: Final = 18.0
_TIP_PX: Final = 8.0


class Block(NamedTuple):
    """Sources, or sinks, that stand together.

    Attributes
    ----------
    box
        The whole block.
    members
        The vertices.
    offsets
        By member, from the block's centre to its own.
    ways
        By member, from the block's centre: the control points of a spline from a source to the middle of the block's
        bottom; or of one from the middle of its top to a sink, and the tip of the arrow.
    """

    box: Box
    members: tuple[int, ...]
    offsets: tuple[Point, ...]
    ways: tuple[Way, ...]


class Folded(NamedTuple):
    """A graph in which each block is one vertex; they come after the others.

    Attributes
    ----------
    boxes, edges
        The vertices that are left, and their edges, each once.
    blocks
        By their vertices.
    place
        By vertex of the whole graph, that of this one.
    """

    boxes: tuple[Box, ...]
    edges: tuple[Edge, ...]
    blocks: Mapping[int, Block]
    place: tuple[int, ...]

    def folded(self, edge: Edge) -> Edge:
        """Return the edge of this graph that stands for an edge of the whole one."""
        return self.place[edge[0]], self.place[edge[1]]


def fold(
    boxes: Sequence[Box], edges: Sequence[Edge], apart: Collection[int] = (), *, is_narrow: bool = False
) -> Folded:
    """Put sources, or sinks, of one shape and with exactly the same neighbours into blocks, if they are many.

    Those that stand ``apart`` are in none. In a narrow picture two sources are many, and a few are a stack.
    """
    turned = [(head, tail) for tail, head in edges]
    blocks = [
        _arranged(boxes, [*zip(members)] if is_narrow and len(members) <= _MOST_STACKED else _rows(boxes, members))
        for members in _alike(boxes, edges, apart, 1 if is_narrow else _MOST_APART)
    ]
    blocks += [_upside_down(boxes, _rows(boxes, members)) for members in _alike(boxes, turned, apart, _MOST_APART)]
    hidden = {member for block in blocks for member in block.members}
    left = [vertex for vertex in range(len(boxes)) if vertex not in hidden]
    place = {vertex: index for index, vertex in enumerate(left)}
    numbered = dict(enumerate(blocks, start=len(left)))
    place |= {member: number for number, block in numbered.items() for member in block.members}
    small = dict.fromkeys((place[tail], place[head]) for tail, head in edges)
    return Folded(
        (*(boxes[vertex] for vertex in left), *(block.box for block in blocks)),
        tuple(small),
        numbered,
        tuple(place[vertex] for vertex in range(len(boxes))),
    )


def _unfolded(layout: Layout, graph: Folded, edges: Sequence[Edge], routed: Sequence[Edge]) -> Layout:
    """Return the layout of the whole graph.

    Parameters
    ----------
    layout
        Of the folded graph, with splines of the edges that are routed.
    edges
        Those of the whole graph that get a spline.
    routed
        The edges of the folded graph in the order of the layout's splines.
    """
    centres = [layout.centres[place] for place in graph.place]
    ways: dict[int, Way] = {}
    for number, block in graph.blocks.items():
        for member, offset, way in zip(block.members, block.offsets, block.ways, strict=True):
            x, y = layout.centres[number]
            centres[member] = (x + offset[0], y + offset[1])
            ways[member] = tuple((x + dx, y + dy) for dx, dy in way)
    found = dict(zip(routed, layout.splines, strict=True))
    splines = []
    for tail, head in edges:
        spline = found[graph.folded((tail, head))]
        # It begins with the way out of a block and ends with that into one; they meet, but for rounding.
        spline = (*ways[tail], *spline[1:]) if tail in ways else spline
        splines.append((*spline[:-2], *ways[head]) if head in ways else spline)
    return Layout(layout.width, layout.height, tuple(centres), tuple(splines))


def _alike(boxes: Sequence[Box], edges: Sequence[Edge], apart: Collection[int], few: int) -> list[tuple[int, ...]]:
    """Return the sources that lead to the same vertices and have the same shape, where they are more than few.

    If all edges are turned, they are sinks.
    """
    heads: dict[int, set[int]] = {}
    for tail, head in edges:
        heads.setdefault(tail, set()).add(head)
    groups: dict[tuple[str, frozenset[int]], list[int]] = {}
    for vertex in sorted(heads.keys() - {head for _, head in edges} - set(apart)):
        groups.setdefault((boxes[vertex].shape, frozenset(heads[vertex])), []).append(vertex)
    return [tuple(members) for members in groups.values() if len(members) > few]


def _rows(boxes: Sequence[Box], members: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return the rows of a block, as they are read; no more columns than so many rows need."""
    if sum(boxes[member].width + _COLUMN_GAP_PX for member in members) - _COLUMN_GAP_PX <= _ROW_PX:
        return [members]
    width = max(boxes[member].width for member in members) + (_LANE_PX + _COLUMN_GAP_PX) / 2
    height = max(boxes[member].height for member in members) + _ROW_GAP_PX
    # So many pairs of columns that a block looks the same whatever the shape of its members.
    pairs = int(math.sqrt(len(members) * _ASPECT * height / width) / 2)
    most = 2 * max(1, min(pairs, int(_MOST_BLOCK_PX / (2 * width)), -(-len(members) // 2)))
    columns = -(-len(members) // -(-len(members) // most))
    return [members[start : start + columns] for start in range(0, len(members), columns)]


def _arranged(boxes: Sequence[Box], rows: Sequence[tuple[int, ...]], tip_px: float = 0.0) -> Block:
    """Arrange sources; or, from bottom to top, sinks, whose ways leave room for the tips of arrows."""
    return _columns(boxes, rows, tip_px) if len(rows) > 1 else _row(boxes, rows[0], tip_px)


def _upside_down(boxes: Sequence[Box], rows: Sequence[tuple[int, ...]]) -> Block:
    """Arrange sinks: their edges come from the middle of the block's top."""
    block = _arranged(boxes, rows[::-1], _TIP_PX)
    ways = []
    for way in block.ways:
        # The tip of the arrow goes on where the way ends, from its last control point.
        (x, y), (dx, dy) = way[0], (way[0][0] - way[1][0], way[0][1] - way[1][1])
        scale = _TIP_PX / math.hypot(dx, dy)
        ways.append(tuple((x, -y) for x, y in (*reversed(way), (x + dx * scale, y + dy * scale))))
    return Block(block.box, block.members, tuple((x, -y) for x, y in block.offsets), tuple(ways))


def _row(boxes: Sequence[Box], members: tuple[int, ...], tip_px: float) -> Block:
    """Arrange vertices in one row, on one line at the bottom, whose edges meet below it."""
    width = sum(boxes[member].width + _COLUMN_GAP_PX for member in members) - _COLUMN_GAP_PX
    bottom = (max(boxes[member].height for member in members) + tip_px + _FUNNEL_PX) / 2
    start, x = bottom - _FUNNEL_PX, -width / 2
    offsets: list[Point] = []
    ways: list[Way] = []
    for member in members:
        x += boxes[member].width / 2
        offsets.append((x, start - tip_px - boxes[member].height / 2))
        ways.append(((x, start), (x, bottom - _FUNNEL_PX / 4), (0.0, start + _FUNNEL_PX / 4), (0.0, bottom)))
        x += boxes[member].width / 2 + _COLUMN_GAP_PX
    return Block(Box("box", width, 2 * bottom), members, tuple(offsets), tuple(ways))


def _columns(boxes: Sequence[Box], rows: Sequence[tuple[int, ...]], tip_px: float) -> Block:
    """Arrange vertices in pairs of columns; one that is left over stands to the right of its lane."""
    members = tuple(member for row in rows for member in row)
    column, count = max(boxes[member].width for member in members), max(map(len, rows))
    lanes = _lanes(count, column)
    heights = [max(boxes[member].height for member in row) for row in rows]
    height = sum(heights) + _ROW_GAP_PX * len(rows) + (_MEETING_PX if any(lanes) else 0.0)
    offsets: list[Point] = []
    ways: list[Way] = []
    middles: list[float] = []
    y = -height / 2
    for tall in heights:
        middles.append(y + tall / 2)
        y += tall + _ROW_GAP_PX
    for number, row in enumerate(rows):
        for place, member in enumerate(row):
            side, lane = 1 if place % 2 or place == count - 1 else -1, lanes[place // 2]
            out = lane + side * _LANE_PX / 2
            offsets.append((out + side * boxes[member].width / 2, middles[number]))
            ways.append(_way(out - side * tip_px, lane, middles[number:], height / 2))
    width = lanes[-1] - lanes[0] + min(count, 2) * column + _LANE_PX
    return Block(Box("box", width, height), members, tuple(offsets), tuple(ways))


def _lanes(columns: int, column_px: float) -> list[float]:
    """Return where the lanes between columns are, from the middle of them all."""
    if columns == 1:
        return [-column_px / 2]
    pairs, pitch = columns // 2, 2 * column_px + _LANE_PX + _COLUMN_GAP_PX
    lanes = [pitch * (pair - (pairs - 1) / 2) for pair in range(pairs)]
    if columns % 2:
        step = column_px + _LANE_PX
        lanes = [lane - step / 2 for lane in (*lanes, lanes[-1] + step)]
    return lanes


def _way(side: float, lane: float, rows: Sequence[float], bottom: float) -> Way:
    """Return a way from the side of a vertex around a bend into its lane, down, and to the middle of the bottom.

    It runs down from row to row, so that ways which meet go on in the same curves, which are painted once.
    """
    way: list[Point] = [(side, rows[0]), ((side + lane) / 2, rows[0]), (lane, rows[0]), (lane, rows[0] + _BEND_PX)]
    for stop in (*(row + _BEND_PX for row in rows[1:]), bottom - (_MEETING_PX if lane else 0.0)):
        way += [way[-1], (lane, stop), (lane, stop)]
    if lane:
        middle = bottom - _MEETING_PX / 2
        way += [(lane, middle), (0.0, middle), (0.0, bottom)]
    return tuple(way)
