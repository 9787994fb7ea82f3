"""Frames of a message as one block of bytes.

A block is a table (a mark, the number of frames, the size of each) and then the frames, one after another. A reader
checks the table first, so nothing is allocated for what a broken or hostile block only claims to hold.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any, Final

from epypes.errors import MessageError
from epypes.wire import EncodedEnvelope, Envelope
from epypes.wire.limits import DEFAULT_LIMITS, LEADING_FRAMES

BytesLike = bytes | bytearray | memoryview

MARK: Final = b"EPF1"
# Mark and number of frames; the size of each follows in 8 bytes.
HEAD: Final = struct.Struct("<4sI")
_SIZE_BYTES: Final = 8
# Of one encoded Envelope: topic, header and payloads.
_MAX_FRAMES: Final = DEFAULT_LIMITS.frames + LEADING_FRAMES
_MAX_BYTES: Final = DEFAULT_LIMITS.total_bytes
# The first byte of an event in one block.
_ENVELOPE: Final = b"v"
_RAW: Final = b"r"
# The type of an Envelope that has a state.
_STATE: Final = "epypes.state"


def pack(frames: Sequence[BytesLike]) -> bytes:
    """Return frames as one block.

    Raises
    ------
    MessageError
        There are more frames than `unpack` accepts, or they are larger.
    """
    sizes = [memoryview(frame).nbytes for frame in frames]
    _check_limits(len(sizes), sum(sizes))
    return b"".join([table_of(sizes), *frames])


def table_of(sizes: Sequence[int]) -> bytes:
    """Return the table of frames of these sizes."""
    return struct.pack(f"<4sI{len(sizes)}Q", MARK, len(sizes), *sizes)


def unpack(data: BytesLike) -> list[memoryview]:
    """Return the frames of a block, as read-only views of it.

    Raises
    ------
    MessageError
        For anything that `pack` does not make, and nothing else; its ``reason`` is a short key to count by.
    """
    block = _view(data)
    if len(block) < HEAD.size:
        raise MessageError("cut off", f"The block has {len(block)} bytes, and its table is longer.")
    mark, count = HEAD.unpack_from(block)
    if mark != MARK:
        raise MessageError("no frames", f"A block of frames begins with {MARK!r}, not with {mark!r}.")
    _check_limits(count, 0)
    begin = HEAD.size + _SIZE_BYTES * count
    if len(block) < begin:
        raise MessageError("cut off", f"The table of {count} frames is cut off.")
    sizes = struct.unpack_from(f"<{count}Q", block, HEAD.size)
    _check_limits(count, sum(sizes))
    if len(block) != begin + sum(sizes):
        held = f"{len(block) - begin:,} bytes after its table, which announces {sum(sizes):,}"
        raise MessageError("wrong size", f"The block has {held}.")
    return [block[start:end] for start, end in pairwise(accumulate(sizes, initial=begin))]


def _check_limits(count: int, total_bytes: int) -> None:
    if count > _MAX_FRAMES:
        raise MessageError("too many frames", f"{count:,} frames; the limit is {_MAX_FRAMES:,}.")
    if total_bytes > _MAX_BYTES:
        raise MessageError("too large", f"Frames of {total_bytes:,} bytes; the limit is {_MAX_BYTES:,}.")


def _view(data: BytesLike) -> memoryview:
    try:
        return memoryview(data).toreadonly().cast("B")
    except (TypeError, ValueError) as error:
        raise MessageError("no bytes", f"A block of frames is bytes: {error}.") from error


def pack_event(event: Envelope | EncodedEnvelope | BytesLike) -> bytes:
    """Return an event as one block, the format of the failure store.

    Parameters
    ----------
    event
        An Envelope, decoded or not, or bytes for a message of one frame, as peers of 2019 send it.

    Raises
    ------
    MessageError
        The envelope can't be sent.
    """
    if isinstance(event, EncodedEnvelope):
        return _ENVELOPE + pack(event.frames)
    if isinstance(event, Envelope):
        from epypes.wire import encode

        return _ENVELOPE + pack(encode(event))
    return _RAW + bytes(event)


def unpack_event(data: BytesLike) -> Envelope | bytes:
    """Return the event of a block of `pack_event`.

    Raises
    ------
    MessageError
        For anything else, and nothing else.
    """
    block = _view(data)
    kind = bytes(block[:1])
    if kind == _RAW:
        return bytes(block[1:])
    if kind == _ENVELOPE:
        from epypes.wire import decode

        return decode(unpack(block[1:]))
    raise MessageError("no event", f"An event in one block begins with {_ENVELOPE!r} or {_RAW!r}, not with {kind!r}.")


def pack_state(state: Mapping[str, Any]) -> bytes:
    """Return a state between events, values by key, as one block.

    Raises
    ------
    MessageError
        A value has no codec, or is too large.
    """
    from epypes.wire import encode

    return pack(encode(Envelope(_STATE, state, id="")))


def unpack_state(data: BytesLike) -> Mapping[str, Any]:
    """Return the state of a block of `pack_state`; arrays are read-only views of it.

    Raises
    ------
    MessageError
        For anything else, and nothing else.
    """
    from epypes.wire import decode

    return decode(unpack(data)).parts
