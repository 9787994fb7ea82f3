"""What is shown of a table?"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final

from epypes.display.markup import cut
from epypes.display.previews.kinds import is_of
from epypes.display.previews.registry import ours
from epypes.display.previews.short import short_repr
from epypes.display.previews.shown import Look, Preview
from epypes.display.previews.statistics import memory_text
from epypes.wording import counted

_MOST_COLUMNS: Final = 4
_NAMED: Final = 8
_ROWS: Final = 3
_ROW_CHARACTERS: Final = 60


# pandas 3 says where a class is imported from, earlier ones where it is defined.
@ours("pandas.DataFrame", "pandas.core.frame.DataFrame")
def _frame(frame: Any, look: Look) -> Preview:
    names = [_label(name) for name in itertools.islice(frame.columns, _NAMED)]
    kinds = [str(kind) for kind in itertools.islice(frame.dtypes, _NAMED)]
    columns = ", ".join(f"{cut(name, 20)} {kind}" for name, kind in zip(names, kinds, strict=True))
    rows = frame.iloc[:_ROWS, :_MOST_COLUMNS].itertuples(index=False, name=None)
    return _table(len(frame), frame.shape[1], names, list(rows), f"DataFrame: {columns}")


@ours("pandas.Series", "pandas.core.series.Series")
def _series(series: Any, look: Look) -> Preview:
    rows = [f"{short_repr(key)}: {_cell(value)}" for key, value in series.iloc[:_ROWS].items()]
    name = "" if series.name is None else f" {cut(_label(series.name), 20)}"
    more = [f"... {len(series) - _ROWS} more"] * (len(series) > _ROWS)
    said = f"Series{name}: {series.dtype}, {counted(len(series), 'row')}, {memory_text(series.nbytes)}"
    return Preview(f"Series, {counted(len(series), 'row')}", said, rows=(*rows, *more))


def record_sketch(array: Any) -> Preview:
    """Look at an array with named fields."""
    names = list(array.dtype.names)
    rows = [tuple(row[name] for name in names[:_MOST_COLUMNS]) for row in array.flat[:_ROWS]]
    fields = ", ".join(f"{cut(name, 20)} {array.dtype[name]}" for name in names[:_NAMED])
    return _table(array.size, len(names), names, rows, f"array of {memory_text(array.nbytes)}: {fields}")


def is_dict_list(value: Sequence[Any]) -> bool:
    """Whether a list is a table: a few dicts of the same texts as keys, as far as its first items tell."""
    first = value[0] if len(value) else None
    if type(first) is not dict or not first or not all(type(key) is str for key in first):
        return False
    return all(type(row) is dict and row.keys() == first.keys() for row in value[:_NAMED])


def dict_list_sketch(value: Sequence[dict[str, Any]]) -> Preview:
    """Look at a list of dicts of the same keys."""
    names = list(value[0])
    rows = [tuple(row[name] for name in names[:_MOST_COLUMNS]) for row in value[:_ROWS]]
    return _table(len(value), len(names), names, rows, f"list of {len(value)} dicts: {', '.join(names[:_NAMED])}")


def _table(count: int, columns: int, names: list[str], rows: list[tuple[Any, ...]], said: str) -> Preview:
    text = f"{counted(count, 'row')} x {columns} columns"
    more = ", ..." if columns > _NAMED else ""
    kept = [[cut(name, 10) for name in names[:_MOST_COLUMNS]], *([_cell(value) for value in row] for row in rows)]
    return Preview(text, cut(f"{said}{more}; {text}", 280), rows=tuple(map(_line, _padded(kept))))


def _padded(lines: list[list[str]]) -> list[list[str]]:
    """Return cells of the same width in each column."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [[cell.ljust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]


def _line(cells: list[str]) -> str:
    return "  ".join(cells).rstrip()[:_ROW_CHARACTERS]


def _cell(value: Any) -> str:
    if is_of(value, "numpy", "generic"):
        value = value.item()
    return cut(f"{value:.4g}" if type(value) is float else _label(value), 12)


def _label(value: Any) -> str:
    return value if type(value) is str else short_repr(value)
