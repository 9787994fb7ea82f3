"""Tables of pandas in messages: streams of Arrow's IPC format, which any library of Arrow reads.

A table is written only if Arrow gives it back as it was, since a replay compares every bit: a column that Arrow would
change is refused with the way out. The frequency of an index of times and the flags of a table are no data and are left
out. Tables that were written before column by column, in bundles and recordings, are read.

Nothing in a received stream is trusted: compressed ones are refused, since 15 kB can be 480 MB, so are columns of other
types than those that pandas makes, and values that are objects are counted.
"""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError, install_command
from epypes.wire.limits import Path, format_path

if TYPE_CHECKING:
    from epypes.wire.decoder import ValueReader
    from epypes.wire.encoder import ValueWriter

# The label of the one column of a series, whose name may be any value.
_SERIES: Final = "values"
_TEXT_DTYPES: Final = ("str", "string")
_TIME_DTYPE: Final = re.compile(r"(datetime64|timedelta64)\[(s|ms|us|ns)\]")
# Objects in a column of objects that Arrow may give back as they were.
_CELLS: Final = frozenset({str, bytes, bool, int, float, type(None)})
# Of a column of Arrow: names of the checks in pyarrow.types. The values of the latter are objects in pandas.
_PLAIN_TYPES: Final = ("boolean", "integer", "floating", "timestamp", "duration")
_OBJECT_TYPES: Final = ("string", "large_string", "binary", "large_binary", "null")
# Errors of pandas for data that it can't make a table of.
_PANDAS_ERRORS: Final = (ValueError, TypeError, OverflowError, LookupError, MemoryError, AttributeError)


def is_table(value: object) -> bool:
    """Return whether a value is a DataFrame or a Series of pandas, and not of a subclass."""
    pandas = sys.modules.get("pandas")
    return pandas is not None and type(value) in (getattr(pandas, "DataFrame", 0), getattr(pandas, "Series", 0))


def _pyarrow(path: Path) -> Any:
    try:
        import pyarrow
    except ImportError as error:
        text = f"{format_path(path)} is a table, which travels by pyarrow: {install_command('tables')}."
        raise MessageError("no pyarrow", text) from error
    return pyarrow


def _pandas(path: Path) -> Any:
    try:
        import pandas
    except ImportError as error:
        text = f"{format_path(path)} is a table of pandas, which is not installed here: pip install pandas."
        raise MessageError("no pandas", text) from error
    return pandas


# -- writing ----------------------------------------------------------------------------------------------------------


def write_table(writer: ValueWriter, message: Any, value: Any, path: Path) -> None:
    """Write a DataFrame or a Series into a Value message.

    Raises
    ------
    MessageError
        Of reason ``"no codec"`` for what Arrow does not give back as it was, ``"no pyarrow"`` where it is missing.
    """
    arrow, content, frame = _pyarrow(path), message.arrow_table, value
    content.series = value.ndim == 1
    if content.series:
        writer.write(content.name, value.name, (*path, "name"))
        frame = value.to_frame(_SERIES)
    _check_labels(frame, path)
    content.numbered = type(frame.columns).__name__ == "RangeIndex"
    try:
        batch = arrow.RecordBatch.from_pandas(frame, nthreads=1)
        objects = _object_columns(arrow, batch.schema)
    except (arrow.ArrowException, *_PANDAS_ERRORS) as error:
        # Arrow's own errors name the column in a second argument.
        why = "; ".join(map(str, error.args)) if isinstance(error, arrow.ArrowException) else str(error)
        text = f"that Arrow can't hold: {why:.200}. Return table.to_dict('list') instead"
        raise _no_codec(path, text) from error
    writer.counter.count(path, batch.num_rows * objects + _object_categories(arrow, [[each] for each in batch.columns]))
    sink = arrow.BufferOutputStream()
    with arrow.ipc.new_stream(sink, batch.schema) as stream:
        stream.write_batch(batch)
    data = sink.getvalue()
    _check_same(frame, _frame_of(arrow.ipc.open_stream(data).read_all(), content.numbered), path)
    writer.store(content, data.to_pybytes(), data.size, path)


