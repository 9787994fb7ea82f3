"""How does an item leave through the socket? Whoever has it sends it, one thread at a time."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import Counter, deque
from dataclasses import dataclass, field

import zmq

from epypes.errors import MessageError
from epypes.transport import io
from epypes.transport.forked import forget_in_child
from epypes.transport.framing import Frames, Framing
from epypes.transport.guard import SUBSCRIPTION_OPTIONS
from epypes.transport.joining import Doorkeeper
from epypes.transport.security import Security
from epypes.transport.throttle import Throttle
from epypes.wire import Limits
from epypes.wire.arrays import is_immutable

log = logging.getLogger("epypes.transport")

# Below this a copy takes less time than to keep account of a buffer that is lent.
_LENT_FROM_BYTES = 64 * 1024
_BREAK_TRIES = 5
_DONTWAIT, _MORE = int(zmq.DONTWAIT), int(zmq.DONTWAIT | zmq.SNDMORE)


@dataclass(slots=True)
class Counts:
    """What a publisher has done since it was made."""

    sent: int = 0
    slow_subscribers: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


class Outlet:
    """The socket of a publisher, from a start to its stop.

    The I/O thread reads subscriptions from it, and whoever publishes sends on it; each holds its lock meanwhile.
    """

    def __init__(self, topic: str, limits: Limits, counts: Counts) -> None:
        self._framing = Framing(topic, limits)
        self._counts = counts
        self._log = Throttle(log)
        self._process = os.getpid()
        # The turn is held while an item is made into frames, which runs its own code, the lock to touch the socket.
        # Re-entrant, since a signal's handler may publish anywhere: it gets the turn, and is busy or not.
        self._turn, self._lock = threading.RLock(), threading.Lock()
        self._is_busy = self._has_asked = False
        self._later: deque[object] = deque()
        self._socket: io.Socket | None = None
        self.doorkeeper = Doorkeeper()
        self.address = ""
        forget_in_child(self)

    def open(self, address: str, security: Security, high_water_mark: int) -> None:
        """Open the socket; raise AddressError if the address is refused."""
        gate = security.gate()
        options = [
            (zmq.XPUB_MANUAL, 1),
            (zmq.SNDHWM, high_water_mark),
            # Not in order to wait for a slow subscriber, but in order to hear of it; see `_send`.
            (zmq.XPUB_NODROP, 1),
            *SUBSCRIPTION_OPTIONS,
            *security.options(gate),
        ]

        def open_socket(thread: io.IOThread) -> str:
            self._socket = opened = thread.open(
                zmq.XPUB, address, security.bind, self._read, options, self._lock, gate, max_message_bytes=0
            )
            self.doorkeeper.attach(opened, thread.watch_of(opened))
            return thread.address_of(opened, address)

        self.address = io.call(open_socket, start=True)

    @property
    def name(self) -> str:
        """Whose it is, for errors."""
        return f"ZMQPublisher {self.address}"

    def is_own_thread(self) -> bool:
        """Return whether the caller runs on the I/O thread, which closing needs."""
        return io.on_io_thread()

    def is_gone(self) -> bool:
        """Return whether this is a forked child, where there is neither thread nor socket."""
        return self._process != os.getpid()

    def forget(self) -> None:
        """Forget the socket, and the threads that held the locks, in a forked child."""
        self._turn, self._lock = threading.RLock(), threading.Lock()
        self._socket, self._is_busy = None, False
        self._later.clear()

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
        handler, follows. What such a handler raises, as Ctrl+C does, comes as it is, and the next item is sent.
        """
        # A signal is handled neither between the lock and its block nor between a flag and its try; wherever else one
        # comes, its handler finds the flag down and sends, or up and leaves its item to whoever has put it up.
        with self._turn:
            self._later.append(item)
            while self._later and not self._is_busy:
                self._is_busy = True
                sent = self._counts.sent
                # Few calls from here to the socket: after an image has filled the caches each takes 3 to 5 us.
                try:
                    item = self._later.popleft()
                    frames = self._framing.frames(item)
                    with self._lock:
                        self._send(frames)
                except BaseException as error:
                    self._refuse(item, error, self._counts.sent > sent)
                    if not isinstance(error, Exception):
                        raise
                finally:
                    self._is_busy = False

    def _refuse(self, item: object, error: BaseException, has_left: bool) -> None:
        if has_left:
            return
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
            self._log.warning(reason, f"{self.address} rejected an item ({reason}): {text}")

    def _send(self, frames: Frames) -> None:
        socket = self._socket
        if socket is None:
            raise zmq.ZMQError(zmq.ENOTSOCK)
        try:
            self._send_frames(socket, frames)
        except zmq.Again:
            # Nothing has left yet. A subscriber's queue is full: the message is dropped for that one, and ZeroMQ leaves
            # it out without a word until half of its queue is empty.
            self._counts.slow_subscribers += 1
            text = f"{self.address}: a subscriber is too slow and loses messages, which it counts itself (lost)"
            self._log.warning("slow subscriber", text)
            socket.setsockopt(zmq.XPUB_NODROP, 0)
            try:
                self._send_frames(socket, frames)
            finally:
                socket.setsockopt(zmq.XPUB_NODROP, 1)
        # The I/O thread reads it: an answer to a join must not be interrupted by a signal.
        if io.has_arrived(socket) and not self._has_asked:
            io.soon(lambda thread: thread.read_again(socket))
            self._has_asked = True

    def _send_frames(self, socket: io.Socket, frames: Frames) -> None:
        # Counted before: whoever has received it must find it counted.
        self._counts.sent += 1
        is_begun = is_last = False
        try:
            for frame in frames[:-1]:
                socket.send(frame, _MORE, copy=not _can_be_lent(frame))
                is_begun = True
            last, is_last = frames[-1], True
            socket.send(last, _DONTWAIT, copy=len(last) < _LENT_FROM_BYTES or not _can_be_lent(last))
        except (zmq.ZMQError, MemoryError):
            # This frame has not left. The next message would be taken for the rest of this one.
            self._counts.sent -= 1
            if is_begun:
                _break_off(socket, frames)
            raise
        except BaseException:
            # Within the last frame nobody can tell whether it has left; mostly it has.
            self._counts.sent -= not is_last
            _break_off(socket, frames)
            raise

    def _read(self) -> bool:
        with self._lock:
            self._has_asked = False
            return self.doorkeeper.read()


def prepare_lending() -> None:
    """Start the thread by which pyzmq learns that ZeroMQ has read memory that was lent to it.

    It starts with the first large frame otherwise, and if it can't ZeroMQ ends the process.
    """
    zmq.Frame(bytes(_LENT_FROM_BYTES), copy=False)


def _can_be_lent(frame: bytes | memoryview) -> bool:
    """Return whether ZeroMQ may read a frame later: if it is worth it, and nobody can change it meanwhile."""
    if len(frame) < _LENT_FROM_BYTES:
        return False
    return isinstance(frame, bytes) or is_immutable(frame)


def _break_off(socket: io.Socket, frames: Frames) -> None:
    """End a message that was interrupted, so that the receiver rejects it, and not the next one as well.

    How many frames have left can't be told. After some of them these two make a message that has the wrong ones; alone
    they make one without a header.
    """
    if len(frames) < 2:
        return
    for _ in range(_BREAK_TRIES):
        # Another signal may come.
        with contextlib.suppress(BaseException):
            socket.send(frames[0], _MORE)
            socket.send(b"", _DONTWAIT)
            return
