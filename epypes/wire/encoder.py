"""Encoding: an Envelope as the frames of a multipart message, and Python values as Value messages.

Only exact types are accepted: a subclass (a namedtuple, a masked array) would come back as its base class.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from epypes.errors import MessageError
from epypes.nothing import NothingType
from epypes.wire.arrays import flat_bytes, write_array
from epypes.wire.envelope import SCALAR_FIELDS, Envelope, FailureRecord
from epypes.wire.limits import DEFAULT_LIMITS, Limits, Path, ValueCounter, format_path, no_codec
from epypes.wire.opencv import are_records, write_records
from epypes.wire.protobuf import message_class
from epypes.wire.tables import is_table, write_table

if TYPE_CHECKING:
    from epypes.wire.arrays import AnyArray

# The version that encode writes, and the greatest that decode reads. Fields may be added without raising it, since old
# receivers skip them; it rises when existing fields change their meaning.
VERSION: Final = 1
MAX_TOPIC_BYTES: Final = 1024
# Arrays and bytes of fewer bytes are sent inside the Envelope frame.
INLINE_BELOW: Final = 8192
# Errors of protobuf and numpy for values that they refuse; any other error is a bug here and must not be hidden.
REFUSALS: Final = (ValueError, TypeError, OverflowError, MemoryError, RecursionError)
_UNSET: Final = ("", 0)
_INT64: Final = range(-(2**63), 2**63)


def topic_frame(topic: str) -> bytes:
    """Return a topic as its frame: UTF-8, with a slash at its end, so that ``cam1`` never matches ``cam10``.

    Raises
    ------
    MessageError
        Of reason ``"bad topic"`` if it is no text, or longer than 1,023 bytes.
    """
    try:
        frame = topic.removesuffix("/").encode() + b"/"
    except (AttributeError, UnicodeEncodeError) as error:
        raise MessageError("bad topic", f"{topic!r} can't be a topic: {error}. Give a str.") from error
    if len(frame) > MAX_TOPIC_BYTES:
        raise MessageError("bad topic", f"A topic of {len(frame)} bytes; {MAX_TOPIC_BYTES} is the limit.")
    return frame


def encode(
    envelope: Envelope,
    topic: str = "",
    inline_below: int = INLINE_BELOW,
    *,
    limits: Limits = DEFAULT_LIMITS,
) -> list[bytes | memoryview]:
    """Return the frames of an envelope: topic, header, payloads.

    Parameters
    ----------
    envelope
        The message to send. Its values are None, Nothing, bool, int, float, complex, str, bytes, list, tuple, dict,
        set, frozenset, arrays and scalars of numpy, KeyPoint and DMatch of OpenCV, DataFrames and Series of pandas, in
        any nesting.
    topic
        The first frame, see `topic_frame`.
    inline_below
        Arrays and bytes of fewer bytes are put into the header. numpy scalars always are.
    limits
        The receiver's limits.

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
    frames: list[bytes | memoryview] = [topic_frame(topic)]
    header = message_class("epypes.v1.Envelope")()
    writer = ValueWriter(limits, inline_below)
    limits.check_names(envelope)
    try:
        header.version = VERSION
        for name in SCALAR_FIELDS:
            value = getattr(envelope, name)
            # A field that is not set reads as 0 or as an empty text.
            if value not in _UNSET:
                setattr(header, name, value)
        for function, duration_ns in envelope.timings.items():
            header.timings.add(function=function, duration_ns=duration_ns)
        if envelope.failure is not None:
            _write_failure(header.failure, envelope.failure)
        for name, value in envelope.parts.items():
            writer.write_named(
                header.parts.add(name=name).value, value, str(name), "rgb" if name in envelope.rgb else "bgr"
            )
        for name, value in envelope.attributes.items():
            writer.write_named(header.attributes.add(name=name).value, value, str(name))
        frames.append(header.SerializeToString())
    except MessageError:
        raise
    except REFUSALS as error:
        raise MessageError("bad field", f"{envelope!r} has a field that can't be sent: {error}") from error
    frames += [data if isinstance(data, bytes) else flat_bytes(data) for _, data in writer.payloads]
    limits.check_frames(frames)
    return frames


def stamped_frames(
    frames: Sequence[bytes | memoryview], epoch: int, sequence: int, published_ns: int, limits: Limits = DEFAULT_LIMITS
) -> tuple[bytes | memoryview, ...]:
    """Return the frames of an envelope with other values of three fields of its header; no value is touched.

    protobuf merges concatenated messages, so that nothing is parsed or encoded again.

    Raises
    ------
    MessageError
        Of reason ``"bad field"`` for a number that the field can't hold, or ``"too large"``.
    """
    try:
        stamp = message_class("epypes.v1.Header")(epoch=epoch, sequence=sequence, published_ns=published_ns)
    except REFUSALS as error:
        raise MessageError("bad field", f"A stamp has a field that can't be sent: {error}") from error
    topic, header, *payloads = frames
    stamped = (topic, b"".join((header, stamp.SerializeToString())), *payloads)
    limits.check_frames(stamped)
    return stamped


def _write_failure(message: Any, failure: FailureRecord) -> None:
    message.SetInParent()
    message.tokens.extend(failure.tokens)
    for name in ("function", "exception", "message", "input_id", "attempt"):
        setattr(message, name, getattr(failure, name))


