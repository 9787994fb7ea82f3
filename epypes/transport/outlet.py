"""How does an item leave through the socket? Whoever has it sends it, one thread at a time."""

from __future__ import annotations

import logging
import os
import threading
import weakref
from collections import Counter, deque
from dataclasses import dataclass, field
from threading import get_ident

import zmq

from epypes.errors import MessageError
from epypes.transport import io
from epypes.transport.framing import Frames, Framing
from epypes.transport.joining import Doorkeeper
from epypes.transport.security import Security
from epypes.wire import Limits
from epypes.wire.arrays import is_settled

log = logging.getLogger("epypes.transport")

# A subscription is short; whoever sends more to a publisher is no subscriber.
_MAX_SUBSCRIPTION_BYTES = 64 * 1024
# Below this a copy takes less time than to keep account of a buffer that is lent.
_LENT_FROM_BYTES = 64 * 1024
_DONTWAIT, _MORE = int(zmq.DONTWAIT), int(zmq.DONTWAIT | zmq.SNDMORE)


@dataclass(slots=True)
class Counts:
    """What a publisher has done since it was made."""

    sent: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


class Outlet:
    """The socket of a publisher, from a start to its stop.

    The I/O thread reads subscriptions from it, and whoever publishes sends on it; each holds its lock meanwhile.
    """

    def __init__(self, topic: str, limits: Limits, counts: Counts) -> None:
        self._framing = Framing(topic, limits)
        self._counts = counts
        self._process = os.getpid()
        # The turn is held while an item is made into frames, which runs its own code, the lock to touch the socket.
        self._turn, self._lock = threading.Lock(), threading.Lock()
        self._whose = 0
        self._later: deque[object] = deque()
        self._socket: io.Socket | None = None
        self.doorkeeper = Doorkeeper()
        self.address = ""
        _outlets.add(self)

    def open(self, address: str, security: Security, high_water_mark: int) -> None:
        """Open the socket; raise AddressError if the address is refused."""
        gate = security.gate()
        options = [
            (zmq.XPUB_MANUAL, 1),
            (zmq.SNDHWM, high_water_mark),
            (zmq.MAXMSGSIZE, _MAX_SUBSCRIPTION_BYTES),
            *security.options(gate),
        ]

        def open_socket(thread: io.IOThread) -> str:
            self._socket = opened = thread.open(zmq.XPUB, address, security.bind, self._read, options, self._lock, gate)
            self.doorkeeper.attach(opened)
            return thread.address_of(opened, address)

        self.address = io.call(open_socket, start=True)

    def is_gone(self) -> bool:
        """Return whether this is a forked child, where there is neither thread nor socket."""
        return self._process != os.getpid()

    def forget(self) -> None:
        """Forget the socket, and the threads that held the locks, in a forked child."""
        self._turn, self._lock = threading.Lock(), threading.Lock()
        self._socket, self._whose = None, 0

    def close(self, timeout_s: float = 10.0) -> None:
        """Close the socket; what was sent still leaves."""
        if self._socket is not None and not self.is_gone():
            io.close(self._socket, timeout_s)

    def close_soon(self) -> None:
        """Close the socket without waiting, as the garbage collector must."""
        if self._socket is not None and not self.is_gone():
            io.close_soon(self._socket)

    def publish(self, item: object) -> None:
        """Send an item; what can't be sent is counted and logged. Arrays that could be changed are copied first.

        From any thread, one after the other; an item that is published from within, by its own code or by a signal's
        handler, follows.
        """
        if not self._turn.acquire(False):
            if self._whose == get_ident():
                self._later.append(item)
                return
            self._turn.acquire()
        self._whose = get_ident()
        # Few calls from here to the socket: after an image has filled the caches each takes 3 to 5 us.
        try:
            frames = self._framing.frames(item)
            with self._lock:
                self._send(frames)
        except Exception as error:
            self._refuse(item, error)
        finally:
            self._whose = 0
            self._turn.release()
        while self._later:
            self.publish(self._later.popleft())

    def _refuse(self, item: object, error: Exception) -> None:
        if isinstance(error, MessageError):
            self.reject(error.reason, str(error))
        elif isinstance(error, zmq.ZMQError):
            self.reject("not sent", f"a message could not be sent: {error}")
        else:
            # The item's own code, called to make bytes of it, may raise anything.
            self.reject(type(error).__name__, f"a {type(item).__name__} could not be sent: {error!r}")

    def reject(self, reason: str, text: str, log_once: bool = False) -> None:
        """Count an item that can't be sent."""
        self._counts.rejected[reason] += 1
        if not log_once or self._counts.rejected[reason] == 1:
            log.warning("%s rejected an item (%s): %s", self.address, reason, text)

    def _send(self, frames: Frames) -> None:
        socket = self._socket
        if socket is None:
            raise zmq.ZMQError(zmq.ENOTSOCK)
        # Counted before: whoever has received it must find it counted.
        self._counts.sent += 1
        try:
            for frame in frames[:-1]:
                socket.send(frame, _MORE, copy=not _can_be_lent(frame))
            last = frames[-1]
            socket.send(last, _DONTWAIT, copy=len(last) < _LENT_FROM_BYTES or not _can_be_lent(last))
        except zmq.ZMQError:
            self._counts.sent -= 1
            raise
        if io.has_arrived(socket) and self.doorkeeper.read():
            io.soon(lambda thread: thread.read_again(socket))

    def _read(self) -> bool:
        with self._lock:
            return self.doorkeeper.read()


# Those of this process; their sockets must not be used in a forked child.
_outlets: weakref.WeakSet[Outlet] = weakref.WeakSet()


def _forget_outlets() -> None:
    for outlet in list(_outlets):
        outlet.forget()


os.register_at_fork(after_in_child=_forget_outlets)


def _can_be_lent(frame: bytes | memoryview) -> bool:
    """Return whether ZeroMQ may read a frame later: if it is worth it, and nobody can change it meanwhile."""
    if len(frame) < _LENT_FROM_BYTES:
        return False
    return isinstance(frame, bytes) or is_settled(frame)
