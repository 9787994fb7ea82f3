"""What stands beside a message at a NATS server, and what does it say? Headers, in and out."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Final

from nats.aio.msg import Msg

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels.packing import ATTEMPTS, FROM, REASON, SIZES, arrived, readable
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Received

ID: Final = "epypes-id"
_STORED_AS: Final = "Nats-Msg-Id"
_OURS: Final = (ID, _STORED_AS)
# The server takes 64 kB, its own first line with them.
_MOST_HEADERS: Final = 65_000
_LONGEST_REASON: Final = 2_000
_TOO_LARGE: Final = 10_054


def headers_of(place: Place, id: str, headers: Mapping[str, str], size: int, max_payload: int) -> dict[str, str]:  # noqa: A002
    """Return the headers that a message is sent with.

    A stream forgets the second message of one ``Nats-Msg-Id``, and may keep several subjects: events, their answers
    and their dead letters, which all have the event's id. So the subject is in it, and the id has a header of its own.

    Raises
    ------
    MessageError
        A header can't be one, or the message is larger than the server takes.
    """
    told = dict(headers)
    if id:
        told |= {ID: id, _STORED_AS: f"{id}@{place.name}"}
    if not fits(told):
        raise MessageError("too large", f"The headers of a message to {place} take more than {_MOST_HEADERS:,} bytes.")
    for name, value in told.items():
        if not name.isascii() or not name.isprintable() or ":" in name or " " in name or not name:
            raise MessageError("bad header", f"{name!r} can't be the name of a header at {place}.")
        size += len(name) + len(value.encode()) + 4
    if size + 14 > max_payload:
        way = "Raise max_payload in the server's settings (nats-server takes up to 64MB), or send less at a time."
        raise MessageError("too large", f"A message of {size:,} bytes; {place} takes {max_payload:,} at most. {way}")
    return told


def fits(headers: Mapping[str, str]) -> bool:
    """Return whether a server takes so many headers."""
    return sum(len(name.encode()) + len(value.encode()) + 4 for name, value in headers.items()) <= _MOST_HEADERS


def id_of(message: Msg) -> str:
    """Return what its sender calls a message, whichever program that was."""
    headers = message.headers or {}
    return str(headers.get(ID) or headers.get(_STORED_AS, ""))


def attempt_of(message: Msg) -> int:
    """Return how often a message was delivered."""
    return int(_told(message)[0])


def _told(message: Msg) -> list[str]:
    """Return how often a message was delivered, its number in the stream, that of the delivery, and when it was kept.

    That is what the subject tells that it is acknowledged to; a server of a domain tells two things more before.
    """
    words: list[str] = message.reply.split(".")
    return words[4:8] if len(words) == 9 else words[6:10]


def received(message: Msg, attempt: int, settle: Callable[[str | None], object] | None) -> Received:
    """Return a message as the seam gives it."""
    told = {name: value for name, value in (message.headers or {}).items() if name not in _OURS}
    frames, headers = arrived(message.data, told)
    if settle is None:
        return Received(frames, id_of(message), attempt, headers)
    return Received(frames, id_of(message), attempt, headers, settle)


def dead_letter(place: Place, message: Msg, reason: str) -> tuple[bytes, dict[str, str]]:
    """Return the body and the headers of a message that is put aside.

    Put aside twice, since the word on the first time was lost, it is kept once; an event that was sent again and failed
    again is another message.
    """
    # What is for the server was for the first time.
    told = {name: value for name, value in (message.headers or {}).items() if not name.startswith("Nats-")}
    headers = readable(message.data, told)
    attempt, number, _, kept = _told(message)
    more = {REASON: reason[:_LONGEST_REASON], FROM: place.name, ATTEMPTS: attempt}
    more |= {ID: id_of(message), _STORED_AS: f"{number}.{kept}@{place.name}"}
    if not fits(headers | more):
        headers = {name: value for name, value in headers.items() if name == SIZES}
    return bytes(message.data), headers | more


def refused(place: Place, message: Msg) -> BrokerError | MessageError | None:
    """Return what a server's word on a message that was sent means; None if it keeps it."""
    if (message.headers or {}).get("Status") == "503":
        return BrokerError(str(place), f"No stream at {place} keeps what is sent there any more.")
    try:
        told = json.loads(message.data)
        error = told.get("error")
    except (ValueError, AttributeError):
        error = {"description": "its answer can't be understood"}
    if not error:
        return None
    text = f"{place} refuses a message: {error.get('description', 'it gives no reason')}."
    return MessageError("too large", text) if error.get("err_code") == _TOO_LARGE else BrokerError(str(place), text)
