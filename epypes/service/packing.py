"""Frames of a message as one block of bytes.

A block is a table (a mark, the number of frames, the size of each) and then the frames, one after another. A reader
checks the table first, so nothing is allocated for what a broken or hostile block only claims to hold.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Final

from epypes.errors import MessageError
from epypes.wire import EncodedEnvelope, Envelope
from epypes.wire.limits import DEFAULT_LIMITS

BytesLike = bytes | bytearray | memoryview

MARK: Final = b"EPF1"
_HEAD: Final = struct.Struct("<4sI")
HEAD_BYTES: Final = _HEAD.size
SIZE_BYTES: Final = 8
# The first byte of an event in one block.
_ENVELOPE: Final = b"v"
_RAW: Final = b"r"


@dataclass(frozen=True, slots=True)
class BlockLimits:
    """Limits of a block.

    Attributes
    ----------
    frames
        How many frames.
    total_bytes
        All of them together.
    """

    frames: int = DEFAULT_LIMITS.frames + 2
    total_bytes: int = DEFAULT_LIMITS.total_bytes


# One encoded Envelope: topic, header and payloads.
ONE_MESSAGE: Final = BlockLimits()


def table_of(frames: Sequence[BytesLike], limits: BlockLimits = ONE_MESSAGE) -> bytes:
    """Return the table that stands before the frames.

    Raises
    ------
    MessageError
        There are more frames than the reader accepts, or they are larger.
    """
    sizes = [memoryview(frame).nbytes for frame in frames]
    _require_room(len(sizes), sum(sizes), limits)
    return struct.pack(f"<4sI{len(sizes)}Q", MARK, len(sizes), *sizes)


def count_in(head: BytesLike, limits: BlockLimits = ONE_MESSAGE) -> int:
    """Return the number of frames in a table, from its first HEAD_BYTES bytes; SIZE_BYTES for each follow.

    Raises
    ------
    MessageError
        This is no table, or there are too many frames.
    """
    if len(head) < HEAD_BYTES:
        raise MessageError("cut off", f"The block has {len(head)} bytes, and its table is longer.")
    mark, count = _HEAD.unpack_from(head)
    if mark != MARK:
        raise MessageError("no frames", f"A block of frames begins with {MARK!r}, not with {bytes(mark)!r}.")
    _require_room(count, 0, limits)
    return int(count)


def sizes_in(table: BytesLike, count: int, limits: BlockLimits = ONE_MESSAGE) -> tuple[int, ...]:
    """Return the size of each frame, from what follows the head of a table.

    Raises
    ------
    MessageError
        The table is cut off, or the frames are too large.
    """
    if len(table) < SIZE_BYTES * count:
        raise MessageError("cut off", f"The table of {count} frames is cut off.")
    sizes = struct.unpack_from(f"<{count}Q", table)
    _require_room(count, sum(sizes), limits)
    return sizes


def _require_room(count: int, total_bytes: int, limits: BlockLimits) -> None:
    if count > limits.frames:
        raise MessageError("too many frames", f"{count:,} frames; the limit is {limits.frames:,}.")
    if total_bytes > limits.total_bytes:
        raise MessageError("too large", f"Frames of {total_bytes:,} bytes; the limit is {limits.total_bytes:,}.")


def pack(frames: Sequence[BytesLike]) -> bytes:
    """Return frames as one block.

    Raises
    ------
    MessageError
        There are more frames than `unpack` accepts, or they are larger.
    """
    return b"".join([table_of(frames), *frames])


def unpack(data: BytesLike) -> list[memoryview]:
    """Return the frames of a block, as read-only views of it.

    Raises
    ------
    MessageError
        For anything that `pack` does not make, and nothing else; its ``reason`` is a short word to count by.
    """
    block = _view(data)
    count = count_in(block)
    begin = HEAD_BYTES + SIZE_BYTES * count
    sizes = sizes_in(block[HEAD_BYTES:begin], count)
    if len(block) != begin + sum(sizes):
        held = f"{len(block) - begin:,} bytes after its table, which announces {sum(sizes):,}"
        raise MessageError("wrong size", f"The block has {held}.")
    return [block[start:end] for start, end in pairwise(accumulate(sizes, initial=begin))]


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
