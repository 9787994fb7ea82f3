"""Which forms of an object does a notebook get?"""

from __future__ import annotations

from typing import Any

from epypes.display.paint.page import paint_graph, paint_page, room_of
from epypes.display.paint.svg import paint_svg
from epypes.display.paint.tables import paint_plan, paint_report, paint_summary
from epypes.display.paint.text import paint_text
from epypes.display.views.view import Shown, view
from epypes.errors import LayoutUnavailable
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner, Plan, Run, RunReport, TimingSummary


def mimebundle(shown: Any) -> dict[str, str]:
    """Return ``text/plain``, ``text/html`` and ``image/svg+xml`` of what shows itself; of reports without SVG.

    Never raises: what can't be painted is shown as text, with the reason and the way out.
    """
    plain = repr(shown)
    try:
        return {"text/plain": plain, **_painted(shown)}
    except LayoutUnavailable as error:
        return {"text/plain": f"{plain}\n{paint_text(view(_subject(shown)))}\n{error}"}
    except Exception as error:
        return {"text/plain": f"{plain}\n(no picture: {type(error).__name__}: {error!s:.200})"}


def _painted(shown: Any) -> dict[str, str]:
    if isinstance(shown, RunReport):
        return {"text/html": paint_report(shown)}
    if isinstance(shown, TimingSummary):
        return {"text/html": paint_summary(shown)}
    graph = view(_subject(shown))
    svg = paint_svg(graph)
    table = paint_plan(graph) if isinstance(shown, Plan) else ""
    figure = paint_graph(svg, graph, room_of(graph, svg) - len(table))
    return {"text/html": paint_page(figure, table), "image/svg+xml": svg}


def _subject(shown: Any) -> Shown:
    """Return what is to be seen of an object: of a pipeline, its runner."""
    if isinstance(shown, CompGraph | CompGraphRunner | Run | Plan):
        return shown
    runner: CompGraphRunner = shown.runner
    return runner


def to_svg(shown: Shown) -> str:
    """Return the picture as the text of an SVG file.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    return paint_svg(view(shown))
