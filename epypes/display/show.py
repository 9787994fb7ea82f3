"""How is something shown as the caller wants it, and written to a file?"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epypes.display.layout.geometry import Direction
from epypes.display.limits import MOST_THUMBNAILS
from epypes.display.markup import escape
from epypes.display.mime import bundle_of, html_and_svg, table_below
from epypes.display.paint.svg import alt_text, paint_svg
from epypes.display.views.graphview import GraphView
from epypes.display.views.groups import function_count
from epypes.display.views.jsonview import to_json
from epypes.display.views.view import view
from epypes.wording import counted


@dataclass(frozen=True, slots=True)
class Figure:
    """A graph, a runner, a run, a plan or a pipeline as it looked when it was shown; made by ``ep.show``.

    Attributes
    ----------
    view
        What is to be seen of it.
    table
        HTML that stands below the picture.
    """

    view: GraphView
    table: str = ""

    @property
    def svg(self) -> str:
        """The picture as the text of an SVG file."""
        return paint_svg(self.view)

    @property
    def html(self) -> str:
        """The picture for a page, with its caption and the insides of its groups."""
        return html_and_svg(self.view, self.table)["text/html"]

    def save(self, path: str | Path) -> Path:
        """Write the picture as ``.svg``, as a page of its own as ``.html``, or what is to be seen as ``.json``.

        Raises
        ------
        ValueError
            The path has another ending.
        """
        path = Path(path)
        if path.suffix == ".svg":
            text = self.svg
        elif path.suffix == ".html":
            text = _page(self.html, alt_text(self.view))
        elif path.suffix == ".json":
            text = json.dumps(to_json(self.view))
        else:
            way_out = "A browser opens .svg and .html, and prints them as PDF or saves them as pictures."
            raise ValueError(f"save() writes .svg, .html and .json, not {path.name!r}. {way_out}")
        path.write_text(text, encoding="utf-8")
        return path

    def __repr__(self) -> str:
        groups = f", {counted(len(self.view.groups), 'closed group')}" * bool(self.view.groups)
        return f"<Figure: {counted(function_count(self.view), 'function')}{groups}; {self.view.direction}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return bundle_of(self, lambda: html_and_svg(self.view, self.table), lambda: self.view)


def show(
    shown: Any,
    *,
    direction: Direction = "down",
    thumbnails: int = MOST_THUMBNAILS,
    open: str | Iterable[str] = (),  # noqa: A002 - the word for what is done to a box
    collapse: bool = True,
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
        The groups whose functions are drawn one by one.
    collapse
        Whether groups are drawn as one box each, but for those that are open. Beside those of ``ep.group``, functions
        whose names have one prefix (``left.blur``, ``left.canny`` ...) are a group in a graph of more than 24.

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
    graph = view(shown, direction=direction, thumbnails=thumbnails, open=open, collapse=collapse)
    return Figure(graph, table_below(shown))


def _page(html: str, title: str) -> str:
    style = "body{margin:16px;font-family:system-ui,sans-serif}table{border-spacing:12px 2px}"
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{style}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{html}</body></html>\n'
