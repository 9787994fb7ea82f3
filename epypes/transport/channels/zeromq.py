"""How do frames come to other processes without a broker? By ZeroMQ's sockets, which keep nothing and promise nothing.

Who sends binds, who receives connects; ``connect:tcp://...`` has the one who sends connect, ``bind:tcp://...`` the one
who receives bind. A message goes to all who are connected just then, and is dropped where somebody does not keep up.
ZeroMQ carries frames alone: neither the id nor the headers of a message go along, and nothing is acknowledged.
"""

from __future__ import annotations

import contextlib
import queue as queues
import threading
from collections.abc import Iterator, Mapping
from typing import Final

from epypes.errors import AddressError, BrokerError, MessageError
from epypes.pipeline import Mailbox
from epypes.transport.channel import Delivery
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Frames, Received
from epypes.transport.publisher import ZMQPublisher
from epypes.transport.subscriber import ZMQSubscriber

_KEPT: Final = 1_000
_CONNECT, _BIND = "connect:", "bind:"


class ZeroMQChannel:
    """A way to all who listen at an address of ZeroMQ; see `seam.Channel`. Its sockets are opened by the first use."""

    def __init__(self, place: Place, prefetch: int, timeout_s: float) -> None:
        self._place, self.prefetch, self._timeout_s = place, prefetch, timeout_s
        self._address = place.name.removeprefix(_CONNECT).removeprefix(_BIND)
        self._lock = threading.Lock()
        self._is_closed = False
        self._leaving = Mailbox("block")
        self._arrived: queues.Queue[Delivery | None] = queues.Queue(max(prefetch, _KEPT))
        self._publisher: ZMQPublisher | None = None
        self._subscriber: ZMQSubscriber | None = None

    def send(self, frames: Frames, *, id: str = "", headers: Mapping[str, str] | None = None) -> None:  # noqa: A002
        """Hand a message to ZeroMQ; whether anybody gets it is not known. See `seam.Channel.send`."""
        with self._lock:
            self._check()
            publisher = self._publisher = self._publisher or self._bound()
        before = publisher.rejected
        self._leaving.put(tuple(frames))
        refused = publisher.rejected - before
        if refused:
            reason = next(iter(refused))
            raise MessageError(reason, f"A message of {sum(map(len, frames)):,} bytes can't be sent: {reason}.")

    def _bound(self) -> ZMQPublisher:
        bind = not self._place.name.startswith(_CONNECT)
        with _as_broker_error():
            return ZMQPublisher(self._address, self._leaving, bind=bind).start()

    def receive(self, timeout_s: float) -> Received | None:
        """Return the next message; see `seam.Channel.receive`."""
        with self._lock:
            self._check()
            self._subscriber = self._subscriber or self._connected()
        try:
            frames = self._arrived.get(timeout=timeout_s)
        except queues.Empty:
            frames = None
        self._check()
        return None if frames is None else Received(frames.frames)

    def _connected(self) -> ZMQSubscriber:
        bind = self._place.name.startswith(_BIND)
        with _as_broker_error():
            return ZMQSubscriber(self._address, self._arrived, bind=bind, undecoded=True).start()

    @property
    def trouble(self) -> str:
        """Why it is over; see `seam.Channel.trouble`. ZeroMQ itself comes back from everything."""
        return "it was closed" if self._is_closed else ""

    def _check(self) -> None:
        if self.trouble:
            raise BrokerError(str(self._place), f"The connection to {self._place} is over: {self.trouble}.")

    def close(self) -> None:
        """End it; see `seam.Channel.close`."""
        with self._lock:
            self._is_closed = True
            publisher, subscriber = self._publisher, self._subscriber
            self._publisher = self._subscriber = None
        # What is full wakes who waits by itself.
        with contextlib.suppress(queues.Full):
            self._arrived.put_nowait(None)
        for opened in (publisher, subscriber):
            if opened is not None:
                opened.stop(self._timeout_s)


@contextlib.contextmanager
def _as_broker_error() -> Iterator[None]:
    try:
        yield
    except AddressError as error:
        raise BrokerError(error.address, str(error)) from error


def open_channel(place: Place, prefetch: int, timeout_s: float) -> ZeroMQChannel:
    """Open a way to an address of ZeroMQ."""
    return ZeroMQChannel(place, prefetch, timeout_s)
