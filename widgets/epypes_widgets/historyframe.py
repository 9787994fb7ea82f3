"""How does a history look as a table of pandas' that shows its thumbnails?"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import pandas as pd

from epypes.display import Picture
from epypes.display.text import escape

if TYPE_CHECKING:
    from epypes_widgets.history import Entry

_ABOUT: Final = ("at", "token", "image", "compute_ms", "label", "picture")
# Columns of these keep their type; all others are objects.
_COLUMN_TYPES: Final = (bool, int, float, str)
# pandas writes the table, and each picture in it as one sign that nobody uses (Unicode's private plane), so that
# escaping and shortening are left to pandas. The sign is replaced afterwards.
_FIRST_SIGN: Final = 0xF0000
_MOST_SIGNS: Final = 0xFFF0
_SIGN: Final = re.compile(f"[{chr(_FIRST_SIGN)}-{chr(_FIRST_SIGN + _MOST_SIGNS)}]")
_MOST_BYTES: Final = 200_000


class HistoryFrame(pd.DataFrame):
    """A DataFrame that shows the pictures in it as pictures; parts of it do so too."""

    @property
    def _constructor(self) -> Callable[..., HistoryFrame]:
        return HistoryFrame

    def _repr_html_(self) -> str | None:
        pictures: list[tuple[Picture, object]] = []
        plain = pd.DataFrame(self, copy=True)
        for place in range(plain.shape[1]):
            column = plain.iloc[:, place]
            if column.dtype == object:
                signs = [_signed(value, number, pictures) for number, value in column.items()]
                plain.isetitem(place, pd.Series(signs, dtype=object).array)
        html = plain._repr_html_()  # type: ignore[operator]
        return None if html is None else _with_pictures(html, pictures)


def frame_of(entries: Sequence[Entry]) -> HistoryFrame:
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
    return HistoryFrame({name: column.set_axis(numbers) for name, column in columns.items()}, index=numbers)


def _column(values: list[Any]) -> pd.Series[Any]:
    kinds = {type(value) for value in values}
    if len(kinds) == 1 and (kinds <= set(_COLUMN_TYPES) or hasattr(values[0], "tzinfo")):
        return pd.Series(values)
    column = pd.Series([None] * len(values), dtype=object)
    for place, value in enumerate(values):
        column.iat[place] = value  # one by one, since arrays and lists would be taken for rows
    return column


def _signed(value: Any, number: object, pictures: list[tuple[Picture, object]]) -> Any:
    if not isinstance(value, Picture) or len(pictures) >= _MOST_SIGNS:
        return value
    pictures.append((value, number))
    return chr(_FIRST_SIGN + len(pictures) - 1)


def _with_pictures(html: str, pictures: Sequence[tuple[Picture, object]]) -> str:
    shown = {ord(sign) - _FIRST_SIGN for sign in _SIGN.findall(html)} & set(range(len(pictures)))
    kept = _within(sorted(shown, reverse=True), pictures)

    def painted(sign: re.Match[str]) -> str:
        index = ord(sign[0]) - _FIRST_SIGN
        return _image(*pictures[index]) if index in kept else "(picture)" if index in shown else ""

    return _SIGN.sub(painted, html)


def _within(newest_first: Iterable[int], pictures: Sequence[tuple[Picture, object]]) -> set[int]:
    """Return which pictures fit into a cell's output, the newest before the older ones."""
    room, kept = _MOST_BYTES, set()
    for index in newest_first:
        room -= len(pictures[index][0].data)
        if room < 0:
            break
        kept.add(index)
    return kept


def _image(picture: Picture, number: object) -> str:
    data = base64.b64encode(picture.data).decode()
    return (
        f'<img src="data:{escape(picture.media_type)};base64,{data}" alt="picture of {escape(str(number)[:40])}" '
        f'width="{picture.width}" height="{picture.height}" style="max-width:none">'
    )
