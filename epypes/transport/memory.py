"""A broker within this process, for tests: ``memory://BROKER/NAME``.

It keeps what the others promise: a message of a queue goes to one consumer, is delivered again when that is closed
before it has acknowledged it, has a count of its deliveries, and can be rejected. `away` has every channel lose its
connection.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from epypes.errors import BrokerError
from epypes.transport.address import Address, parse_address
from epypes.transport.brokers.channel import BrokerChannel, BrokerSession
from epypes.transport.brokers.message import IncomingMessage, OutgoingMessage, unpack
from epypes.transport.channel import ChannelOptions, Delivery


@dataclass(slots=True, eq=False)
class _StoredMessage:
    body: bytes
    id: str
    headers: dict[str, str]
    deliveries: int = 0


@dataclass(slots=True)
class _MemoryBroker:
    """The queues, logs and sessions of one name; used on the asyncio thread, but for ``is_away``."""

    queues: dict[str, deque[_StoredMessage]] = field(default_factory=dict)
    logs: dict[str, list[_StoredMessage]] = field(default_factory=dict)
    sessions: list[MemorySession] = field(default_factory=list)
    is_away: bool = False


_brokers: Final[dict[str, _MemoryBroker]] = {}
_lock: Final = threading.Lock()


def _broker(name: str) -> _MemoryBroker:
    with _lock:
        return _brokers.setdefault(name, _MemoryBroker())


@contextlib.contextmanager
def away(host: str) -> Iterator[None]:
    """Have a broker be gone for the time of a ``with`` block; what it keeps is there again afterwards."""
    broker = _broker(host)
    broker.is_away = True
    for session in list(broker.sessions):
        session.lose_from_outside()
    try:
        yield
    finally:
        broker.is_away = False


class MemorySession(BrokerSession):
    """A connection to a broker in this process."""

    most_header_bytes = 65_536

    def __init__(self, address: Address, timeout_s: float) -> None:
        super().__init__(address, timeout_s)
        self._broker = _broker(address.host)
        self._deliver: Callable[[IncomingMessage], object] | None = None
        self._window = 0
        # What waits for this session: of a queue, shared by all its sessions; else its own.
        self.waiting: deque[_StoredMessage] = deque()
        # In the order of delivery.
        self._unsettled: dict[IncomingMessage, None] = {}

    def lose_from_outside(self) -> None:
        """Have the connection break; from any thread."""
        with contextlib.suppress(RuntimeError):
            self.lost.get_loop().call_soon_threadsafe(self.lose, "the broker has gone away")

    async def connect(self, window: int) -> None:
        """Connect; the queue is made if the address says so."""
        address, broker = self.address, self._broker
        if broker.is_away:
            raise BrokerError(str(address), f"{address} can't be reached: the broker is away.")
        if address.kind == "queue":
            if address.name not in broker.queues and not address.create:
                text = f"There is no queue {address.name!r} at {address}. Make it, or add ?create=true to the address."
                raise BrokerError(str(address), text)
            self.waiting = broker.queues.setdefault(address.name, deque())
        else:
            self.waiting = deque(broker.logs.get(address.name, ()))
        broker.sessions.append(self)

    async def publish(self, message: OutgoingMessage) -> None:
        """Keep a message, and deliver it to the sessions that are connected."""
        address, broker = message.address, self._broker
        if broker.is_away or self.lost.done():
            raise BrokerError(str(address), f"{address} can't be reached: the broker is away.")
        stored = _StoredMessage(message.body, message.id, dict(message.headers))
        if address.kind == "queue":
            broker.queues.setdefault(address.name, deque()).append(stored)
        else:
            if address.kind == "log":
                broker.logs.setdefault(address.name, []).append(stored)
            for session in broker.sessions:
                if (session.address.name, session.address.kind) == (address.name, address.kind):
                    session.waiting.append(stored)
        self._hand_out()

    async def consume(self, deliver: Callable[[IncomingMessage], object], window: int) -> None:
        """Have a function called with what comes."""
        self._deliver, self._window = deliver, window
        self._hand_out()

    async def settle(self, message: IncomingMessage, *, requeue: bool) -> None:
        """Forget a message, or put it back."""
        if message in self._unsettled:
            del self._unsettled[message]
            if requeue:
                self.waiting.appendleft(message.receipt)
            self._hand_out()

    def _hand_out(self) -> None:
        """Deliver what waits, in turn to those that have room."""
        sessions = self._broker.sessions
        while any(session.take_one() for session in [*sessions]):
            # The next one begins.
            sessions.append(sessions.pop(0))

    def take_one(self) -> bool:
        """Deliver one message that waits, if there is room for it."""
        is_queue = self.address.kind == "queue"
        is_full = is_queue and len(self._unsettled) >= self._window
        if self._deliver is None or self.lost.done() or is_full or not self.waiting:
            return False
        stored = self.waiting.popleft()
        stored.deliveries += is_queue
        message = IncomingMessage(stored.body, stored.id, dict(stored.headers), stored.deliveries, receipt=stored)
        if is_queue:
            self._unsettled[message] = None
        self._deliver(message)
        return True

    async def close(self) -> None:
        """Disconnect; what is unsettled is delivered again."""
        self._deliver = None
        if self in self._broker.sessions:
            self._broker.sessions.remove(self)
        for message in reversed(self._unsettled):
            self.waiting.appendleft(message.receipt)
        self._unsettled.clear()
        self._hand_out()


def make_channel(address: Address, options: ChannelOptions) -> BrokerChannel:
    """Return a channel to a broker in this process."""
    return BrokerChannel(MemorySession(address, options.timeout_s), options)


def queued(address: str | Address) -> list[Delivery]:
    """Return copies of the messages that wait in a queue and are not delivered, the oldest first; for tests."""
    parsed = parse_address(address)
    found = []
    for stored in [*_broker(parsed.host).queues.get(parsed.name, ())]:
        frames, headers = unpack(IncomingMessage(stored.body, stored.id, dict(stored.headers)))
        found.append(Delivery(frames, stored.id, stored.deliveries, headers))
    return found
