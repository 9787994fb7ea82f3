"""Which forms of an object does a notebook get?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final
from urllib.parse import quote

from epypes.display.markup import cut, escape
from epypes.display.paint.bars import paint_bars, times_alt_text
from epypes.display.paint.rows import NO_REPORTS, plan_table, table_of
from epypes.display.paint.svg import alt_text, least_width, paint_svg
from epypes.display.paint.tables import paint_table, paint_twin
from epypes.display.paint.text import paint_text
from epypes.display.views.graphview import GraphView
from epypes.display.views.groups import counted, function_count
from epypes.display.views.times import report_times, summary_times
from epypes.display.views.tokens import THUMBNAIL_CHARACTERS
from epypes.display.views.view import Shown, view
from epypes.errors import LayoutUnavailable
from epypes.run import Plan, RunReport, TimingSummary, summarize
from epypes.run.report import Reports

# What a picture in a page may take: so many characters, and more for every vertex and for thumbnails.
_LEAST_CHARACTERS: Final = 20_000
_VERTEX_CHARACTERS: Final = 600
_NAMED_CHARACTERS: Final = 200
_NOTICE_CHARACTERS: Final = 1_500
_SVG_URI: Final = "data:image/svg+xml,"
_INLINE: Final = (
    "(()=>{const s=document.currentScript,i=s&&s.previousElementSibling;if(!i||i.tagName!=='IMG')return;"
    f"const t=decodeURIComponent(i.getAttribute('src').slice({len(_SVG_URI)}));"
    "const d=new DOMParser().parseFromString(t,'image/svg+xml').documentElement;"
    "if(d.tagName==='svg')i.replaceWith(document.importNode(d,true))})()"
)


def mimebundle(shown: Any) -> dict[str, str]:
    """Return ``text/plain``, ``text/html`` and ``image/svg+xml`` of what shows itself.

    Never raises: what can't be painted is shown as text, with the reason and the way out.
    """
    return bundle_of(repr(shown), lambda: _painted(shown), lambda: view(shown))


def bundle_of(plain: str, paint: Callable[[], dict[str, str]], look: Callable[[], GraphView]) -> dict[str, str]:
    """Return a text and what is painted, or, where that can't be, the text with the reason.

    Parameters
    ----------
    plain
        The text.
    paint
        Paints the other forms.
    look
        Looks at the graph, which is shown as text where no Graphviz engine answers.
    """
    try:
        return {"text/plain": plain, **paint()}
    except LayoutUnavailable as error:
        return {"text/plain": f"{plain}\n{paint_text(look())}\n{error}"}
    except Exception as error:
        return {"text/plain": f"{plain}\n(no picture: {type(error).__name__}: {error!s:.200})"}


def _painted(shown: Any) -> dict[str, str]:
    if isinstance(shown, Reports) and not len(shown):
        return {"text/html": f"<p>{NO_REPORTS}</p>"}
    if isinstance(shown, RunReport | TimingSummary | Reports):
        return _painted_times(summarize(shown) if isinstance(shown, Reports) else shown)
    html, svg = html_and_svg(view(shown))
    return {"text/html": html + table_below(shown), "image/svg+xml": svg}


def _painted_times(shown: RunReport | TimingSummary) -> dict[str, str]:
    times = report_times(shown) if isinstance(shown, RunReport) else summary_times(shown)
    svg, table = paint_bars(times), paint_table(table_of(shown))
    return {"text/html": _figure(svg, times_alt_text(times), times.legend, "") + table, "image/svg+xml": svg}


def table_below(shown: Any) -> str:
    """Return the table below the picture of a plan, with all functions of its groups; nothing for anything else."""
    if not isinstance(shown, Plan):
        return ""
    return paint_table(plan_table(view(shown, collapse=False))._replace(caption=""))


def html_and_svg(graph: GraphView) -> tuple[str, str]:
    """Return a picture for a page, with the insides of its groups, and as the text of an SVG file.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    svg = paint_svg(graph)
    figure = _graph_figure(graph, svg)
    return figure + _insides(graph, len(figure)), svg


def _graph_figure(graph: GraphView, svg: str) -> str:
    alt = alt_text(graph)
    return _figure(svg, alt, graph.caption, paint_twin(graph, alt))


def to_svg(shown: Shown) -> str:
    """Return the picture as the text of an SVG file.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    return paint_svg(view(shown))


def _figure(svg: str, alt: str, caption: str, twin: str) -> str:
    """Return the picture as an image that a script replaces by the SVG itself.

    A page that does not trust the notebook strips the script and would strip inline SVG down to its loose words, but
    keeps the image. Where the script runs, the picture takes the page's colours and its vertices tell their titles.
    """
    source = quote(svg, safe=" <>/=:;,.()!?+*'@|^~-_{}[]$")
    below = f'<figcaption style="font-size:11px">{escape(caption)}</figcaption>' if caption else ""
    return (
        f'<figure style="margin:0"><div style="overflow-x:auto"><img src="{_SVG_URI}{source}" '
        f'alt="{escape(alt)}" style="max-width:100%;min-width:{least_width(svg)}px">'
        f"<script>{_INLINE}</script></div>{below}{twin}</figure>"
    )


def _insides(graph: GraphView, characters: int) -> str:
    """Return what is inside the groups, each to be opened in place, as far as the page has room beside its figure."""
    parts = (graph, *(group.graph for group in graph.groups))
    vertices = function_count(graph) + len({token.name for part in parts for token in part.tokens})
    room = _LEAST_CHARACTERS + _VERTEX_CHARACTERS * vertices + THUMBNAIL_CHARACTERS - _NOTICE_CHARACTERS - characters
    details: list[str] = []
    for place, group in enumerate(graph.groups):
        name, count = escape(group.name), counted(len(group.graph.functions), "function")
        summary = f'<summary style="font-size:12px;cursor:pointer">{name}: {count}</summary>'
        inside = _graph_figure(group.graph, paint_svg(group.graph))
        part = f'<details class="epypes-inside" data-group="{name}">{summary}{inside}</details>'
        room -= len(part)
        if room < 0:
            names = cut(", ".join(group.name for group in graph.groups[place:]), _NAMED_CHARACTERS)
            details.append(f"<p>Not shown here: the inside of {escape(names)}. Call ep.show(..., open=[...]).</p>")
            break
        details.append(part)
    return "".join(details)
