"""Outcomes of items, as JSON, as a pandas table and as an HTML table; results of any kind that show themselves."""

from __future__ import annotations

import abc
import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar, overload

from epypes.batch.items import Item
from epypes.batch.thumbnails import LEAST_BYTES, Thumbnail, picture_element, smaller
from epypes.display.previews import Look
from epypes.display.previews.preview import sketch
from epypes.display.previews.short import float_text, reason
from epypes.display.text import content, duration_text, fitted
from epypes.errors import ImageFileError, ScaleError
from epypes.graph import CompGraph
from epypes.nothing import Nothing
from epypes.optional import optional_import
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd


# What reading a file raises.
_UNREADABLE: Final = frozenset({ImageFileError.__name__, ScaleError.__name__})
_NOT_STORED: Final = frozenset({"kept", "series", "state"})
# Python can be configured to refuse numbers of more than 640 digits.
_MOST_BITS: Final = 2_126


@dataclass(frozen=True, slots=True)
class ErrorInfo:
    """What failed.

    Attributes
    ----------
    function
        Its name in the graph; "" if the input could not be read, or is none that the graph takes.
    kind
        Name of the exception's class.
    message
        The exception's text.
    """

    function: str
    kind: str
    message: str

    @property
    def is_unreadable(self) -> bool:
        """Whether it is a file of the input that could not be read: with other hyperparameters it can't be either."""
        return not self.function and self.kind in _UNREADABLE

    def __str__(self) -> str:
        where = f"{self.function}: " if self.function else ""
        return f"{where}{self.kind}{': ' + self.message if self.message else ''}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one item under one setting.

    Attributes
    ----------
    number, name
        Of the item.
    setting
        The hyperparameters that were varied, by token; nothing in a map.
    values
        By sink token: a number, text or truth value as it is, of anything else a short text. Those of ``nothing`` are
        not among them.
    times_ns
        Nanoseconds by function that ran; what was reused from the setting before is not among them.
    total_ns
        Nanoseconds of the run, without reading files.
    error_info
        What failed; None if nothing did.
    thumbnails
        By token, if they were asked for.
    kept
        Whole values by token, if they were asked for.
    texts
        Of tokens whose thumbnails were asked for and that have no picture: a text instead.
    nothing
        The sink tokens whose value is Nothing; their cells of a table are empty.
    series
        The key of the item's series.
    frame, time_s
        Of a frame of a video or a camera, its number, from 0, and its time in s since the first one; else None.
    state
        Of a graph with state, what the next item of the series begins with; a map does not keep it.
    """

    number: int
    name: str
    setting: Mapping[str, Any] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)
    times_ns: Mapping[str, int] = field(default_factory=dict)
    total_ns: int = 0
    error_info: ErrorInfo | None = None
    thumbnails: Mapping[str, Thumbnail] = field(default_factory=dict)
    kept: Mapping[str, Any] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    nothing: tuple[str, ...] = ()
    frame: int | None = None
    time_s: float | None = None
    series: Any = ""
    state: Mapping[str, Any] = field(default_factory=dict)

    @property
    def has_failed(self) -> bool:
        """Whether something failed."""
        return self.error_info is not None

    def to_json(self) -> dict[str, Any]:
        """Return all but ``kept`` and the series as JSON can hold it."""
        setting = {token: short_value(value) for token, value in self.setting.items()}
        data = asdict(replace(self, setting=setting, times_ns=dict(self.times_ns), kept={}, series=None, state={}))
        for shown in data["thumbnails"].values():
            shown["data"] = base64.b64encode(shown["data"]).decode()
        return {name: part for name, part in data.items() if name not in _NOT_STORED}

    @staticmethod
    def from_json(data: Mapping[str, Any], item: Item, setting: Mapping[str, Any]) -> Outcome:
        """Return the outcome that ``to_json`` wrote, for the item and the setting that it was looked up for."""
        info = data["error_info"]
        thumbnails = {
            token: Thumbnail(**{**shown, "data": base64.b64decode(shown["data"])})
            for token, shown in data["thumbnails"].items()
        }
        error_info = None if info is None else ErrorInfo(**info)
        found = replace(Outcome(**data), number=item.number, name=item.name, setting=setting)
        found = replace(found, error_info=error_info, thumbnails=thumbnails, nothing=tuple(found.nothing))
        return replace(found, frame=item.frame, time_s=item.time_s, series=item.series)


def short_value(value: Any) -> Any:
    """Return a number, text or truth value as Python's own, and of anything else a short text."""
    if isinstance(value, int) and value.bit_length() > _MOST_BITS:
        return f"int of {value.bit_length():,} bits"
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        item = value.item()
        value = item if isinstance(item, bool | int | float) else value
    if value is None or type(value) in (bool, int, float, str):
        return value
    return str(value) if isinstance(value, str) else short_text(value)


def short_text(value: Any) -> str:
    """Return a value in at most 30 characters."""
    return sketch(value, Look()).shown.text


# -- results that show themselves ---------------------------------------------------------------------------------


