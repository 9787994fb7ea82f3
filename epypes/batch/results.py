"""Outcomes of items, as JSON, as a pandas table and as an HTML table."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, overload

from epypes.batch.items import Item
from epypes.batch.thumbnails import Thumbnail, data_uri
from epypes.display.previews import Look
from epypes.display.previews.preview import sketch
from epypes.display.previews.short import float_text
from epypes.display.text import content, duration_text, escape, fitted
from epypes.errors import ImageFileError, ScaleError
from epypes.graph import CompGraph
from epypes.nothing import Nothing
from epypes.optional import optional_import

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


class OutcomeSequence(Sequence[Outcome]):
    """The outcomes of a map or a sweep; ``outcomes`` has them as a tuple."""

    __slots__ = ()
    outcomes: tuple[Outcome, ...]

    @property
    def failures(self) -> tuple[Outcome, ...]:
        """The outcomes of what could not be read or on which a function failed."""
        return tuple(outcome for outcome in self.outcomes if outcome.has_failed)

    @overload
    def __getitem__(self, index: int) -> Outcome: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Outcome, ...]: ...
    def __getitem__(self, index: int | slice) -> Outcome | tuple[Outcome, ...]:
        return self.outcomes[index]

    def __len__(self) -> int:
        return len(self.outcomes)


def short_value(value: Any) -> Any:
    """Return a number, text or truth value as it is, and of anything else a short text."""
    value = _scalar(value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    return str(value) if isinstance(value, str) else short_text(value)


def short_text(value: Any) -> str:
    """Return a value in at most 30 characters."""
    return sketch(value, Look()).shown.text


def _scalar(value: Any) -> Any:
    """Return a number or truth value of numpy as Python's, and a very long number as text; anything else as it is."""
    if isinstance(value, int) and value.bit_length() > _MOST_BITS:
        return f"int of {value.bit_length():,} bits"
    if getattr(value, "shape", None) != () or not hasattr(value, "item"):
        return value
    item = value.item()
    return item if isinstance(item, bool | int | float) else value


_FRAME_COLUMNS: Final = ("frame", "time_s")


