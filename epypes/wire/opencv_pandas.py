"""Objects of OpenCV and pandas in messages: keypoints and matches as rows of a tensor, tables column by column.

Neither library is imported to write: such an object only exists once its library has been imported.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError
from epypes.wire.arrays import read_tensor, write_tensor
from epypes.wire.limits import Path, format_path

if TYPE_CHECKING:
    from epypes.wire.arrays import AnyArray
    from epypes.wire.decoder import ValueReader
    from epypes.wire.encoder import ValueWriter

# The fields of each record class in the order of its constructor's parameters, and the places of the integers.
# Each is a C float or a C int, and "<f8" holds both to the last bit.
FIELDS: Final = {
    "KeyPoint": ("x", "y", "size", "angle", "response", "octave", "class_id"),
    "DMatch": ("queryIdx", "trainIdx", "imgIdx", "distance"),
}
_INTEGERS: Final = {"KeyPoint": (5, 6), "DMatch": (0, 1, 2)}
# Records.Holder in the schema; 0 is a record that stands alone.
_HOLDERS: Final[dict[int, Callable[[Any], Any]]] = {1: list, 2: tuple}
_HOLDER_NUMBERS: Final[dict[type, int]] = {list: 1, tuple: 2}

_TEXT_DTYPES: Final = ("str", "string")
_TIME_DTYPE: Final = re.compile(r"(datetime64|timedelta64)\[(s|ms|us|ns)\]")
# Errors of pandas for data that it can't make a table of.
_PANDAS_ERRORS: Final = (ValueError, TypeError, OverflowError, LookupError, MemoryError, AttributeError)


def record_type(value: object) -> str:
    """Return the name of the OpenCV class of a keypoint or match; ``""`` for any other value."""
    kind = type(value)
    name = kind.__name__
    return name if name in FIELDS and getattr(sys.modules.get("cv2"), name, None) is kind else ""


def record_fields(record: Any) -> tuple[float, ...]:
    """Return the fields of a keypoint or a match, in the order of FIELDS."""
    if type(record).__name__ == "DMatch":
        return (record.queryIdx, record.trainIdx, record.imgIdx, record.distance)
    return (*record.pt, record.size, record.angle, record.response, record.octave, record.class_id)


def are_records(value: Sequence[Any]) -> bool:
    """Return whether all items of a sequence, or all items of all sequences in it, are records of one class."""
    first = value[0] if value else None
    if type(first) in _HOLDER_NUMBERS:
        inner = first[0] if first else None
        same = record_type(inner) and all(type(item) is type(first) for item in value)
        return bool(same) and all(type(record) is type(inner) for item in value for record in item)
    return bool(record_type(first)) and all(type(record) is type(first) for record in value)


def write_records(writer: ValueWriter, message: Any, value: Any, path: Path) -> None:
    """Write a record, a sequence of records or a sequence of such sequences into a Value message."""
    import numpy as np

    content = message.records
    content.outer = _HOLDER_NUMBERS.get(type(value), 0)
    records = value if content.outer else [value]
    if type(records[0]) in _HOLDER_NUMBERS:
        content.inner = _HOLDER_NUMBERS[type(records[0])]
        content.counts.extend(map(len, records))
        records = [record for item in records for record in item]
    content.type = type(records[0]).__name__
    write_tensor(writer, content.rows, np.array([*map(record_fields, records)], "<f8"), path)


def read_records(reader: ValueReader, content: Any, path: Path) -> Any:
    """Return the records of a Records message, in the sequences that held them.

    Raises
    ------
    MessageError
        Of reason ``"bad record"`` for anything that `write_records` does not write, ``"no opencv"`` where OpenCV is
        not installed.
    """
    where, name = format_path(path), content.type
    if name not in FIELDS:
        raise MessageError("bad record", f"{where} is of type {name[:40]!r}; known are {', '.join(FIELDS)}.")
    rows = read_tensor(reader, content.rows, path)
    _check_rows(rows, name, where)
    reader.counter.count(path, len(rows) + len(content.counts))
    outer, inner = _HOLDERS.get(content.outer), _HOLDERS.get(content.inner)
    known = {0, *_HOLDERS} >= {content.outer, content.inner}
    wanted = sum(content.counts) if inner else len(rows) if outer else 1
    if not known or wanted != len(rows) or (inner and not outer) or (content.counts and not inner):
        raise MessageError("bad record", f"{where} has {len(rows)} rows, which is not the number that it declares.")
    records = _made_records(rows, name, where)
    if outer is None:
        return next(records)
    return outer(records if inner is None else [inner(islice(records, count)) for count in content.counts])


def _check_rows(rows: Any, name: str, where: str) -> None:
    import numpy as np

    columns = len(FIELDS[name])
    if rows.dtype.str != "<f8" or rows.ndim != 2 or rows.shape[1] != columns:
        text = f"{where} has rows of {rows.dtype.str} {rows.shape}; a {name} is {columns} numbers of '<f8'."
        raise MessageError("bad record", text)
    integers = [*_INTEGERS[name]]
    floats = [column for column in range(columns) if column not in integers]
    with np.errstate(all="ignore"):
        whole, real = rows[:, integers], rows[:, floats]
        fits = bool((whole.astype(np.int32) == whole).all())
        fits = fits and np.array_equal(real.astype(np.float32).astype(np.float64), real, equal_nan=True)
    if not fits:
        raise MessageError("bad record", f"{where} has a {name} with a number that does not fit its field.")


def _made_records(rows: AnyArray, name: str, where: str) -> Iterator[Any]:
    try:
        import cv2
    except ImportError as error:
        text = f"{where} holds objects of OpenCV, which is not installed here: pip install opencv-python-headless."
        raise MessageError("no opencv", text) from error
    make, integers = getattr(cv2, name), frozenset(_INTEGERS[name])
    for row in rows.tolist():
        yield make(*(int(number) if column in integers else number for column, number in enumerate(row)))


def is_table(value: object) -> bool:
    """Return whether a value is a DataFrame or a Series of pandas, and not of a subclass."""
    pandas = sys.modules.get("pandas")
    return pandas is not None and type(value) in (getattr(pandas, "DataFrame", 0), getattr(pandas, "Series", 0))


def write_table(writer: ValueWriter, message: Any, value: Any, path: Path) -> None:
    """Write a DataFrame or a Series into a Value message.

    Raises
    ------
    MessageError
        Of reason ``"no codec"`` for a kind of column, index or label that has none.
    """
    if value.attrs:
        text = f"{format_path(path)} is a table with attrs, which have no codec. Set attrs = {{}}."
        raise MessageError("no codec", text)
    table = message.table
    writer.counter.enter(path, 1 + (1 if value.ndim == 1 else value.shape[1]))
    _write_column(writer, table.index, value.index, (*path, "index"))
    table.series = value.ndim == 1
    if table.series:
        _write_column(writer, table.data.add(), value, (*path, "values"))
        return
    _write_column(writer, table.columns, value.columns, (*path, "columns"))
    for position in range(value.shape[1]):
        column = value.iloc[:, position]
        _write_column(writer, table.data.add(), column, (*path, column.name), named=False)


def _write_column(writer: ValueWriter, message: Any, column: Any, path: Path, *, named: bool = True) -> None:
    if type(column).__name__ == "MultiIndex":
        text = f"{format_path(path)} has several levels, which have no codec. Return table.reset_index() instead."
        raise MessageError("no codec", text)
    if named:
        writer.write(message.name, column.name, (*path, "name"))
    message.dtype, values = _plain_column(column, path)
    writer.write(message.values, values, path)


def _plain_column(column: Any, path: Path) -> tuple[str, Any]:
    """Return the name of a column's dtype, and its values as an array or a list."""
    if type(column).__name__ == "RangeIndex":
        return "range", [column.start, column.stop, column.step]
    name = str(column.dtype)
    if name in _TEXT_DTYPES:
        return name, [None if missing else text for text, missing in zip(column, column.isna(), strict=True)]
    if name == "object":
        return name, column.tolist()
    if _TIME_DTYPE.fullmatch(name):
        return name, column.to_numpy().view("<i8")
    array = column.to_numpy() if getattr(column.dtype, "kind", "") in "biufc" else None
    # A dtype of pandas' own (Int64, category) has no array with all of its values.
    if type(array).__module__ == "numpy" and str(array.dtype) == name:  # type: ignore[union-attr]
        return name, array
    text = f"{format_path(path)} is a column of dtype {name}, which has no codec. Convert it: astype('float64')."
    raise MessageError("no codec", text)


