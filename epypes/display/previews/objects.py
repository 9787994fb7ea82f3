"""Previews of plain values, containers, records and tables."""

from __future__ import annotations

import enum
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from typing import Any, Final

from epypes.display.previews import Look, Preview, Sketch
from epypes.display.previews.drawing import bar_chart
from epypes.display.previews.features import list_sketch
from epypes.display.previews.images import some_of, statistics_text
from epypes.display.previews.introspection import fields_of, is_of, items_in, kind_name, length_of, pairs_in, stored
from epypes.display.previews.short import float_text, reason, row_texts, short_repr, shown_items
from epypes.display.text import cut, memory_text
from epypes.nothing import NothingType
from epypes.wording import counted

_MOST_ROWS: Final = 4
# A tuple that is so short is written out on the vertex: the sides of a kernel, a size.
_PLAIN_TUPLE: Final = 4
_NUMBERS: Final = (int, float, bool)


def plain_preview(value: Any, look: Look) -> Preview:
    """Look at a number, a text, bytes or None."""
    if issubclass(type(type(value)), enum.EnumType):
        return enum_preview(value, look)
    short = short_repr(value)
    count = length_of(value)
    size = f" of {count}" if count > len(short) else ""
    return Preview(short, f"{_name(value)}{size} {short}")


def nothing_preview(value: NothingType, look: Look) -> Preview:
    """Look at what functions never receive."""
    return Preview("nothing found", "Nothing")


def float_preview(value: float, look: Look) -> Preview:
    """Look at a float."""
    if issubclass(type(type(value)), enum.EnumType) or not math.isfinite(value):
        return plain_preview(value, look)
    return Preview(float_text(value), f"{_name(value)} {float.__repr__(value)}")


def enum_preview(value: Any, look: Look) -> Preview:
    """Look at a member of an enumeration."""
    (name,), (content,) = stored(value, "_name_"), stored(value, "_value_")
    text = f"{_name(value)}.{name}"
    return Preview(text, f"{text} = {short_repr(content)}")


def exception_preview(value: BaseException, look: Look) -> Preview:
    """Look at an exception."""
    return Preview(reason(value), reason(value, 200))


def path_preview(value: Any, look: Look) -> Preview:
    """Look at a path."""
    text = os.fspath(value)
    return Preview(value.name or text, f"{_name(value)} {cut(text, 200)}")


def list_preview(value: Sequence[Any], look: Look) -> Sketch | Preview:
    """Look at a list: keypoints, matches, contours, a table of dicts, or any items."""
    # A subclass may have ways of its own to reach its items, which are not used.
    plain = value if type(value) is list else list(items_in(value))
    if is_dict_list(plain):
        return dict_list_sketch(plain)
    return list_sketch(plain, _name(value), look, lambda: items_preview(value, look)) or items_preview(value, look)


def tuple_preview(value: tuple[Any, ...], look: Look) -> Sketch | Preview:
    """Look at a tuple: a histogram, named fields, what a list may be, or any items."""
    plain = value if type(value) is tuple else tuple(items_in(value))
    if is_histogram(plain):
        return histogram_sketch((plain[0], plain[1]))
    fields = fields_of(value)
    if fields is not None:
        return _fields(value, fields)
    if 0 < len(plain) <= _PLAIN_TUPLE and all(type(item) in _NUMBERS for item in plain):
        return Preview(short_repr(plain), f"tuple {short_repr(plain)}")
    return list_sketch(plain, _name(value), look, lambda: items_preview(value, look)) or items_preview(value, look)


def dict_preview(value: Any, look: Look) -> Preview:
    """Look at a mapping."""
    count = length_of(value) or len(value)
    rows = row_texts(_item_rows(value), count, _MOST_ROWS) or ("(empty)",)
    keys = ", ".join(short_repr(key) for key, _ in itertools.islice(pairs_in(value), 8))
    return Preview(f"{_name(value)} of {count}", cut(f"{_name(value)} of {count}: {keys}", 200), rows=rows)


def object_preview(value: Any, look: Look) -> Preview:
    """Look at any other object."""
    fields = fields_of(value)
    if fields is not None:
        return _fields(value, fields)
    text, kind = short_repr(value), _name(value)
    return Preview(text, text if text.startswith(kind) else f"{kind} {text}")


def _fields(value: Any, fields: dict[str, Any]) -> Preview:
    text = _name(value)
    detail = ", ".join(f"{name}: {short_repr(item)}" for name, item in itertools.islice(fields.items(), 8))
    return Preview(text, cut(f"{text}: {detail}", 280), rows=row_texts(_item_rows(fields), len(fields), _MOST_ROWS))


