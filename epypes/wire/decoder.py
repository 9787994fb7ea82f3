"""Decoding: the frames of a multipart message as an Envelope, and Value messages as Python values.

Nothing in a message is trusted before it is checked; whatever the bytes are, only MessageError is raised.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError
from epypes.wire.arrays import read_image, read_tensor
from epypes.wire.encoder import MAX_TOPIC_BYTES, REFUSALS, VERSION
from epypes.wire.envelope import Envelope, FailureRecord, scalar_fields
from epypes.wire.limits import DEFAULT_LIMITS, Limits, Path, ValueCounter, format_path
from epypes.wire.opencv_pandas import read_records, read_table
from epypes.wire.protobuf import message_class

if TYPE_CHECKING:
    from epypes.images import Order

_HEXADECIMAL: Final = re.compile(r"-?[0-9a-f]+")


def decode(frames: Sequence[bytes | bytearray | memoryview], limits: Limits = DEFAULT_LIMITS) -> Envelope:
    """Return the envelope of the frames of a multipart message.

    Parameters
    ----------
    frames
        As `encode` returns them. Arrays of payload frames are read-only views of these buffers: leave them as they
        are. Bytes are copied.
    limits
        They are checked before anything is allocated.

    Raises
    ------
    MessageError
        For anything that `encode` does not make, and nothing else, whatever the bytes are; its ``reason`` is a
        short text to count by.
    """
    views = [*map(as_view, frames)]
    header = read_header(views, limits)
    reader = ValueReader(views[2:], limits)
    rgb: set[str] = set()

    def read_part(entry: Any) -> Any:
        value = reader.read_named(entry.value, entry.name)
        if reader.order == "rgb":
            rgb.add(entry.name)
        return value

    def read_attribute(entry: Any) -> Any:
        return reader.read_named(entry.value, entry.name)

    try:
        envelope = Envelope(
            **scalar_fields(header),
            parts=_by_name(header.parts, "parts", limits, read_part),
            attributes=_by_name(header.attributes, "attributes", limits, read_attribute),
            timings=_by_name(header.timings, "timings", limits, attrgetter("duration_ns"), "function"),
            failure=read_failure(header),
            rgb=rgb,
        )
    except MessageError:
        raise
    except REFUSALS as error:
        raise MessageError("bad message", f"The message can't be decoded: {error}") from error
    reader.check_all_used()
    return envelope


def as_view(frame: bytes | bytearray | memoryview) -> memoryview:
    """Return a frame as a read-only, flat memoryview; raise MessageError if it is not contiguous bytes."""
    try:
        return memoryview(frame).toreadonly().cast("B")
    except (TypeError, ValueError) as error:
        raise MessageError("bad frame", f"A frame must be contiguous bytes: {error}") from error


def read_header(views: Sequence[memoryview], limits: Limits) -> Any:
    """Check the sizes, the topic and the version of a message; return its parsed header.

    Raises
    ------
    MessageError
        The frames are no v1 message, or exceed the limits.
    """
    limits.check_sizes([view.nbytes for view in views])
    topic = bytes(views[0][: MAX_TOPIC_BYTES + 1])
    if len(topic) > MAX_TOPIC_BYTES or not topic.endswith(b"/"):
        raise MessageError("bad topic", "The first frame is no topic: it must be short and end in a slash.")
    try:
        topic.decode()
    except UnicodeDecodeError as error:
        raise MessageError("bad topic", f"The topic is not UTF-8: {error}.") from error
    try:
        header = message_class("epypes.v1.Envelope").FromString(bytes(views[1]))
    except Exception as error:
        # Imported here, since an import takes as long as parsing.
        from google.protobuf.message import DecodeError

        if not isinstance(error, (DecodeError, *REFUSALS)):
            raise
        raise MessageError("no envelope", f"The second frame is no Envelope: {error}.") from error
    if header.version > VERSION:
        text = f"The Envelope is of version {header.version}, and this EPypes reads version {VERSION}."
        raise MessageError("unknown version", f"{text} Install a newer EPypes where it is received.")
    return header


def read_failure(header: Any) -> FailureRecord | None:
    """Return the failure that a header reports, or None."""
    if not header.HasField("failure"):
        return None
    found = header.failure
    return FailureRecord(
        found.function, tuple(found.tokens), found.exception, found.message, found.input_id, found.attempt
    )


def _by_name(
    entries: Sequence[Any], kind: str, limits: Limits, read: Callable[[Any], Any], field: str = "name"
) -> dict[str, Any]:
    """Read the entries into a dict by the name in a field; each name may occur once."""
    limits.check_names(len(entries), kind)
    result: dict[str, Any] = {}
    for entry in entries:
        name = getattr(entry, field)
        if name in result:
            raise MessageError("name used twice", f"The message has {name[:80]!r} twice among its {kind}.")
        result[name] = read(entry)
    return result


class ValueReader:
    """Reads the Value messages of one multipart message.

    Parameters
    ----------
    frames
        The payload frames, each a one-dimensional memoryview of bytes.
    limits
        Depth, number of values and of keys.

    Attributes
    ----------
    counter
        Counts the values that are read.
    order
        The colour order of the named value that was read last, None if it has no colours. A value has one order:
        an image of another order than the first one in it is converted.
    """

    def __init__(self, frames: Sequence[memoryview], limits: Limits = DEFAULT_LIMITS) -> None:
        self._frames = frames
        self._used: set[int] = set()
        self.counter = ValueCounter(limits)
        self.order: Order | None = None

    def read_named(self, message: Any, name: str) -> Any:
        """Return the value with a name of its own, such as a part; raise MessageError if the message has none."""
        self.order = None
        self.counter.count((name,))
        return self.read(message, (name,))

    def read(self, message: Any, path: Path) -> Any:
        """Return the value that is at a path; its container has counted it."""
        kind = message.WhichOneof("kind")
        if kind is None:
            raise MessageError("unknown value", f"{format_path(path)} has no value, or one of a newer kind.")
        content = getattr(message, kind)
        read = _READ.get(kind)
        return content if read is None else read(self, content, path)

    def stored(self, holder: Any, path: Path) -> memoryview:
        """Return the data of a message with the fields ``inline`` and ``frame``."""
        storage = holder.WhichOneof("storage")
        if storage is None:
            raise MessageError("no data", f"{format_path(path)} has neither inline data nor a frame.")
        if storage == "inline":
            return memoryview(holder.inline)
        index: int = holder.frame
        if index >= len(self._frames):
            text = f"{format_path(path)} is in payload frame {index}, but there are {len(self._frames)}."
            raise MessageError("missing frame", text)
        if index in self._used:
            text = f"{format_path(path)} is in payload frame {index}, and so is another value."
            raise MessageError("frame used twice", text)
        self._used.add(index)
        return self._frames[index]

    def check_all_used(self) -> None:
        """Raise MessageError if a frame belongs to no value."""
        if len(self._used) != len(self._frames):
            left = sorted(set(range(len(self._frames))) - self._used)
            raise MessageError("unused frame", f"Payload frames {left[:8]} belong to no value.")

    def _none(self, content: bool, path: Path) -> None:
        return None

    def _big_integer(self, content: str, path: Path) -> int:
        if not _HEXADECIMAL.fullmatch(content):
            raise MessageError("bad integer", f"{format_path(path)} is no hexadecimal integer: {content[:40]!r}.")
        return int(content, 16)

    def _complex(self, content: Any, path: Path) -> complex:
        return complex(content.real, content.imaginary)

    def _bytes(self, content: Any, path: Path) -> bytes:
        return bytes(self.stored(content, path))

    def _list(self, content: Any, path: Path) -> list[Any]:
        self.counter.enter(path, len(content.items))
        return [self.read(item, (*path, index)) for index, item in enumerate(content.items)]

    def _tuple(self, content: Any, path: Path) -> tuple[Any, ...]:
        return tuple(self._list(content, path))

    def _set(self, content: Any, path: Path) -> set[Any]:
        items = self._list(content, path)
        check = self.counter.key_check(path)
        for item in items:
            check(item)
        result = set(items)
        if len(result) < len(items):
            raise MessageError("bad key", f"{format_path(path)} is a set that has an item twice.")
        return result

    def _frozen_set(self, content: Any, path: Path) -> frozenset[Any]:
        return frozenset(self._set(content, path))

    def _mapping(self, content: Any, path: Path) -> dict[Any, Any]:
        result: dict[Any, Any] = {}
        self.counter.enter(path, 2 * len(content.entries))
        check = self.counter.key_check(path)
        for index, entry in enumerate(content.entries):
            key = self.read(entry.key, (*path, f"key {index}"))
            check(key)
            if key in result:
                raise MessageError("bad key", f"{format_path(path)} has the key {str(key)[:40]!r} twice.")
            result[key] = self.read(entry.value, (*path, key))
        return result


# The kinds of Value that are not here (boolean, integer, number, text) need no conversion.
_READ: Final[dict[str, Callable[[ValueReader, Any, Path], Any]]] = {
    "none": ValueReader._none,
    "big_integer": ValueReader._big_integer,
    "complex": ValueReader._complex,
    "encoded": ValueReader._bytes,
    "list": ValueReader._list,
    "tuple": ValueReader._tuple,
    "map": ValueReader._mapping,
    "set": ValueReader._set,
    "frozen_set": ValueReader._frozen_set,
    "image": read_image,
    "tensor": read_tensor,
    "records": read_records,
    "table": read_table,
}
