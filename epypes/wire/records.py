"""How do OpenCV's keypoints and matches travel? As rows of one tensor, whatever sequence holds them.

Each field is a C float or a C int, and "<f8" holds both to the last bit.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError
from epypes.wire.instead import spoken

if TYPE_CHECKING:
    from epypes.wire.arrays import AnyArray
    from epypes.wire.codecs import Writer
    from epypes.wire.instead import Path
    from epypes.wire.reading import Reader

# Of each class its fields, in the order in which its constructor takes them, and where the integers are.
FIELDS: Final = {
    "KeyPoint": ("x", "y", "size", "angle", "response", "octave", "class_id"),
    "DMatch": ("queryIdx", "trainIdx", "imgIdx", "distance"),
}
_INTEGERS: Final = {"KeyPoint": (5, 6), "DMatch": (0, 1, 2)}
_HOLDERS: Final[dict[int, Callable[[Any], Any]]] = {1: list, 2: tuple}
_NUMBERS: Final[dict[type, int]] = {list: 1, tuple: 2}


def record_type(value: object) -> str:
    """Return which of OpenCV's classes a value is an object of; "" for any other value."""
    kind = type(value)
    name = kind.__name__
    # Such an object can only turn up once OpenCV has been imported by somebody else.
    return name if name in FIELDS and getattr(sys.modules.get("cv2"), name, None) is kind else ""


def record_fields(record: Any) -> tuple[float, ...]:
    """Return the fields of a keypoint or a match, as FIELDS names them."""
    if type(record).__name__ == "DMatch":
        return (record.queryIdx, record.trainIdx, record.imgIdx, record.distance)
    return (*record.pt, record.size, record.angle, record.response, record.octave, record.class_id)


def records_in(value: Sequence[Any]) -> str:
    """Return of which class all items of a sequence are, or all items of all sequences in it; "" if of none."""
    first = value[0] if value else None
    if type(first) in (list, tuple):
        inner = first[0] if first else None
        name = record_type(inner)
        same = name and all(type(item) is type(first) for item in value)
        return name if same and all(type(record) is type(inner) for item in value for record in item) else ""
    name = record_type(first)
    return name if name and all(type(record) is type(first) for record in value) else ""


def write_records(writer: Writer, message: Any, value: Any, path: Path) -> None:
    """Write a record, a sequence of records or a sequence of such sequences, as `records_in` has found them."""
    import numpy as np

    message.outer = _NUMBERS.get(type(value), 0)
    records = value if message.outer else [value]
    if type(records[0]) in (list, tuple):
        message.inner = _NUMBERS[type(records[0])]
        message.counts.extend(map(len, records))
        records = [record for item in records for record in item]
    message.type = type(records[0]).__name__
    writer.fill_tensor(message.rows, np.array([*map(record_fields, records)], "<f8"), path)


def read_records(reader: Reader, content: Any, path: Path) -> Any:
    """Return what `write_records` was given; raise MessageError for anything that it does not write."""
    where = spoken(path)
    if content.type not in FIELDS:
        raise MessageError("bad record", f"{where} is of type {content.type[:40]!r}; known are {', '.join(FIELDS)}.")
    rows = reader.tensor(content.rows, path)
    _check_rows(rows, content.type, where)
    reader.check_count(len(rows) + len(content.counts), path)
    _check_counts(content, len(rows), where)
    records = _made(rows, content.type, where)
    if not content.outer:
        return next(records)
    inner = _HOLDERS.get(content.inner)
    return _HOLDERS[content.outer](records if inner is None else [inner(islice(records, n)) for n in content.counts])


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


def _check_counts(content: Any, rows: int, where: str) -> None:
    is_nested = content.inner in _HOLDERS
    known = content.outer in (0, *_HOLDERS) and content.inner in (0, *_HOLDERS)
    wanted = sum(content.counts) if is_nested else rows if content.outer else 1
    if not known or wanted != rows or (is_nested and not content.outer) or (content.counts and not is_nested):
        raise MessageError("bad record", f"{where} has {rows} rows, which are not those that it says it has.")


def _made(rows: AnyArray, name: str, where: str) -> Iterator[Any]:
    try:
        import cv2
    except ImportError as error:
        text = f"{where} holds objects of OpenCV, which is not installed here: pip install opencv-python-headless."
        raise MessageError("no opencv", text) from error
    make = getattr(cv2, name)
    integers = frozenset(_INTEGERS[name])
    for row in rows.tolist():
        yield make(*(int(number) if column in integers else number for column, number in enumerate(row)))