def items_preview(value: Any, look: Look) -> Preview:
    """Look at a list, a tuple or a set by its items."""
    count = length_of(value)
    text, rows = f"{_name(value)} of {count}", row_texts(map(short_repr, shown_items(value)), count, _MOST_ROWS)
    return Preview(text, f"{text}: {short_repr(value)}", rows=rows or ("(empty)",))


def _item_rows(mapping: Any) -> Iterator[str]:
    for key, value in pairs_in(mapping):
        yield f"{_label(key)}: {short_repr(value)}"


def _name(value: Any) -> str:
    return cut(kind_name(type(value)), 20)


def histogram_sketch(value: tuple[Any, Any]) -> Sketch:
    """Look at counts and edges as ``np.histogram`` returns them."""
    counts, edges = value
    text = f"{len(counts)} bins"
    detail = f"histogram of {text}, from {edges[0]:.4g} to {edges[-1]:.4g}, {statistics_text(some_of(counts), counts)}"
    return Sketch(Preview(text, detail), lambda most_bytes: bar_chart(counts))


def is_histogram(value: Any) -> bool:
    """Whether a value is what ``np.histogram`` returns."""
    if len(value) != 2 or not all(is_of(part, "numpy", "ndarray") and part.ndim == 1 for part in value):
        return False
    counts, edges = value
    return len(edges) == len(counts) + 1 and all(part.dtype.kind in "iuf" for part in value)


# -- tables -----------------------------------------------------------------------------------------------------------

_MOST_COLUMNS: Final = 4
_NAMED: Final = 8
_ROWS: Final = 3
_ROW_CHARACTERS: Final = 60


def frame_preview(frame: Any, look: Look) -> Preview:
    """Look at a table of pandas."""
    names = [_label(name) for name in itertools.islice(frame.columns, _NAMED)]
    kinds = [str(kind) for kind in itertools.islice(frame.dtypes, _NAMED)]
    columns = ", ".join(f"{cut(name, 20)} {kind}" for name, kind in zip(names, kinds, strict=True))
    rows = frame.iloc[:_ROWS, :_MOST_COLUMNS].itertuples(index=False, name=None)
    return _table(len(frame), frame.shape[1], names, list(rows), f"DataFrame: {columns}")


def series_preview(series: Any, look: Look) -> Preview:
    """Look at a column of pandas."""
    rows = (f"{short_repr(key)}: {_cell(value)}" for key, value in series.iloc[:_MOST_ROWS].items())
    name = "" if series.name is None else f" {cut(_label(series.name), 20)}"
    detail = f"Series{name}: {series.dtype}, {counted(len(series), 'row')}, {memory_text(series.nbytes)}"
    return Preview(f"Series, {counted(len(series), 'row')}", detail, rows=row_texts(rows, len(series), _MOST_ROWS))


def record_sketch(array: Any) -> Preview:
    """Look at an array with named fields."""
    names = list(array.dtype.names)
    rows = [tuple(row[name] for name in names[:_MOST_COLUMNS]) for row in array.flat[:_ROWS]]
    fields = ", ".join(f"{cut(name, 20)} {array.dtype[name]}" for name in names[:_NAMED])
    return _table(array.size, len(names), names, rows, f"array of {memory_text(array.nbytes)}: {fields}")


def is_dict_list(value: Sequence[Any]) -> bool:
    """Whether a list is a table: a few dicts of the same texts as keys, as far as its first items show."""
    first = value[0] if len(value) else None
    if type(first) is not dict or not first or not all(type(key) is str for key in first):
        return False
    return all(type(row) is dict and row.keys() == first.keys() for row in value[:_NAMED])


def dict_list_sketch(value: Sequence[dict[str, Any]]) -> Preview:
    """Look at a list of dicts of the same keys."""
    names = list(value[0])
    rows = [tuple(row[name] for name in names[:_MOST_COLUMNS]) for row in value[:_ROWS]]
    return _table(len(value), len(names), names, rows, f"list of {len(value)} dicts: {', '.join(names[:_NAMED])}")


def _table(count: int, columns: int, names: list[str], rows: list[tuple[Any, ...]], detail: str) -> Preview:
    text = f"{counted(count, 'row')} x {columns} columns"
    more = ", ..." if columns > _NAMED else ""
    lines = [[cut(name, 10) for name in names[:_MOST_COLUMNS]], *([_cell(value) for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    shown = ("  ".join(map(str.ljust, line, widths)).rstrip()[:_ROW_CHARACTERS] for line in lines)
    return Preview(text, cut(f"{detail}{more}; {text}", 280), rows=tuple(shown))


def _cell(value: Any) -> str:
    if is_of(value, "numpy", "generic"):
        value = value.item()
    return cut(f"{value:.4g}" if type(value) is float else _label(value), 12)


def _label(value: Any) -> str:
    return value if type(value) is str else short_repr(value)