class Payload(NamedTuple):
    """Bytes that are sent beside the header: an array as it was given (any layout), or bytes; and where it was."""

    path: Path
    data: AnyArray | bytes


class ValueWriter:
    """Writes Python values into Value messages and collects the payloads beside them.

    Parameters
    ----------
    limits
        Depth, number of values and of keys.
    inline_below
        Arrays and bytes of fewer bytes are put into the message.

    Attributes
    ----------
    counter
        Counts the values that are written.
    payloads
        The payloads of the values written so far, in the order of their frames.
    order
        ``"bgr"`` or ``"rgb"``: the colour order of the named value that is being written.
    """

    def __init__(self, limits: Limits = DEFAULT_LIMITS, inline_below: int = INLINE_BELOW) -> None:
        self._inline_below = inline_below
        self.counter = ValueCounter(limits)
        self.payloads: list[Payload] = []
        self.order = "bgr"

    def write_named(self, message: Any, value: object, name: str, order: str = "bgr") -> None:
        """Write a value with a name of its own, such as a part, into a Value message.

        Raises
        ------
        MessageError
            Of reason ``"no codec"`` for another type than those of `encode`, ``"too deep"``, ``"too many values"``,
            ``"too many keys"``, ``"colliding keys"`` or ``"not utf-8"``.
        """
        self.order = order
        self.counter.count((name,))
        self.write(message, value, (name,))

    def write(self, message: Any, value: object, path: Path) -> None:
        """Write a value that is at a path; its container has counted it."""
        write = _WRITE.get(type(value))
        if write is not None:
            write(self, message, value, path)
            return
        # An array only exists once numpy has been imported.
        np = sys.modules.get("numpy")
        if np is not None and isinstance(value, (np.ndarray, np.generic)):
            write_array(self, message, value, path)
        elif are_records((value,)):
            write_records(self, message, value, path)
        elif is_table(value):
            write_table(self, message, value, path)
        else:
            raise no_codec(value, path)

    def store(self, holder: Any, data: AnyArray | bytes, size: int, path: Path) -> None:
        """Put data of so many bytes into a message with the fields ``inline`` and ``frame``, or beside it."""
        if size >= self._inline_below:
            holder.frame = len(self.payloads)
            self.payloads.append(Payload(path, data))
        else:
            holder.inline = data if isinstance(data, bytes) else data.tobytes()

    def _none(self, message: Any, value: None, path: Path) -> None:
        message.none = True

    def _nothing(self, message: Any, value: NothingType, path: Path) -> None:
        message.nothing = True

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

    def _complex(self, message: Any, value: complex, path: Path) -> None:
        message.complex.SetInParent()
        message.complex.real, message.complex.imaginary = value.real, value.imag

    def _text(self, message: Any, value: str, path: Path) -> None:
        try:
            message.text = value
        except ValueError as error:
            text = f"{format_path(path)} has lone surrogates, which UTF-8 can't hold."
            way_out = "Encode it with errors='surrogateescape' and send bytes."
            raise MessageError("not utf-8", f"{text} {way_out}") from error

    def _bytes(self, message: Any, value: bytes, path: Path) -> None:
        message.encoded.media_type = "application/octet-stream"
        self.store(message.encoded, value, len(value), path)

    def _sequence(self, message: Any, value: Sequence[object], path: Path) -> None:
        if are_records(value):
            write_records(self, message, value, path)
            return
        content = message.tuple if type(value) is tuple else message.list
        content.SetInParent()
        self.counter.enter(path, len(value))
        for index, item in enumerate(value):
            self.write(content.items.add(), item, (*path, index))

    def _set(self, message: Any, value: Collection[object], path: Path) -> None:
        content = message.set if type(value) is set else message.frozen_set
        content.SetInParent()
        self.counter.enter(path, len(value))
        check = self.counter.key_check(path)
        for item in sorted(value, key=set_sort_key):
            check(item)
            self.write(content.items.add(), item, (*path, item))

    def _mapping(self, message: Any, value: Mapping[object, object], path: Path) -> None:
        message.map.SetInParent()
        self.counter.enter(path, 2 * len(value))
        check = self.counter.key_check(path)
        for key, item in value.items():
            check(key)
            entry = message.map.entries.add()
            self.write(entry.key, key, (*path, key))
            self.write(entry.value, item, (*path, key))


_WRITE: Final[dict[type, Callable[[ValueWriter, Any, Any, Path], None]]] = {
    type(None): ValueWriter._none,
    NothingType: ValueWriter._nothing,
    bool: ValueWriter._boolean,
    int: ValueWriter._integer,
    float: ValueWriter._number,
    complex: ValueWriter._complex,
    str: ValueWriter._text,
    bytes: ValueWriter._bytes,
    list: ValueWriter._sequence,
    tuple: ValueWriter._sequence,
    dict: ValueWriter._mapping,
    set: ValueWriter._set,
    frozenset: ValueWriter._set,
}


def set_sort_key(item: object) -> str:
    """Return the text by which a set's items are sorted, since the order of hashes differs between processes."""
    if type(item) in (tuple, frozenset):
        texts = map(set_sort_key, cast("Collection[object]", item))
        return f"{type(item).__name__}({','.join(sorted(texts) if type(item) is frozenset else texts)})"
    return f"{type(item).__name__} {item:x}" if type(item) is int else f"{type(item).__name__} {item!r}"
