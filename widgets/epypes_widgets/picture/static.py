"""The output beside a panel for a saved notebook, where no kernel runs: its last picture and values.

The widget alone leaves nothing there: beside it stands an output of plain HTML, which the live panel hides. It has
text, borders and one picture: no script and no colours of its own, so that it is readable on any ground, also where a
page does not trust the notebook. Where a page does, JupyterLab shows the widget's output, and finds no model for it: a
rule hides the error that it puts there. Where a page does not, it drops both the widget's output and the rule.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from typing import Any, Final

from epypes.display.previews import Look
from epypes.display.previews.preview import sketch
from epypes.display.text import content, cut, escape, fitted, written_length
from epypes.errors import NotComputed
from epypes.graph import colour_order
from epypes.run import Run
from epypes_widgets.picture.frames import still_picture
from epypes_widgets.picture.picture_settings import NO_LIMITS, Limits
from epypes_widgets.values import differing, short_text

# In a page a picture is a third longer. Together with 40 rows of 420 characters it stays below 120 kB.
_PICTURE_BYTES: Final = 72_000
_PICTURE_SIDE_PX: Final = 720
_MAX_ROWS: Final = 40
_NAME_CHARACTERS: Final = 80
# What a text takes in the page at most.
_CELL_ROOM: Final = 80
_TEXT_ROOM: Final = 800
# Within the picture, since an output cuts off what is around it.
_FRAME: Final = "max-width:100%;height:auto;outline:1px solid currentColor;outline-offset:-1px"
# True also where the panel lives and this can't be hidden, as in VS Code.
_KEPT: Final = (
    "<style>.jp-OutputArea-child:not(:has(.epypes-view:not(.epypes-void), .epypes-picker))"
    ":has(+ .jp-OutputArea-child .epypes-kept) {display: none}</style>"
    '<p style="margin:0 0 8px">Kept from the last run: run the cells up to this one to go on.</p>'
)
_LEFT: Final = ' style="text-align:left;padding:2px 12px 2px 0"'


class Displayed:
    """What shows its widget in a notebook, and a static output beside it."""

    _static: StaticOutput

    @property
    def widget(self) -> Any:
        """The widget that is shown, to be put into a layout of one's own."""
        raise NotImplementedError

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, Any]:
        shown = self.widget._repr_mimebundle_()
        bundle: dict[str, Any] = (shown[0] if isinstance(shown, tuple) else shown) or {}
        return {**bundle, "text/plain": repr(self)}

    def _ipython_display_(self) -> None:
        from IPython.display import display

        display(self._repr_mimebundle_(), raw=True)
        self._static.display()


class StaticOutput:
    """An output beside the panel, replaced from time to time.

    Parameters
    ----------
    html
        Returns what it shows now, below a line on what to do.
    """

    def __init__(self, html: Callable[[], str]) -> None:
        self._html = html
        self._handle: Any = None
        self._shown = ""

    def html(self) -> str:
        """Return what it shows now."""
        return f'<div class="epypes-kept">{_KEPT}{self._html()}</div>'

    def display(self) -> None:
        """Show it below the outputs of the running cell."""
        from IPython.display import HTML, display

        self._shown = self.html()
        self._handle = display(HTML(self._shown), display_id=True)

    def update(self) -> None:
        """Replace it where it is shown, if anything has changed."""
        from IPython.display import HTML

        if self._handle is not None and (new := self.html()) != self._shown:
            self._shown = new
            self._handle.update(HTML(new))


def static_html(
    run: Run,
    token: str | None,
    values: Mapping[str, Any],
    defaults: Mapping[str, Any],
    *,
    image: str = "",
    code: str = "",
    limits: Limits = NO_LIMITS,
) -> str:
    """Return one ``<figure class="epypes-static">`` of less than 120 kB: the picture of a token, and the values.

    The same run, token and values give the same bytes.

    Parameters
    ----------
    run
        The last one that completed.
    token
        Is shown as a picture if it is an image, else as text; None if nothing was shown.
    values, defaults
        By hyperparameter, now and at first. What differs is marked.
    image
        The title of the image that it was computed on; may be empty.
    code
        The equivalent code line; may be empty, and is left out if it is very long.
    limits
        By token, the values that are shown black and white where the user has set them.
    """
    on = f" of {cut(image, _NAME_CHARACTERS)}" if image else ""
    picture = _shown(run, token, on, limits) if token is not None else ""
    # Half a line of code is worse than none: the table has the values.
    fits = code and written_length(code) <= _TEXT_ROOM
    line = f'<pre style="white-space:pre-wrap;font-family:monospace">{content(code)}</pre>' if fits else ""
    return f'<figure class="epypes-static" style="margin:0">{picture}{_table(values, defaults)}{line}</figure>'


def _shown(run: Run, token: str, on: str, limits: Limits) -> str:
    name = cut(token, _NAME_CHARACTERS)
    try:
        value = run[token]
    except NotComputed as error:
        return _caption(f"{name}{on}: {cut(str(error), 200)}")
    look = Look(colour_order(run.cg, token))
    about = f"{name}{on}: {sketch(value, look).shown.detail}"
    picture = still_picture(run, token, _PICTURE_SIDE_PX, _PICTURE_BYTES, limits)
    if picture is None:
        return _caption(about)
    data = base64.b64encode(picture.data).decode()
    return (
        f'<img src="data:{escape(picture.media_type)};base64,{data}" alt="{escape(about)}" '
        f'width="{picture.width}" style="{_FRAME}">{_caption(about)}'
    )


def _caption(text: str) -> str:
    return f'<figcaption style="margin:4px 0 8px">{content(fitted(text, _TEXT_ROOM))}</figcaption>'


def _table(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> str:
    if not values:
        return ""
    moved = {name for name in differing(defaults, values) if name in defaults}
    # Those that were moved are listed before all others.
    listed = set(sorted(values, key=lambda name: name not in moved)[:_MAX_ROWS])
    rows = [("th", "hyperparameter", "value", "since the start")]
    for name in values:
        if name in listed:
            now, before = short_text(values[name]), short_text(defaults[name]) if name in moved else ""
            change = f"● changed from {before}" if before != now else "● changed"
            rows.append(("td", cut(name, _NAME_CHARACTERS), now, change if name in moved else ""))
    if len(listed) < len(values):
        rows.append(("td", f"and {len(values) - len(listed)} more", "", ""))
    cells = (
        "".join(f"<{tag}{_LEFT}>{content(fitted(text, _CELL_ROOM))}</{tag}>" for text in texts) for tag, *texts in rows
    )
    return f'<table style="border-collapse:collapse">{"".join(f"<tr>{row}</tr>" for row in cells)}</table>'
