"""Where does each vertex and edge go?

The graphviz package writes the DOT source, which holds sizes and edges but no names and no values; an engine lays it
out, and the result is kept: a run with other values, or a graph with other names of the same lengths, is not laid out
again. pygraphviz has Graphviz inside its wheel; where it is missing, ``dot`` on the PATH serves.
"""

from __future__ import annotations

import functools
import json
import math
import shutil
import subprocess
import threading
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Final

from epypes.display.layout.blocks import fold, unfold
from epypes.display.layout.geometry import Box, Edge, Layout, Point
from epypes.errors import LayoutUnavailable

_POINTS_PER_INCH: Final = 72.0
_GAP_PX: Final = 14.0
# Graphviz puts a point into every row that an edge skips, and takes 0.1 s to place 500 of them, 20 s for 5,000.
_MOST_SKIPPED: Final = 500
_LEAST_BULGE_PX: Final = 20.0
_MOST_BULGE_PX: Final = 160.0
_TIP_PX: Final = 9.0
_DOT_TIMEOUT_S: Final = 30.0
# Graphviz keeps global state, so only one thread may be in it.
_engine_lock = threading.Lock()


@functools.lru_cache(maxsize=128)
def lay_out(boxes: tuple[Box, ...], edges: tuple[Edge, ...], is_dense: bool = False) -> Layout:
    """Place vertices and edges from top to bottom.

    Parameters
    ----------
    boxes, edges
        The vertices, and pairs of their indices.
    is_dense
        Whether the edges are too many to be followed. Then they are not routed, and the vertices stand in rows: a
        search for few crossings would take Graphviz minutes.

    Raises
    ------
    LayoutUnavailable
        No engine answered.
    """
    if is_dense:
        return _in_rows(boxes, edges)
    graph = fold(boxes, edges)
    unrouted = _long_edges(len(graph.boxes), graph.edges)
    routed = [edge for edge in graph.edges if edge not in unrouted]
    source = _dot_source(graph.boxes, routed, graph.blocks)
    layout = _read(json.loads(_run_engine(source)), len(graph.boxes), routed)
    arcs = {edge for edge in edges if graph.folded(edge) in unrouted}
    layout = unfold(layout, graph, [edge for edge in edges if edge not in arcs], routed)
    return _with_arcs(layout, boxes, edges, arcs) if arcs else layout


def _ranks(count: int, edges: Iterable[Edge]) -> list[int]:
    """Return the row of each vertex: the first one below all that lead to it."""
    rank = [0] * count
    # Functions come in run order, so going over their edges in that order settles each before it is used.
    for tail, head in edges:
        rank[head] = max(rank[head], rank[tail] + 1)
    return rank


def _long_edges(count: int, edges: Sequence[Edge]) -> set[Edge]:
    """Return edges that skip so many rows, taken together, that Graphviz would search minutes for their ways.

    Those of a hyperparameter that each function of a long chain takes: all but the one to the first of them.
    """
    rank = _ranks(count, edges)
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


def _in_rows(boxes: Sequence[Box], edges: Sequence[Edge]) -> Layout:
    """Place vertices in rows, each below all that lead to it, without any search."""
    rows: dict[int, list[int]] = {}
    for vertex, row in enumerate(_ranks(len(boxes), edges)):
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


def _dot_source(boxes: Sequence[Box], edges: Sequence[Edge], blocks: Collection[int]) -> str:
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
            shape=box.shape,
            width=f"{box.width / _POINTS_PER_INCH:.4f}",
            height=f"{box.height / _POINTS_PER_INCH:.4f}",
        )
    for tail, head in edges:
        # The edges of a block leave it where those of its members meet.
        dot.edge(f"v{tail}:s" if tail in blocks else f"v{tail}", f"v{head}")
    return str(dot.source)


def _run_engine(source: str) -> str:
    tried: list[str] = []
    for name, engine in (("pygraphviz", _pygraphviz), ("dot on the PATH", _dot_on_path)):
        try:
            return engine(source)
        except (ImportError, OSError, subprocess.SubprocessError) as error:
            tried.append(f"{name} ({error})")
    raise LayoutUnavailable(tried)


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


def _spline(position: str, height: float) -> tuple[Point, ...]:
    """Read Graphviz's ``e,TIP P0 P1 ... Pn`` as control points with the tip last."""
    tip: list[Point] = []
    points: list[Point] = []
    for part in position.split():
        words = part.split(",")
        into = tip if words[0] == "e" else points
        x, y = words[-2:]
        into.append((float(x), height - float(y)))
    return (*points, *(tip or points[-1:]))
