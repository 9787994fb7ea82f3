"""How does a broker behave that lives in this process? For tests: ``memory://BROKER/NAME``.

It keeps what the others promise: a message of a queue goes to one receiver, comes again when that is closed before it
has acknowledged it, counts its deliveries, and can be put aside. `away` has every channel of it fail, until it is over.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Final

from epypes.errors import BrokerError
from epypes.transport.channels.packing import ATTEMPTS, FROM, REASON, check
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Frames, Received


@dataclass(slots=True, eq=False)
class _Message:
    frames: tuple[bytes, ...]
    id: str
    headers: dict[str, str]
    attempt: int = 0


@dataclass(slots=True)
class _Broker:
    """All places of one name in this process; whoever changes them holds ``changed``."""

    changed: threading.Condition = field(default_factory=threading.Condition)
    queues: dict[str, deque[_Message]] = field(default_factory=dict)
    logs: dict[str, list[_Message]] = field(default_factory=dict)
    listeners: dict[str, list[deque[_Message]]] = field(default_factory=dict)
    channels: list[MemoryChannel] = field(default_factory=list)
    is_away: bool = False


_brokers: Final[dict[str, _Broker]] = {}
_lock: Final = threading.Lock()


def _broker(name: str) -> _Broker:
    with _lock:
        return _brokers.setdefault(name, _Broker())


@contextlib.contextmanager
def away(host: str) -> Iterator[None]:
    """Have a broker be gone for the time of a ``with`` block; what it keeps is there again afterwards."""
    broker = _broker(host)
    with broker.changed:
        broker.is_away = True
        for channel in list(broker.channels):
            channel.lose()
        broker.changed.notify_all()
    try:
        yield
    finally:
        with broker.changed:
            broker.is_away = False


class MemoryChannel:
    """A way to one place of a broker in this process; see `seam.Channel`."""

    def __init__(self, place: Place, prefetch: int) -> None:
        self._place, self.prefetch = place, prefetch
        self._broker = broker = _broker(place.host)
        self._held: list[_Message] = []
        self._heard: deque[_Message] | None = None
        self._is_lost = self._is_closed = False
        with broker.changed:
            if broker.is_away:
                raise BrokerError(str(place), f"{place} can't be reached: the broker is away.")
            if place.kind == "queue" and place.name not in broker.queues:
                if not place.create:
                    text = f"There is no queue {place.name!r} at {place}. Make it, or add ?create=true to the address."
                    raise BrokerError(str(place), text)
                broker.queues[place.name] = deque()
            broker.channels.append(self)

    def send(self, frames: Frames, *, id: str = "", headers: Mapping[str, str] | None = None) -> None:  # noqa: A002
        """Send a message; see `seam.Channel.send`."""
        check(frames, id, headers or {})
        message = _Message(tuple(bytes(frame) for frame in frames), id, dict(headers or {}))
        with self._broker.changed:
            self._check()
            self._put(self._place, message)

    def _put(self, place: Place, message: _Message) -> None:
        broker = self._broker
        if place.kind == "queue":
            broker.queues.setdefault(place.name, deque()).append(message)
        elif place.kind == "log":
            broker.logs.setdefault(place.name, []).append(message)
        else:
            for heard in broker.listeners.get(place.name, ()):
                heard.append(message)
        broker.changed.notify_all()

    def receive(self, timeout_s: float) -> Received | None:
        """Return the next message; see `seam.Channel.receive`."""
        until_s, broker = monotonic() + timeout_s, self._broker
        with broker.changed:
            waiting = self._source()
            while True:
                self._check()
                if waiting and len(self._held) < self.prefetch:
                    return self._received(waiting.popleft())
                if not broker.changed.wait(max(until_s - monotonic(), 0.0)) and monotonic() >= until_s:
                    return None
                waiting = self._source()

    def _source(self) -> deque[_Message]:
        broker, place = self._broker, self._place
        if place.kind == "queue":
            return broker.queues[place.name]
        if self._heard is None:
            self._heard = _Replay(broker.logs.setdefault(place.name, [])) if place.kind == "log" else deque()
            if place.kind == "broadcast":
                broker.listeners.setdefault(place.name, []).append(self._heard)
        return self._heard

    def _received(self, message: _Message) -> Received:
        views = tuple(memoryview(frame) for frame in message.frames)
        if self._place.kind != "queue":
            return Received(views, message.id, 0, message.headers)
        message.attempt += 1
        self._held.append(message)
        return Received(
            views, message.id, message.attempt, message.headers, lambda reason: self._settle(message, reason)
        )

    def _settle(self, message: _Message, reason: str | None) -> None:
        with self._broker.changed:
            if message not in self._held:
                return
            self._held.remove(message)
            if reason is not None:
                more = {REASON: reason, FROM: self._place.name, ATTEMPTS: str(message.attempt)}
                dead = _Message(message.frames, message.id, {**message.headers, **more})
                self._put(self._place.dead_letters, dead)
            self._broker.changed.notify_all()

    @property
    def trouble(self) -> str:
        """Why it is over; see `seam.Channel.trouble`."""
        if self._is_lost:
            return "the broker has gone away"
        return "it was closed" if self._is_closed else ""

    def _check(self) -> None:
        if self.trouble:
            raise BrokerError(str(self._place), f"The connection to {self._place} is over: {self.trouble}.")

    def lose(self) -> None:
        """Have the connection break: what was not acknowledged is delivered again. With the broker's lock held."""
        self._is_lost = True
        self._give_back()

    def close(self) -> None:
        """End it; see `seam.Channel.close`."""
        with self._broker.changed:
            if not self._is_closed:
                self._is_closed = True
                self._give_back()
            self._broker.changed.notify_all()

    def _give_back(self) -> None:
        broker, place = self._broker, self._place
        if self in broker.channels:
            broker.channels.remove(self)
        if place.kind == "queue":
            broker.queues[place.name].extendleft(reversed(self._held))
        elif place.kind == "broadcast" and self._heard is not None:
            # By identity: two that have nothing to hear are equal.
            others = [each for each in broker.listeners[place.name] if each is not self._heard]
            broker.listeners[place.name] = others
        self._held.clear()


class _Replay(deque[_Message]):
    """A log as one receiver reads it, from the first message on."""

    def __init__(self, log: list[_Message]) -> None:
        super().__init__()
        self._log, self._read = log, 0

    def __bool__(self) -> bool:
        return self._read < len(self._log)

    def popleft(self) -> _Message:
        self._read += 1
        return self._log[self._read - 1]


def open_channel(place: Place, prefetch: int, timeout_s: float) -> MemoryChannel:
    """Open a way to a place of a broker in this process."""
    return MemoryChannel(place, prefetch)
