"""Messages as a broker carries them: one body, an id and headers.

Several frames are joined to one body, and their sizes go into the header ``epypes-frames``. A body without that header
is one frame, as any program sends it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, Final

from epypes.errors import MessageError
from epypes.transport.address import Address
from epypes.transport.channel import ERROR, ERROR_REASON, Confirmed, Frames
from epypes.wire import Limits
from epypes.wire.limits import LEADING_FRAMES

SIZES: Final = "epypes-frames"
# The headers of a dead letter: why it was rejected, the queue it comes from, and how often it was delivered.
REASON, FROM, ATTEMPTS = "epypes-reason", "epypes-from", "epypes-attempts"
# An envelope has two more than its payload.
_MOST_FRAMES: Final = Limits().frames + LEADING_FRAMES
# Whatever can be sent can be rejected, too: what goes along with a dead letter takes no more than this.
REASON_BYTES: Final = 700
DEAD_LETTER_BYTES: Final = 1_024
_BAD: Final = "bad frames"
# Control characters, lone surrogates and Unicode's noncharacters: brokers alter them, or end the connection for them.
_NOT_TEXT: Final = re.compile(
    "[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufdd0-\ufdef"
    + "".join(chr(plane << 16 | 0xFFFE) + chr(plane << 16 | 0xFFFF) for plane in range(17))
    + "]"
)


@dataclass(slots=True, eq=False)
class OutgoingMessage:
    """A message that was accepted for sending.

    Attributes
    ----------
    address
        Where it is sent to: the channel's own address, or the dead-letter queue beside it.
    body, id, headers
        What is sent.
    confirmed
        See `epypes.transport.channel.Confirmed`.
    origin
        For a dead letter: what names the stored message that it comes from; a broker that detects duplicates keeps it
        once.
    """

    address: Address
    body: bytes
    id: str
    headers: Mapping[str, str]
    confirmed: Confirmed | None = None
    origin: str = ""


@dataclass(slots=True, eq=False)
class IncomingMessage:
    """A message as a session hands it to the channel.

    Attributes
    ----------
    body, id, headers, attempt
        See `epypes.transport.channel.Delivery`.
    receipt
        What the session settles it by; None if the broker doesn't wait for an acknowledgement.
    origin
        See `OutgoingMessage`.
    """

    body: bytes | memoryview
    id: str = ""
    headers: dict[str, str] = field(default_factory=dict)
    attempt: int = 0
    receipt: Any = None
    origin: str = ""


def pack(frames: Frames, id: str, headers: Mapping[str, str]) -> tuple[bytes, dict[str, str]]:  # noqa: A002
    """Return the body and the headers that carry some frames; one frame needs no header.

    Raises
    ------
    MessageError
        As from `check_message`.
    """
    check_message(frames, id, headers)
    if len(frames) == 1:
        return bytes(frames[0]), dict(headers)
    return b"".join(frames), {**headers, SIZES: ",".join(str(len(frame)) for frame in frames)}


def check_message(frames: Frames, id: str, headers: Mapping[str, str]) -> None:  # noqa: A002
    """Raise MessageError if there are too few or too many frames, or the id or a header would not arrive as it is."""
    if not 0 < len(frames) <= _MOST_FRAMES:
        raise MessageError(_BAD, f"A message has 1 to {_MOST_FRAMES:,} frames, not {len(frames):,}.")
    _check_text("bad id", "The id", id)
    for name, text in headers.items():
        _check_text("bad header", f"The header {name[:40]!r}", text)


def _check_text(reason: str, what: str, text: str) -> None:
    if text != text.strip() or _NOT_TEXT.search(text):
        wrong = f"{text[:40]!r} has a space at an end, or a control character, in it"
        raise MessageError(reason, f"{what} of a message can't be sent: {wrong}.")


def unpack(message: IncomingMessage) -> tuple[Frames, dict[str, str]]:
    """Return the frames of a message, which share its memory, and its other headers.

    There are no frames if its sizes don't fit its body; the headers `ERROR` and `ERROR_REASON` say so.
    """
    others = {name: text for name, text in message.headers.items() if name not in (SIZES, ERROR, ERROR_REASON)}
    whole, listed = memoryview(message.body).toreadonly(), message.headers.get(SIZES)
    if listed is None:
        return (whole,), others
    parts = listed.split(",", _MOST_FRAMES)
    if len(parts) > _MOST_FRAMES or not all(part.isascii() and part.isdecimal() and len(part) < 12 for part in parts):
        return (), {**others, ERROR: f"{SIZES} is {listed[:40]!r}, which is no list of sizes.", ERROR_REASON: _BAD}
    ends = [*accumulate(map(int, parts), initial=0)]
    if ends[-1] != len(whole):
        text = f"{SIZES} lists {ends[-1]:,} bytes; {len(whole):,} came."
        return (), {**others, ERROR: text, ERROR_REASON: _BAD}
    return tuple(whole[begin:end] for begin, end in pairwise(ends)), others


def dead_letter(address: Address, message: IncomingMessage, reason: str, most_header_bytes: int) -> OutgoingMessage:
    """Return a rejected message of an address as it goes into the dead-letter queue.

    The reason becomes one line of printable text, since brokers end a connection for other text. The sender's headers
    are left out where they leave no room for ours.
    """
    line = " ".join(_NOT_TEXT.sub(" ", reason.encode("utf-8", "replace").decode()).split())
    line = line.encode()[:REASON_BYTES].decode(errors="ignore").strip()
    ours = {REASON: line, FROM: address.name, ATTEMPTS: str(message.attempt)}
    # Without sizes that don't fit the body it is one frame.
    frames, others = unpack(message)
    sizes = {SIZES: message.headers[SIZES]} if frames and SIZES in message.headers else {}
    headers = {**{name: text for name, text in others.items() if name not in (ERROR, ERROR_REASON)}, **sizes, **ours}
    if header_bytes(headers) > most_header_bytes:
        headers = {**sizes, **ours}
    return OutgoingMessage(address.dead_letters, bytes(message.body), message.id, headers, origin=message.origin)


def header_bytes(headers: Mapping[str, str]) -> int:
    """Return how many bytes some headers take, with what any broker adds to each."""
    return sum(len(name.encode()) + len(text.encode()) + 8 for name, text in headers.items())
