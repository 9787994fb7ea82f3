"""Which forms of an object does a notebook get?"""

from __future__ import annotations

from typing import Any, Final
from urllib.parse import quote

from epypes.display.markup import escape
from epypes.display.paint.bars import paint_bars, times_alt_text
from epypes.display.paint.rows import NO_REPORTS, plan_table, table_of
from epypes.display.paint.svg import alt_text, paint_svg
from epypes.display.paint.tables import paint_table, paint_twin
from epypes.display.paint.text import paint_text
from epypes.display.views.times import report_times, summary_times
from epypes.display.views.view import Shown, view
from epypes.errors import LayoutUnavailable
from epypes.run import Plan, RunReport, TimingSummary, summarize
from epypes.run.report import Reports

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
    plain = repr(shown)
    try:
        return {"text/plain": plain, **_painted(shown)}
    except LayoutUnavailable as error:
        return {"text/plain": f"{plain}\n{paint_text(view(shown))}\n{error}"}
    except Exception as error:
        return {"text/plain": f"{plain}\n(no picture: {type(error).__name__}: {error!s:.200})"}


def _painted(shown: Any) -> dict[str, str]:
    if isinstance(shown, Reports) and not len(shown):
        return {"text/html": f"<p>{NO_REPORTS}</p>"}
    if isinstance(shown, RunReport | TimingSummary | Reports):
        return _painted_times(summarize(shown) if isinstance(shown, Reports) else shown)
    graph = view(shown)
    svg, alt = paint_svg(graph), alt_text(graph)
    table = paint_table(plan_table(graph)._replace(caption="")) if isinstance(shown, Plan) else ""
    return {"text/html": _figure(svg, alt, graph.caption, paint_twin(graph, alt)) + table, "image/svg+xml": svg}


def _painted_times(shown: RunReport | TimingSummary) -> dict[str, str]:
    times = report_times(shown) if isinstance(shown, RunReport) else summary_times(shown)
    svg, table = paint_bars(times), paint_table(table_of(shown))
    return {"text/html": _figure(svg, times_alt_text(times), times.legend, "") + table, "image/svg+xml": svg}


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
    return (
        f'<figure style="margin:0"><img src="{_SVG_URI}{source}" alt="{escape(alt)}" '
        f'style="max-width:100%"><script>{_INLINE}</script>'
        f'<figcaption style="font-size:11px">{escape(caption)}</figcaption>{twin}</figure>'
    )