class ShownAsPage(abc.ABC):
    """What a notebook shows as a page of HTML, and as text where that can't be made."""

    __slots__ = ()

    @abc.abstractmethod
    def _page(self) -> str:
        """Return the page."""

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        try:
            return {"text/plain": repr(self), "text/html": self._page()}
        except Exception as error:  # a notebook shows the result whatever is wrong with its pictures
            return {"text/plain": f"{self!r}\n(no picture: {reason(error)})"}


class HasFailed(Protocol):
    """A row of a result, such as an Outcome."""

    @property
    def has_failed(self) -> bool:
        """Whether something failed."""
        ...


_Row = TypeVar("_Row", bound=HasFailed)


class BatchResult(ShownAsPage, Sequence[_Row]):
    """The result of a map, a sweep, a check or a search: a sequence of rows that shows itself."""

    __slots__ = ()
    outcomes: tuple[_Row, ...]

    @property
    def _rows(self) -> tuple[_Row, ...]:
        """What it is a sequence of."""
        return self.outcomes

    @property
    @abc.abstractmethod
    def _caption(self) -> str:
        """What there is, in a line."""

    @property
    def failures(self) -> tuple[_Row, ...]:
        """The rows of what failed or has not passed."""
        return tuple(row for row in self._rows if row.has_failed)

    @overload
    def __getitem__(self, index: int) -> _Row: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[_Row, ...]: ...
    def __getitem__(self, index: int | slice) -> _Row | tuple[_Row, ...]:
        return self._rows[index]

    def __len__(self) -> int:
        return len(self._rows)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._caption}>"


# -- tables of pandas ---------------------------------------------------------------------------------------------


def frame_of(columns: Iterable[tuple[str, Any, str]]) -> pd.DataFrame:
    """Return a pandas table.

    Parameters
    ----------
    columns
        Name and values, and ``"token"`` or ``"hyperparameter"`` for what the user has named: if it is called like
        another column, it has that after its name. Where a list has None and numbers, None becomes NaN or NA.
    """
    with optional_import():
        import pandas as pd
    columns = list(columns)
    own = {name for name, _, kind in columns if not kind}
    found: dict[str, Any] = {}
    for name, values, kind in columns:
        kinds = {type(value) for value in values if value is not None} if type(values) is list else set()
        if kinds in ({bool}, {int}) and None in values:
            # Integers and truth values stay what they are, but for those above 64 bits.
            with suppress(OverflowError):
                values = pd.array(values, dtype="boolean" if bool in kinds else "Int64")
        found[f"{name} ({kind})" if kind and name in own else name] = values
    return pd.DataFrame(found)


def failure_column(reasons: Iterable[str]) -> tuple[str, Any, str]:
    """Return the column of what failed, on one line each; None where nothing did."""
    return "failure", object_column([" ".join(text.split()) or None for text in reasons]), ""


def object_column(values: Sequence[Any]) -> Any:
    """Return values as a column in which None stays None, since NaN is another value."""
    with optional_import():
        import pandas as pd
    return pd.Series(list(values), dtype=object) if any(value is None for value in values) else values


def outcomes_frame(
    outcomes: Sequence[Outcome], cg: CompGraph, varied: Mapping[str, Sequence[Any]] = MappingProxyType({})
) -> pd.DataFrame:
    """Return a table with one row per outcome.

    Parameters
    ----------
    outcomes
        The rows.
    cg
        The graph, which gives the order of sink tokens and functions.
    varied
        By hyperparameter that varies, a value per outcome; they stand after ``name``.

    Returns
    -------
    pandas.DataFrame
        ``name``, ``series`` if there are some, of frames ``frame`` and ``time_s``, the varied columns, ``failure``
        (None, or what failed), one column per sink token, ``total_ms``, and ``"<function> ms"`` of what ran. A token
        that is called like another column has `` (token)`` after its name.
        Where nothing was found, or the run failed, the cell of the token is empty: None, NaN or NA.
    """
    return frame_of([
        ("name", [outcome.name for outcome in outcomes], ""),
        *((name, values, "") for name, values in _item_columns(outcomes).items()),
        *((name, object_column(values), "hyperparameter") for name, values in varied.items()),
        failure_column("" if outcome.error_info is None else str(outcome.error_info) for outcome in outcomes),
        *((token, [outcome.values.get(token) for outcome in outcomes], "token") for token in cg.sink_tokens),
        ("total_ms", [outcome.total_ns / 1e6 for outcome in outcomes], ""),
        *(
            (f"{function} ms", [outcome.times_ns.get(function, math.nan) / 1e6 for outcome in outcomes], "")
            for function in cg.functions
        ),
    ])  # fmt: skip


def _item_columns(outcomes: Sequence[Outcome]) -> dict[str, list[Any]]:
    """Return the columns that there are: of series if there are several or they have keys, of frames, and of times."""
    columns = {name: [getattr(outcome, name) for outcome in outcomes] for name in ("frame", "time_s")}
    found = {name: values for name, values in columns.items() if any(value is not None for value in values)}
    series = [outcome.series for outcome in outcomes]
    # Of the frames of one video the names say it.
    has_series = len(set(series)) > 1 or ("frame" not in found and any(key != "" for key in series))
    return {"series": series, **found} if has_series else found