def table_parts(value: Any) -> list[tuple[str, Any]]:
    """Return the plain values and arrays that a table consists of, each with its place, to compare two tables."""

    def parts_of(where: str, column: Any, name: object) -> list[tuple[str, Any]]:
        dtype, values = _plain_column(column, (where,))
        return [(f"{where}.name", name), (f"{where}.dtype", dtype), (where, values)]

    parts = parts_of(".index", value.index, value.index.name)
    if value.ndim == 1:
        return parts + parts_of("", value, value.name)
    parts += parts_of(".columns", value.columns, value.columns.name)
    for position, label in enumerate(value.columns):
        parts += parts_of(f"[{label!r}]", value.iloc[:, position], None)
    return parts


def read_table(reader: ValueReader, content: Any, path: Path) -> Any:
    """Return the DataFrame or the Series of a Table message.

    Raises
    ------
    MessageError
        Of reason ``"bad table"`` for anything that `write_table` does not write, ``"no pandas"`` where pandas is not
        installed.
    """
    try:
        import pandas as pd
    except ImportError as error:
        text = f"{format_path(path)} is a table of pandas, which is not installed here: pip install pandas."
        raise MessageError("no pandas", text) from error

    def index_of(column: Any, part: str) -> Any:
        values, dtype = _read_column(reader, column, (*path, part))
        name = reader.read(column.name, (*path, part, "name"))
        return pd.RangeIndex(values, name=name) if column.dtype == "range" else pd.Index(values, dtype, name=name)

    reader.counter.enter(path, 1 + len(content.data))
    try:
        index = index_of(content.index, "index")
        labels = [0] if content.series else index_of(content.columns, "columns")
        columns = [_read_column(reader, column, (*path, place)) for place, column in enumerate(content.data)]
        if len(labels) != len(columns) or any(len(values) != len(index) for values, _ in columns):
            raise _bad_table(path, "columns that do not fit its labels and its index")
        if content.series:
            (values, dtype), name = columns[0], reader.read(content.data[0].name, (*path, "name"))
            return pd.Series(values, index, dtype, name)
        if not columns:
            # A range index declares any length in a few bytes, and without columns nothing else bounds it.
            reader.counter.count(path, len(index))
        data = {place: pd.Series(values, index, dtype) for place, (values, dtype) in enumerate(columns)}
        table = pd.DataFrame(data, index)
        table.columns = labels
    except MessageError:
        raise
    except _PANDAS_ERRORS as error:
        raise _bad_table(path, f"content that pandas refuses ({type(error).__name__})") from error
    return table


