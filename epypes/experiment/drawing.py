"""What do all figures of an experiment have in common: how do they look, and how do they show themselves?

They are Matplotlib's, made without pyplot, so nothing is shown twice and no figure stays open. Colours are Okabe and
Ito's, which people with any colour vision tell apart. The ground is white, so that text is readable in a dark notebook
and on any page.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from types import MappingProxyType
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

BLUE: Final = "#0072b2"
ORANGE: Final = "#e69f00"
GREEN: Final = "#009e73"
RED: Final = "#c44e00"
INK: Final = "#1f2328"
GREY: Final = "#525a64"

# All else is Matplotlib's default, whatever users have set for figures of their own.
_STYLE: Final[Any] = MappingProxyType(
    {
        "axes.edgecolor": GREY,
        "axes.labelcolor": INK,
        "axes.linewidth": 0.8,
        "axes.spines.right": False,
        "axes.spines.top": False,
        "axes.titlecolor": GREY,
        "legend.fontsize": 9,
        "legend.frameon": False,
        "legend.labelcolor": INK,
        # The same figure has the same names inside its SVG.
        "svg.hashsalt": "epypes",
        "text.color": INK,
        "xtick.color": GREY,
        "xtick.labelcolor": INK,
        "ytick.color": GREY,
        "ytick.labelcolor": INK,
    }
)


@contextmanager
def in_style() -> Iterator[None]:
    """Draw in the style of these figures, whatever the user's own is."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


class Drawing(Figure):
    """A figure of Matplotlib that shows itself in a notebook, whether pyplot has been imported or not."""

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save the figure as Matplotlib does, in its own style."""
        with in_style():
            super().savefig(fname, **options)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        # The PNG is for pages that show no SVG, such as that of a notebook which is not trusted.
        svg, png = self._saved("svg", metadata={"Date": None}), self._saved("png")
        return {"text/plain": repr(self), "image/svg+xml": svg.decode(), "image/png": png}

    def _saved(self, kind: str, **options: Any) -> bytes:
        file = BytesIO()
        self.savefig(file, format=kind, **options)
        return file.getvalue()


def blank(title: str) -> tuple[Drawing, Axes]:
    """Return a figure with a title and nothing in it, and its axes."""
    figure = Drawing(figsize=(8, 4.2), dpi=100, layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06))
    figure.suptitle(title, x=0.015, ha="left", fontsize=11, fontweight="bold")
    return figure, figure.add_subplot()


def told(figure: Drawing, axes: Axes, why: str) -> Drawing:
    """Return the figure with a sentence instead of axes: why there is nothing to draw."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, why, ha="center", va="center", transform=axes.transAxes)
    return figure


def finished(figure: Drawing, axes: Axes, *notes: str, columns: int = 3) -> Drawing:
    """Return the figure with notes above its axes, and with its legend in so many columns below them."""
    axes.set_title("; ".join(filter(None, notes)), loc="left", fontsize=9)
    figure.legend(loc="outside lower left", ncols=columns, handlelength=1.6, columnspacing=1.4)
    return figure
