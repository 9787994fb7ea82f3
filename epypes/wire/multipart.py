"""How does an Envelope become frames, and frames an Envelope? Topic, header, payloads."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from epypes.errors import MessageError
from epypes.wire.arrays import flat_bytes
from epypes.wire.codecs import Payload, Writer
from epypes.wire.envelope import Envelope, FailureRecord
from epypes.wire.limits import DEFAULT_LIMITS, Limits
from epypes.wire.reading import Reader
from epypes.wire.schema import message_class

# Fields of the same name and meaning in the dataclass and in the message.
_PLAIN_FIELDS = (
    "id",
    "type",
    "source",
    "epoch",
    "sequence",
    "acquired_ns",
    "published_ns",
    "correlation_id",
    "revision",
    "bundle_digest",
)
_UNSET = ("", 0)
_MAX_TOPIC_BYTES = 1024
# What encode writes, and the greatest that decode reads. Fields may be added without raising it, since old receivers
# pass over them; it rises when what is there already changes its meaning.
VERSION = 1
# What protobuf and numpy raise for values that they can't take; anything else is a bug of ours and must show.
_REFUSALS = (ValueError, TypeError, OverflowError, MemoryError, RecursionError)


class Stamp(NamedTuple):
    """What a publisher knows better than who made the envelope; see there."""

    epoch: int
    sequence: int
    published_ns: int


def encode(
    envelope: Envelope,
    topic: str = "",
    inline_below: int = 8192,
    *,
    rgb: Collection[str] = (),
    limits: Limits = DEFAULT_LIMITS,
    stamp: Stamp | None = None,
) -> list[bytes | memoryview]:
    """Return the frames of an envelope: topic, header, payloads.

    Parameters
    ----------
    envelope
        What to send.
    topic
        The first frame is the topic with a slash at its end, so that ``cam1`` never matches ``cam10``.
    inline_below
        Arrays and bytes of fewer bytes ride inside the header.
    rgb
        Names of parts in RGB order, beside those that the envelope names itself.
    limits
        What the receiver will accept.
    stamp
        Epoch, sequence number and time of publishing, in place of the envelope's own.

    Returns
    -------
    list of bytes or memoryview
        A memoryview is read-only, of the array's own memory where that is C-contiguous: leave the array alone
        until the frames are sent.

    Raises
    ------
    MessageError
        Of reason ``"no codec"``, ``"too deep"``, ``"too large"``, ``"not utf-8"``, ``"bad field"``, ...
    """
    header = message_class("epypes.v1.Envelope")()
    writer = Writer(inline_below, limits)
    first = topic_frame(topic)
    try:
        _write_plain(header, envelope)
        if stamp is not None:
            header.epoch, header.sequence, header.published_ns = stamp
        _write_values(writer, header.parts, envelope.parts, "parts", limits, {*rgb, *envelope.rgb})
        if envelope.attributes:
            _write_values(writer, header.attributes, envelope.attributes, "attributes", limits)
        head: bytes = header.SerializeToString()
    except MessageError:
        raise
    except _REFUSALS as error:
        raise MessageError("bad field", f"{envelope!r} has a field that can't be sent: {error}") from error
    frames: list[bytes | memoryview] = [first, head, *map(_payload_frame, writer.payloads)]
    # The frames are flat, so the length of each is its size in bytes.
    _check_sizes([len(frame) for frame in frames], limits)
    return frames


def _write_values(
    writer: Writer,
    entries: Any,
    values: Mapping[str, Any],
    what: str,
    limits: Limits,
    marked: Collection[str] = (),
) -> None:
    if len(values) > limits.parts:
        raise MessageError(f"too many {what}", f"{len(values)} {what}, but the limit is {limits.parts}.")
    for name, value in values.items():
        writer.write(entries.add(name=name).value, value, str(name), "rgb" if name in marked else "bgr")


def topic_frame(topic: str) -> bytes:
    """Return a topic as its frame: UTF-8, with a slash at its end.

    Raises
    ------
    MessageError
        Of reason ``"bad topic"`` if it is no text, or longer than 1,023 bytes.
    """
    try:
        frame = topic.removesuffix("/").encode() + b"/"
    except (AttributeError, UnicodeEncodeError) as error:
        raise MessageError("bad topic", f"{topic!r} can't be a topic: {error}. Give a str.") from error
    if len(frame) > _MAX_TOPIC_BYTES:
        raise MessageError("bad topic", f"A topic of {len(frame)} bytes; {_MAX_TOPIC_BYTES} is the limit.")
    return frame


def _write_plain(header: Any, envelope: Envelope) -> None:
    header.version = VERSION
    for name in _PLAIN_FIELDS:
        value = getattr(envelope, name)
        # What is not set reads as 0 or as an empty text.
        if value not in _UNSET:
            setattr(header, name, value)
    for function, duration_ns in envelope.timings.items():
        header.timings.add(function=function, duration_ns=duration_ns)
    failure = envelope.failure
    if failure is not None:
        header.failure.SetInParent()
        for name in ("function", "exception", "message", "input_id", "attempt"):
            setattr(header.failure, name, getattr(failure, name))
        header.failure.tokens.extend(failure.tokens)


def _payload_frame(payload: Payload) -> bytes | memoryview:
    if isinstance(payload.data, bytes):
        return payload.data
    return flat_bytes(payload.data)


def decode(frames: Sequence[bytes | bytearray | memoryview], limits: Limits = DEFAULT_LIMITS) -> Envelope:
    """Return the envelope of the frames of a multipart message.

    Parameters
    ----------
    frames
        As `encode` returns them. Arrays of payload frames are read-only views of these buffers: keep them as they
        are. Bytes are copied.
    limits
        What is accepted. It is checked before anything is allocated.

    Raises
    ------
    MessageError
        For anything that `encode` does not make, and nothing else, whatever the bytes are; its ``reason`` is a
        short word to count by.
    """
    views = [*map(_view, frames)]
    _check_sizes([view.nbytes for view in views], limits)
    _check_topic(views[0])
    header = _parse(views[1])
    _check_version(header.version)
    reader = Reader(views[2:], limits)
    rgb: set[str] = set()

    def read_part(entry: Any) -> Any:
        value = reader.read(entry.value, (entry.name,))
        if reader.order == "rgb":
            rgb.add(entry.name)
        return value

    def read_attribute(entry: Any) -> Any:
        return reader.read(entry.value, (entry.name,))

    try:
        envelope = Envelope(
            **{name: getattr(header, name) for name in _PLAIN_FIELDS},
            parts=_read_unique(header.parts, "parts", limits, read_part),
            attributes=_read_unique(header.attributes, "attributes", limits, read_attribute),
            timings=_read_unique(header.timings, "timings", limits, _duration, _function),
            failure=_read_failure(header.failure) if header.HasField("failure") else None,
            rgb=rgb,
        )
    except MessageError:
        raise
    except _REFUSALS as error:
        raise MessageError("bad message", f"The message can't be understood: {error}") from error
    reader.check_all_used()
    return envelope


def _view(frame: bytes | bytearray | memoryview) -> memoryview:
    try:
        return memoryview(frame).toreadonly().cast("B")
    except (TypeError, ValueError) as error:
        raise MessageError("bad frame", f"A frame must be contiguous bytes: {error}") from error


def _check_sizes(sizes: Sequence[int], limits: Limits) -> None:
    if len(sizes) < 2:
        raise MessageError("too few frames", f"{len(sizes)} frames; a v1 message has a topic and an Envelope.")
    if len(sizes) - 2 > limits.frames:
        raise MessageError("too many frames", f"{len(sizes) - 2} payload frames, but the limit is {limits.frames}.")
    total = sum(sizes)
    if total > limits.total_bytes:
        raise MessageError("too large", f"The message has {total:,} bytes; the limit is {limits.total_bytes:,}.")
    if sizes[1] > limits.header_bytes:
        raise MessageError(
            "too large",
            f"The Envelope has {sizes[1]:,} bytes; the limit is {limits.header_bytes:,}. "
            "Send long lists as numpy arrays.",
        )


def _check_topic(view: memoryview) -> None:
    if view.nbytes > _MAX_TOPIC_BYTES or not bytes(view[-1:]) == b"/":
        raise MessageError("bad topic", "The first frame is no topic: it must be short and end in a slash.")
    try:
        bytes(view).decode()
    except UnicodeDecodeError as error:
        raise MessageError("bad topic", f"The topic is not UTF-8: {error}.") from error


def _parse(view: memoryview) -> Any:
    try:
        return message_class("epypes.v1.Envelope").FromString(bytes(view))
    except Exception as error:
        # Looked up here, since an import takes as long as parsing.
        from google.protobuf.message import DecodeError

        if not isinstance(error, (DecodeError, *_REFUSALS)):
            raise
        raise MessageError("no envelope", f"The second frame is no Envelope: {error}.") from error


def _check_version(version: int) -> None:
    if version > VERSION:
        raise MessageError(
            "unknown version",
            f"The Envelope is of version {version}, and this EPypes reads version {VERSION}. "
            "Install a newer EPypes where it is received.",
        )


def _name(entry: Any) -> str:
    return str(entry.name)


def _function(entry: Any) -> str:
    return str(entry.function)


def _duration(entry: Any) -> int:
    return int(entry.duration_ns)


def _read_unique(
    entries: Iterable[Any],
    what: str,
    limits: Limits,
    read: Callable[[Any], Any],
    name_of: Callable[[Any], str] = _name,
) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for entry in entries:
        name = name_of(entry)
        if name in result:
            raise MessageError("name used twice", f"The message has {name[:80]!r} twice among its {what}.")
        if len(result) == limits.parts:
            raise MessageError(f"too many {what}", f"The message has more than {limits.parts} {what}.")
        result[name] = read(entry)
    return result


def _read_failure(message: Any) -> FailureRecord:
    return FailureRecord(
        message.function,
        tuple(message.tokens),
        message.exception,
        message.message,
        message.input_id,
        message.attempt,
    )
