"""Channels over middleware from peer to peer, which has threads of its own and no broker: DDS and Zenoh.

As over ZeroMQ, a message goes to all subscribers that are there just then, nothing keeps it, and nothing acknowledges
it. A `PeerSession` is the middleware of one channel. Its threads call `PeerChannel.deliver` and the other methods under
*for the middleware*, which return at once; one thread per channel calls the handler of deliveries and the callbacks of
the user, and closes the session. What is sent leaves on the caller's thread.
"""

from __future__ import annotations

import abc
import atexit
import logging
import os
import queue
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from time import monotonic
from typing import Final

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import Address
from epypes.transport.brokers.message import check_message
from epypes.transport.channel import (
    CLOSING_GRACE_S,
    ERROR,
    ERROR_REASON,
    MESSAGE_OVERHEAD_BYTES,
    MOST_BACKLOG_BYTES,
    NO_HEADERS,
    ChannelOptions,
    Confirmed,
    Delivery,
    Frames,
    confirm,
)

log = logging.getLogger("epypes.transport")

# How long the end of the interpreter waits for all sessions that were left open.
_EXIT_S: Final = 2.0


class PeerSession(abc.ABC):
    """The middleware of one channel.

    Attributes
    ----------
    channel
        Set by the channel before `open`; the session's threads call its methods under *for the middleware*.
    """

    channel: PeerChannel

    def __init__(self, address: Address, options: ChannelOptions) -> None:
        self.address, self.options = address, options

    @abc.abstractmethod
    def open(self, is_receiver: bool) -> None:
        """Begin to receive, or to send; on the channel's thread.

        Raises
        ------
        AddressError, BrokerError
            The address has no meaning, or what it names can't be reached. `close` is called then.
        """

    @abc.abstractmethod
    def send(self, frames: Frames, id: str, headers: Mapping[str, str]) -> None:  # noqa: A002
        """Hand a message over; from any thread, several at once. The frames belong to the caller afterwards.

        Raises
        ------
        BrokerError
            It can't be sent now.
        MessageError
            It can never be sent.
        """

    @abc.abstractmethod
    def close(self, timeout_s: float) -> None:
        """Have what was sent leave within the time, and end everything; once, also after an `open` that failed."""


