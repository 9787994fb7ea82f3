"""Writes Python values as Value messages; `reading` has the way back.

Only exact types are taken: a subclass (a namedtuple, a masked array) would come back as something else.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from epypes.errors import MessageError
from epypes.wire.arrays import image_encoding
from epypes.wire.instead import Path, no_codec, spoken
from epypes.wire.limits import DEFAULT_LIMITS, KeyCheck, Limits
from epypes.wire.records import records_in, write_records
from epypes.wire.schema import message_class
from epypes.wire.tables import write_table

if TYPE_CHECKING:
    from epypes.wire.arrays import AnyArray

_INT64 = range(-(2**63), 2**63)
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
        None, bool, int, float, complex, str, bytes, list, tuple, dict, set, frozenset, numpy array or scalar, OpenCV's
        KeyPoint and DMatch, a DataFrame or Series of pandas, nested as you like.
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
        Of reason ``"no codec"`` for another type, ``"too deep"``, ``"too many values"``, ``"too many keys"``,
        ``"colliding keys"`` or ``"not utf-8"``.
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
        self._key_check = KeyCheck(limits)
        self.payloads: list[Payload] = []

    def write(self, message: Any, value: object, name: str, order: str) -> None:
        """Write a named value into a Value message; see `to_value`."""
        self._order, self._count = order, 0
        self.fill(message, value, (name,))

    def fill(self, message: Any, value: object, path: Path) -> None:
        """Write a value that is at a path into a Value message."""
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
            self._fill_by_class(message, value, path)

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

    def _complex(self, message: Any, value: complex, path: Path) -> None:
        message.complex.real, message.complex.imaginary = value.real, value.imag
        message.complex.SetInParent()

    def _set(self, message: Any, value: Collection[object], path: Path) -> None:
        items = message.set if type(value) is set else message.frozen_set
        items.SetInParent()
        check = self._key_check.for_container(path)
        for item in sorted(value, key=set_order):
            check(item)
            self.fill(items.items.add(), item, (*path, item))

    def _list(self, message: Any, value: Sequence[object], path: Path) -> None:
        if records_in(value):
            write_records(self, message.records, value, path)
            return
        items = message.tuple if type(value) is tuple else message.list
        items.SetInParent()
        for index, item in enumerate(value):
            self.fill(items.items.add(), item, (*path, index))

    def _map(self, message: Any, value: dict[object, object], path: Path) -> None:
        message.map.SetInParent()
        check = self._key_check.for_container(path)
        for key, item in value.items():
            check(key)
            entry = message.map.entries.add()
            self.fill(entry.key, key, (*path, key))
            self.fill(entry.value, item, (*path, key))

    def _bytes(self, message: Any, value: bytes, path: Path) -> None:
        message.encoded.media_type = "application/octet-stream"
        self._store(message.encoded, value, len(value), path)

    def _fill_by_class(self, message: Any, value: object, path: Path) -> None:
        # An array can only turn up once numpy has been imported by somebody else.
        np = sys.modules.get("numpy")
        if np is not None and isinstance(value, (np.ndarray, np.generic)):
            self._fill_from_numpy(message, value, path, np.ndarray)
        elif records_in((value,)):
            write_records(self, message.records, value, path)
        elif not write_table(self, message, value, path):
            raise no_codec(value, path)

    def _fill_from_numpy(self, message: Any, value: Any, path: Path, array_class: type) -> None:
        dtype = value.dtype
        is_array = isinstance(value, array_class)
        if dtype.kind not in "biufcUS" or (is_array and type(value) is not array_class):
            raise no_codec(value, path, f" of {dtype!r}")
        if not is_array:
            self._scalar(message, value)
        elif dtype.itemsize == 0:
            raise no_codec(value, path, " of text of no length")
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
            self.fill_tensor(message.tensor, array, path)
            return
        holder = message.image
        holder.height, holder.width = array.shape[:2]
        holder.encoding, holder.step = encoding, array.nbytes // array.shape[0]
        self._store(holder, array, array.nbytes, path)

    def fill_tensor(self, message: Any, array: AnyArray, path: Path) -> None:
        """Write an array that is at a path into a Tensor message."""
        message.dtype = array.dtype.str
        message.shape.extend(array.shape)
        self._store(message, array, array.nbytes, path)

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
    complex: Writer._complex,
    str: Writer._text,
    bytes: Writer._bytes,
    list: Writer._list,
    tuple: Writer._list,
    dict: Writer._map,
    set: Writer._set,
    frozenset: Writer._set,
}


def set_order(item: object) -> str:
    """Return the text by which a set's items are sorted: that of their hashes changes from process to process."""
    if type(item) in (tuple, frozenset):
        texts = map(set_order, cast("Collection[object]", item))
        return f"{type(item).__name__}({','.join(sorted(texts) if type(item) is frozenset else texts)})"
    return f"{type(item).__name__} {item:x}" if type(item) is int else f"{type(item).__name__} {item!r}"
