"""How is a GraphView painted as SVG?

Graphviz gives the geometry only; every mark is painted here, so that names, values, thumbnails and states change
without a new layout, and colours follow the page's theme.
"""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Iterable
from typing import Final

from epypes.display.edges import paint_edges
from epypes.display.geometry import Box, Layout, Point
from epypes.display.graphview import FunctionView, GraphView, TokenView
from epypes.display.layout import lay_out
from epypes.display.markup import cut, cut_name, escape
from epypes.display.view import duration_text

_LINE_PX: Final = 16
_CHARACTER_PX: Final = 6.9
# detect_and_describe_features_1, of the paper's figure 13, is to fit.
_NAME_CHARACTERS: Final = 32
_MESSAGE_CHARACTERS: Final = 48
_ID_CHARACTERS: Final = 40
# Beyond this many edges, and this many for each vertex, curves and arrows can't be followed by the eye, would take
# Graphviz minutes and would fill the picture.
_MANY_EDGES: Final = 150
_DENSE: Final = 1.6
_THUMB_WIDTH: Final = 128
_THUMB_HEIGHT: Final = 96
_MARGIN: Final = 6
# A switch is drawn like a multiplexer, narrower at its output, by this much on each side.
_SLOPE_PX: Final = 14
# Between the two borders of a pipeline.
_INSIDE_PX: Final = 4

# The fallbacks serve where the page has no Jupyter theme: dark text on light vertices, grey edges, readable on white
# and on black paper alike.
STYLE: Final = """
.epypes-graph{max-width:100%;height:auto;font:12px var(--jp-ui-font-family,system-ui,sans-serif)}
.epypes-graph text{fill:var(--jp-ui-font-color1,#1f2328);text-anchor:middle;stroke:none}
.epypes-graph .small{font-size:10px}
.epypes-graph .name{font-weight:600}
.epypes-graph .shape{fill:var(--jp-layout-color1,#fff);stroke:#80868f}
.epypes-graph .function .shape{fill:var(--jp-layout-color2,#e9eef6);stroke-width:1.4}
.epypes-graph .function .shape{stroke:var(--jp-brand-color1,#1976d2)}
.epypes-graph .hyperparameter .shape{fill:var(--jp-layout-color3,#dcdfe4)}
.epypes-graph .bar{fill:var(--jp-brand-color1,#1976d2)}
.epypes-graph .planned .shape{stroke-width:3}
.epypes-graph .redefined .shape{stroke:var(--jp-warn-color1,#e65100);stroke-width:3}
.epypes-graph .missing .shape{stroke:var(--jp-error-color1,#d32f2f);stroke-width:2}
.epypes-graph .left-out .shape{stroke-dasharray:2 3}
.epypes-graph .left-out{opacity:.6}
.epypes-graph .failed .shape{stroke:var(--jp-error-color1,#d32f2f);stroke-width:3}
.epypes-graph .stale .shape,.epypes-graph .not-computed .shape,.epypes-graph .not-run .shape{stroke-dasharray:2 3}
.epypes-graph .placeholder .shape{stroke-dasharray:7 4}
.epypes-graph .stale image{opacity:.35}
.epypes-graph .function .inner{fill:none;stroke-width:1}
.epypes-graph .edge{fill:none;stroke:#80868f}
.epypes-graph .dense{stroke-width:.5}
.epypes-graph .tip{fill:#80868f}
.epypes-graph .off{opacity:.6}
.epypes-graph .edge.off{stroke-dasharray:4 4}
""".replace("\n", "")


