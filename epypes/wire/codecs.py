"""Which Python value is which Value message? The one place that maps them, both ways.

Only exact types are taken: a subclass (a namedtuple, a masked array) would come back as something else.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from epypes.errors import MessageError
from epypes.images import Order, swapped
from epypes.wire.arrays import frozen, image_encoding, read_dtype, read_image, read_tensor
from epypes.wire.limits import DEFAULT_LIMITS, Limits
from epypes.wire.schema import message_class

if TYPE_CHECKING:
    from epypes.wire.arrays import AnyArray

Path = tuple[object, ...]
_INT64 = range(-(2**63), 2**63)
_HEXADECIMAL = re.compile(r"-?[0-9a-f]+")
_TEXT_KINDS = frozenset("US")


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """Bytes that travel beside the message: an array, or bytes.

    Attributes
    ----------
    path
        Where the value is: its name, then the indices and keys into it.
    data
        The array as it was given (any layout), or the bytes.
    """

    path: Path
    data: AnyArray | bytes


def spoken(path: Path) -> str:
    """Return a path as it is written in Python: ``keypoints[0]['size']``."""
    return str(path[0]) if len(path) == 1 else str(path[0]) + "".join(f"[{step!r}]"[:60] for step in path[1:])


def to_value(
    value: object,
    name: str,
    *,
    inline_below: int = 8192,
    order: str = "bgr",
    first_frame: int = 0,
    limits: Limits = DEFAULT_LIMITS,
) -> tuple[Any, list[Payload]]:
    """Return the Value message of a Python value, and the payloads it refers to.

    Parameters
    ----------
    value
        None, bool, int, float, str, bytes, list, tuple, dict, numpy array or numpy scalar, nested as you like.
    name
        What it is called, for errors and payload paths.
    inline_below
        Arrays and bytes of fewer bytes are put into the message. numpy scalars always are.
    order
        ``"bgr"`` or ``"rgb"``: what three channels are.
    first_frame
        Index of the first payload.
    limits
        Depth and number of values.

    Raises
    ------
    MessageError
        Of reason ``"no codec"`` for another type, ``"too deep"``, ``"too many values"`` or ``"not utf-8"``.
    """
    writer = Writer(inline_below, limits, first_frame)
    message = message_class("epypes.v1.Value")()
    writer.write(message, value, name, order)
    return message, writer.payloads


class Writer:
    """Writes Value messages and collects what travels beside them.

    Attributes
    ----------
    payloads
        What travels beside the messages written so far, in the order of its frames.
    """

    def __init__(self, inline_below: int, limits: Limits, first_frame: int = 0) -> None:
        self._inline_below, self._limits, self._first_frame = inline_below, limits, first_frame
        self._order, self._count = "bgr", 0
        self.payloads: list[Payload] = []

    def write(self, message: Any, value: object, name: str, order: str) -> None:
        """Write a named value into a Value message; see `to_value`."""
        self._order, self._count = order, 0
        self._fill(message, value, (name,))

    def _fill(self, message: Any, value: object, path: Path) -> None:
        self._count += 1
        if self._count > self._limits.values:
            raise MessageError(
                "too many values",
                f"{path[0]!r} holds more than {self._limits.values:,} values. Make it a numpy array.",
            )
        if len(path) - 1 > self._limits.depth:
            raise MessageError(
                "too deep",
                f"{path[0]!r} nests deeper than {self._limits.depth} containers, or holds itself. Flatten it.",
            )
        plain = _PLAIN.get(type(value))
        if plain is not None:
            plain(self, message, value, path)
        else:
            self._fill_from_numpy(message, value, path)

    def _none(self, message: Any, value: None, path: Path) -> None:
        message.none = True

    def _boolean(self, message: Any, value: bool, path: Path) -> None:
        message.boolean = value

    def _integer(self, message: Any, value: int, path: Path) -> None:
        if value in _INT64:
            message.integer = value
        else:
            # Hexadecimal takes linear time; Python limits the decimal digits it converts.
            message.big_integer = format(value, "x")

    def _number(self, message: Any, value: float, path: Path) -> None:
        message.number = value

    def _text(self, message: Any, value: str, path: Path) -> None:
        try:
            message.text = value
        except ValueError as error:
            raise MessageError(
                "not utf-8",
                f"{spoken(path)} has lone surrogates, which no UTF-8 can hold. "
                "Encode it with errors='surrogateescape' and send bytes.",
            ) from error

    def _list(self, message: Any, value: Sequence[object], path: Path) -> None:
        items = message.tuple if type(value) is tuple else message.list
        items.SetInParent()
        for index, item in enumerate(value):
            self._fill(items.items.add(), item, (*path, index))

    def _map(self, message: Any, value: dict[object, object], path: Path) -> None:
        message.map.SetInParent()
        for key, item in value.items():
            entry = message.map.entries.add()
            self._fill(entry.key, key, (*path, key))
            self._fill(entry.value, item, (*path, key))

    def _bytes(self, message: Any, value: bytes, path: Path) -> None:
        message.encoded.media_type = "application/octet-stream"
        self._store(message.encoded, value, len(value), path)

    def _fill_from_numpy(self, message: Any, value: object, path: Path) -> None:
        # An array can only turn up once numpy has been imported by somebody else.
        np = sys.modules.get("numpy")
        if np is None or not isinstance(value, (np.ndarray, np.generic)):
            raise _no_codec(value, path)
        dtype = value.dtype
        if dtype.kind not in "biufcUS" or (isinstance(value, np.ndarray) and type(value) is not np.ndarray):
            raise _no_codec(value, path, f" of {dtype!r}")
        if isinstance(value, np.generic):
            self._scalar(message, value)
        elif dtype.itemsize == 0:
            raise _no_codec(value, path, " of text of no length")
        else:
            self._array(message, value, path)

    def _scalar(self, message: Any, value: Any) -> None:
        tensor = message.tensor
        tensor.dtype, tensor.scalar, tensor.inline = value.dtype.str, True, value.tobytes()
        if value.dtype.kind in _TEXT_KINDS:
            # As an array its trailing zeros would be cut.
            raw = bytes(value) if value.dtype.kind == "S" else value.encode("utf-32-le", "surrogatepass")
            tensor.inline = raw
            tensor.dtype = f"|S{len(raw)}" if value.dtype.kind == "S" else f"<U{len(raw) // 4}"

    def _array(self, message: Any, array: AnyArray, path: Path) -> None:
        encoding = image_encoding(array, self._order)
        if encoding is None:
            holder = message.tensor
            holder.dtype = array.dtype.str
            holder.shape.extend(array.shape)
        else:
            holder = message.image
            holder.height, holder.width = array.shape[:2]
            holder.encoding, holder.step = encoding, array.nbytes // array.shape[0]
        self._store(holder, array, array.nbytes, path)

    def _store(self, holder: Any, data: AnyArray | bytes, size: int, path: Path) -> None:
        if size >= self._inline_below:
            holder.frame = self._first_frame + len(self.payloads)
            self.payloads.append(Payload(path, data))
        elif isinstance(data, bytes):
            holder.inline = data
        else:
            holder.inline = data.tobytes()


_PLAIN: dict[type, Callable[[Writer, Any, Any, Path], None]] = {
    type(None): Writer._none,
    bool: Writer._boolean,
    int: Writer._integer,
    float: Writer._number,
    str: Writer._text,
    bytes: Writer._bytes,
    list: Writer._list,
    tuple: Writer._list,
    dict: Writer._map,
}


def _no_codec(value: object, path: Path, detail: str = "") -> MessageError:
    kind = type(value)
    name = kind.__qualname__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__qualname__}"
    return MessageError(
        "no codec",
        f"{spoken(path)} is of type {name}{detail}, which has no codec. Make it None, a bool, int, float, str, bytes, "
        "list, tuple, dict or a numpy array of booleans, numbers or text.",
    )


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

    def _map(self, content: Any, path: Path) -> dict[Any, Any]:
        result: dict[Any, Any] = {}
        for index, entry in enumerate(content.entries):
            key = self.read(entry.key, (*path, f"key {index}"))
            try:
                twice = key in result
            except TypeError as error:
                raise MessageError("bad key", f"{spoken(path)} has a key that can't be one: {error}.") from error
            if twice:
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

    def _tensor(self, content: Any, path: Path) -> Any:
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
    "tensor": Reader._tensor,
    "encoded": Reader._encoded,
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