class Peers:
    """The peers of the other role that are there: the publishers of a subscriber, or the subscribers of a publisher.

    Parameters
    ----------
    report
        Called with whether the input is stale, when that changes, with a lock held: it returns at once.
    """

    def __init__(self, report: Callable[[bool], object]) -> None:
        self._report = report
        self._changed = threading.Condition()
        self._count = 0
        self._heard_s = 0.0
        self.is_stale = False

    @property
    def last_heard_s(self) -> float | None:
        """How many seconds ago something was heard; None if nothing was yet."""
        return monotonic() - self._heard_s if self._heard_s else None

    def wait(self, timeout_s: float, count: int = 1) -> bool:
        """Return whether so many peers are there within ``timeout_s`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self._count >= count, timeout_s)

    def set_count(self, count: int) -> None:
        """Take note of how many there are; the input is stale when the last one has gone."""
        with self._changed:
            was, self._count = self._count, count
            self._changed.notify_all()
            if count > was:
                self.set_stale(False)
            elif was and not count:
                self.set_stale(True)

    def heard(self) -> None:
        """Take note that something has been heard."""
        self._heard_s = monotonic()
        if self.is_stale:
            with self._changed:
                # The last messages of a publisher may come after the news that it has gone.
                if self._count:
                    self.set_stale(False)

    def set_stale(self, is_stale: bool) -> None:
        """Take note of whether the input is stale."""
        with self._changed:
            was, self.is_stale = self.is_stale, is_stale
            if was != is_stale:
                self._report(is_stale)


class PeerChannel:
    """A `epypes.transport.channel.Channel` over the session of any middleware without a broker.

    Parameters
    ----------
    session
        Not open.
    options
        See there.

    Attributes
    ----------
    publishers, subscriptions
        The peers, by the role of the channel.
    dropped
        How many messages came faster than the handler took them; it gets an error delivery for each.
    """

    keeps_messages: Final = False
    waiting: Final = 0
    slow_subscribers: Final = 0

    def __init__(self, session: PeerSession, options: ChannelOptions) -> None:
        self._session, self._options = session, options
        session.channel = self
        self.address = str(session.address)
        self.prefetch = options.prefetch
        self.is_connected, self.trouble, self.reconnects = False, "", 0
        self.publishers, self.subscriptions = Peers(self._report_stale), Peers(lambda is_stale: None)
        self._process = os.getpid()
        self._handler: Callable[[Delivery], object] | None = None
        self._thread: threading.Thread | None = None
        # What the thread handles, in order; None ends it. Its put may be called by the garbage collector.
        self._events: queue.SimpleQueue[Delivery | Callable[[], object] | None] = queue.SimpleQueue()
        self._until_s = 0.0
        self._is_open = self._is_paused = self._is_closed = False
        # Guards what the threads of the middleware share.
        self._lock = threading.Lock()
        self._backlog_bytes = self.dropped = self._reported = 0

    # --- for any thread ---

    def open(self, on_delivery: Callable[[Delivery], object] | None) -> None:
        """Open the session; see `epypes.transport.channel.Channel.open`."""
        self._handler = on_delivery
        # In a forked child it stays referenced for ever: the threads that its end would wait for are the parent's.
        _opened[self] = None
        opening: Future[None] = Future()
        name = f"epypes peer {self._session.address.name}"
        arguments = (on_delivery is not None, opening)
        self._thread = threading.Thread(target=self._run, args=arguments, name=name, daemon=True)
        self._thread.start()
        try:
            opening.result()
        except BaseException:
            self.close(0.0)
            raise
        finally:
            # It keeps the error, whose traceback keeps this frame.
            del opening
        with self._lock:
            self._is_open, self.is_connected = True, not self.trouble
        self._tell_connection(self.is_connected, self.trouble)

    def send(
        self,
        frames: Frames,
        *,
        id: str = "",  # noqa: A002 - that is its name in every protocol
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Hand a message to the middleware, on this thread; see `epypes.transport.channel.Channel.send`."""
        check_message(frames, id, headers)
        size = sum(map(len, frames))
        if size > self._options.max_message_bytes:
            text = f"A message of {size:,} bytes; the limit is {self._options.max_message_bytes:,}."
            raise MessageError("too large", text)
        if self._is_closed or not self._is_open or self._process != os.getpid():
            state = "closed" if self._is_closed else "not open"
            raise BrokerError(self.address, f"A message to {self.address} was not sent: the channel is {state}.")
        self._session.send(frames, id, headers)
        confirm(confirmed, None)

    def send_if_room(self, frames: Frames) -> bool:
        """Send a message, and return True: what the middleware has no room for it drops, or waits for."""
        self.send(frames)
        return True

    def pause(self) -> None:
        """Drop what arrives from now on; a subscriber counts it as `lost`."""
        self._is_paused = True

    def resume(self) -> None:
        """Take messages again."""
        self._is_paused = False

    def close(self, timeout_s: float = 5.0) -> None:
        """Close the session; what was sent still leaves. See `epypes.transport.channel.Channel.close`."""
        if self._thread is None or self._process != os.getpid():
            return
        if not self._is_closed:
            self._until_s = monotonic() + timeout_s
            self.abandon()
        # If the middleware does not end, or the handler does not return, the rest happens in the background.
        self.join(timeout_s + CLOSING_GRACE_S)

    def join(self, timeout_s: float) -> None:
        """Wait for the end of the channel's thread, unless this is it."""
        if self._thread not in (None, threading.current_thread()):
            self._thread.join(max(timeout_s, 0.0))

    def abandon(self) -> None:
        """Close without waiting and without taking a lock: the garbage collector calls it."""
        if self._process == os.getpid():
            self._is_closed = True
            self._events.put(None)

    # --- for the middleware: from any thread, and they return at once ---

    def deliver(self, frames: Frames, id: str = "", headers: Mapping[str, str] = NO_HEADERS) -> None:  # noqa: A002
        """Hand on a message. It is dropped and counted if the handler is far behind."""
        self.publishers.heard()
        if self._is_paused or self._is_closed:
            return
        size = sum(map(len, frames))
        if size > self._options.max_message_bytes:
            limit = self._options.max_message_bytes
            self.reject("too large", f"A message of {size:,} bytes; the limit is {limit:,}.")
            return
        with self._lock:
            # A single message may always wait.
            if self._backlog_bytes and self._backlog_bytes + size > MOST_BACKLOG_BYTES:
                self.dropped += 1
                return
            self._backlog_bytes += size + MESSAGE_OVERHEAD_BYTES
        self._events.put(Delivery(frames, id, headers=headers))

    def reject(self, reason: str, text: str) -> None:
        """Hand on that a message came that can't be read: why, to count by, and for people."""
        self.deliver((), headers={ERROR: text, ERROR_REASON: reason})

    def report_connection(self, trouble: str) -> None:
        """Take note of why the middleware is not connected; of ``""`` when it is again."""
        with self._lock:
            self.trouble = trouble
            # Before the end of `open` there is no connection that could be lost.
            if self.is_connected == (not trouble) or not self._is_open:
                return
            self.is_connected = not trouble
            self.reconnects += self.is_connected
        self._events.put(lambda: self._tell_connection(not trouble, trouble))

    # --- the channel's thread ---

    def _run(self, is_receiver: bool, opening: Future[None]) -> None:
        # Here, since threads that Zenoh starts for callbacks are daemons if the one that asks for them is.
        try:
            self._session.open(is_receiver)
        except BaseException as error:
            opening.set_exception(error)
        else:
            opening.set_result(None)
        del opening
        while (event := self._events.get()) is not None and not self._is_closed:
            if isinstance(event, Delivery):
                self._hand_over(event)
            else:
                event()
            # Not kept in memory while the next one is waited for.
            del event
        try:
            self._session.close(max(self._until_s - monotonic(), 0.0))
        except BaseException:
            log.exception("%s: the end of the session failed", self.address)
        self.is_connected = False
        _opened.pop(self, None)

    def _hand_over(self, delivery: Delivery) -> None:
        with self._lock:
            self._backlog_bytes -= sum(map(len, delivery.frames)) + MESSAGE_OVERHEAD_BYTES
            dropped, self._reported = self.dropped - self._reported, self.dropped
        text = "Messages come faster than they are handled."
        late = [Delivery((), headers={ERROR: text, ERROR_REASON: "too many at once"})] * dropped
        for one in (delivery, *late):
            try:
                if self._handler is not None:
                    self._handler(one)
            except BaseException:
                log.exception("%s: a message could not be taken", self.address)

    def _tell_connection(self, is_connected: bool, trouble: str) -> None:
        _call(self._options.on_connection, is_connected, trouble)

    def _report_stale(self, is_stale: bool) -> None:
        self._events.put(lambda: _call(self._options.on_stale, is_stale))


# The channels of this process, and of the process that it was forked from.
_opened: Final[dict[PeerChannel, None]] = {}


@atexit.register
def _close_all() -> None:
    """Close what was left open, since the threads of a middleware must not call an interpreter that has ended."""
    left = [*_opened]
    for channel in left:
        channel.abandon()
    until_s = monotonic() + _EXIT_S
    for channel in left:
        channel.join(until_s - monotonic())


def _call(listener: Callable[..., object] | None, *arguments: object) -> None:
    try:
        if listener is not None:
            listener(*arguments)
    except BaseException:
        # It is the user's; the channel goes on.
        log.exception("%s itself failed", getattr(listener, "__name__", "a listener"))
