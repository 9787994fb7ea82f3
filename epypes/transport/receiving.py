"""How does what a broker keeps come into a queue? Through a subscriber, which reconnects until it is stopped."""

from __future__ import annotations

import logging
import os
import threading
import warnings
import weakref
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Final, Self, get_args

from epypes.errors import StillRunning
from epypes.transport.arrivals import Acknowledge, Arrivals, Item, PutQueue
from epypes.transport.channels.place import Place, place_of
from epypes.transport.channels.seam import Received
from epypes.transport.connection import Connection, reporter
from epypes.transport.inhand import InHand
from epypes.transport.within import Within
from epypes.wire import Limits, topic_frame

log = logging.getLogger("epypes.transport")

PREFETCH: Final = 8
TIMEOUT_S: Final = 10.0
# How long it waits for a message before it looks whether it shall stop.
_TICK_S: Final = 0.1


class Subscriber(Within):
    """Puts what is delivered from a place, of a broker or of ZeroMQ, into a queue.

    Parameters
    ----------
    address
        Of the place: ``"amqp://user:password@127.0.0.1/events"``; see `epypes.transport.channels.place_of`.
    queue
        Any object with ``put(item, block=..., timeout=...)``, as queue.Queue and ep.Mailbox have it. A message of one
        frame is put as bytes, one of more frames as an Envelope, whose arrays are read-only; both have ``ack()`` and
        ``reject(reason)``. When it is full, no more is taken from the broker.
    topic
        Topic of the envelopes that are wanted; ``""`` for everything. At a queue, anything else is a dead letter.
    acknowledge
        ``"done"``: the broker keeps a message until its ``ack`` or ``reject`` was called, which a pipeline does when it
        has answered; so none is lost, and one may be delivered again. Whoever takes messages from the queue otherwise
        calls ``ack()`` on each: with ``prefetch`` of them in hand the broker sends no more. ``"received"``: until it is
        in the queue; what a process has in hand when it dies is lost then.
    prefetch
        How many messages may be in hand at once. A broker that counts deliveries counts those that have waited here
        unread as well: with many of them, let the place allow for more attempts.
    exhausted
        None, or called with what was delivered more often than the place allows, instead of rejecting it; on the
        subscriber's thread.
    max_message_bytes
        Larger messages are rejected.
    timeout_s
        Longest wait for the broker's word, in seconds.

    Attributes
    ----------
    on_connection
        None, or called with whether the broker is there, and why not, when that has changed; on the subscriber's
        thread, and at the start on the caller's.

    Raises
    ------
    AddressError
        If the address can't be understood.
    MessageError
        If ``topic`` can't be one.

    Notes
    -----
    Start it, or use ``with``. What is in hand when it stops is delivered again, to whoever asks.
    """

    def __init__(
        self,
        address: str | Place,
        queue: PutQueue,
        topic: str = "",
        *,
        acknowledge: Acknowledge = "done",
        prefetch: int = PREFETCH,
        exhausted: Callable[[Item], object] | None = None,
        max_message_bytes: int = Limits().total_bytes,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        if acknowledge not in get_args(Acknowledge):
            raise ValueError(f"acknowledge is {' or '.join(map(repr, get_args(Acknowledge)))}, not {acknowledge!r}.")
        self.place = place_of(address)
        first = topic_frame(topic) if topic else b""
        limits = Limits(total_bytes=max_message_bytes)
        # Who settles even what is exhausted has a clock of its own for what takes long.
        self._most_in_hand = prefetch if self.place.kind == "queue" and exhausted is None else 0
        self._arrivals = Arrivals(queue, first, limits, self.place, acknowledge, exhausted)
        self._prefetch, self._timeout_s = _checked(prefetch), timeout_s
        self.on_connection: Callable[[bool, str], object] | None = None
        self._lock = threading.Lock()
        self._receiving: _Receiving | None = None
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The address, without the password."""
        return str(self.place)

    @property
    def prefetch(self) -> int:
        """How many messages may be in hand at once. It may be set to another number while the subscriber runs."""
        return self._prefetch

    @prefetch.setter
    def prefetch(self, count: int) -> None:
        self._prefetch, receiving = _checked(count), self._receiving
        if receiving is not None:
            receiving.connection.prefetch = count

    @property
    def received(self) -> int:
        """How many messages were put into the queue."""
        return self._arrivals.received

    @property
    def rejected(self) -> Counter[str]:
        """How many messages could not be understood, or were delivered too often, by reason; a copy."""
        return Counter(self._arrivals.rejected)

    @property
    def dropped(self) -> Counter[str]:
        """How many messages the queue refused, by what it raised; a copy."""
        return Counter(self._arrivals.dropped)

    @property
    def duplicates(self) -> int:
        """How many messages were in hand or done already."""
        return self._arrivals.duplicates

    @property
    def dead_letters(self) -> int:
        """How many messages were put aside, by whomever."""
        return self._arrivals.dead_letters

    @property
    def is_connected(self) -> bool:
        """Whether the broker is there, as far as is known."""
        receiving = self._receiving
        return receiving is not None and receiving.is_alive() and receiving.connection.is_connected

    @property
    def trouble(self) -> str:
        """Why the broker is not there; empty if it is, and when the subscriber is stopped."""
        receiving = self._receiving
        return receiving.connection.trouble if receiving is not None and receiving.is_alive() else ""

    @property
    def reconnects(self) -> int:
        """How often the broker was there again."""
        receiving = self._receiving
        return 0 if receiving is None else receiving.connection.reconnects

    def start(self) -> Self:
        """Connect and begin to receive; nothing happens if it runs already.

        Raises
        ------
        BrokerError
            If the broker can't be reached, refuses, or has no such place.
        """
        with self._lock:
            if self._receiving is None or not self._receiving.is_alive():
                before = None if self._receiving is None else self._receiving.connection
                connection = Connection(
                    self.place, self._prefetch, self._timeout_s, reporter(self), before, receives=True
                )
                connection.open()
                self._receiving = receiving = _Receiving(connection, self._arrivals, self._most_in_hand)
                self._finalizer = weakref.finalize(self, _abandon, receiving, self.address)
                receiving.start()
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the connection; from any thread, as often as you like. What is in hand is delivered again.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds. If the broker does not answer by then, the rest happens in the background.

        Raises
        ------
        StillRunning
            If the queue's ``put``, or a callback, does not return in time.
        """
        receiving = self._receiving
        if self._finalizer is not None:
            self._finalizer.detach()
        if receiving is not None:
            receiving.stop(timeout_s)

    def pause(self) -> None:
        """Take nothing more from the broker, and stay connected: what is in hand can be acknowledged."""
        if self._receiving is not None:
            self._receiving.connection.receives = False

    def resume(self) -> None:
        """Take messages again after `pause`."""
        if self._receiving is not None:
            self._receiving.connection.receives = True

    def seen(self, ids: Iterable[str]) -> None:
        """Take note that others have answered these: if they are delivered later they are duplicates."""
        self._arrivals.seen.add(ids)

    def wait_connected(self, timeout_s: float = 5.0) -> bool:
        """Return whether the broker is there within ``timeout_s`` seconds."""
        receiving = self._receiving
        return receiving is not None and receiving.connection.wait(timeout_s)

    def __repr__(self) -> str:
        receiving = self._receiving
        state = "stopped" if receiving is None or not receiving.is_alive() else "running"
        return f"<Subscriber {self.address[:50]} {state}: {self.received} received>"


def _checked(prefetch: int) -> int:
    if prefetch < 1:
        raise ValueError(f"prefetch is a whole number from 1, not {prefetch!r}.")
    return prefetch


class _Receiving:
    """From a start to its stop: the connection, and the thread that reads it."""

    def __init__(self, connection: Connection, arrivals: Arrivals, most_in_hand: int) -> None:
        self.connection, self._arrivals = connection, arrivals
        # How many stop a broker that hears no word; 0 once somebody was told, or need not be.
        self._most_in_hand = most_in_hand
        self._in_hand = (connection.number, InHand(connection.place, most_in_hand))
        self._over = threading.Event()
        # Whether the thread is in code of the user.
        self._is_in_put = False
        self._process = os.getpid()
        self._thread = threading.Thread(target=self._run, name=f"epypes from {connection.place.name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def is_alive(self) -> bool:
        """Return whether it receives; in a forked child there is neither thread nor connection."""
        return self._process == os.getpid() and self._thread.is_alive() and not self._over.is_set()

    def stop(self, timeout_s: float) -> None:
        if self._process != os.getpid():
            return
        self._over.set()
        if self._thread is threading.current_thread():
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive() and self._is_in_put:
            self.connection.end()
            raise StillRunning(f"Subscriber {self.connection.place}", ["put"], timeout_s)

    def abandon(self) -> bool:
        """Stop without waiting, as the garbage collector must; return whether it was running."""
        was_alive = self.is_alive()
        self._over.set()
        return was_alive

    def _run(self) -> None:
        try:
            while not self._over.is_set():
                if self.connection.receives:
                    self._receive()
                else:
                    self._rest()
        finally:
            self.connection.end()

    def _rest(self) -> None:
        """Take nothing for a moment, and stay connected."""
        self.connection.look()
        if self.connection.channel(self._over) is not None:
            self._over.wait(_TICK_S)

    def _receive(self) -> None:
        connection = self.connection
        channel = connection.channel(self._over)
        if channel is None:
            return
        try:
            received = connection.receive(channel, _TICK_S)
        except Exception as error:
            connection.lose(error)
            return
        connection.works()
        if received is not None:
            self._count(received)
            self._take(received)
        elif self._most_in_hand and self._in_hand[1].is_stuck:
            self._most_in_hand = 0
            self._in_hand[1].warn()

    def _count(self, received: Received) -> None:
        if self._in_hand[0] != self.connection.number:
            # A word on what came over an earlier connection lets nothing more come.
            self._in_hand = (self.connection.number, InHand(self.connection.place, self._most_in_hand))
        self._in_hand[1].take(received)

    def _take(self, received: Received) -> None:
        self._is_in_put = True
        try:
            self._arrivals.accept(received, self.connection.number, self._over)
        except BaseException:
            # A bug of ours, or what a signal raises: the message is delivered again.
            log.exception("a message could not be taken")
        finally:
            self._is_in_put = False


def _abandon(receiving: _Receiving, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if receiving.abandon():
        warnings.warn(
            f"Subscriber {address} was left running. Call stop(), or use with.", ResourceWarning, stacklevel=2
        )