def paint_svg(graph: GraphView) -> str:
    """Paint a graph; the same view gives the same text.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    functions = len(graph.functions)
    boxes = (*map(_function_box, graph.functions), *map(_token_box, graph.tokens))
    edges = tuple(
        (functions + edge.token, edge.function) if edge.is_input else (edge.function, functions + edge.token)
        for edge in graph.edges
    )
    is_dense = len(edges) > max(_MANY_EDGES, _DENSE * len(boxes))
    layout = lay_out(boxes, edges, is_dense)
    size = f"{layout.width + 2 * _MARGIN:.0f}", f"{layout.height + 2 * _MARGIN:.0f}"
    box = f"{-_MARGIN} {-_MARGIN} {size[0]} {size[1]}"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="epypes-graph" role="figure" '
        f'aria-label="{escape(alt_text(graph))}" width="{size[0]}" height="{size[1]}" viewBox="{box}">'
    )
    parts = [head, f"<style>{STYLE}</style>"]
    parts += paint_edges(graph.edges, edges, layout)
    parts += _paint_vertices(graph, boxes, layout)
    parts.append("</svg>")
    return "\n".join(parts)


def alt_text(graph: GraphView) -> str:
    """Return the graph in one sentence, for screen readers."""
    order = ", ".join(_cut(function.name) for function in graph.functions[:12])
    more = ", ..." if len(graph.functions) > 12 else ""
    functions = f"{len(graph.functions)} function{'s' * (len(graph.functions) != 1)}"
    return f"Computational graph of {functions}: {order}{more}. {graph.caption}".strip()


def _paint_vertices(graph: GraphView, boxes: tuple[Box, ...], layout: Layout) -> Iterable[str]:
    functions = len(graph.functions)
    for function, box, centre in zip(graph.functions, boxes, layout.centres, strict=False):
        yield _paint_function(function, box, centre)
    for token, box, centre in zip(graph.tokens, boxes[functions:], layout.centres[functions:], strict=True):
        yield _paint_token(token, box, centre)


# -- sizes ------------------------------------------------------------------------------------------------------------


def _width(*lines: str) -> float:
    return max(len(line) for line in lines) * _CHARACTER_PX + 22


def _function_lines(function: FunctionView) -> tuple[str, ...]:
    return (_cut(function.name), *function.notes, *_state_line(function))


def _state_line(function: FunctionView) -> tuple[str, ...]:
    """Say in which state a function is, where that is more than its shape and its notes say."""
    if function.state in ("static", "not run", "missing"):
        return ()
    if function.state == "ran" and function.duration_ns is not None:
        return (f"{duration_text(function.duration_ns)}, {function.share:.0%}",)
    if function.state == "failed":
        return (cut(function.message, _MESSAGE_CHARACTERS),)
    return ("to run" if function.state == "planned" else function.state,)


def _function_box(function: FunctionView) -> Box:
    lines = _function_lines(function)
    # The widest time is reserved for, so that another run's times do not move anything.
    widest = "000.0 ms, 100%" if len(lines) > 1 and function.state != "failed" else ""
    slope = 2 * _SLOPE_PX if function.kind == "switch" else 0
    return Box("box", max(_width(*lines, widest), 64) + slope, _LINE_PX * len(lines) + 14)


def _token_lines(token: TokenView) -> tuple[str, ...]:
    name = _cut(token.name)
    if token.role == "hyperparameter" and token.preview:
        return (f"{name} = {token.preview.text}",)
    if token.state in ("missing", "left out"):
        return name, token.state
    return (name, token.preview.text) if token.preview else (name,)


def _token_box(token: TokenView) -> Box:
    lines = _token_lines(token)
    if token.preview and token.preview.picture:
        return Box("box", max(_THUMB_WIDTH + 12, _width(*lines)), _THUMB_HEIGHT + 2 * _LINE_PX + 16)
    if token.role == "hyperparameter":
        return Box("hexagon", _width(*lines) + 14, _LINE_PX + 12)
    return Box("ellipse", _width(*lines) * 1.18, _LINE_PX * len(lines) + 16)


def _cut(text: str) -> str:
    return cut_name(text, _NAME_CHARACTERS)


# -- marks ------------------------------------------------------------------------------------------------------------


def vertex_id(kind: str, name: str) -> str:
    """Return the id of a vertex's element, made from its name so that the same graph has the same ids."""
    plain = re.sub(r"[^A-Za-z0-9_.-]", lambda match: f":{ord(match[0]):x}:", name[:_ID_CHARACTERS])
    if len(name) > _ID_CHARACTERS:
        plain += f":{zlib.crc32(name.encode(errors='surrogatepass')):x}"
    return f"{kind}-{plain}"


def _group(kind: str, name: str, states: tuple[str, ...], title: str, body: str) -> str:
    classes = " ".join(state.replace(" ", "-") for state in (kind, *states))
    return f'<g id="{vertex_id(kind, name)}" class="{classes}"><title>{escape(title)}</title>{body}</g>'