def fixed_columns(outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """Return the names of the columns that a table of outcomes has in any case."""
    return ("name", *_item_columns(outcomes), "failure", "total_ms")


def _item_columns(outcomes: Sequence[Outcome]) -> dict[str, list[Any]]:
    """Return the columns that there are: of series if there are several or they have keys, of frames, and of times."""
    columns = {name: [getattr(outcome, name) for outcome in outcomes] for name in _FRAME_COLUMNS}
    found = {name: values for name, values in columns.items() if any(value is not None for value in values)}
    series = [outcome.series for outcome in outcomes]
    # Of the frames of one video the names say it.
    has_series = len(set(series)) > 1 or ("frame" not in found and any(key != "" for key in series))
    return {"series": series, **found} if has_series else found


def outcomes_frame(
    outcomes: Sequence[Outcome], cg: CompGraph, extra: Mapping[str, Sequence[Any]] = MappingProxyType({})
) -> pd.DataFrame:
    """Return a table with one row per outcome.

    Parameters
    ----------
    outcomes
        The rows.
    cg
        The graph, which gives the order of sink tokens and functions.
    extra
        Columns by name, each with a value per outcome; they stand after ``name``.

    Returns
    -------
    pandas.DataFrame
        ``name``, ``series`` if there are some, of frames ``frame`` and ``time_s``, the extra columns, ``failure``
        (None, or what failed), one column per sink token, ``total_ms``, and ``"<function> ms"`` of what ran. A token
        that is called like another column has `` (token)`` after its name.
        Where nothing was found, or the run failed, the cell of the token is empty: None, NaN or NA.
    """
    fixed = fixed_columns(outcomes)
    columns: dict[str, Any] = {"name": [outcome.name for outcome in outcomes]}
    columns |= {column: _column(values) for column, values in _item_columns(outcomes).items()}
    columns |= {column: object_column(values) for column, values in extra.items()}
    columns["failure"] = object_column(
        [None if outcome.error_info is None else " ".join(str(outcome.error_info).split()) for outcome in outcomes]
    )
    for token in cg.sink_tokens:
        is_taken = token in columns or token in fixed
        columns[f"{token} (token)" if is_taken else token] = _column(
            [outcome.values.get(token) for outcome in outcomes]
        )
    columns["total_ms"] = [outcome.total_ns / 1e6 for outcome in outcomes]
    for function in cg.functions:
        columns[f"{function} ms"] = [outcome.times_ns.get(function, math.nan) / 1e6 for outcome in outcomes]
    return frame_of(columns)


def frame_of(columns: Mapping[str, Any]) -> pd.DataFrame:
    """Return a pandas table of columns by name."""
    with optional_import():
        import pandas as pd
    return pd.DataFrame(columns)


def _column(values: list[Any]) -> Any:
    """Return values as a column; integers and truth values of which some are missing stay what they are."""
    kinds = {type(value) for value in values if value is not None}
    if None in values and kinds in ({bool}, {int}):
        with optional_import():
            import pandas as pd
        with suppress(OverflowError):  # above 64 bits
            return pd.array(values, dtype="boolean" if bool in kinds else "Int64")
    return values


def object_column(values: Sequence[Any]) -> Any:
    """Return values as a column; where None is one of them it stays None, since NaN is another value."""
    if not any(value is None for value in values):
        return values
    with optional_import():
        import pandas as pd
    return pd.Series(list(values), dtype=object)


# -- tables as HTML -----------------------------------------------------------------------------------------------

_MOST_ROWS: Final = 100
_ROOM_OF_PICTURES: Final = 80_000
_CELL_ROOM: Final = 100
_FAILURE_ROOM: Final = 300
_LEFT: Final = ' style="text-align:left"'
# A red that is read on a white and on a black ground; the mark has the same meaning.
_FAILED: Final = ' style="text-align:left;color:var(--jp-error-color1,var(--vscode-errorForeground,#d9482b))"'
HtmlCell = str | Thumbnail | None


def html_table(
    caption: str,
    head: Sequence[str],
    rows: Sequence[Sequence[HtmlCell]],
    failures: Sequence[str] = (),
    *,
    most: int = _MOST_ROWS,
) -> str:
    """Return a table of texts and pictures as HTML, with as many pictures as there is room for.

    Parameters
    ----------
    caption, head
        Texts; a picture is described by its column and the first cell of its row.
    rows
        A cell per column.
    failures
        By row, what failed; empty texts where nothing did. These rows come first, and have one more column.
    most
        How many rows are shown.
    """
    reasons = failures if any(failures) else [""] * len(rows)
    order = sorted(range(len(rows)), key=lambda place: not reasons[place])
    titles = [*head, *(["failure"] if any(failures) else [])]
    lines = [f"<tr>{''.join(f'<th{_LEFT}>{content(title)}</th>' for title in titles)}</tr>"]
    room = _ROOM_OF_PICTURES
    for place in order[:most]:
        painted = ""
        for title, cell in zip(head, rows[place], strict=True):
            element = _html_cell(cell, f"{title} of {rows[place][0]}")
            if isinstance(cell, Thumbnail):
                element = element if len(element) <= room else ""
                room -= len(element)
            painted += f"<td{_LEFT}>{element}</td>"
        if any(failures):
            reason = reasons[place]
            painted += f"<td{_FAILED}>\u2717 {content(fitted(reason, _FAILURE_ROOM))}</td>" if reason else "<td></td>"
        lines.append(f"<tr>{painted}</tr>")
    above = f"<caption{_LEFT}>{content(fitted(caption, _FAILURE_ROOM))}</caption>" if caption else ""
    more = f"<p>and {len(rows) - most} more: to_frame() has all of them</p>" if len(rows) > most else ""
    return f"<table>{above}{''.join(lines)}</table>{more}"


def _html_cell(cell: HtmlCell, what: str) -> str:
    if isinstance(cell, Thumbnail):
        alt = escape(fitted(f"{what}: {cell.caption}", _CELL_ROOM))
        return f'<img src="{data_uri(cell)}" alt="{alt}" title="{alt}">'
    return content(fitted(cell or "", _CELL_ROOM))


def outcomes_html(outcomes: Sequence[Outcome], cg: CompGraph, caption: str) -> str:
    """Return a table of outcomes as HTML, with their thumbnails."""
    shown = [token for token in cg.tokens if any(token in outcome.thumbnails for outcome in outcomes)]
    # A sink token with a picture is described in the picture's title.
    sinks = [token for token in cg.sink_tokens if token not in shown]
    has_series, has_times = ("series" in _item_columns(outcomes), "time_s" in _item_columns(outcomes))
    rows = [
        [
            outcome.name,
            *([value_text(outcome.series)] if has_series else []),
            *([] if not has_times else ["" if outcome.time_s is None else f"{outcome.time_s:.3f} s"]),
            *(outcome.thumbnails.get(token) for token in shown),
            *(_cell_text(outcome, token) for token in sinks),
            duration_text(outcome.total_ns),
        ]
        for outcome in outcomes
    ]
    failures = ["" if outcome.error_info is None else str(outcome.error_info) for outcome in outcomes]
    times = [*(["series"] if has_series else []), *(["time of the frame"] if has_times else [])]
    return html_table(caption, ["name", *times, *shown, *sinks, "time"], rows, failures)


def _cell_text(outcome: Outcome, token: str) -> str:
    if token in outcome.nothing:
        return short_text(Nothing)
    return value_text(outcome.values[token]) if token in outcome.values else ""


def value_text(value: Any) -> str:
    """Return a value of an outcome or a setting as a table shows it: a float to six digits, a member by its name."""
    return float_text(value) if isinstance(value, float) else str(getattr(value, "name", value))
