"""How does a table of pandas travel? Column by column, each as the array or the list that it holds."""

from __future__ import annotations

import re
import sys
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError
from epypes.wire.instead import spoken

if TYPE_CHECKING:
    from epypes.wire.codecs import Writer
    from epypes.wire.instead import Path
    from epypes.wire.reading import Reader

_TEXTS: Final = ("str", "string")
_TIMES: Final = re.compile(r"(datetime64|timedelta64)\[(s|ms|us|ns)\]")
# What pandas raises for what it can't make a table of.
_BROKEN: Final = (ValueError, TypeError, OverflowError, LookupError, MemoryError, AttributeError)


def is_table(value: object) -> bool:
    """Whether a value is a DataFrame or a Series of pandas, and no subclass."""
    # A table can only turn up once pandas has been imported by somebody else.
    pandas = sys.modules.get("pandas")
    return pandas is not None and type(value) in (getattr(pandas, "DataFrame", 0), getattr(pandas, "Series", 0))


def write_table(writer: Writer, message: Any, value: Any, path: Path) -> bool:
    """Write a table into a Value message; return whether the value is one.

    Raises
    ------
    MessageError
        Of reason ``"no codec"`` for a kind of column, index or label that has none.
    """
    if not is_table(value):
        return False
    if value.attrs:
        raise MessageError("no codec", f"{spoken(path)} is a table with attrs, which have no codec. Set attrs = {{}}.")
    table = message.table
    _write_column(writer, table.index, value.index, (*path, "index"))
    table.series = value.ndim == 1
    if table.series:
        _write_column(writer, table.data.add(), value, (*path, "values"))
        return True
    _write_column(writer, table.columns, value.columns, (*path, "columns"))
    for place in range(value.shape[1]):
        column = value.iloc[:, place]
        _write_column(writer, table.data.add(), column, (*path, column.name), named=False)
    return True


def _write_column(writer: Writer, message: Any, column: Any, path: Path, *, named: bool = True) -> None:
    if type(column).__name__ == "MultiIndex":
        text = f"{spoken(path)} has several levels, which have no codec. Return table.reset_index() instead."
        raise MessageError("no codec", text)
    if named:
        writer.fill(message.name, column.name, (*path, "name"))
    message.dtype, values = _plain_column(column, path)
    writer.fill(message.values, values, path)


def _plain_column(column: Any, path: Path) -> tuple[str, Any]:
    """Return the name of a column's dtype, and its values as an array or a list."""
    if type(column).__name__ == "RangeIndex":
        return "range", [column.start, column.stop, column.step]
    name = str(column.dtype)
    if name in _TEXTS:
        return name, [None if missing else text for text, missing in zip(column, column.isna(), strict=True)]
    if name == "object":
        return name, column.tolist()
    if _TIMES.fullmatch(name):
        return name, column.to_numpy().view("<i8")
    if getattr(column.dtype, "kind", "") in "biufc" and type(column.to_numpy()).__module__ == "numpy":
        array = column.to_numpy()
        # A dtype of pandas' own (Int64, category) has no array that says all of it.
        if str(array.dtype) == name:
            return name, array
    text = f"{spoken(path)} is a column of dtype {name}, which has no codec. Convert it: astype('float64')."
    raise MessageError("no codec", text)


def table_parts(value: Any) -> list[tuple[str, Any]]:
    """Return what a table is made of, each with where it is: plain values and arrays, so that two can be compared."""
    parts = _parts_of(".index", value.index, value.index.name)
    if value.ndim == 1:
        return [*parts, *_parts_of("", value, value.name)]
    parts += _parts_of(".columns", value.columns, value.columns.name)
    for place, label in enumerate(value.columns):
        parts += _parts_of(f"[{label!r}]", value.iloc[:, place], None)
    return parts


def _parts_of(where: str, column: Any, name: object) -> list[tuple[str, Any]]:
    dtype, values = _plain_column(column, (where,))
    return [(f"{where}.name", name), (f"{where}.dtype", dtype), (where, values)]


def read_table(reader: Reader, content: Any, path: Path) -> Any:
    """Return the table of a Table message; raise MessageError for anything that `write_table` does not write."""
    try:
        import pandas  # noqa: F401 - here to say what is missing
    except ImportError as error:
        text = f"{spoken(path)} is a table of pandas, which is not installed here: pip install pandas."
        raise MessageError("no pandas", text) from error
    try:
        return _series(reader, content, path) if content.series else _frame(reader, content, path)
    except _BROKEN as error:
        if isinstance(error, MessageError):
            raise
        raise _bad(path, f"what pandas refuses ({type(error).__name__})") from error


def _frame(reader: Reader, content: Any, path: Path) -> Any:
    import pandas as pd

    index = _index(reader, content.index, (*path, "index"))
    labels = _index(reader, content.columns, (*path, "columns"))
    columns = [_column(reader, column, (*path, place)) for place, column in enumerate(content.data)]
    if len(labels) != len(columns) or any(len(values) != len(index) for values, _ in columns):
        raise _bad(path, "columns that are not those of its labels and its index")
    if not columns:
        # An index of a range may be of any length, and nothing else says that it is one that can be looked at.
        reader.check_count(len(index), path)
    data = {place: pd.Series(values, index, dtype) for place, (values, dtype) in enumerate(columns)}
    table = pd.DataFrame(data, index)
    table.columns = labels
    return table


def _series(reader: Reader, content: Any, path: Path) -> Any:
    import pandas as pd

    index = _index(reader, content.index, (*path, "index"))
    if len(content.data) != 1:
        raise _bad(path, "as a Series not one column")
    values, dtype = _column(reader, content.data[0], (*path, "values"))
    if len(values) != len(index):
        raise _bad(path, "values that are not those of its index")
    return pd.Series(values, index, dtype, reader.read(content.data[0].name, (*path, "name")))


def _index(reader: Reader, content: Any, path: Path) -> Any:
    import pandas as pd

    values, dtype = _column(reader, content, path)
    name = reader.read(content.name, (*path, "name"))
    return pd.RangeIndex(values, name=name) if content.dtype == "range" else pd.Index(values, dtype, name=name)


def _column(reader: Reader, content: Any, path: Path) -> tuple[Any, Any]:
    """Return the values of a column, and the dtype that pandas is to give them; a range as Python's own."""
    values = reader.read(content.values, path)
    kind = content.dtype
    if type(values) is list:
        return _listed(values, kind, path)
    if not hasattr(values, "dtype") or values.ndim != 1:
        raise _bad(path, "a column that is no list or array")
    time = _TIMES.fullmatch(kind)
    if time and values.dtype.str == "<i8":
        return values.view(f"<{'M8' if time[1] == 'datetime64' else 'm8'}[{time[2]}]"), None
    if values.dtype.kind not in "biufc" or str(values.dtype) != kind:
        raise _bad(path, f"a column of {kind[:40]!r} that is an array of {values.dtype.str}")
    return values, None


def _listed(values: list[Any], kind: str, path: Path) -> tuple[Any, Any]:
    if kind == "range" and [*map(type, values)] == [int, int, int] and values[2] and max(map(abs, values)) < 2**62:
        return range(*values), None
    if kind in _TEXTS and all(text is None or type(text) is str for text in values):
        return values, kind
    if kind == "object":
        return values, object
    raise _bad(path, f"a column of {kind[:40]!r} that is a list of something else")


def _bad(path: Path, what: str) -> MessageError:
    return MessageError("bad table", f"{spoken(path)} is a table that has {what}.")
