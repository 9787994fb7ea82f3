"""A picture in a page: how it is explored, its twin for screen readers, its functions' sources, its tokens' pictures.

The picture is an ``<img>`` of the SVG, which the script replaces by the SVG itself: a page that does not trust a
notebook strips scripts and would strip inline SVG down to its loose words, but keeps the image. Where the script runs,
the picture takes the page's colours and can be explored (``explore.js``). So it is with the pictures of tokens that are
kept: without a script they are opened below the graph, else the script shows them beside it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from importlib import resources
from typing import Any, Final

from epypes.display.paint.style import PAGE_STYLE
from epypes.display.paint.svg import alt_text, least_width, paint_svg
from epypes.display.paint.tables import paint_twin
from epypes.display.previews import Picture
from epypes.display.text import (
    CHARACTERS,
    CHARACTERS_OF_A_VERTEX,
    QUOTE,
    THUMBNAIL_CHARACTERS,
    content,
    cut,
    escape,
    fitted,
    size,
)
from epypes.display.views.graphview import FunctionView, GraphView, has_picture
from epypes.display.views.groups import function_count
from epypes.wording import counted

_NAMED_CHARACTERS: Final = 200
_CAPTION_ROOM: Final = 1_500
# Taken away by the script.
_STILL: Final = '<p class="epypes-still" style="font-size:12px"><i>Trust the notebook to explore the graph.</i></p>'
# A twin without rows, and what stands beside it.
_TWIN_CHARACTERS: Final = len(paint_twin(GraphView((), (), ()), "", 0)) + len(_STILL)

_SVG_URI: Final = "data:image/svg+xml,"
# What would end the attribute, the address or a line of it; all else may stand as it is, in any language.
_IN_URI: Final = {sign: f"%{ord(sign):02X}" for sign in '%#&"\n\r\t'}  # % comes first
_THUMBNAIL: Final = re.compile('<image [^>]*>|<g class="chart">.*?</g>')
_END: Final = "</figure>"
# Below the picture stands what is inside.
_OPENED: Final = ("group", "pipeline")
_WEIGHTS: Final = {"failed": -2.0, "running": -1.5}


def paint_page(*parts: str, address: str = "") -> str:
    """Return what is shown together, such as a figure and the tables below it, with what it takes to explore it.

    Parameters
    ----------
    address
        Where the script finds the run that is shown; empty if it is in no kernel.
    """
    run = f' data-run="{escape(address)}"' if address else ""
    return (
        f'<div class="epypes-sheet"{run}>{"".join(parts)}<style>{PAGE_STYLE}{_asset("css")}</style>'
        f"<script>{_asset('js')}</script></div>"
    )


@cache
def _asset(kind: str) -> str:
    """Return the script or the style without what is there for people: comments, and blanks at the start of lines."""
    text = (resources.files("epypes.display.paint") / f"explore.{kind}").read_text("utf-8")
    text = re.sub(r"(?m)^\s*//.*\n|/\*.*?\*/", "", text)
    text = re.sub(r"\n\s*", "\n", text).strip()
    return re.sub(r"\s*([{};:,>])\s+", r"\1", text) if kind == "css" else text


def paint_figure(svg: str, alt: str, caption: str = "") -> str:
    """Return a picture as a figure."""
    # An image knows nothing of the page; where the script puts the picture itself, the page's style is there already.
    source = svg.replace(PAGE_STYLE, "", 1)
    # The quotes that are left are those around attributes: they need not be encoded if they are single ones.
    source = source.replace('"', "'").replace(QUOTE, '"')
    for sign, encoded in _IN_URI.items():
        source = source.replace(sign, encoded)
    text = content(fitted(caption, _CAPTION_ROOM))
    below = f'<figcaption style="font-size:12px">{text}</figcaption>' if caption else ""
    return (
        f'<figure class="epypes-figure" style="margin:0"><div class="epypes-window" style="overflow:auto">'
        f'<img src="{_SVG_URI}{source}" alt="{escape(alt)}" style="max-width:100%;min-width:{least_width(svg)}px">'
        f"</div>{below}{_END}"
    )


def paint_graph(graph: GraphView, svg: str, taken: int = 0) -> list[str]:
    """Return the picture of a graph as a figure, and what is inside each of its groups, to be opened below it.

    Each figure has a table twin and what the script needs to know. Rows of the twins, sources of functions and the
    insides of groups are left out where they don't fit, and what was left out is stated.

    Parameters
    ----------
    svg
        What was painted of the graph.
    taken
        How many characters the page has already.
    """
    names = [group.name for group in graph.groups]
    pictures = [(graph, svg), *((group.graph, paint_svg(group.graph)) for group in graph.groups)]
    room = _room_of(pictures) - taken - size(_left_out(names))
    figures: list[str] = []
    alts = [alt_text(part) for part, _ in pictures]
    for name, alt, (part, picture) in zip(("", *names), alts, pictures, strict=True):
        figure = paint_figure(picture, alt, part.caption)
        least = size(_inside(name, part, figure) if figures else figure) + size(_data(part, {})) + _TWIN_CHARACTERS
        if figures and least > room:
            break
        room -= least
        figures.append(figure)
    parts = [part for part, _ in pictures[: len(figures)]]
    # What is left is for twins and sources: as much for each function and token.
    each = max(room, 0) / max(sum(map(_vertices, parts)), 1)
    first, *insides = [
        _explained(figure, part, alt, int(each * _vertices(part)))
        for figure, part, alt in zip(figures, parts, alts, strict=False)
    ]
    details = [_inside(name, part, figure) for name, part, figure in zip(names, parts[1:], insides, strict=False)]
    left_out = _left_out(names[len(details) :])
    return [first, *details, *([left_out] if left_out else [])]


def paint_kept(kept: Mapping[str, Picture]) -> str:
    """Return the pictures of tokens that a page keeps, by their names; to be opened where no script runs."""
    pictures = "".join(
        f'<figure style="display:inline-block;margin:4px"><img src="{escape(picture.uri)}" alt="{escape(name)}" '
        f'style="max-width:100%"><figcaption>{content(cut(name, _NAMED_CHARACTERS))}</figcaption></figure>'
        for name, picture in kept.items()
    )
    summary = "<summary>Its images, larger</summary>"
    return f'<details class="epypes-album" style="font-size:12px">{summary}{pictures}</details>' if kept else ""


def _explained(figure: str, graph: GraphView, alt: str, room: int) -> str:
    """Add the twin of a figure and what the script needs to know, in ``room`` more characters than is their least."""
    # A fifth at least is kept for the rows of the twin.
    sources = _fitting(graph, room * 4 // 5)
    data = _data(graph, sources)
    room += _TWIN_CHARACTERS - len(_STILL) - sum(map(_source_size, sources))
    return f"{figure.removesuffix(_END)}{_STILL}{data}{paint_twin(graph, alt, room)}{_END}"


def _inside(name: str, graph: GraphView, figure: str) -> str:
    text = f"{content(fitted(name, _NAMED_CHARACTERS))}: {counted(len(graph.functions), 'function')}"
    return f'<details class="epypes-inside" data-group="{escape(name)}"><summary>{text}</summary>{figure}</details>'


def _left_out(names: Sequence[str]) -> str:
    some = content(cut(", ".join(names), _NAMED_CHARACTERS))
    return f"<p>Not shown here: the inside of {some}. Call ep.show(..., open=[...]).</p>" if names else ""


def _vertices(graph: GraphView) -> int:
    return len(graph.functions) + len(graph.tokens)


def _room_of(pictures: Sequence[tuple[GraphView, str]]) -> int:
    """Return how many characters figures may take on a page of their own.

    A token that several of them show counts once; where thumbnails leave room, the others are paid from theirs.
    """
    thumbnails = sum(len(found) for _, svg in pictures for found in _THUMBNAIL.findall(svg))
    vertices = function_count(pictures[0][0]) + len({token.name for part, _ in pictures for token in part.tokens})
    twice = sum(_vertices(part) for part, _ in pictures) - vertices
    spent = min(thumbnails + CHARACTERS_OF_A_VERTEX * twice, THUMBNAIL_CHARACTERS)
    return CHARACTERS - len(paint_page()) + CHARACTERS_OF_A_VERTEX * vertices + spent


# -- what the script needs to know ---------------------------------------------------------------------------------

Texts = tuple[str, str]


def _fitting(graph: GraphView, room: int) -> dict[Texts, list[int]]:
    """Return signatures and sources, with the functions that have them, so many as fit: the most relevant first."""
    kept: dict[Texts, list[int]] = {}
    by_relevance = sorted(enumerate(graph.functions), key=lambda each: _WEIGHTS.get(each[1].state, -each[1].share))
    for place, function in by_relevance:
        texts = function.signature, function.source
        taken = 5 if texts in kept else _source_size(texts)
        if any(texts) and taken <= room:
            room -= taken
            kept.setdefault(texts, []).append(place)
    return kept


@lru_cache(maxsize=1_000)
def _source_size(texts: Texts) -> int:
    return size(_json(texts)) + 5


def _data(graph: GraphView, kept: Mapping[Texts, Sequence[int]]) -> str:
    """Return what the script needs to know, as text that does nothing by itself.

    Edges by function, a token that no run reads as its complement; then by function which of the texts are its own,
    null if they were left out; then by token the names of those with a picture.
    """
    owner = {place: index for index, places in enumerate(kept.values()) for place in places}
    io: list[tuple[list[int], list[int]]] = [([], []) for _ in graph.functions] if graph.draws_edges else []
    for edge in graph.edges if io else ():
        io[edge.function][0 if edge.is_input else 1].append(edge.token if edge.is_live else ~edge.token)
    data = {
        "io": io,
        "groups": {place: each.name for place, each in enumerate(graph.functions) if each.kind in _OPENED},
        "about": [owner.get(place, _unexplained(each)) for place, each in enumerate(graph.functions)],
        "texts": list(kept),
        "images": {place: each.name for place, each in enumerate(graph.tokens) if has_picture(each)},
    }
    return f'<script type="application/json" class="epypes-data">{_json(data)}</script>'


def _unexplained(function: FunctionView) -> int | None:
    return None if function.signature or function.source else -1


def _json(value: Any) -> str:
    """Return JSON in which nothing can end a script's element, and no half of a surrogate pair is left."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    return text.encode("utf-8", "replace").decode().replace("<", "\\u003c")
