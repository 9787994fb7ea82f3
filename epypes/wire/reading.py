"""Reads Value messages into Python values. Nothing in a message is believed before it is checked."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from epypes.errors import MessageError
from epypes.images import Order, swapped
from epypes.wire.arrays import frozen, read_dtype, read_image, read_tensor
from epypes.wire.instead import Path, spoken
from epypes.wire.limits import DEFAULT_LIMITS, KeyCheck, Limits
from epypes.wire.records import read_records
from epypes.wire.tables import read_table

if TYPE_CHECKING:
    from epypes.wire.arrays import AnyArray

_HEXADECIMAL = re.compile(r"-?[0-9a-f]+")
_TEXT_KINDS = frozenset("US")


class Reader:
    """Reads the Value messages of one multipart message.

    Parameters
    ----------
    frames
        The payload frames, each a one-dimensional memoryview of bytes.
    limits
        What is accepted.

    Attributes
    ----------
    order
        That of the colours in the named value that was read last, None if there are none in it. A value has one order:
        an image of another order than the first one in it is converted.
    used
        The indices of the frames that were read.
    """

    def __init__(self, frames: Sequence[memoryview], limits: Limits = DEFAULT_LIMITS) -> None:
        self._frames, self._limits = frames, limits
        self._count = 0
        self._key_check = KeyCheck(limits)
        self._seen: set[int] = set()
        self.order: Order | None = None
        self.used: list[int] = []

    def read(self, message: Any, path: Path) -> Any:
        """Return the value of a message; raise MessageError if there is none in it."""
        self._count += 1
        if len(path) == 1:
            self.order = None
        if self._count > self._limits.values:
            raise MessageError("too many values", f"The message holds more than {self._limits.values:,} values.")
        if len(path) - 1 > self._limits.depth:
            raise MessageError("too deep", f"{path[0]!r} nests deeper than {self._limits.depth} containers.")
        kind = message.WhichOneof("kind")
        if kind is None:
            raise MessageError("unknown value", f"{spoken(path)} has no value, or one of a newer kind.")
        return _READ[kind](self, getattr(message, kind), path)

    def check_all_used(self) -> None:
        """Raise MessageError if a frame belongs to no value."""
        if len(self._seen) != len(self._frames):
            left = sorted(set(range(len(self._frames))) - self._seen)
            raise MessageError("unused frame", f"Payload frames {left[:8]} belong to no value.")

    def check_count(self, count: int, path: Path) -> None:
        """Raise MessageError if a value stands for more values than a message may hold."""
        self._count += count
        if self._count > self._limits.values:
            raise MessageError("too many values", f"{spoken(path)} holds more than {self._limits.values:,} values.")

    def _as_it_is(self, content: Any, path: Path) -> Any:
        return content

    def _none(self, content: bool, path: Path) -> None:
        return None

    def _big_integer(self, content: str, path: Path) -> int:
        if not _HEXADECIMAL.fullmatch(content):
            raise MessageError("bad integer", f"{spoken(path)} is no hexadecimal integer: {content[:40]!r}.")
        return int(content, 16)

    def _list(self, content: Any, path: Path) -> list[Any]:
        return [self.read(item, (*path, index)) for index, item in enumerate(content.items)]

    def _tuple(self, content: Any, path: Path) -> tuple[Any, ...]:
        return tuple(self._list(content, path))

    def _complex(self, content: Any, path: Path) -> complex:
        return complex(content.real, content.imaginary)

    def _set(self, content: Any, path: Path) -> set[Any]:
        items = self._list(content, path)
        check = self._key_check.for_container(path)
        for item in items:
            check(item)
        result = set(items)
        if len(result) < len(items):
            raise MessageError("bad key", f"{spoken(path)} is a set that has an item twice.")
        return result

    def _frozen_set(self, content: Any, path: Path) -> frozenset[Any]:
        return frozenset(self._set(content, path))

    def _map(self, content: Any, path: Path) -> dict[Any, Any]:
        result: dict[Any, Any] = {}
        check = self._key_check.for_container(path)
        for index, entry in enumerate(content.entries):
            key = self.read(entry.key, (*path, f"key {index}"))
            check(key)
            if key in result:
                raise MessageError("bad key", f"{spoken(path)} has the key {str(key)[:40]!r} twice.")
            result[key] = self.read(entry.value, (*path, key))
        return result

    def _image(self, content: Any, path: Path) -> AnyArray:
        data = self._data(content, path)
        image = read_image(content.width, content.height, content.encoding, content.step, data, spoken(path))
        if image.ndim == 2:
            return image
        order: Order = "rgb" if content.encoding.startswith("rgb") else "bgr"
        self.order = self.order or order
        return image if order == self.order else frozen(swapped(image))

    def tensor(self, content: Any, path: Path) -> Any:
        """Return the array, or the scalar, of a Tensor message."""
        where = spoken(path)
        data = self._data(content, path)
        if content.scalar and content.dtype[1:2] in _TEXT_KINDS:
            return _text_scalar(content.dtype, bytes(data), where)
        shape = tuple(content.shape)
        array = read_tensor(read_dtype(content.dtype, where), shape, data, where)
        if not content.scalar:
            return array
        if shape:
            raise MessageError("bad shape", f"{where} is a scalar, but has the shape {shape}.")
        return array[()]

    def _encoded(self, content: Any, path: Path) -> bytes:
        return bytes(self._data(content, path))

    def _data(self, content: Any, path: Path) -> memoryview:
        storage = content.WhichOneof("storage")
        if storage is None:
            raise MessageError("no data", f"{spoken(path)} says neither inline nor frame.")
        if storage == "inline":
            inline: bytes = content.inline
            return memoryview(inline)
        index: int = content.frame
        if index >= len(self._frames):
            raise MessageError(
                "missing frame",
                f"{spoken(path)} is in payload frame {index}, but there are {len(self._frames)}.",
            )
        if index in self._seen:
            raise MessageError("frame used twice", f"{spoken(path)} is in payload frame {index}, as another is.")
        self._seen.add(index)
        self.used.append(index)
        return self._frames[index]


_READ: dict[str, Callable[[Reader, Any, Path], Any]] = {
    "none": Reader._none,
    "boolean": Reader._as_it_is,
    "integer": Reader._as_it_is,
    "number": Reader._as_it_is,
    "text": Reader._as_it_is,
    "big_integer": Reader._big_integer,
    "list": Reader._list,
    "tuple": Reader._tuple,
    "map": Reader._map,
    "image": Reader._image,
    "tensor": Reader.tensor,
    "encoded": Reader._encoded,
    "complex": Reader._complex,
    "set": Reader._set,
    "frozen_set": Reader._frozen_set,
    "records": read_records,
    "table": read_table,
}


def _text_scalar(dtype: str, data: bytes, where: str) -> Any:
    import numpy as np

    try:
        if dtype == f"|S{len(data)}":
            return np.bytes_(data)
        if dtype == f"<U{len(data) // 4}" and len(data) % 4 == 0:
            return np.str_(data.decode("utf-32-le", "surrogatepass"))
    except UnicodeDecodeError as error:
        raise MessageError("bad data", f"{where} has text with code points that don't exist.") from error
    raise MessageError("size differs", f"{where} is a scalar of {dtype[:40]!r}, but has {len(data)} bytes.")