def _check_labels(frame: Any, path: Path) -> None:
    """Refuse labels that Arrow would hold as other ones: it has texts alone."""
    labels = frame.columns
    if frame.attrs:
        raise _no_codec(path, "with attrs. Set attrs = {}")
    is_numbered = type(labels).__name__ == "RangeIndex" and (labels.start, labels.step) == (0, 1)
    if not is_numbered and not (labels.is_unique and all(type(label) is str for label in labels)):
        raise _no_codec(path, "whose labels are not texts that all differ. Set table.columns = [...]")
    for name in (*frame.index.names, *labels.names):
        if not (name is None or type(name) is str):
            raise _no_codec(path, f"with an index called {name!r:.40}, which is no text. Set table.index.name")


def _check_same(given: Any, back: Any, path: Path) -> None:
    """Refuse a table that Arrow gives back as another one, and name the column."""
    for what, own, its in (("index", given.index, back.index), ("columns", given.columns, back.columns)):
        is_same = type(own) is type(its) and own.dtype == its.dtype and own.names == its.names
        if not (is_same and own.equals(its)):
            text = f"whose {what} of dtype {own.dtype} Arrow gives back as {its.dtype}."
            raise _no_codec(path, f"{text} Convert it: table.{what} = table.{what}.astype({str(its.dtype)!r})")
    for label in given.columns:
        column, other = given[label], back[label]
        if column.dtype != other.dtype:
            text = f"whose column {label!r:.80} of dtype {column.dtype} Arrow gives back as {other.dtype}."
            raise _no_codec(path, f"{text} Convert it: astype({str(other.dtype)!r})")
        is_same = column.equals(other)
        if column.dtype == object:
            is_same = all(map(_is_same_cell, column, other))
        if not is_same:
            text = f"whose column {label!r:.80} has objects that Arrow changes. Return table.to_dict('list') instead"
            raise _no_codec(path, text)


def _is_same_cell(given: Any, back: Any) -> bool:
    is_plain = type(given) is type(back) and type(given) in _CELLS
    return is_plain and bool(given == back or (given != given and back != back))


def _no_codec(path: Path, what: str) -> MessageError:
    return MessageError("no codec", f"{format_path(path)} is a table {what}.")


# -- comparing ----------------------------------------------------------------------------------------------------


def table_parts(value: Any) -> list[tuple[str, Any]]:
    """Return the plain values and arrays that a table consists of, each with its place, to compare two tables."""

    def parts_of(where: str, column: Any, name: object) -> list[tuple[str, Any]]:
        dtype, values = _plain_column(column)
        return [(f"{where}.name", name), (f"{where}.dtype", dtype), (where, values)]

    parts = parts_of(".index", value.index, [*value.index.names])
    if value.ndim == 1:
        return parts + parts_of("", value, value.name)
    parts += parts_of(".columns", value.columns, value.columns.name)
    for position, label in enumerate(value.columns):
        parts += parts_of(f"[{label!r}]", value.iloc[:, position], None)
    return parts


def _plain_column(column: Any) -> tuple[str, Any]:
    """Return the name of a column's dtype, and its values as an array or a list."""
    if type(column).__name__ == "RangeIndex":
        return "range", [column.start, column.stop, column.step]
    # The text of a categorical dtype is "category" alone.
    name = repr(column.dtype) if str(column.dtype) == "category" else str(column.dtype)
    if _TIME_DTYPE.fullmatch(name):
        return name, column.to_numpy().view("<i8")
    if name == "object":
        return name, column.tolist()
    array = column.to_numpy() if getattr(column.dtype, "kind", "") in "biufc" else None
    if type(array).__module__ == "numpy" and str(array.dtype) == name:  # type: ignore[union-attr]
        return name, array
    # A dtype of pandas' own has a missing value that equals nothing.
    return name, [None if missing else cell for cell, missing in zip(column, column.isna(), strict=True)]


# -- reading ------------------------------------------------------------------------------------------------------