def _paint_function(function: FunctionView, box: Box, centre: Point) -> str:
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    slope = _SLOPE_PX if function.kind == "switch" else 0
    if slope:
        body = f'<polygon class="shape" points="{_trapezium(x, y, box)}"/>'
    else:
        body = f'<rect class="shape" x="{x:.1f}" y="{y:.1f}" width="{box.width:.1f}" height="{box.height:.1f}" rx="3"/>'
    if function.kind == "pipeline":
        body += _inner_border(x, y, box)
    if function.share > 0:
        body += (
            f'<rect class="bar" x="{x + slope:.1f}" y="{y + box.height - 4:.1f}" '
            f'width="{(box.width - 2 * slope) * min(function.share, 1):.1f}" height="4"/>'
        )
    body += _text(_function_lines(function), centre)
    said = "; ".join((function.state, *function.notes))
    title = f"{function.kind} {function.name}: {said}. {function.message}".removesuffix(" ")
    return _group("function", function.name, _classes(function), title[:600], body)


def _inner_border(x: float, y: float, box: Box) -> str:
    """Draw a second border inside that of a pipeline, so far away that the bar stands between them."""
    width, height = box.width - 2 * _INSIDE_PX, box.height - 2 * _INSIDE_PX
    at = f'x="{x + _INSIDE_PX:.1f}" y="{y + _INSIDE_PX:.1f}"'
    return f'<rect class="shape inner" {at} width="{width:.1f}" height="{height:.1f}" rx="2"/>'


def _classes(function: FunctionView) -> tuple[str, ...]:
    kind = () if function.kind == "function" else (function.kind,)
    return (*kind, *(("redefined",) if function.is_redefined else ()), function.state)


def _paint_token(token: TokenView, box: Box, centre: Point) -> str:
    lines = _token_lines(token)
    x, y = centre[0] - box.width / 2, centre[1] - box.height / 2
    if box.shape == "box":
        body = (
            f'<rect class="shape" x="{x:.1f}" y="{y:.1f}" width="{box.width:.1f}" height="{box.height:.1f}" rx="10"/>'
        )
        body += _text(lines, (centre[0], y + _LINE_PX + 4)) + _thumbnail(token, centre[0], y + 2 * _LINE_PX + 8)
    elif box.shape == "hexagon":
        body = f'<polygon class="shape" points="{_hexagon(x, y, box)}"/>' + _text(lines, centre)
    else:
        body = (
            f'<ellipse class="shape" cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" '
            f'rx="{box.width / 2:.1f}" ry="{box.height / 2:.1f}"/>'
        ) + _text(lines, centre)
    detail = token.preview.detail if token.preview else "no value"
    state = "" if token.state == "static" else f": {detail}, {token.state}"
    return _group("token", token.name, (token.role, token.state), _title(token, state), body)


def _title(token: TokenView, state: str) -> str:
    kind = "hyperparameter token" if token.role == "hyperparameter" else "token"
    return f"{kind} {token.name}{state}"[:600]


def _trapezium(x: float, y: float, box: Box) -> str:
    right, bottom = x + box.width, y + box.height
    points = ((x, y), (right, y), (right - _SLOPE_PX, bottom), (x + _SLOPE_PX, bottom))
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)


def _hexagon(x: float, y: float, box: Box) -> str:
    cut = 10.0
    right, bottom, middle = x + box.width, y + box.height, y + box.height / 2
    points = (
        (x, middle),
        (x + cut, y),
        (right - cut, y),
        (right, middle),
        (right - cut, bottom),
        (x + cut, bottom),
    )
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in points)


def _text(lines: tuple[str, ...], centre: Point) -> str:
    """Write the lines around a centre: the first is the name, the second smaller."""
    top = centre[1] - _LINE_PX * (len(lines) - 1) / 2 + 4
    kinds = ("name", "small")
    return "".join(
        f'<text class="{kinds[min(row, 1)]}" x="{centre[0]:.1f}" y="{top + row * _LINE_PX:.1f}">{escape(line)}</text>'
        for row, line in enumerate(lines)
    )


def _thumbnail(token: TokenView, x: float, y: float) -> str:
    picture = token.preview.picture if token.preview else None
    if picture is None:
        return ""
    scale = min(_THUMB_WIDTH / picture.width, _THUMB_HEIGHT / picture.height)
    width, height = picture.width * scale, picture.height * scale
    data = base64.b64encode(picture.data).decode()
    return (
        f'<image x="{x - width / 2:.1f}" y="{y + (_THUMB_HEIGHT - height) / 2:.1f}" width="{width:.1f}" '
        f'height="{height:.1f}" href="data:{picture.media_type};base64,{data}"/>'
    )
