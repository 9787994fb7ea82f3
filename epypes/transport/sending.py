"""How does what is put into a queue get to a broker? Through a publisher, which sends until that is confirmed."""

from __future__ import annotations

import threading
import warnings
import weakref
from collections import Counter
from collections.abc import Callable
from typing import Any, Self

from epypes.transport.channels.place import Place, place_of
from epypes.transport.connection import reporter
from epypes.transport.outbox import TIMEOUT_S, Outbox, Tally
from epypes.transport.takers import TakeQueue, Taker, taker
from epypes.transport.within import Within
from epypes.wire import Limits, topic_frame


class Publisher(Within):
    """Sends what is put into a queue to a place, of a broker or of ZeroMQ.

    Parameters
    ----------
    address
        Of the place: ``"amqp://user:password@127.0.0.1/answers"``; see `epypes.transport.channels.place_of`.
    queue
        Any object with ``get(timeout=...)`` that raises queue.Empty. It takes what a ZMQPublisher takes: bytes,
        protobuf messages, Envelopes and Failures. From a Mailbox an item is sent within ``put``, whatever its policy,
        which returns when the broker has confirmed it: so a pipeline acknowledges an event when its answer is safe.
        From other queues a thread takes it a little later, one after the other.
    topic
        Topic of the envelopes.
    max_message_bytes
        Larger messages are rejected here. A broker may take less: NATS 1 MB, unless its ``max_payload`` says more.
        What is larger than that is not sent: a line in the log says so, ``rejected`` counts it under ``"too large"``,
        and ``put`` into a Mailbox raises MessageError.
    timeout_s
        Longest wait for the broker's word, in seconds; after it the message is sent again, under the same id.

    Attributes
    ----------
    on_connection
        None, or called with whether the broker is there, and why not, when that has changed; on the publisher's
        thread, and at the start on the caller's.

    Raises
    ------
    AddressError
        If the address can't be understood.
    MessageError
        If ``topic`` can't be one.

    Notes
    -----
    Start it, or use ``with``. A message is called by the id of its Envelope, by which it is told from others when it
    arrives twice: if an answer may be computed twice, let f_out give it an id made of the event's. While the broker is
    away, ``put`` into a Mailbox waits. It raises BrokerError if the publisher is stopped meanwhile, and MessageError
    for what can't be sent.
    """

    def __init__(
        self,
        address: str | Place,
        queue: TakeQueue,
        topic: str = "",
        *,
        max_message_bytes: int = Limits().total_bytes,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        self.place = place_of(address)
        topic_frame(topic)
        self._queue, self._topic = queue, topic
        self._max_message_bytes, self._timeout_s = max_message_bytes, timeout_s
        self.on_connection: Callable[[bool, str], object] | None = None
        self._tally = Tally()
        self._lock = threading.Lock()
        self._outbox: Outbox | None = None
        self._taker: Taker | None = None
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The address, without the password."""
        return str(self.place)

    @property
    def sent(self) -> int:
        """How many messages the broker has confirmed."""
        return self._tally.sent

    @property
    def rejected(self) -> Counter[str]:
        """How many items could not be sent, by reason; a copy."""
        return Counter(self._tally.rejected)

    @property
    def is_connected(self) -> bool:
        """Whether the broker is there, as far as is known."""
        outbox = self._outbox
        return outbox is not None and outbox.is_alive() and outbox.is_connected

    @property
    def trouble(self) -> str:
        """Why the broker is not there; empty if it is, and when the publisher is stopped."""
        outbox = self._outbox
        return outbox.trouble if outbox is not None and outbox.is_alive() else ""

    @property
    def reconnects(self) -> int:
        """How often the broker was there again."""
        outbox = self._outbox
        return 0 if outbox is None else outbox.reconnects

    def start(self) -> Self:
        """Connect and begin to send; nothing happens if it runs already.

        Raises
        ------
        BrokerError
            If the broker can't be reached, refuses, or has no such place.
        StillRunning
            If another thread's stop takes too long.
        """
        with self._lock:
            if self._taker is not None and self._taker.is_alive() and not self._taker.stopping:
                return self
            if self._taker is not None:
                self._taker.stop(5.0)
            outbox = self._new_outbox()
            outbox.start()
            outlet = _Outlet(outbox)
            try:
                self._taker = taker(self._queue, outlet)
            except BaseException:
                outlet.close(0.0)
                raise
            outlet.starter = None
            self._outbox = outbox
            self._finalizer = weakref.finalize(self, _abandon, self._taker, self.address)
        return self

    def _new_outbox(self) -> Outbox:
        return Outbox(
            self.place,
            topic=self._topic,
            max_message_bytes=self._max_message_bytes,
            timeout_s=self._timeout_s,
            tell=reporter(self),
            tally=self._tally,
            before=self._outbox,
        )

    def stop(self, timeout_s: float = 5.0) -> None:
        """Send what is queued, then end the connection; from any thread, as often as you like.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds. What is still queued then stays in the queue; what has been taken from it and is
            not confirmed is counted in `rejected`, and raises from a Mailbox's ``put``.

        Raises
        ------
        StillRunning
            If the queue's ``get`` does not return in time. The connection is ended all the same.
        """
        running = self._taker
        if running is None:
            return
        if self._finalizer is not None:
            self._finalizer.detach()
        running.stop(timeout_s)

    def wait_connected(self, timeout_s: float = 5.0) -> bool:
        """Return whether the broker is there within ``timeout_s`` seconds."""
        outbox = self._outbox
        return outbox is not None and outbox.is_alive() and outbox.wait_connected(timeout_s)

    def __repr__(self) -> str:
        state = "stopped" if self._outbox is None or not self._outbox.is_alive() else "running"
        return f"<Publisher {self.address[:50]} {state}: {self.sent} sent>"


class _Outlet:
    """What a taker needs of an outbox; see `takers.Outlet`."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self.name = f"Publisher {outbox.place}"
        # It does not wait while what a Mailbox has kept so far is handed over, within the publisher's start; who puts
        # meanwhile on another thread does.
        self.starter: threading.Thread | None = threading.current_thread()

    def publish(self, item: object) -> None:
        """Send an item, and wait until the broker has confirmed it.

        Raises
        ------
        BrokerError
            It was stopped before.
        MessageError
            It can't be sent. What code of the item itself raises comes as it is.
        """
        is_told = threading.Event()
        errors: list[Exception | None] = []

        def then(error: Exception | None) -> None:
            errors.append(error)
            is_told.set()

        is_starting = self.starter is threading.current_thread()
        waits = not is_starting and not self._outbox.is_own_thread()
        self._outbox.put(item, then=then, waits=waits)
        if waits:
            is_told.wait()
        if errors and errors[0] is not None and not is_starting:
            raise errors[0]

    def reject(self, reason: str, text: str, log_once: bool = False) -> None:
        """Count an item that can't be had."""
        self._outbox.reject(reason, text, log_once)

    def close(self, timeout_s: float = 10.0) -> None:
        """Send what waits, and end the connection."""
        self._outbox.stop(timeout_s)

    def close_soon(self) -> None:
        """End the connection without waiting, as the garbage collector must."""
        self._outbox.abandon()

    def is_gone(self) -> bool:
        """Return whether this is a forked child."""
        return self._outbox.is_gone()

    def is_own_thread(self) -> bool:
        """Return whether the caller runs on the thread that sends."""
        return self._outbox.is_own_thread()


def _abandon(running: Taker, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if running.is_alive():
        running.abandon()
        warnings.warn(f"Publisher {address} was left running. Call stop(), or use with.", ResourceWarning, stacklevel=2)
