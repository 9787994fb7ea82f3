"""Layouts by Graphviz.

The graphviz package writes the DOT source, which holds sizes and edges but no names and no values. pygraphviz has
Graphviz inside its wheel; where it is missing, ``dot`` on the PATH serves.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Collection, Sequence
from typing import Any, Final

from epypes.display.layout.geometry import Box, Edge, Layout, Point
from epypes.errors import LayoutUnavailable

_POINTS_PER_INCH: Final = 72.0
_DOT_TIMEOUT_S: Final = 30.0
# Graphviz keeps global state, so only one thread may be in it.
_engine_lock = threading.Lock()


def routed_layout(boxes: Sequence[Box], edges: Sequence[Edge], blocks: Collection[int]) -> Layout:
    """Return the layout with a spline for every edge; edges leave and enter ``blocks`` in the middle.

    An edge into a block has no tip, since it goes on inside: its last control point stands there twice.

    Raises
    ------
    LayoutUnavailable
        No engine answered.
    """
    source, tried = _dot_source(boxes, edges, blocks), []
    for name, engine in (("pygraphviz", _pygraphviz), ("dot on the PATH", _dot_on_path)):
        try:
            return _read(json.loads(engine(source)), len(boxes), edges)
        except Exception as error:  # an engine that is broken is as good as none
            tried.append(f"{name} ({type(error).__name__}: {error!s:.200})")
    raise LayoutUnavailable(tried)


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
            # Graphviz's hexagon has its tips left and right, but ours may lie; an ellipse is inside it either way, so
            # that no edge begins before it.
            shape="box" if box.shape == "box" else "ellipse",
            width=f"{box.width / _POINTS_PER_INCH:.4f}",
            height=f"{box.height / _POINTS_PER_INCH:.4f}",
        )
    for tail, head in edges:
        # The edges of a block leave or enter it where those of its members meet.
        ends = f"v{tail}:s" if tail in blocks else f"v{tail}", f"v{head}:n" if head in blocks else f"v{head}"
        dot.edge(*ends, arrowhead="none" if head in blocks else None)
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
