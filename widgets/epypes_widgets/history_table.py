"""The history as a table of pandas that shows its thumbnails."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import pandas as pd

from epypes.display import Picture
from epypes.display.text import escape

if TYPE_CHECKING:
    from epypes_widgets.history import Entry

_ABOUT: Final = ("at", "token", "image", "compute_ms", "label", "picture")
# Columns of these keep their type; all others are objects.
_COLUMN_TYPES: Final = (bool, int, float, str)
# pandas writes the table, and each picture in it as one sign without a meaning (Unicode's private plane), so that
# escaping and shortening are left to pandas. The sign is replaced afterwards.
_FIRST_SIGN: Final = 0xF0000
_MAX_SIGNS: Final = 0xFFF0
_SIGNS: Final = re.compile(f"[{chr(_FIRST_SIGN)}-{chr(_FIRST_SIGN + _MAX_SIGNS)}]")
_MAX_BYTES: Final = 200_000


class HistoryTable(pd.DataFrame):
    """A DataFrame that shows the pictures in it as pictures; parts of it do so too."""

    @property
    def _constructor(self) -> Callable[..., HistoryTable]:
        return HistoryTable

    def _repr_html_(self) -> str | None:
        pictures: list[tuple[Picture, object]] = []
        plain = pd.DataFrame(self, copy=True)
        for place in range(plain.shape[1]):
            column = plain.iloc[:, place]
            if column.dtype == object:
                signs = [_sign(value, number, pictures) for number, value in column.items()]
                plain.isetitem(place, pd.Series(signs, dtype=object).array)
        html = plain._repr_html_()  # type: ignore[operator]
        return None if html is None else _with_pictures(html, pictures)


def table_of(entries: Sequence[Entry]) -> HistoryTable:
    """Return the table of entries of a history; see ``History.to_frame``."""
    names = dict.fromkeys(name for entry in entries for name in entry.values)
    columns = {name: _column([entry.values.get(name) for entry in entries]) for name in names}
    for about in _ABOUT:
        column = about
        while column in names:
            column += "_"
        columns[column] = _column([getattr(entry, about) for entry in entries])
    numbers = pd.Index([entry.number for entry in entries], dtype="int64", name="number")
    # By place, since the columns have no index of their own.
    return HistoryTable({name: column.set_axis(numbers) for name, column in columns.items()}, index=numbers)


def _column(values: list[Any]) -> pd.Series[Any]:
    kinds = {type(value) for value in values}
    if len(kinds) == 1 and (kinds <= set(_COLUMN_TYPES) or hasattr(values[0], "tzinfo")):
        return pd.Series(values)
    column = pd.Series([None] * len(values), dtype=object)
    for place, value in enumerate(values):
        column.iat[place] = value  # one by one, since arrays and lists would be taken for rows
    return column


def _sign(value: Any, number: object, pictures: list[tuple[Picture, object]]) -> Any:
    if not isinstance(value, Picture) or len(pictures) >= _MAX_SIGNS:
        return value
    pictures.append((value, number))
    return chr(_FIRST_SIGN + len(pictures) - 1)


def _with_pictures(html: str, pictures: Sequence[tuple[Picture, object]]) -> str:
    """Return a table with pictures for their signs, the newest first as long as they fit into a cell's output."""
    room, painted = _MAX_BYTES, dict[str, str]()
    for place in sorted({ord(sign) - _FIRST_SIGN for sign in _SIGNS.findall(html)}, reverse=True):
        if place >= len(pictures):  # a sign of the user's own
            continue
        picture, number = pictures[place]
        room -= len(picture.data)
        painted[chr(_FIRST_SIGN + place)] = _image(picture, number) if room >= 0 else "(picture)"
    return _SIGNS.sub(lambda sign: painted.get(sign[0], ""), html)


def _image(picture: Picture, number: object) -> str:
    data = base64.b64encode(picture.data).decode()
    return (
        f'<img src="data:{escape(picture.media_type)};base64,{data}" alt="picture of {escape(str(number)[:40])}" '
        f'width="{picture.width}" height="{picture.height}" style="max-width:none">'
    )
