"""Keypoints and matches of OpenCV in messages: the rows of a tensor.

OpenCV is not imported to write: such an object only exists once it has been imported.
"""

from __future__ import annotations

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
