"""How do several frames become the one body that a broker carries, and the other way round?

The sizes of the frames go beside the body, in a header; a body without is one frame, as any program sends it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from epypes.errors import MessageError
from epypes.transport.channels.seam import NO_TEXT, Frames
from epypes.wire.limits import DEFAULT_LIMITS

SIZES: Final = "epypes-frames"
REASON, FROM, ATTEMPTS = "epypes-reason", "epypes-from", "epypes-attempts"
# What a channel says of a message that can't be unpacked; never of one that can.
ERROR: Final = "epypes-error"
# An envelope has two more than its payload.
_MOST_FRAMES: Final = DEFAULT_LIMITS.frames + 2


def packed(frames: Frames, id: str, headers: Mapping[str, str]) -> tuple[bytes, dict[str, str]]:  # noqa: A002
    """Return the body and the headers of a message that is sent; one frame needs no header of ours.

    Raises
    ------
    MessageError
        See `check`.
    """
    check(frames, id, headers)
    if len(frames) == 1:
        only = frames[0]
        # Of a subclass too: to make plain bytes of it would be to copy it.
        return only if isinstance(only, bytes) else bytes(only), dict(headers)
    return b"".join(frames), {**headers, SIZES: ",".join(str(len(frame)) for frame in frames)}


def check(frames: Frames, id: str, headers: Mapping[str, str]) -> None:  # noqa: A002
    """See that a message can be sent by any broker.

    Raises
    ------
    MessageError
        There are too few or too many frames, or the id or a header would not arrive everywhere as it is.
    """
    if not 0 < len(frames) <= _MOST_FRAMES:
        raise MessageError("bad frames", f"A message has 1 to {_MOST_FRAMES:,} frames, not {len(frames):,}.")
    _check_text("bad id", "The id", id)
    for name, text in headers.items():
        _check_text("bad header", f"The header {name[:40]!r}", text)


def _check_text(reason: str, what: str, text: str) -> None:
    """Raise MessageError for what some brokers alter, and others end the connection for."""
    if text != text.strip() or NO_TEXT.search(text):
        wrong = f"{text[:40]!r} has a space at an end, or a control character, in it"
        raise MessageError(reason, f"{what} of a message can't be sent: {wrong}.")


def unpacked(body: bytes, headers: Mapping[str, str]) -> tuple[memoryview, ...]:
    """Return the frames of a message, which share the body's memory.

    Raises
    ------
    MessageError
        The header does not fit the body.
    """
    whole = memoryview(body)
    told = headers.get(SIZES)
    if told is None:
        return (whole,)
    parts = told.split(",", _MOST_FRAMES)
    if len(parts) > _MOST_FRAMES or not all(part.isascii() and part.isdecimal() and len(part) < 12 for part in parts):
        raise MessageError("bad frames", f"{SIZES} is {told[:40]!r}, which is no list of sizes.")
    sizes = [int(part) for part in parts]
    if sum(sizes) != len(whole):
        raise MessageError("bad frames", f"{SIZES} tells of {sum(sizes):,} bytes; {len(whole):,} came.")
    frames, begin = [], 0
    for size in sizes:
        frames.append(whole[begin : begin + size])
        begin += size
    return tuple(frames)


def arrived(body: bytes, headers: Mapping[str, str]) -> tuple[Frames, dict[str, str]]:
    """Return the frames of a message that was received, and what else came with it; raise nothing.

    Of one that can't be unpacked there are no frames, and why not is told beside it.
    """
    others = {name: text for name, text in headers.items() if name not in (SIZES, ERROR)}
    try:
        return unpacked(body, headers), others
    except MessageError as error:
        return (), {**others, ERROR: str(error)}


def readable(body: bytes, headers: Mapping[str, str]) -> dict[str, str]:
    """Return the headers that go with a body to the dead letters: without sizes that don't fit it, it is one frame."""
    frames, _ = arrived(body, headers)
    return {name: text for name, text in headers.items() if frames or name != SIZES}
