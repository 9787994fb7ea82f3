"""What does EPypes ask of whoever carries its messages? Three methods, and a word on each message that was received."""

from __future__ import annotations

import importlib
import logging
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, Protocol

from epypes.errors import AddressError
from epypes.transport.channels.place import ENCRYPTED_AS, Kind, Place, place_of

__all__ = ["Channel", "Frames", "Kind", "Received", "is_brokered", "open_channel"]

log = logging.getLogger("epypes.transport")

Frames = Sequence[bytes | memoryview]
_NOTHING: Final[Mapping[str, str]] = MappingProxyType({})

# By scheme: the module that speaks it, and the extra that brings what it needs.
_SPOKEN: Final[Mapping[str, tuple[str, str]]] = {
    "amqp": ("amqp", "rabbitmq"),
    "amqps": ("amqp", "rabbitmq"),
    "nats": ("jetstream", "nats"),
    "tls": ("jetstream", "nats"),
    "mqtt": ("mqtt", "mqtt"),
    "mqtts": ("mqtt", "mqtt"),
    "tcp": ("zeromq", "serve"),
    "ipc": ("zeromq", "serve"),
    "memory": ("memory", ""),
}
# Control characters, lone surrogates, and what Unicode says is no character: brokers alter such, or end the connection.
NO_TEXT: Final = re.compile(
    "[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\ufdd0-\ufdef"
    + "".join(chr(plane << 16 | 0xFFFE) + chr(plane << 16 | 0xFFFF) for plane in range(17))
    + "]"
)
# Of a reason: some brokers have room for 4 kB of headers.
_MOST_CHARACTERS: Final = 1_000
_UNBROKERED: Final = ("tcp", "ipc", "inproc")
# The brokers of which somebody was told that they are not encrypted.
_warned: Final[set[tuple[str, str, int]]] = set()


@dataclass(slots=True, eq=False)
class Received:
    """A message that was received. Until it is acknowledged or rejected the broker keeps it for another receiver.

    Attributes
    ----------
    frames
        Its frames, read-only.
    id
        What its sender calls it; empty if it came without. Two messages of one id are the same event.
    attempt
        How often it was delivered, from 1; 0 where nobody counts.
    headers
        What else came with it, by name.
    """

    frames: Frames
    id: str = ""
    attempt: int = 0
    headers: Mapping[str, str] = field(default_factory=dict)
    # Called once, with None to acknowledge, else with the reason; never raises.
    settle: Callable[[str | None], object] = lambda reason: None
    _turn: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _is_settled: bool = False

    def ack(self) -> None:
        """Tell the broker that it is done with. Once, from any thread; what comes after the first word is ignored.

        Raises nothing: if the broker is away it delivers the message again, which its id tells.
        """
        self._settle(None)

    def reject(self, reason: str) -> None:
        """Have the broker put it aside for good, among the dead letters. Otherwise as `ack`.

        If they can't take it, which is logged, it is delivered again.
        The reason goes with it as one line of what can be printed: brokers end a connection for other text.
        """
        self._settle(_line(reason))

    def _settle(self, reason: str | None) -> None:
        with self._turn:
            if self._is_settled:
                return
            self._is_settled = True
        self.settle(reason)


def _line(reason: str) -> str:
    """Return a reason as what any broker's header can hold: one line of text, not too long."""
    text = reason[:_MOST_CHARACTERS].encode("utf-8", "replace").decode()
    return " ".join(NO_TEXT.sub(" ", text).split())


class Channel(Protocol):
    """An open way to one place of a broker. One thread sends, one receives; any may close, ack and reject.

    After a BrokerError it is of no use any more: close it, and open another.

    Attributes
    ----------
    prefetch
        How many messages may be received and not acknowledged, at most. Whoever receives may change it from one call
        to the next; to a ZeroMQ socket it means nothing, and to MQTT no more once it is open.
    """

    prefetch: int

    @property
    def trouble(self) -> str:
        """Why it is of no use any more, as soon as that is known; empty as long as it is. For who sends seldom."""

    def send(self, frames: Frames, *, id: str = "", headers: Mapping[str, str] = _NOTHING) -> None:  # noqa: A002
        """Send a message; return when the broker has taken it over: it outlives us from then on.

        Raises
        ------
        BrokerError
            The broker is away, refuses, or did not confirm in time: whether it has the message is not known.
        MessageError
            It can't be sent, now or later: of reason ``"too large"``, ...
        """

    def receive(self, timeout_s: float) -> Received | None:
        """Return the next message; None if none has come within so many seconds.

        Raises
        ------
        BrokerError
            The broker is away, or refuses. What was received and not acknowledged is delivered again, to whoever asks.
        """

    def close(self) -> None:
        """End it, as often as you like; what was received and not acknowledged is delivered again. Bounded."""


def is_brokered(address: str) -> bool:
    """Return whether an address is one of a broker, which keeps messages until somebody has acknowledged them."""
    scheme = address.partition("://")[0]
    return scheme in _SPOKEN and scheme not in _UNBROKERED


def extra_of(address: str) -> str:
    """Return which extra of EPypes brings what an address needs; empty if none does."""
    return _SPOKEN.get(address.partition("://")[0], ("", ""))[1]


def open_channel(address: str | Place, *, prefetch: int = 1, timeout_s: float = 10.0) -> Channel:
    """Open a way to the place that an address names.

    Parameters
    ----------
    address
        See `place_of` for how it is written.
    prefetch
        How many messages may be received and not acknowledged, at most.
    timeout_s
        Longest wait for the broker's word, here and in ``send``, in seconds.

    Raises
    ------
    AddressError
        The address can't be understood, or what it needs is not installed.
    BrokerError
        The broker can't be reached, refuses the credentials, or has no such place.
    """
    place = place_of(address)
    module, extra = _SPOKEN[place.scheme]
    try:
        spoken = importlib.import_module(f"epypes.transport.channels.{module}")
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.startswith("epypes"):
            raise
        text = f"{place} needs {error.name}, which is not installed: pip install 'epypes[{extra}]'."
        raise AddressError(str(place), text) from error
    _warn_of_readers(place)
    opened: Channel = spoken.open_channel(place, prefetch, timeout_s)
    return opened


def _warn_of_readers(place: Place) -> None:
    """Say once of a broker elsewhere, however often it is connected to, that others can read what is sent there."""
    encrypted, broker = ENCRYPTED_AS.get(place.scheme), (place.scheme, place.host, place.port)
    if encrypted is None or place.is_on_this_machine or broker in _warned:
        return
    _warned.add(broker)
    log.warning(
        "%s is on another machine and not encrypted: whoever is on the way can read along, the password too. "
        "Write %s:// with ?ca=FILE.",
        place,
        encrypted,
    )
