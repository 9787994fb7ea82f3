"""A broker within this process, for tests: ``memory://BROKER/NAME``.

It keeps what the other brokers promise: a message of a queue goes to one consumer, is delivered again when that one
disconnects before it has acknowledged it, counts its deliveries, and can be rejected into the dead-letter queue.
`away` has all connections to it break, until it is over.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import Address, parse_address
from epypes.transport.channel import NO_HEADERS, ChannelOptions, Confirmed, Delivery, Frames

log = logging.getLogger("epypes.transport")

# The headers of a dead letter: why it was rejected, the queue it comes from, and how often it was delivered.
REASON, FROM, ATTEMPTS = "epypes-reason", "epypes-from", "epypes-attempts"
_RECONNECT_S: Final = 0.02
_TICK_S: Final = 0.25


@dataclass(slots=True, eq=False)
class _Message:
    frames: tuple[bytes, ...]
    id: str
    headers: dict[str, str]
    confirmed: Confirmed | None = None
    attempt: int = 0


@dataclass(slots=True, eq=False)
class _Broker:
    """All queues, logs and listeners of one name in this process; ``changed`` is held to use them."""

    changed: threading.Condition = field(default_factory=lambda: threading.Condition(threading.RLock()))
    queues: dict[str, deque[_Message]] = field(default_factory=dict)
    logs: dict[str, list[_Message]] = field(default_factory=dict)
    listeners: dict[str, list[deque[_Message]]] = field(default_factory=dict)
    is_away: bool = False
    # The number of outages, by which a channel notices one that is over again.
    outages: int = 0

    def put(self, address: Address, message: _Message) -> None:
        if address.kind == "queue":
            self.queues.setdefault(address.name, deque()).append(message)
        elif address.kind == "log":
            self.logs.setdefault(address.name, []).append(message)
        else:
            for listener in self.listeners.get(address.name, ()):
                listener.append(message)
        self.changed.notify_all()


_brokers: Final[dict[str, _Broker]] = {}


@contextlib.contextmanager
def away(host: str) -> Iterator[None]:
    """Have a broker be away for the time of a ``with`` block; what it keeps is there again afterwards."""
    broker = _brokers.setdefault(host, _Broker())
    with broker.changed:
        broker.is_away = True
        broker.outages += 1
        broker.changed.notify_all()
    try:
        yield
    finally:
        with broker.changed:
            broker.is_away = False
            broker.changed.notify_all()


class MemoryChannel:
    """A connection to one address of a broker in this process; see `epypes.transport.channel.Channel`."""

    def __init__(self, address: Address, options: ChannelOptions) -> None:
        self._place, self._options = address, options
        self.address = str(address)
        self.keeps_messages = address.kind == "queue"
        self.is_connected, self.trouble, self.reconnects = False, "", 0
        self.prefetch = options.prefetch
        self._process = os.getpid()
        self._broker = _brokers.setdefault(address.host, _Broker())
        self._on_delivery: Callable[[Delivery], object] | None = None
        self._thread: threading.Thread | None = None
        self._is_over = self._is_paused = self._is_handling = False
        self._outages = 0
        self._accepted: deque[_Message] = deque()
        self._unsettled: list[_Message] = []
        # What it reads: a queue, or what it has heard or is to hear of a broadcast or a log.
        self._source: deque[_Message] = deque()
        self._read = 0

    @property
    def waiting(self) -> int:
        """How many messages were accepted for sending and are not confirmed."""
        return len(self._accepted)

    def open(self, on_delivery: Callable[[Delivery], object] | None) -> None:
        """Connect for the first time; see `Channel.open`."""
        self._on_delivery = on_delivery
        with self._broker.changed:
            self._connect()
        name = f"epypes memory {self._place.name}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def send(
        self,
        frames: Frames,
        *,
        id: str = "",  # noqa: A002 - that is its name in every protocol
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Accept a message for sending; see `Channel.send`."""
        if not frames:
            raise MessageError("bad frames", "A message has at least one frame.")
        if self._is_over or self._thread is None or self._process != os.getpid():
            raise BrokerError(self.address, f"A message to {self.address} was not sent: the channel is closed.")
        message = _Message(tuple(bytes(frame) for frame in frames), id, dict(headers), confirmed)
        with self._broker.changed:
            self._accepted.append(message)
            self._broker.changed.notify_all()

    def pause(self) -> None:
        """Take no further messages; see `Channel.pause`."""
        self._is_paused = True

    def resume(self) -> None:
        """Take messages again."""
        with self._broker.changed:
            self._is_paused = False
            self._broker.changed.notify_all()

    def close(self, timeout_s: float = 5.0) -> None:
        """Send what was accepted and disconnect; see `Channel.close`."""
        if self._process != os.getpid() or self._thread is None:
            return
        is_own = threading.current_thread() is self._thread
        with self._broker.changed:
            if not is_own:
                self._broker.changed.wait_for(lambda: self._is_over or not self._accepted, timeout_s)
            self._is_over = True
            self._disconnect()
            self._broker.changed.notify_all()
        self._drop_accepted()
        if not is_own:
            self._thread.join(0.0 if self._is_handling else timeout_s)

    def abandon(self) -> None:
        """Close without waiting and without a lock; its thread notices."""
        self._is_over = True

    def _run(self) -> None:
        while not self._is_over:
            with self._broker.changed:
                self._check_connection()
                delivery = self._next_delivery()
                sent = self._accepted[0] if self._accepted and self.is_connected else None
                if sent is not None:
                    self._broker.put(self._place, sent)
                    self._accepted.popleft()
                elif delivery is None and not self._is_over:
                    self._broker.changed.wait(_TICK_S if self.is_connected else _RECONNECT_S)
            if sent is not None:
                _tell(sent, None)
            if delivery is not None and self._on_delivery is not None:
                self._is_handling = True
                try:
                    self._on_delivery(delivery)
                except BaseException:
                    log.exception("%s: a message could not be handled", self.address)
                finally:
                    self._is_handling = False
        with self._broker.changed:
            self._disconnect()
        self._drop_accepted()

    def _connect(self) -> None:
        broker, place = self._broker, self._place
        if broker.is_away:
            raise BrokerError(self.address, f"{place} can't be reached: the broker is away.")
        if place.kind == "queue" and place.name not in broker.queues:
            if not place.create:
                text = f"There is no queue {place.name!r} at {place}. Make it, or add ?create=true to the address."
                raise BrokerError(self.address, text)
            broker.queues[place.name] = deque()
        if place.kind == "queue":
            self._source = broker.queues[place.name]
        elif place.kind == "broadcast" and self._on_delivery is not None:
            self._source = deque()
            broker.listeners.setdefault(place.name, []).append(self._source)
        self._outages = broker.outages
        self._report("")

    def _check_connection(self) -> None:
        if self.is_connected and self._outages != self._broker.outages:
            self._disconnect()
            self._report("the broker has gone away")
            log.warning("lost %s, which is tried again until it is connected: the broker has gone away", self.address)
        if not self.is_connected:
            try:
                self._connect()
            except BrokerError as error:
                self._report(str(error))
            else:
                self.reconnects += 1
                log.warning("%s is connected again", self.address)

    def _report(self, trouble: str) -> None:
        was_connected, self.is_connected, self.trouble = self.is_connected, not trouble, trouble
        if was_connected != self.is_connected and self._options.on_connection is not None:
            self._options.on_connection(self.is_connected, trouble)

    def _next_delivery(self) -> Delivery | None:
        if self._on_delivery is None or self._is_paused or self._is_over or not self.is_connected:
            return None
        if self._place.kind == "log":
            entries = self._broker.logs.setdefault(self._place.name, [])
            self._source.extend(entries[self._read :])
            self._read = len(entries)
        if not self._source or len(self._unsettled) >= self.prefetch:
            return None
        message = self._source.popleft()
        views = tuple(memoryview(frame) for frame in message.frames)
        if not self.keeps_messages:
            return Delivery(views, message.id, 0, message.headers)
        message.attempt += 1
        self._unsettled.append(message)
        return Delivery(
            views,
            message.id,
            message.attempt,
            message.headers,
            lambda verdict, reason: self._settle(message, verdict, reason),
        )

    def _settle(self, message: _Message, verdict: str, reason: str) -> None:
        with self._broker.changed:
            # What was delivered over an earlier connection is none of this one's.
            if message not in self._unsettled or self._outages != self._broker.outages:
                return
            self._unsettled.remove(message)
            if verdict == "reject":
                line = " ".join(reason.encode("utf-8", "replace").decode().split())
                more = {REASON: line, FROM: self._place.name, ATTEMPTS: str(message.attempt)}
                dead = _Message(message.frames, message.id, {**message.headers, **more})
                self._broker.put(self._place.dead_letters, dead)
            elif verdict == "nack":
                self._source.append(message)
            self._broker.changed.notify_all()

    def _disconnect(self) -> None:
        """Return what is unsettled to the broker; its lock is held."""
        self.is_connected = self.is_connected and not self._is_over
        if self._place.kind == "queue":
            self._source.extendleft(reversed(self._unsettled))
        elif self._place.kind == "broadcast":
            # By identity: two that have nothing to hear are equal.
            known = self._broker.listeners.get(self._place.name, [])
            self._broker.listeners[self._place.name] = [each for each in known if each is not self._source]
        self._unsettled.clear()

    def _drop_accepted(self) -> None:
        why = self.trouble or "the channel was closed before the broker had confirmed it"
        error = BrokerError(self.address, f"A message to {self.address} was not sent: {why.rstrip('.')}.")
        while self._accepted:
            with contextlib.suppress(IndexError):
                _tell(self._accepted.popleft(), error)


def _tell(message: _Message, error: Exception | None) -> None:
    if message.confirmed is not None:
        try:
            message.confirmed(error)
        except BaseException:
            # It is the sender's; the other messages go on.
            log.exception("the confirmation of a message itself failed")


def make_channel(address: Address, options: ChannelOptions) -> MemoryChannel:
    """Return a channel to an address of a broker in this process."""
    return MemoryChannel(address, options)


def queued(address: str | Address) -> list[Delivery]:
    """Return copies of the messages that wait in a queue, and are not delivered; the oldest first."""
    place = parse_address(address)
    broker = _brokers.setdefault(place.host, _Broker())
    with broker.changed:
        waiting = [*broker.queues.get(place.name, ())]
    return [Delivery(message.frames, message.id, message.attempt, message.headers) for message in waiting]
