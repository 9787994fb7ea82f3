"""The formatters that notebooks, ``print()`` and ``ep.show`` ask for."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from epypes.display.layout import Direction
from epypes.display.paint.page import paint_figure, paint_graph, paint_kept, paint_page
from epypes.display.paint.paper import save_on_paper
from epypes.display.paint.svg import alt_text, paint_svg
from epypes.display.paint.tables import Tabular, paint_table, paint_text, repr_text, summary_of, table_of, text_table
from epypes.display.paint.times import paint_bars, times_alt_text, times_of
from epypes.display.previews.short import reason
from epypes.display.text import MOST_THUMBNAILS, escape, size
from epypes.display.views.full_pictures import address_of, kept_pictures, run_of
from epypes.display.views.graphview import GraphView, to_json
from epypes.display.views.groups import function_count
from epypes.display.views.view import view
from epypes.errors import InvalidValue, LayoutUnavailable
from epypes.run import Plan, Run, RunReport, TimingSummary
from epypes.run.timing import Reports
from epypes.wording import counted

Forms = dict[str, str]


def mimebundle(shown: Any) -> Forms:
    """Return ``text/plain``, ``text/html`` and ``image/svg+xml`` of what shows itself.

    Never raises: what can't be painted is shown as text, with the reason and the way out.
    """
    plain = repr_text(shown)
    try:
        return {"text/plain": plain, **_forms(shown)}
    except LayoutUnavailable as error:
        graph = shown.view if isinstance(shown, Figure) else view(shown)
        return {"text/plain": f"{plain}\n{paint_text(graph)}\n{error}"}
    except Exception as error:
        return {"text/plain": f"{plain}\n(no picture: {reason(error)})"}


def to_svg(shown: Any) -> str:
    """Return the picture as the text of an SVG file.

    Raises
    ------
    LayoutUnavailable
        No Graphviz engine answered.
    """
    return paint_svg(view(shown))


def to_text(shown: Tabular) -> str:
    """Return a plan, a report, reports or their summary as an aligned table of text; never raises."""
    try:
        return text_table(table_of(shown))
    except Exception as error:
        return f"{repr_text(shown)}\n(no table: {reason(error)})"


def _forms(shown: Any) -> Forms:
    if isinstance(shown, Figure):
        return _graph_forms(shown.view, shown.table, shown.run)
    if isinstance(shown, Reports):
        shown = summary_of(shown)
    if isinstance(shown, str):
        return {"text/html": f"<p>{shown}</p>"}
    if not isinstance(shown, RunReport | TimingSummary):
        return _graph_forms(view(shown), _table_below(shown), run_of(shown))
    times = times_of(shown)
    svg = paint_bars(times)
    figure = paint_figure(svg, times_alt_text(times), times.legend)
    return {"text/html": paint_page(figure, paint_table(table_of(shown))), "image/svg+xml": svg}


def _graph_forms(graph: GraphView, below: str, run: Run | None) -> Forms:
    svg, kept = paint_svg(graph), paint_kept(kept_pictures(graph, run)) if run is not None else ""
    html = paint_page(*paint_graph(graph, svg, size(below)), kept, below, address=address_of(run))
    return {"text/html": html, "image/svg+xml": svg}


def _table_below(shown: Any) -> str:
    """Return the table below the picture of a plan, with all functions of its groups; nothing for anything else."""
    return paint_table(table_of(shown)._replace(caption="")) if isinstance(shown, Plan) else ""


@dataclass(frozen=True, slots=True)
class Figure:
    """A graph, a runner, a run, a plan or a pipeline as it looked when it was shown; made by ``ep.show``.

    Attributes
    ----------
    view
        What is to be seen of it.
    table
        HTML that stands below the picture.
    run
        The run whose values are seen, if there is one; in a notebook its tokens' pictures are seen in full.
    """

    view: GraphView
    table: str = ""
    run: Run | None = field(default=None, repr=False, compare=False)

    @property
    def svg(self) -> str:
        """The picture as the text of an SVG file."""
        return paint_svg(self.view)

    @property
    def html(self) -> str:
        """The picture for a page, with its caption and the insides of its groups."""
        return _graph_forms(self.view, self.table, self.run)["text/html"]

    def save(self, path: str | Path) -> Path:
        """Write the picture as ``.svg``, ``.pdf`` or ``.png``, as a page as ``.html``, or what is seen as ``.json``.

        A PNG has two pixels for each of the SVG, on white. A PDF has text and lines as such.

        Raises
        ------
        ValueError
            The path has another ending.
        MissingPackage
            A PNG or a PDF needs Matplotlib.
        """
        path = Path(path)
        if path.suffix in (".png", ".pdf"):
            save_on_paper(self.svg, path)
            return path
        if path.suffix == ".svg":
            text = self.svg
        elif path.suffix == ".html":
            style = "body{margin:16px;font-family:system-ui,sans-serif}table{border-spacing:12px 2px}"
            head = f'<meta charset="utf-8"><title>{escape(alt_text(self.view))}</title><style>{style}</style>'
            text = f'<!doctype html><html lang="en"><head>{head}</head><body>{self.html}</body></html>\n'
        elif path.suffix == ".json":
            text = json.dumps(to_json(self.view))
        else:
            raise InvalidValue(f"save() writes .svg, .html, .png, .pdf and .json, not {path.name!r}. Use one of these.")
        path.write_text(text, encoding="utf-8")
        return path

    def __repr__(self) -> str:
        closed = sum(function.kind == "group" for function in self.view.functions)
        groups = f", {counted(closed, 'closed group')}" * bool(closed)
        return f"<Figure: {counted(function_count(self.view), 'function')}{groups}; {self.view.direction}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> Forms:
        return mimebundle(self)


def show(
    shown: Any,
    *,
    direction: Direction = "down",
    thumbnails: int = MOST_THUMBNAILS,
    open: str | Iterable[str] = (),  # noqa: A002 - the word for what is done to a box
    collapse: bool = True,
    depth: int = 0,
) -> Figure:
    """Look at a graph, a runner, a run, a plan or a pipeline, and draw it in this way.

    Parameters
    ----------
    shown
        What is looked at.
    direction
        Where the data flows to on the page: ``"down"`` or ``"right"``.
    thumbnails
        How many there are at most.
    open
        The groups whose functions are drawn one by one, and the pipelines whose inside is drawn in a frame: of one in
        another, ``"geometry__pose"``.
    collapse
        Whether groups are drawn as one box each, but for those that are open. Beside those of ``ep.group``, functions
        whose names have one prefix (``left.blur``, ``left.canny`` ...) are a group in a graph of more than 24; if it
        has still more than 24 boxes, so are stretches of the way that the data takes (``"blur … canny"``).

    depth
        How many levels of pipelines are drawn open; what is inside the others opens below the picture when they are
        clicked.

    Returns
    -------
    Figure
        It shows itself in a notebook, and ``save("graph.svg")`` writes it to a file.

    Raises
    ------
    TypeError, ValueError
        An argument is of another kind, or none of these.
    UnknownName
        There is no such group.

    Examples
    --------
    >>> from epypes.graph import CompGraph
    >>> show(CompGraph({"f": abs}, {"f": ("x", "y")}), direction="right")
    <Figure: 1 function; right>
    """
    graph = view(shown, direction=direction, thumbnails=thumbnails, open=open, collapse=collapse, depth=depth)
    return Figure(graph, _table_below(shown), run_of(shown))