# -- tables as HTML -----------------------------------------------------------------------------------------------

_MOST_ROWS: Final = 100
_ROOM_OF_PICTURES: Final = 80_000
_ELEMENT_ROOM: Final = 110
# More of them are smaller, all of one size.
_MANY_PICTURES: Final = 24
_SMALL_PX: Final = 80
_CELL_ROOM: Final = 100
_FAILURE_ROOM: Final = 300
_LEFT: Final = ' style="text-align:left"'
# A red that is read on a white and on a black ground; the mark has the same meaning.
_FAILED: Final = ' style="text-align:left;color:var(--jp-error-color1,var(--vscode-errorForeground,#d9482b))"'
HtmlColumn = tuple[str, Sequence[str | Thumbnail | None]]


def html_table(caption: str, columns: Iterable[HtmlColumn], failures: Sequence[str] = ()) -> str:
    """Return a table of texts and pictures as HTML, with as many rows and pictures as there is room for.

    Parameters
    ----------
    caption
        What stands above it.
    columns
        Titles, and a cell per row. The more pictures there are, the smaller they are.
    failures
        By row, what failed; empty texts where nothing did. These rows come first, and have one more column.
    """
    titles, cells = zip(*columns, strict=True)
    rows = list(zip(*cells, strict=True))
    reasons = failures if any(failures) else [""] * len(rows)
    shown = sorted(range(len(rows)), key=lambda place: not reasons[place])[:_MOST_ROWS]
    head = [*titles, *(["failure"] if any(failures) else [])]
    lines = [f"<tr>{''.join(f'<th{_LEFT}>{content(title)}</th>' for title in head)}</tr>"]
    pictures = sum(isinstance(cell, Thumbnail) for place in shown for cell in rows[place])
    room, hidden, side_px = _ROOM_OF_PICTURES, 0, None if pictures <= _MANY_PICTURES else _SMALL_PX
    for place in shown:
        painted = ""
        for title, cell in zip(titles, rows[place], strict=True):
            if isinstance(cell, Thumbnail):
                text = f"{title} of {rows[place][0]}: {cell.caption}"
                # The description stands there twice.
                most_bytes = (_ROOM_OF_PICTURES // pictures - _ELEMENT_ROOM - 2 * len(text)) * 3 // 4
                element = picture_element(
                    smaller(cell, max(most_bytes, LEAST_BYTES)) or cell, text, _CELL_ROOM, side_px
                )
                element = element if len(element) <= room else ""
                room -= len(element)
                hidden += not element
            else:
                element = content(fitted(cell or "", _CELL_ROOM))
            painted += f"<td{_LEFT}>{element}</td>"
        if any(failures):
            text = reasons[place]
            painted += f"<td{_FAILED}>\u2717 {content(fitted(text, _FAILURE_ROOM))}</td>" if text else "<td></td>"
        lines.append(f"<tr>{painted}</tr>")
    above = f"<caption{_LEFT}>{content(fitted(caption, _FAILURE_ROOM))}</caption>" if caption else ""
    left_out = len(rows) - len(shown)
    more = f"<p>and {left_out} more: to_frame() has all of them</p>" if left_out else ""
    more += f"<p>and {counted(hidden, 'picture')} more, for which there is no room here</p>" if hidden else ""
    return f"<table>{above}{''.join(lines)}</table>{more}"


def outcomes_html(outcomes: Sequence[Outcome], cg: CompGraph, caption: str) -> str:
    """Return a table of outcomes as HTML, with their thumbnails."""
    of_items = _item_columns(outcomes)
    columns: list[HtmlColumn] = [("name", [outcome.name for outcome in outcomes])]
    if "series" in of_items:
        columns.append(("series", list(map(value_text, of_items["series"]))))
    if "time_s" in of_items:
        times_s = of_items["time_s"]
        columns.append(("time of the frame", ["" if time_s is None else f"{time_s:.3f} s" for time_s in times_s]))
    shown = [token for token in cg.tokens if any(token in outcome.thumbnails for outcome in outcomes)]
    columns += [(token, [outcome.thumbnails.get(token) for outcome in outcomes]) for token in shown]
    # A sink token with a picture is described in the picture's title.
    sinks = [token for token in cg.sink_tokens if token not in shown]
    columns += [(token, [_cell_text(outcome, token) for outcome in outcomes]) for token in sinks]
    columns.append(("time", [duration_text(outcome.total_ns) for outcome in outcomes]))
    failures = ["" if outcome.error_info is None else str(outcome.error_info) for outcome in outcomes]
    return html_table(caption, columns, failures)


def _cell_text(outcome: Outcome, token: str) -> str:
    if token in outcome.nothing:
        return short_text(Nothing)
    return value_text(outcome.values[token]) if token in outcome.values else ""


def value_text(value: Any) -> str:
    """Return a value of an outcome or a setting as a table shows it: a float to six digits, a member by its name."""
    return float_text(value) if isinstance(value, float) else str(getattr(value, "name", value))
