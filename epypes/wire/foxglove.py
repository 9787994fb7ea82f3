"""Images of a message in Foxglove's published schemas, so that programs that know them show what a recording holds.

``foxglove.RawImage`` has the rows of an image, ``foxglove.CompressedImage`` a JPEG, PNG or WebP file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from epypes.errors import MessageError
from epypes.optional import optional_import
from epypes.wire.arrays import row_bytes
from epypes.wire.decoder import read_header
from epypes.wire.limits import DEFAULT_LIMITS, LEADING_FRAMES
from epypes.wire.protobuf import message_class

if TYPE_CHECKING:
    from google.protobuf.message import Message

# Those of ours that Foxglove shows; they have the same names there.
_RAW_ENCODINGS: Final = frozenset({"mono8", "mono16", "bgr8", "rgb8", "bgra8", "rgba8"})
_FILE_STARTS: Final = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}
_SECOND_NS: Final = 10**9


class FoxgloveImage(NamedTuple):
    """An image of a message.

    Attributes
    ----------
    part
        The name of the part that it is.
    message
        A ``foxglove.RawImage`` or a ``foxglove.CompressedImage``.
    frame
        The place of the frame in the message whose bytes are its ``data``; None if these were inside the Envelope.
    """

    part: str
    message: Message
    frame: int | None


def foxglove_images(frames: Sequence[bytes | memoryview], time_ns: int) -> Iterator[FoxgloveImage]:
    """Yield the parts of a v1 message that are images; none of any other message.

    Parameters
    ----------
    frames
        Of the message, as they arrived.
    time_ns
        Of the images if the message has no time of acquisition, Unix time in nanoseconds.
    """
    views = [memoryview(frame).cast("B") for frame in frames]
    try:
        header = read_header(views, "epypes.v1.Envelope", DEFAULT_LIMITS)
    except MessageError:
        return
    seconds, nanoseconds = divmod(header.acquired_ns or time_ns, _SECOND_NS)
    # A frame is one value: named by a thousand parts, it would be written as often.
    free = set(range(LEADING_FRAMES, len(views)))
    for part in header.parts:
        kind = part.value.WhichOneof("kind")
        if kind not in {"image", "encoded"}:
            continue
        content = getattr(part.value, kind)
        frame = LEADING_FRAMES + content.frame if content.WhichOneof("storage") == "frame" else None
        if frame is not None and frame not in free:
            continue
        data = memoryview(content.inline) if frame is None else views[frame]
        message = _raw_image(content, data) if kind == "image" else _compressed_image(data)
        if message is not None:
            message.timestamp.seconds, message.timestamp.nanos = seconds, nanoseconds
            message.frame_id, message.data = header.source, bytes(data)
            free.discard(frame)
            yield FoxgloveImage(part.name, message, frame)


def image_data(schema: str, message: bytes) -> bytes:
    """Return the ``data`` of an image's message; of a schema that `foxglove_images` uses.

    Raises
    ------
    ValueError
        It is no such message.
    """
    with optional_import():
        from google.protobuf.message import DecodeError
    try:
        data: bytes = message_class(schema).FromString(message).data
    except (DecodeError, KeyError) as error:
        raise ValueError(f"an image is none of {schema[:40]!r}") from error
    return data


def _raw_image(content: Any, data: memoryview) -> Any:
    row = row_bytes(content.width, content.encoding) if content.encoding in _RAW_ENCODINGS else 0
    if not 0 < row <= content.step or content.height * content.step != data.nbytes:
        return None
    fields = {name: getattr(content, name) for name in ("width", "height", "encoding", "step")}
    return message_class("foxglove.RawImage")(**fields)


def image_file_format(data: bytes | memoryview) -> str:
    """Return ``"jpeg"``, ``"png"`` or ``"webp"``, by the first bytes of a file; empty for any other."""
    start = bytes(data[:12])
    if start[:4] == b"RIFF" and start[8:] == b"WEBP":
        return "webp"
    return next((name for sign, name in _FILE_STARTS.items() if start.startswith(sign)), "")


def _compressed_image(data: memoryview) -> Any:
    found = image_file_format(data)
    return message_class("foxglove.CompressedImage")(format=found) if found else None
