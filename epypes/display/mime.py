"""Which forms of an object does a notebook get?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from epypes.display.markup import size
from epypes.display.paint.bars import paint_bars, times_alt_text
from epypes.display.paint.page import paint_figure, paint_graph, paint_page
from epypes.display.paint.rows import summary_of, table_of
from epypes.display.paint.svg import paint_svg
from epypes.display.paint.tables import paint_table
from epypes.display.paint.text import paint_text, repr_text
from epypes.display.previews.short import reason
from epypes.display.views.graphview import GraphView
from epypes.display.views.times import report_times, summary_times
from epypes.display.views.view import Shown, view
from epypes.errors import LayoutUnavailable
from epypes.run import Plan, RunReport, TimingSummary
from epypes.run.timing import Reports


def mimebundle(shown: Any) -> dict[str, str]:
    """Return ``text/plain``, ``text/html`` and ``image/svg+xml`` of what shows itself.

    Never raises: what can't be painted is shown as text, with the reason and the way out.
    """
    return bundle_of(shown, lambda: _painted(shown), lambda: view(shown))


def bundle_of(shown: Any, paint: Callable[[], dict[str, str]], look: Callable[[], GraphView]) -> dict[str, str]:
    """Return a text and what is painted, or, where that can't be, the text with the reason.

    Parameters
    ----------
    shown
        What the text is of.
    paint
        Paints the other forms.
    look
        Looks at the graph, which is shown as text where no Graphviz engine answers.
    """
    plain = repr_text(shown)
    try:
        return {"text/plain": plain, **paint()}
    except LayoutUnavailable as error:
        return {"text/plain": f"{plain}\n{paint_text(look())}\n{error}"}
    except Exception as error:
        return {"text/plain": f"{plain}\n(no picture: {reason(error)})"}


def _painted(shown: Any) -> dict[str, str]:
    if isinstance(shown, Reports):
        shown = summary_of(shown)
    if isinstance(shown, str):
        return {"text/html": f"<p>{shown}</p>"}
    if isinstance(shown, RunReport | TimingSummary):
        return _painted_times(shown)
    return html_and_svg(view(shown), table_below(shown))


def _painted_times(shown: RunReport | TimingSummary) -> dict[str, str]:
    times = report_times(shown) if isinstance(shown, RunReport) else summary_times(shown)
    svg, table = paint_bars(times), paint_table(table_of(shown))
    return {
        "text/html": paint_page(paint_figure(svg, times_alt_text(times), times.legend), table),
        "image/svg+xml": svg,
    }


def table_below(shown: Any) -> str:
    """Return the table below the picture of a plan, with all functions of its groups; nothing for anything else."""
    if not isinstance(shown, Plan):
        return ""
    return paint_table(table_of(shown)._replace(caption=""))


def html_and_svg(graph: GraphView, below: str = "") -> dict[str, str]:
    """Return a picture for a page, with what is ``below`` it, and as the text of an SVG file.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    svg = paint_svg(graph)
    return {"text/html": paint_page(*paint_graph(graph, svg, size(below)), below), "image/svg+xml": svg}


def to_svg(shown: Shown) -> str:
    """Return the picture as the text of an SVG file.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    return paint_svg(view(shown))
