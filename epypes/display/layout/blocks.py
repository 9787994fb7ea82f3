"""Blocks: many sources, or sinks, of the same functions, which stand together.

A function with nine hyperparameters would have them all in one row, so wide that a page shrinks the picture until
nothing can be read. Sources that lead to exactly the same vertices stand in a block instead: a row whose edges meet
below it, or, if that is too wide, pairs of columns, each around a lane in which their edges run down together. Sinks
that come from exactly the same vertices stand in such a block turned upside down. For Graphviz a block is one vertex.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from epypes.display.layout.geometry import Box, Edge, Layout, Point

# The edges of so many can still be followed.
_MOST_APART: Final = 4
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


@dataclass(frozen=True, slots=True)
class Block:
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
    ways: tuple[tuple[Point, ...], ...]


@dataclass(frozen=True, slots=True)
class Folded:
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


def fold(boxes: Sequence[Box], edges: Sequence[Edge]) -> Folded:
    """Put sources, or sinks, of one shape and with exactly the same neighbours into blocks, if they are many."""
    turned = [(head, tail) for tail, head in edges]
    blocks = [_arranged(boxes, _rows(boxes, members)) for members in _alike(boxes, edges)]
    blocks += [_upside_down(boxes, _rows(boxes, members)) for members in _alike(boxes, turned)]
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


def unfold(layout: Layout, graph: Folded, edges: Sequence[Edge], routed: Sequence[Edge]) -> Layout:
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
    if not graph.blocks:
        return layout
    centres = [layout.centres[place] for place in graph.place]
    ways: dict[int, tuple[Point, ...]] = {}
    for number, block in graph.blocks.items():
        for member, offset, way in zip(block.members, block.offsets, block.ways, strict=True):
            x, y = layout.centres[number]
            centres[member] = (x + offset[0], y + offset[1])
            ways[member] = tuple((x + dx, y + dy) for dx, dy in way)
    found = dict(zip(routed, layout.splines, strict=True))
    splines = tuple(_joined(ways.get(edge[0], ()), found[graph.folded(edge)], ways.get(edge[1], ())) for edge in edges)
    return Layout(layout.width, layout.height, tuple(centres), splines)


def _joined(out: tuple[Point, ...], spline: tuple[Point, ...], into: tuple[Point, ...]) -> tuple[Point, ...]:
    """Let a spline begin with the way out of a block and end with that into one; they meet, but for rounding."""
    start = (*out, *spline[1:]) if out else spline
    return (*start[:-2], *into) if into else start


def _alike(boxes: Sequence[Box], edges: Sequence[Edge]) -> list[tuple[int, ...]]:
    """Return the sources that lead to the same vertices and have the same shape, where they are many.

    If all edges are turned, they are sinks.
    """
    heads: dict[int, set[int]] = {}
    for tail, head in edges:
        heads.setdefault(tail, set()).add(head)
    inner = {head for _, head in edges}
    groups: dict[tuple[str, frozenset[int]], list[int]] = {}
    for vertex in sorted(heads.keys() - inner):
        groups.setdefault((boxes[vertex].shape, frozenset(heads[vertex])), []).append(vertex)
    return [tuple(members) for members in groups.values() if len(members) > _MOST_APART]


def _rows(boxes: Sequence[Box], members: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return the rows of a block, as they are read; no more columns than so many rows need."""
    if sum(boxes[member].width + _COLUMN_GAP_PX for member in members) - _COLUMN_GAP_PX <= _ROW_PX:
        return [members]
    most = 2 * _pairs([boxes[member] for member in members])
    columns = -(-len(members) // -(-len(members) // most))
    return [members[start : start + columns] for start in range(0, len(members), columns)]


def _pairs(members: Sequence[Box]) -> int:
    """Return how many pairs of columns a block has, so that it looks the same whatever the shape of its members."""
    width = max(box.width for box in members) + (_LANE_PX + _COLUMN_GAP_PX) / 2
    height = max(box.height for box in members) + _ROW_GAP_PX
    columns = math.sqrt(len(members) * _ASPECT * height / width)
    return max(1, min(int(columns / 2), int(_MOST_BLOCK_PX / (2 * width)), -(-len(members) // 2)))


def _arranged(boxes: Sequence[Box], rows: Sequence[tuple[int, ...]], tip_px: float = 0.0) -> Block:
    """Arrange sources; or, from bottom to top, sinks, whose ways leave room for the tips of arrows."""
    return _columns(boxes, rows, tip_px) if len(rows) > 1 else _row(boxes, rows[0], tip_px)


def _upside_down(boxes: Sequence[Box], rows: Sequence[tuple[int, ...]]) -> Block:
    """Arrange sinks: their edges come from the middle of the block's top."""
    block = _arranged(boxes, rows[::-1], _TIP_PX)

    def over(points: Iterable[Point]) -> tuple[Point, ...]:
        return tuple((x, -y) for x, y in points)

    ways = tuple(over((*reversed(way), _tip(*way[:2]))) for way in block.ways)
    return Block(block.box, block.members, over(block.offsets), ways)


def _tip(end: Point, control: Point) -> Point:
    """Return the tip of an arrow that goes on where a way ends, from its last control point."""
    (x, y), (dx, dy) = end, (end[0] - control[0], end[1] - control[1])
    scale = _TIP_PX / math.hypot(dx, dy)
    return x + dx * scale, y + dy * scale


def _row(boxes: Sequence[Box], members: tuple[int, ...], tip_px: float) -> Block:
    """Arrange vertices in one row, on one line at the bottom, whose edges meet below it."""
    width = sum(boxes[member].width + _COLUMN_GAP_PX for member in members) - _COLUMN_GAP_PX
    bottom = (max(boxes[member].height for member in members) + tip_px + _FUNNEL_PX) / 2
    start, x = bottom - _FUNNEL_PX, -width / 2
    offsets: list[Point] = []
    ways: list[tuple[Point, ...]] = []
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
    height = sum(max(boxes[member].height for member in row) + _ROW_GAP_PX for row in rows)
    height += _MEETING_PX if len(lanes) > 1 else 0.0
    offsets: list[Point] = []
    ways: list[tuple[Point, ...]] = []
    middles: list[float] = []
    y = -height / 2
    for row in rows:
        tall = max(boxes[member].height for member in row)
        middles.append(y + tall / 2)
        y += tall + _ROW_GAP_PX
    for number, row in enumerate(rows):
        for place, member in enumerate(row):
            side, lane = 1 if place % 2 or place == count - 1 else -1, lanes[place // 2]
            out = lane + side * _LANE_PX / 2
            offsets.append((out + side * boxes[member].width / 2, middles[number]))
            ways.append(_way(out - side * tip_px, lane, middles[number:], height / 2))
    width = lanes[-1] - lanes[0] + 2 * column + _LANE_PX
    return Block(Box("box", width, height), members, tuple(offsets), tuple(ways))


def _lanes(columns: int, column_px: float) -> list[float]:
    """Return where the lanes between columns are, from the middle of them all."""
    pairs, pitch = columns // 2, 2 * column_px + _LANE_PX + _COLUMN_GAP_PX
    lanes = [pitch * (pair - (pairs - 1) / 2) for pair in range(pairs)]
    if columns % 2:
        step = column_px + _LANE_PX
        lanes = [lane - step / 2 for lane in (*lanes, lanes[-1] + step)]
    return lanes


def _way(side: float, lane: float, rows: Sequence[float], bottom: float) -> tuple[Point, ...]:
    """Return a way from the side of a vertex around a bend into its lane, down, and to the middle of the bottom.

    It runs down from row to row, so that ways which meet go on in the same curves, which are painted once.
    """
    way: list[Point] = [(side, rows[0]), ((side + lane) / 2, rows[0]), (lane, rows[0]), (lane, rows[0] + _BEND_PX)]
    stops = [row + _BEND_PX for row in rows[1:]] + [bottom - (_MEETING_PX if lane else 0.0)]
    for stop in stops:
        way += [way[-1], (lane, stop), (lane, stop)]
    if lane:
        middle = bottom - _MEETING_PX / 2
        way += [(lane, middle), (0.0, middle), (0.0, bottom)]
    return tuple(way)
