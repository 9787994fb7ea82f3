"""What tells a value from any other one?

A digest of all that is in it. A `repr` would not do: that of a large array leaves out most of it, that of an object is
the place where it is in memory.
"""

from __future__ import annotations

import datetime
import decimal
import enum
import fractions
import hashlib
import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.errors import MessageError
from epypes.run.guard import is_array, is_plain_array
from epypes.wire.encoder import ValueWriter
from epypes.wire.protobuf import message_class

_BYTES: Final = 16
_SHOWN: Final = 60
_SCALARS: Final = (type(None), bool, int, float, complex, str)
# Their repr says all that is in them.
_SAID: Final = (
    datetime.date,
    datetime.time,
    datetime.datetime,
    datetime.timedelta,
    datetime.timezone,
    decimal.Decimal,
    fractions.Fraction,
    uuid.UUID,
    range,
    type(...),
)


class Untold(TypeError):
    """A value of which nobody can say what is in it."""


def digest_of(value: Any) -> str:
    """Return what tells a value from others: arrays of any kind, containers, enumerations, numbers, texts, files.

    A path stands for what is in its file. Beside these, all that `epypes.wire` has a codec for.

    Raises
    ------
    Untold
        It is, or holds, something of which that can't be said; or a file that can't be read.
    """
    try:
        return _digest(value).hex()
    except RecursionError as error:
        raise Untold(f"a {type(value).__name__!r} that holds itself") from error


def told(value: Any) -> str:
    """Return a value as a person reads it, with its digest if that does not say all.

    Raises
    ------
    Untold
        As for `digest_of`.
    """
    digest = digest_of(value)
    if _is_short(value) and len(text := repr(value)) <= _SHOWN:
        return text
    what = f"{value.dtype} {value.shape}" if is_plain_array(value) else type(value).__name__
    return f"{value} {digest}" if isinstance(value, enum.Enum) else f"{what} {digest}"


def joined(kind: str, *parts: bytes | memoryview | str) -> bytes:
    """Return a digest of several parts, each of which is told from its neighbours."""
    made = hashlib.blake2b(kind.encode(), digest_size=_BYTES)
    for part in parts:
        raw = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        made.update(b"\0%d:" % len(raw))
        made.update(raw)
    return made.digest()


def _is_short(value: Any) -> bool:
    if type(value) in (tuple, list):
        return len(value) <= _SHOWN and all(map(_is_short, value))
    # A long number takes long to write, and of one that is too long Python refuses to.
    return type(value) in _SCALARS and not (type(value) is int and value.bit_length() > _SHOWN * 4)


def _digest(value: Any) -> bytes:
    plain = _BY_TYPE.get(type(value))
    if plain is not None:
        return plain(value)
    if is_array(value):
        return _of_array(value)
    found = next((way for kind, way in _BY_CLASS if isinstance(value, kind)), None)
    if found is not None:
        return found(value)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return _of_items(value)
    return _of_scalar(value) if _is_numpy_scalar(value) else _of_wire(value)


def _kind(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"


def _of_text(value: Any) -> bytes:
    return joined(_kind(value), repr(value))


def _of_int(value: int) -> bytes:
    # In time linear in its length; and Python refuses to write very long ones as decimals.
    return joined("int", hex(value))


def _of_str(value: str) -> bytes:
    return joined("str", value)


def _of_bytes(value: Any) -> bytes:
    return joined(_kind(value), bytes(value))


def _of_view(value: memoryview) -> bytes:
    return joined("memoryview", repr(value.format), repr(value.shape), value.tobytes())


def _of_items(value: Iterable[Any]) -> bytes:
    return joined(_kind(value), *map(_digest, value))


def _of_set(value: Iterable[Any]) -> bytes:
    return joined(_kind(value), *sorted(map(_digest, value)))


def _of_dict(value: Mapping[Any, Any]) -> bytes:
    return joined(_kind(value), *(_digest(part) for item in value.items() for part in item))


def _of_member(value: enum.Enum) -> bytes:
    return joined(_kind(value), str(value.name), _digest(value.value))


def _of_class(value: type) -> bytes:
    return joined("type", f"{value.__module__}.{value.__qualname__}")


def file_digest(path: Path) -> str:
    """Return a digest of what is in a file, and of the end of its name, which decides how it is read.

    Raises
    ------
    Untold
        There is no such file, or it can't be read.
    """
    try:
        # Who opens a pipe waits for somebody who writes into it.
        if not path.is_file():
            raise Untold(f"{str(path)!r}, which is no file")
        with path.open("rb") as file:
            # The fastest one that there is: processors compute it themselves.
            found = hashlib.file_digest(file, "sha256").digest()
    except OSError as error:
        raise Untold(f"{str(path)!r}, which can't be read: {error.strerror}") from error
    return joined("file", path.suffix.lower(), found).hex()


def _of_path(value: PurePath) -> bytes:
    """Return a digest of a path that is handed on as it is: of the name, and of the file if there is one."""
    try:
        return joined("path", str(value), file_digest(Path(value)))
    except Untold:
        return joined("path", str(value))


def _is_numpy_scalar(value: Any) -> bool:
    return getattr(value, "shape", None) == () and hasattr(value, "dtype") and hasattr(value, "tobytes")


# NumPy's long doubles have bytes that mean nothing.
_PADDED: Final = "gG"


def _of_scalar(value: Any) -> bytes:
    content = repr(value) if value.dtype.char in _PADDED else value.tobytes()
    return joined(_kind(value), repr(value.dtype.descr), content)


def _of_array(array: Any) -> bytes:
    import numpy as np

    plain = np.asarray(array)
    described = _kind(array), repr(plain.dtype.descr), repr(plain.shape)
    if plain.dtype.hasobject or plain.dtype.char in _PADDED:
        content: bytes | memoryview = _digest(plain.tolist())
    else:
        content = np.ascontiguousarray(plain).reshape(-1).view(np.uint8).data if plain.nbytes else b""
    if isinstance(array, np.ma.MaskedArray):
        more = _digest((np.ma.getmaskarray(array), array.fill_value, bool(array.hardmask)))
    else:
        # What a class of somebody's own keeps beside the numbers, such as a unit.
        more = _digest(dict(getattr(array, "__dict__", {}))) if type(array) is not np.memmap else b""
    return joined("array", *described, content, more)


def _of_wire(value: Any) -> bytes:
    message, writer = message_class("epypes.v1.Value")(), ValueWriter()
    try:
        writer.write_named(message, value, "value")
    except MessageError as error:
        raise Untold(f"a {type(value).__name__!r}") from error
    beside = (_digest(payload.data) for payload in writer.payloads)
    return joined(_kind(value), message.SerializeToString(deterministic=True), *beside)


_BY_TYPE: Final[Mapping[type, Callable[[Any], bytes]]] = {
    int: _of_int,
    str: _of_str,
    bytes: _of_bytes,
    bytearray: _of_bytes,
    memoryview: _of_view,
    list: _of_items,
    tuple: _of_items,
    dict: _of_dict,
    set: _of_set,
    frozenset: _of_set,
    type: _of_class,
    **dict.fromkeys((type(None), bool, float, complex, *_SAID), _of_text),
}
_BY_CLASS: Final[tuple[tuple[type, Callable[[Any], bytes]], ...]] = (
    (enum.Enum, _of_member),
    (PurePath, _of_path),
    (type, _of_class),
)
