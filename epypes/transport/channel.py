"""The interface between EPypes and what carries its messages: ZeroMQ, a broker, DDS, Zenoh, or this process.

`Subscriber` and `Publisher` are written on it once, for every scheme. A channel is opened either for sending or for
receiving. It reconnects by itself until it is closed: what it has accepted for sending stays in order, under one id,
until the broker confirms it, and what is delivered and unacknowledged is delivered again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Protocol

from epypes.wire import Limits

if TYPE_CHECKING:
    from epypes.errors import MessageError
    from epypes.wire import EncodedEnvelope

log = logging.getLogger("epypes.transport")

# Messages that nothing keeps are dropped when those that wait for the handler take more than this.
MOST_BACKLOG_BYTES: Final = 256 * 1024**2
MESSAGE_OVERHEAD_BYTES: Final = 1_024
# A caller of `close` waits so much longer than its time-out for the end of a connection.
CLOSING_GRACE_S: Final = 0.5

Frames = Sequence[bytes | memoryview]
NO_HEADERS: Final[Mapping[str, str]] = MappingProxyType({})

# The headers of a delivery that could not be read: it has no frames, and these say why, for people and to count by.
ERROR, ERROR_REASON = "epypes-error", "epypes-error-reason"

# Called exactly once per accepted message: with None when the broker has confirmed it (ZeroMQ: when it was handed
# over), else with the reason why it will never be sent. It runs on the channel's thread or on the caller's of `send`
# or `close`, and must be quick.
Confirmed = Callable[[Exception | None], object]
# Called with whether the broker is connected, and why not, on each change; on the channel's thread.
ConnectionListener = Callable[[bool, str], object]


def confirm(confirmed: Confirmed | None, error: Exception | None) -> None:
    """Call the confirmation of a message, if it has one; what it raises is logged, and other messages go on."""
    if confirmed is not None:
        try:
            confirmed(error)
        except BaseException:
            log.exception("the confirmation of a message itself failed")


def _ignore(verdict: str, reason: str) -> None:
    """Settle a message that nothing keeps."""


class Delivery:
    """A message as a channel has received it.

    Attributes
    ----------
    frames
        Its frames, read-only; none if the message could not be read, which the headers `ERROR` and `ERROR_REASON`
        explain.
    id
        The sender's id of the message; empty if it came without. Two messages with one id are the same event.
    attempt
        How often it was delivered, from 1; 0 where the broker does not count.
    headers
        Text that came beside the frames, by name.
    envelope, error
        Set by a Subscriber that puts deliveries: the header of the frames; None if they are no envelope, and then, of
        several frames, why not.
    settle
        Of the channel; called at most once: ``("ack", "")``, ``("reject", reason)`` or ``("nack", "")``. It
        returns at once and raises nothing, from any thread.
    """

    __slots__ = ("attempt", "envelope", "error", "frames", "headers", "id", "is_settled", "settle")

    def __init__(
        self,
        frames: Frames,
        id: str = "",  # noqa: A002 - that is its name in every protocol
        attempt: int = 0,
        headers: Mapping[str, str] = NO_HEADERS,
        settle: Callable[[str, str], object] = _ignore,
    ) -> None:
        self.frames, self.id, self.attempt, self.headers, self.settle = frames, id, attempt, headers, settle
        self.envelope: EncodedEnvelope | None = None
        self.error: MessageError | None = None
        self.is_settled = False

    def ack(self) -> None:
        """Tell the broker that the message is done. The first of ack, reject and nack counts; from any thread.

        Raises nothing: if the broker is away it delivers the message again, and its id shows that it is a duplicate.
        """
        self._settle("ack")

    def reject(self, reason: str) -> None:
        """Have the broker put the message into the dead-letter queue, with the reason. Otherwise as `ack`."""
        self._settle("reject", reason)

    def nack(self) -> None:
        """Return the message to the broker, which delivers it again, to any consumer. Otherwise as `ack`."""
        self._settle("nack")

    def _settle(self, verdict: str, reason: str = "") -> None:
        if not self.is_settled:
            self.is_settled = True
            self.settle(verdict, reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelOptions:
    """What `open_channel` is given beside the address; a channel refuses what has no meaning for its scheme.

    Attributes
    ----------
    prefetch
        Most unacknowledged messages at once (brokers).
    timeout_s
        Longest wait for the broker's answer, in seconds (brokers).
    max_message_bytes
        Larger messages are refused.
    on_connection
        None, or called when the broker is connected or lost.
    on_stale
        None, or called when the input becomes stale, and when something is heard again (DDS, Zenoh).
    """

    prefetch: int = 8
    timeout_s: float = 10.0
    max_message_bytes: int = Limits().total_bytes
    on_connection: ConnectionListener | None = None
    on_stale: Callable[[bool], object] | None = None


class Channel(Protocol):
    """One address, opened for sending or for receiving. Every method may be called from any thread.

    Attributes
    ----------
    prefetch
        See `ChannelOptions`.
    """

    prefetch: int

    @property
    def address(self) -> str:
        """Where it is, without a password; the bound endpoint once a ZeroMQ socket is bound."""

    @property
    def keeps_messages(self) -> bool:
        """Whether a message that is not acknowledged is delivered again.

        The handler of `open` may wait for room, unless it is ZeroMQ: then it must return at once, since it runs on the
        I/O thread of all sockets.
        """

    @property
    def is_connected(self) -> bool:
        """Whether the broker is connected, as far as is known."""

    @property
    def trouble(self) -> str:
        """Why the broker is not connected; empty while it is."""

    @property
    def reconnects(self) -> int:
        """How often the connection was established again."""

    @property
    def waiting(self) -> int:
        """How many messages were accepted for sending and are not confirmed."""

    def open(self, on_delivery: Callable[[Delivery], object] | None) -> None:
        """Connect for the first time: to receive, if there is a handler of deliveries, else to send.

        The handler is called by one thread of the channel, with one delivery after another. ``on_connection`` is called
        for the first connection too, before this returns.

        Raises
        ------
        AddressError
            The address can't be bound or connected to.
        BrokerError
            The broker can't be reached, refuses the credentials, or has no such queue.
        """

    def send(
        self,
        frames: Frames,
        *,
        id: str = "",  # noqa: A002 - that is its name in every protocol
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Accept a message for sending; returns at once, but for what a ZeroMQ socket takes.

        When it returns, the caller may change the frames: what the channel still needs it has copied, except for frames
        that can't be changed (`epypes.wire.arrays.is_immutable`).

        Raises
        ------
        MessageError
            The channel can never send it: of reason ``"too large"``, ``"bad id"``, ...
        BrokerError
            The channel is closed.
        """

    def pause(self) -> None:
        """Take no further messages from the broker and stay connected: what was delivered can be acknowledged."""

    def resume(self) -> None:
        """Take messages again after `pause`."""

    def close(self, timeout_s: float = 5.0) -> None:
        """Send what was accepted, within ``timeout_s``, and disconnect; from any thread, as often as you like.

        What is not confirmed by then gets a BrokerError; what was delivered and not settled is delivered again, also if
        a handler has not returned. Called on the channel's own thread, by a handler or a callback, it does not wait.

        Raises
        ------
        StillRunning
            The I/O thread of ZeroMQ is held up for so long, by a handler.
        """

    def abandon(self) -> None:
        """Close without waiting and without taking a lock: the garbage collector calls it."""
