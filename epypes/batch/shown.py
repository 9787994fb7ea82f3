"""How do outcomes look as a table in a notebook?"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from typing import Any, Final

from epypes.batch.outcome import Outcome, Thumbnail
from epypes.display.durations import duration_text
from epypes.display.markup import content, escape
from epypes.display.previews.short import float_text
from epypes.graph import CompGraph

_MOST_ROWS: Final = 30
_THUMBNAIL_CHARACTERS: Final = 80_000
_MESSAGE_CHARACTERS: Final = 160
_ERROR: Final = "var(--jp-error-color1,var(--vscode-errorForeground,#cf222e))"
_LEFT: Final = ' style="text-align:left"'


def rows_shown(outcomes: Sequence[Outcome], cg: CompGraph, caption: str) -> str:
    """Return a table as HTML: the failed and the first others, in order, with the thumbnails there is room for."""
    chosen = _chosen(outcomes)
    shown = [token for token in cg.tokens if any(token in outcome.thumbnails for outcome in chosen)]
    # A sink token with a picture says the rest in the picture's title.
    sinks = [token for token in cg.sink_tokens if token not in shown]
    head = _row("th", ["name", *shown, *sinks, "time"])
    room, rows = _THUMBNAIL_CHARACTERS, []
    for outcome in chosen:
        pictures = [_picture(outcome.thumbnails.get(token)) for token in shown]
        room -= sum(map(len, pictures))
        rows.append(_outcome_row(outcome, pictures if room >= 0 else [""] * len(shown), sinks))
    left_out = len(outcomes) - len(chosen)
    more = f"<p>and {left_out} more: to_frame() has all of them</p>" if left_out else ""
    return f"<table><caption>{content(caption)}</caption>{head}{''.join(rows)}</table>{more}"


def _chosen(outcomes: Sequence[Outcome]) -> list[Outcome]:
    if len(outcomes) <= _MOST_ROWS:
        return list(outcomes)
    places = [place for place, outcome in enumerate(outcomes) if outcome.has_failed][: _MOST_ROWS // 2]
    others = (place for place, outcome in enumerate(outcomes) if not outcome.has_failed)
    places += [place for place, _ in zip(others, range(_MOST_ROWS - len(places)), strict=False)]
    return [outcomes[place] for place in sorted(places)]


def _outcome_row(outcome: Outcome, pictures: list[str], sinks: Sequence[str]) -> str:
    name = content(outcome.name)
    if outcome.trouble is None:
        values = [content(value_text(outcome.values[token])) if token in outcome.values else "" for token in sinks]
        return _row("td", [name, *pictures, *values, duration_text(outcome.total_ns)])
    said = " ".join(str(outcome.trouble).split())
    cut = said if len(said) <= _MESSAGE_CHARACTERS else f"{said[:_MESSAGE_CHARACTERS]}..."
    style = f'style="text-align:left;color:{_ERROR}" title="{escape(said)}"'
    failure = f'<td colspan="{len(sinks) + 1}" {style}>\u2717 {content(cut)}</td>'
    cells = "".join(f"<td{_LEFT}>{cell}</td>" for cell in (name, *pictures))
    return f"<tr>{cells}{failure}</tr>"


def _row(kind: str, cells: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<{kind}{_LEFT}>{cell}</{kind}>' for cell in cells)}</tr>"


def _picture(shown: Thumbnail | None) -> str:
    return (
        ""
        if shown is None
        else f'<img src="{data_uri(shown)}" alt="{escape(shown.caption)}" title="{escape(shown.caption)}">'
    )


def data_uri(shown: Thumbnail) -> str:
    """Return a thumbnail as the address that an image element of a page has."""
    return f"data:{shown.media_type};base64,{base64.b64encode(shown.data).decode()}"


def value_text(value: Any) -> str:
    """Return a value of an outcome as a table shows it: a float to six digits."""
    text = float_text(value) if isinstance(value, float) else str(value)
    return text if len(text) <= _MESSAGE_CHARACTERS else f"{text[:_MESSAGE_CHARACTERS]}..."
