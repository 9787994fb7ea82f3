"""How does what came of a labelled set look in a notebook?"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from epypes.batch.differing import LEGEND
from epypes.batch.measuring import CheckOutcome
from epypes.display.markup import content, escape, fitted
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.batch.checking import CheckResult

_MOST_ROWS: Final = 100
_MOST_PICTURE_BYTES: Final = 60_000
_CELL_ROOM: Final = 100
_REASON_ROOM: Final = 300
_PICTURES: Final = ("expected", "got", "difference")
_HEAD: Final = ("case", "check", "value", "must be", "passed", *_PICTURES)
_LEFT: Final = ' style="text-align:left"'
# Colours that are read on a white and on a black ground; the sign and the word say the same.
_PASSED: Final = '<span style="color:#2e8b57">✓</span> passed'
_FAILED: Final = '<b style="color:#d9482b">✗</b> <b>failed</b>'


def check_html(result: CheckResult) -> str:
    """Return a table with a row per check, those that have not passed first, of at most about 120 kB."""
    outcomes = sorted(result.outcomes, key=lambda outcome: outcome.passed)
    room = _MOST_PICTURE_BYTES
    rows = []
    for outcome in outcomes[:_MOST_ROWS]:
        row, room = _row(outcome, room)
        rows.append(row)
    has_pictures = [any(outcome.pictures.get(name) for outcome in outcomes[:_MOST_ROWS]) for name in _PICTURES]
    head = "".join(f"<th{_LEFT}>{name}</th>" for name in _shown(_HEAD, has_pictures))
    more = len(outcomes) - _MOST_ROWS
    body = "".join(
        f"<tr>{''.join(f'<td{_LEFT}>{cell}</td>' for cell in _shown(row, has_pictures))}</tr>" for row in rows
    )
    below = f"<tr><td{_LEFT}>and {counted(more, 'check')} more</td></tr>" if more > 0 else ""
    legend = f"<p>difference of masks: {LEGEND}</p>" if has_pictures[-1] else ""
    caption = content(fitted(str(result), _REASON_ROOM))
    return f"<table><caption{_LEFT}>{caption}</caption><tr>{head}</tr>{body}{below}</table>{legend}"


def _shown(cells: Sequence[str], has_pictures: Sequence[bool]) -> list[str]:
    """Return the cells of a row without the columns of pictures in which there is none."""
    first = len(cells) - len(_PICTURES)
    return [*cells[:first], *(cell for cell, is_there in zip(cells[first:], has_pictures, strict=True) if is_there)]


def _row(outcome: CheckOutcome, room: int) -> tuple[list[str], int]:
    """Return the cells of a check, and how many bytes of pictures there is still room for."""
    value = "" if outcome.value is None else f"{outcome.value:.6g}"
    verdict = _PASSED if outcome.passed else f"{_FAILED}<br>{content(fitted(outcome.reason, _REASON_ROOM))}"
    cells = [content(fitted(text, _CELL_ROOM)) for text in (outcome.case, outcome.check, value, outcome.threshold)]
    cells.append(verdict)
    for name in _PICTURES:
        picture = outcome.pictures.get(name)
        size = 0 if picture is None else len(picture.data) * 4 // 3
        if picture is None or size > room:
            cells.append("")
            continue
        room -= size
        about = f"{name} of {outcome.case}: {picture.caption}"
        data = base64.b64encode(picture.data).decode()
        cells.append(f'<img src="data:{picture.media_type};base64,{data}" alt="{escape(fitted(about, _CELL_ROOM))}">')
    return cells, room
