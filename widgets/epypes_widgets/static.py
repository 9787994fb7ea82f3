"""What does a saved notebook show of a panel where no kernel runs?

Nothing but text, borders and one picture: no script, no style sheet, no colours of its own, so that it is readable on
any ground, also where a page does not trust the notebook.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any, Final

from epypes.display.previews.model import Look
from epypes.display.previews.preview import sketch
from epypes.display.text import content, cut, escape, fitted, written_length
from epypes.errors import NotComputed
from epypes.graph import colour_order
from epypes.run import Run
from epypes_widgets.pictures import picture_of
from epypes_widgets.values import differing, said

# In a page a picture is a third longer. Together with 40 rows of 420 characters it stays below 120 kB.
_PICTURE_BYTES: Final = 72_000
_PICTURE_SIDE_PX: Final = 720
_MOST_ROWS: Final = 40
_NAME_CHARACTERS: Final = 40
# What a text takes in the page at most.
_CELL_ROOM: Final = 80
_TEXT_ROOM: Final = 800
# Within the picture, since an output cuts off what is around it.
_FRAME: Final = "max-width:100%;height:auto;outline:1px solid currentColor;outline-offset:-1px"
_LEFT: Final = ' style="text-align:left;padding:2px 12px 2px 0"'


def static_html(
    run: Run,
    token: str | None,
    values: Mapping[str, Any],
    defaults: Mapping[str, Any],
    *,
    image: str = "",
    code: str = "",
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
    """
    on = f" of {cut(image, _NAME_CHARACTERS)}" if image else ""
    picture = _shown(run, token, on) if token is not None else ""
    # Half a line of code is worse than none: the table has the values.
    is_told = code and written_length(code) <= _TEXT_ROOM
    line = f'<pre style="white-space:pre-wrap;font-family:monospace">{content(code)}</pre>' if is_told else ""
    return f'<figure class="epypes-static" style="margin:0">{picture}{_table(values, defaults)}{line}</figure>'


def _shown(run: Run, token: str, on: str) -> str:
    name = cut(token, _NAME_CHARACTERS)
    try:
        value = run[token]
    except NotComputed as error:
        return _caption(f"{name}{on}: {cut(str(error), 200)}")
    look = Look(colour_order(run.cg, token))
    about = f"{name}{on}: {sketch(value, look).shown.detail}"
    picture = picture_of(run, token, _PICTURE_SIDE_PX, _PICTURE_BYTES)
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
    kept = _most_telling(values, moved)
    rows = "".join(_row(name, values[name], defaults, name in moved) for name in values if name in kept)
    more = _cells("td", f"and {len(values) - len(kept)} more") if len(kept) < len(values) else ""
    head = _cells("th", "hyperparameter", "value", "since the start")
    return f'<table style="border-collapse:collapse">{head}{rows}{more}</table>'


def _most_telling(values: Mapping[str, Any], moved: set[str]) -> set[str]:
    """Return the names that are listed: those that were moved before all others."""
    first = sorted(values, key=lambda name: name not in moved)
    return set(first[:_MOST_ROWS])


def _row(name: str, value: Any, defaults: Mapping[str, Any], is_moved: bool) -> str:
    label = cut(name, _NAME_CHARACTERS)
    if not is_moved:
        return _cells("td", label, said(value), "")
    before, now = said(defaults[name]), said(value)
    change = f"● changed from {before}" if before != now else "● changed"
    return _cells("td", label, now, change)


def _cells(tag: str, *texts: str) -> str:
    return f"<tr>{''.join(f'<{tag}{_LEFT}>{content(fitted(text, _CELL_ROOM))}</{tag}>' for text in texts)}</tr>"