def _read_column(reader: ValueReader, content: Any, path: Path) -> tuple[Any, Any]:
    """Return the values of a column, and the dtype for pandas to use; those of a range as a Python range."""
    values = reader.read(content.values, path)
    kind = content.dtype
    if type(values) is list:
        return _read_list(values, kind, path)
    if not hasattr(values, "dtype") or values.ndim != 1:
        raise _bad_table(path, "a column that is no list or array")
    time = _TIME_DTYPE.fullmatch(kind)
    if time and values.dtype.str == "<i8":
        return values.view(f"<{'M8' if time[1] == 'datetime64' else 'm8'}[{time[2]}]"), None
    if values.dtype.kind not in "biufc" or str(values.dtype) != kind:
        raise _bad_table(path, f"a column of {kind[:40]!r} that is an array of {values.dtype.str}")
    return values, None


def _read_list(values: list[Any], kind: str, path: Path) -> tuple[Any, Any]:
    if kind == "range" and [*map(type, values)] == [int, int, int] and values[2] and max(map(abs, values)) < 2**62:
        return range(*values), None
    if kind in _TEXT_DTYPES and all(text is None or type(text) is str for text in values):
        return values, kind
    if kind == "object":
        return values, object
    raise _bad_table(path, f"a column of {kind[:40]!r} that is a list of something else")


def _bad_table(path: Path, problem: str) -> MessageError:
    return MessageError("bad table", f"{format_path(path)} is a table that has {problem}.")
