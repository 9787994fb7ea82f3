"""Plots: figures of Matplotlib that show themselves in a notebook, in the colours of its theme.

On paper a plot is black on white. On a page its colours are those of the theme, as in pictures of graphs (``page.py``),
and its ground is that of the page; all other colours are chosen to be seen on light and on dark. Plots are made
without pyplot, so nothing is shown twice and no figure stays open.
"""

from __future__ import annotations

import re
from io import BytesIO
from typing import Any, Final

from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from epypes.display.paint.page import paint_figure, paint_page

# Matplotlib's own, whatever users have set for figures of theirs. With a fixed salt, the same figure has the same names
# inside its SVG.
PLOT_STYLE: Final[list[Any]] = [
    "default",
    {
        "axes.spines.right": False,
        "axes.spines.top": False,
        "legend.frameon": False,
        "svg.hashsalt": "epypes",
    },
]
# Okabe and Ito's, which people with any colour vision tell apart; the red is darker, to be seen on white.
BLUE: Final = "#0072b2"
RED: Final = "#c44e00"
# What Matplotlib writes -> what a page has instead, in this order. An image knows no variables: it has no ground, and a
# grey for text that is readable on light and on dark. On a page no rule of a plot is one for all pictures; names of
# fonts have quotes that an address can't hold.
_THEMED: Final = {
    r"^.*?(?=<svg )|<metadata>.*?</metadata>|<!--.*?-->|<defs>\s*<style.*?</style>\s*</defs>": "",
    r"(<svg[^>]*?) height=\S+": r"\1",  # follows the width, which is no more than that of the page
    '<g id="figure_1">': '<g id="figure_1" style="fill: #000000; stroke-linejoin: round">',
    "#000000": "var(--epypes-text,#767676)",
    "#ffffff": "var(--epypes-paper,none)",
    BLUE: f"var(--epypes-accent,{BLUE})",
    RED: f"var(--epypes-warn,{RED})",
    # Of figures in the style "ggplot", as Optuna's: the ground of the axes, their texts, edges, dots, lines and bars.
    "#e5e5e5": "var(--epypes-grey,#e5e5e5)",
    "#555555": "var(--epypes-quiet,#555555)",
    "#cccccc": "var(--epypes-line,#cccccc)",
    "#1f77b4": "var(--epypes-accent,#1f77b4)",
    "#d62728": "var(--epypes-warn,#d62728)",
    "#3182bd": "var(--epypes-accent,#3182bd)",
    r"(font-family:|font: (?:\w+ )*[\d.]+px) [^;\"]*": r"\1 var(--jp-ui-font-family,sans-serif)",
    r"(\.\d\d)\d+(?=[^<>]*>)": r"\1",
    r"\s*\n\s*": " ",
}
# The ground of outputs, so that none is seen; on a page without a theme text is dark, and needs a light one.
_PAPER: Final = "var(--jp-layout-color0,var(--vscode-editor-background,#ffffff))"


class ThemedFigure:
    """A figure of any library, as it shows itself in a notebook: in the colours of the page.

    Attributes
    ----------
    figure
        Of Matplotlib.
    """

    def __init__(self, figure: Figure) -> None:
        self.figure = figure

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save the figure as Matplotlib does, in Matplotlib's own style."""
        self._save(fname, {}, **options)

    @property
    def alt(self) -> str:
        """What is drawn, in words."""
        titles = [axes.get_title(loc=side) for axes in self.figure.axes for side in ("left", "center")]
        return ". ".join(filter(None, (self.figure.get_suptitle(), *titles)))

    def html(self) -> str:
        """Return the figure as an element for ``paint_page``."""
        return self._themed(self._svg())

    def _svg(self) -> str:
        svg = BytesIO()
        # In a file letters are drawn. Here they stay text, which is smaller, and which screen readers read.
        self._save(svg, {"svg.fonttype": "none"}, format="svg", metadata={"Date": None})
        return svg.getvalue().decode()

    def _save(self, fname: Any, settings: dict[str, Any], **options: Any) -> None:
        with style.context([*PLOT_STYLE, settings]):
            # A Plot's own savefig comes here, and would set the style again, without these settings.
            Figure.savefig(self.figure, fname, **options)

    def _themed(self, svg: str) -> str:
        for written, themed in _THEMED.items():
            svg = re.sub(written, themed, svg, flags=re.DOTALL)
        return f'<div style="--epypes-paper:{_PAPER}">{paint_figure(svg, self.alt)}</div>'

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        svg, png = self._svg(), BytesIO()
        # For what shows neither, such as a document made by LaTeX.
        self.savefig(png, format="png")
        page, text = paint_page(self._themed(svg)), repr(self.figure)
        return {"text/plain": text, "text/html": page, "image/svg+xml": svg, "image/png": png.getvalue()}


class Plot(Figure):
    """A figure of Matplotlib that shows itself in a notebook, whether pyplot has been imported or not."""

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save the figure as Matplotlib does, in its own style."""
        ThemedFigure(self).savefig(fname, **options)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        return ThemedFigure(self)._repr_mimebundle_(include, exclude)


def plot(title: str = "", width: float = 8.0, height: float = 4.2) -> tuple[Plot, Axes]:
    """Return a figure with a title and nothing in it, of a size in inches, and its axes; call it in PLOT_STYLE."""
    figure = Plot(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06))
    if title:
        figure.suptitle(title, x=0.015, ha="left", fontsize=11, fontweight="bold")
    return figure, figure.add_subplot()
