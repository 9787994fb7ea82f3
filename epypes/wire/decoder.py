"""Decoding: the frames of a multipart message as an Envelope, or its header alone; Value messages as Python values.

Nothing in a message is trusted before it is checked; whatever the bytes are, only MessageError is raised.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import MessageError
from epypes.nothing import Nothing, NothingType
from epypes.wire.arrays import read_image, read_tensor
from epypes.wire.encoder import MAX_TOPIC_BYTES, REFUSALS, VERSION, encode
from epypes.wire.envelope import SCALAR_FIELDS, Envelope, FailureRecord
from epypes.wire.limits import DEFAULT_LIMITS, LEADING_FRAMES, Limits, Path, ValueCounter, format_path
from epypes.wire.opencv import read_records
from epypes.wire.protobuf import message_class
from epypes.wire.tables import read_arrow_table, read_table

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
    views = _views(frames)
    header = read_header(views, "epypes.v1.Envelope", limits)
    limits.check_names(header)
    reader = ValueReader(views[LEADING_FRAMES:], limits)
    try:
        parts, rgb = reader.read_named(header.parts, "parts")
        attributes, _ = reader.read_named(header.attributes, "attributes")
        envelope = Envelope(
            **{name: getattr(header, name) for name in SCALAR_FIELDS},
            parts=parts,
            attributes=attributes,
            timings={entry.function: entry.duration_ns for entry in header.timings},
            failure=_read_failure(header.failure) if header.HasField("failure") else None,
            rgb=rgb,
        )
    except MessageError:
        raise
    except REFUSALS as error:
        raise MessageError("bad message", f"The message can't be decoded: {error}") from error
    if len(envelope.timings) < len(header.timings):
        raise _used_twice("a function", "timings")
    reader.check_all_used()
    return envelope


class EncodedEnvelope:
    """A v1 message as its frames, of which only the header is read; made by `read` or `encode`.

    What arrives as frames leaves as frames: a process that routes, numbers or counts messages needs none of their
    values.

    Attributes
    ----------
    frames
        Topic, header, payloads. Those of `encode` may be the memory of an array: leave the array alone until the frames
        are sent.
    failure
        None, or the failure that the envelope reports.
    limits
        The limits that it was checked against.
    id, type, source, epoch, sequence, acquired_ns, published_ns, correlation_id, revision, bundle_digest, \
    request_source, request_epoch, request_sequence
        As in `Envelope`.
    """

    __slots__ = ("failure", "frames", "limits", *SCALAR_FIELDS)

    frames: tuple[memoryview, ...]
    failure: FailureRecord | None
    limits: Limits
    id: str
    type: str
    source: str
    epoch: int
    sequence: int
    acquired_ns: int
    published_ns: int
    correlation_id: str
    revision: int
    bundle_digest: str
    request_source: str
    request_epoch: int
    request_sequence: int

    @classmethod
    def read(cls, frames: Sequence[bytes | bytearray | memoryview], limits: Limits = DEFAULT_LIMITS) -> Self:
        """Return a received message; its values are neither parsed nor checked.

        Parameters
        ----------
        frames
            Topic, header, payloads. They are kept, not copied.
        limits
            Sizes and number of frames that are accepted.

        Raises
        ------
        MessageError
            The frame count, a size, the topic, the version or the header is not that of a v1 message.
        """
        views = _views(frames)
        header = read_header(views, "epypes.v1.Header", limits)
        made = cls()
        made.frames, made.limits = tuple(views), limits
        made.failure = _read_failure(header.failure) if header.HasField("failure") else None
        for name in SCALAR_FIELDS:
            setattr(made, name, getattr(header, name))
        return made

    @classmethod
    def encode(cls, envelope: Envelope, topic: str = "", *, limits: Limits = DEFAULT_LIMITS) -> Self:
        """Return an envelope encoded.

        Raises
        ------
        MessageError
            As `epypes.wire.encode`.
        """
        return cls.read(encode(envelope, topic, limits=limits), limits)

    def decode(self) -> Envelope:
        """Return the envelope with its values.

        Raises
        ------
        MessageError
            As `epypes.wire.decode`.
        """
        return decode(self.frames, self.limits)

    def text_attributes(self) -> dict[str, str]:
        """Return the attributes that are texts, by name; no other value is decoded.

        Raises
        ------
        MessageError
            The header is not that of a v1 message.
        """
        entries = read_header(self.frames, "epypes.v1.Envelope", self.limits).attributes
        return {entry.name: entry.value.text for entry in entries if entry.value.WhichOneof("kind") == "text"}

    def __repr__(self) -> str:
        number = f" #{self.sequence}" if self.sequence else ""
        return f"<EncodedEnvelope {self.type[:20]!r}{number}: {sum(map(len, self.frames)):,} bytes>"


def _views(frames: Sequence[bytes | bytearray | memoryview]) -> list[memoryview]:
    try:
        return [memoryview(frame).toreadonly().cast("B") for frame in frames]
    except (TypeError, ValueError) as error:
        raise MessageError("bad frame", f"A frame must be contiguous bytes: {error}") from error


def read_header(views: Sequence[memoryview], kind: str, limits: Limits) -> Any:
    """Check the sizes, the topic and the version of a message; return its header, parsed as a message of a kind."""
    limits.check_frames(views)
    topic = bytes(views[0][: MAX_TOPIC_BYTES + 1])
    if len(topic) > MAX_TOPIC_BYTES or not topic.endswith(b"/"):
        raise MessageError("bad topic", "The first frame is no topic: it must be short and end in a slash.")
    try:
        topic.decode()
    except UnicodeDecodeError as error:
        raise MessageError("bad topic", f"The topic is not UTF-8: {error}.") from error
    try:
        header = message_class(kind).FromString(bytes(views[1]))
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


def _read_failure(found: Any) -> FailureRecord:
    return FailureRecord(
        found.function, tuple(found.tokens), found.exception, found.message, found.input_id, found.attempt
    )


def _used_twice(name: str, kind: str) -> MessageError:
    return MessageError("name used twice", f"The message has {name} twice among its {kind}.")


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

    def read_named(self, entries: Sequence[Any], kind: str) -> tuple[dict[str, Any], set[str]]:
        """Return the values of messages with the fields ``name`` and ``value`` by name, and the names of those in RGB.

        Raises
        ------
        MessageError
            A name occurs twice, or a value is none that `epypes.wire.encoder.ValueWriter` writes.
        """
        result: dict[str, Any] = {}
        rgb: set[str] = set()
        for entry in entries:
            name = entry.name
            if name in result:
                raise _used_twice(repr(name[:80]), kind)
            self.order = None
            self.counter.count((name,))
            result[name] = self.read(entry.value, (name,))
            if self.order == "rgb":
                rgb.add(name)
        return result, rgb

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

    def _nothing(self, content: bool, path: Path) -> NothingType:
        return Nothing

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
    "nothing": ValueReader._nothing,
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
    "arrow_table": read_arrow_table,
}