def read_arrow_table(reader: ValueReader, content: Any, path: Path) -> Any:
    """Return the DataFrame or the Series of an ArrowTable message.

    Raises
    ------
    MessageError
        Of reason ``"bad table"`` for anything that `write_table` does not write, ``"no pandas"`` or ``"no pyarrow"``
        where they are not installed.
    """
    _pandas(path)
    arrow, data = _pyarrow(path), reader.stored(content, path)
    reader.counter.enter(path, 1)
    name = reader.read(content.name, (*path, "name")) if content.series else None
    try:
        for message in arrow.ipc.MessageReader.open_stream(arrow.py_buffer(data)):
            if _is_compressed(message.metadata.to_pybytes()):
                raise _bad_table(path, "a compressed batch")
        stream = arrow.ipc.open_stream(arrow.py_buffer(data))
        objects = _object_columns(arrow, stream.schema)
        table = stream.read_all()
        # Without columns nothing else bounds the rows, and categories that are null take no bytes.
        categories = _object_categories(arrow, [column.chunks for column in table.columns])
        reader.counter.count(path, table.num_rows * (objects or not table.num_columns) + categories)
        table.validate(full=True)
        frame = _frame_of(table, content.numbered)
    except MessageError:
        raise
    except Exception as error:  # Arrow and pandas raise errors of any type for damaged bytes
        raise _bad_table(path, f"content that Arrow or pandas refuses ({type(error).__name__})") from error
    if frame.attrs or (content.series and [*frame.columns] != [_SERIES]):
        raise _bad_table(path, "attrs, or is no series")
    return frame[_SERIES].rename(name) if content.series else frame


def _frame_of(table: Any, is_numbered: bool) -> Any:
    frame = table.to_pandas(use_threads=False)
    if is_numbered:
        frame.columns = sys.modules["pandas"].RangeIndex(len(frame.columns), name=frame.columns.name)
    return frame


def _object_columns(arrow: Any, schema: Any) -> int:
    """Return how many columns have values that are objects in pandas; raise ValueError for another type of Arrow."""
    count = 0
    for column in schema:
        kind = column.type.value_type if arrow.types.is_dictionary(column.type) else column.type
        if not _is_one_of(arrow, kind, (*_PLAIN_TYPES, *_OBJECT_TYPES)):
            raise ValueError(f"column {column.name!r:.80} is of Arrow's type {kind!s:.60}")
        count += _is_one_of(arrow, kind, _OBJECT_TYPES)
    return count


def _object_categories(arrow: Any, columns: Sequence[Sequence[Any]]) -> int:
    """Return how many categories are objects in pandas; ``columns`` has the arrays of each column."""
    return sum(
        max(len(array.dictionary) for array in arrays)
        for arrays in columns
        if arrays
        and arrow.types.is_dictionary(arrays[0].type)
        and _is_one_of(arrow, arrays[0].type.value_type, _OBJECT_TYPES)
    )


def _is_one_of(arrow: Any, kind: Any, names: tuple[str, ...]) -> bool:
    return any(getattr(arrow.types, f"is_{name}")(kind) for name in names)


def _is_compressed(metadata: bytes) -> bool:
    """Return whether a message of Arrow has a batch with compressed buffers: pyarrow does not say it.

    Its metadata is a flatbuffer of Arrow's Message.fbs: a Message has the type of its header in field 1 and the header
    in field 2; a DictionaryBatch (2) has a RecordBatch in field 1, and a RecordBatch (3) its compression in field 3.
    """

    def number(layout: str, place: int) -> int:
        found: int = struct.unpack_from(layout, metadata, place)[0]
        return found

    def field(table: int, index: int) -> int:
        """Return the place of a field of a table; 0 if it is not there."""
        fields = table - number("<i", table)
        entry = 4 + 2 * index
        offset = number("<H", fields + entry) if entry < number("<H", fields) else 0
        return table + offset if offset else 0

    def follow(place: int) -> int:
        return place + number("<I", place)

    message = follow(0)
    kind = metadata[field(message, 1)] if field(message, 1) else 0
    if kind not in {2, 3}:
        return False
    batch = follow(field(message, 2))
    return field(follow(field(batch, 1)) if kind == 2 else batch, 3) != 0


def read_table(reader: ValueReader, content: Any, path: Path) -> Any:
    """Return the DataFrame or the Series of a Table message, as EPypes wrote them before there was ArrowTable.

    Raises
    ------
    MessageError
        Of reason ``"bad table"`` for anything else, ``"no pandas"`` where pandas is not installed.
    """
    pd = _pandas(path)

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
