"""How does what is published come into a queue? Through a subscriber, read by the I/O thread."""

from __future__ import annotations

import logging
import os
import queue as queues
import threading
import warnings
import weakref
from collections import Counter
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Protocol, Self

import zmq

from epypes.errors import MessageError, StillRunning
from epypes.transport import io
from epypes.transport.addresses import check_bind
from epypes.transport.joining import Guest
from epypes.wire import Envelope, Limits, decode, topic_frame

log = logging.getLogger("epypes.transport")

# Messages read before the I/O thread looks at other sockets again.
_BATCH = 100
# Sources whose sequence numbers are followed; a peer that invents sources must not fill the memory.
_MAX_SOURCES = 1_024
HIGH_WATER_MARK = 1_000
_DONTWAIT = int(zmq.DONTWAIT)

Source = tuple[str, int]


class PutQueue(Protocol):
    """What a subscriber puts into: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def put(self, item: Any, *, block: bool) -> object:
        """Take an item, or raise queue.Full; called with ``block=False`` on the I/O thread."""


class ZMQSubscriber:
    """Puts what arrives on a ZeroMQ SUB socket into a queue.

    Parameters
    ----------
    address
        Where the publisher is: ``"tcp://127.0.0.1:5555"``.
    queue
        Any object with ``put(item, block=False)``. A message of one frame is put as bytes (2019 mode), one of more
        frames as an Envelope, whose arrays are read-only. It is called on the I/O thread, and must be quick.
    topic
        Topic of the envelopes: ``"cam1"`` gets ``cam1`` and ``cam1/left``, not ``cam10``; ``""`` gets everything.
        Messages of 2019 have no topic: with one given, only those come whose own bytes begin with it and a slash.
    bind
        True to bind, for publishers that connect.
    insecure
        True to bind an address that other machines can reach.
    max_message_bytes
        A peer that sends a larger frame is disconnected; a larger message is counted in `rejected`.
    high_water_mark
        Messages kept by ZeroMQ until the I/O thread has read them.

    Raises
    ------
    AddressError
        If ``bind`` is asked for an address that is not loopback, without ``insecure``.
    MessageError
        If ``topic`` can't be one.

    Notes
    -----
    Start it, or use ``with``. Semeniuta and Falkman 2019, "Reactive pipelines".
    """

    def __init__(
        self,
        address: str,
        queue: PutQueue,
        topic: str = "",
        bind: bool = False,
        *,
        insecure: bool = False,
        max_message_bytes: int = Limits().total_bytes,
        high_water_mark: int = HIGH_WATER_MARK,
    ) -> None:
        if bind:
            check_bind(address, insecure)
        self._given, self._bind = address, bind
        self._subscription = topic_frame(topic) if topic else b""
        self._limits = Limits(total_bytes=max_message_bytes)
        self._high_water_mark = high_water_mark
        self._inbox = _Inbox(queue, self._limits)
        self._lock = threading.Lock()
        self._opened: _Opened | None = None
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The endpoint that is bound, once it is started; otherwise the address that was given."""
        opened = self._opened
        return self._given if opened is None else opened.address

    @property
    def received(self) -> int:
        """How many messages were put into the queue."""
        return self._inbox.received

    @property
    def rejected(self) -> Counter[str]:
        """How many messages could not be understood, by reason; a copy."""
        return Counter(self._inbox.rejected)

    @property
    def dropped(self) -> Counter[str]:
        """How many messages the queue did not take, by reason (``"queue full"``); a copy."""
        return Counter(self._inbox.dropped)

    @property
    def lost(self) -> Mapping[Source, int]:
        """How many envelopes never arrived, by (source, epoch): gaps in their sequence numbers; a copy."""
        return dict(self._inbox.lost)

    def start(self) -> Self:
        """Open the socket and begin to receive; nothing happens if it runs already.

        Raises
        ------
        AddressError
            If the address can't be bound, or can't be understood.
        """
        with self._lock:
            if self._opened is None or self._opened.is_gone():
                self._opened = opened = _Opened(self._inbox)
                try:
                    opened.open(self._given, self._bind, self._options(opened.guest))
                except BaseException:
                    self._opened = None
                    raise
                self._finalizer = weakref.finalize(self, _abandon, opened, self._given)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Close the socket; from any thread, as often as you like.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds.

        Raises
        ------
        StillRunning
            If the I/O thread is held up for so long, which a slow ``put`` of some queue can do. The socket is
            closed as soon as it returns.
        """
        with self._lock:
            opened, self._opened = self._opened, None
            if self._finalizer is not None:
                self._finalizer.detach()
        if opened is not None:
            opened.close(timeout_s)

    def wait_joined(self, timeout_s: float = 5.0, publishers: int = 1) -> bool:
        """Return whether publishers have confirmed the subscription: what they send from then on is not lost.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds.
        publishers
            How many must have confirmed it since the start. Only publishers of EPypes 1.0 do; one of 2019 never will.
        """
        opened = self._opened
        return opened is not None and opened.guest.wait(timeout_s, publishers)

    def _options(self, guest: Guest) -> list[tuple[int, int | bytes]]:
        return [
            (zmq.RCVHWM, self._high_water_mark),
            (zmq.MAXMSGSIZE, self._limits.total_bytes),
            # A subscriber has nothing to send but its subscriptions.
            (zmq.LINGER, 0),
            (zmq.SUBSCRIBE, self._subscription),
            (zmq.SUBSCRIBE, guest.topic),
        ]

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def __repr__(self) -> str:
        state = "stopped" if self._opened is None else "running"
        return f"<ZMQSubscriber {self.address[:40]} {state}: {self.received} received>"


class _Inbox:
    """What happens to a message; all of it on the I/O thread."""

    def __init__(self, queue: PutQueue, limits: Limits) -> None:
        self._queue, self._limits = queue, limits
        self.received = 0
        self.rejected: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.lost: dict[Source, int] = {}
        self._last: dict[Source, int] = {}

    def accept(self, frames: Sequence[zmq.Frame], guest: Guest) -> None:
        if len(frames) == 2 and guest.saw(frames[0].bytes, frames[1].bytes):
            return
        try:
            envelope = decode([frame.buffer for frame in frames], self._limits)
        except MessageError as error:
            self.rejected[error.reason] += 1
            log.warning("rejected a message (%s): %s", error.reason, error)
            return
        self._follow(envelope)
        self.put(envelope)

    def put(self, item: object) -> None:
        # Counted before: whoever has the item must find it counted.
        self.received += 1
        try:
            self._queue.put(item, block=False)
        except queues.Full:
            self.received -= 1
            self.dropped["queue full"] += 1
        except Exception as error:
            # The user's queue may raise anything, a Mailbox of policy "fault" does; the others' sockets go on.
            self.received -= 1
            self.dropped[type(error).__name__] += 1
            log.warning("the queue refused a message: %r", error)

    def _follow(self, envelope: Envelope) -> None:
        if envelope.sequence == 0:
            return
        source = (envelope.source, envelope.epoch)
        # What came before the first one that was received was sent before this subscriber had joined.
        last = self._last.pop(source, envelope.sequence - 1)
        missing = envelope.sequence - last - 1
        if missing > 0:
            self.lost[source] = self.lost.get(source, 0) + missing
        self._last[source] = max(last, envelope.sequence)
        if len(self._last) > _MAX_SOURCES:
            oldest = next(iter(self._last))
            del self._last[oldest]
            self.lost.pop(oldest, None)


class _Opened:
    """From a start to its stop: the socket, and who has confirmed its subscription."""

    def __init__(self, inbox: _Inbox) -> None:
        self._inbox = inbox
        self._process = os.getpid()
        self._socket: io.Socket | None = None
        self.guest = Guest()
        self.address = ""

    def open(self, address: str, bind: bool, options: Sequence[tuple[int, int | bytes]]) -> None:
        def open_socket(thread: io.IOThread) -> str:
            self._socket = thread.open(zmq.SUB, address, bind, self._read, options)
            return thread.address_of(self._socket, address)

        self.address = io.call(open_socket, start=True)

    def close(self, timeout_s: float) -> None:
        if self._socket is not None and not self.is_gone():
            try:
                io.close(self._socket, timeout_s)
            except TimeoutError as error:
                raise StillRunning(f"ZMQSubscriber {self.address}", ["put"], timeout_s) from error

    def close_soon(self) -> None:
        if self._socket is not None:
            io.close_soon(self._socket)

    def is_gone(self) -> bool:
        """Return whether this is a forked child, where there is neither thread nor socket."""
        return self._process != os.getpid()

    def _read(self) -> bool:
        socket = self._socket
        for _ in range(_BATCH):
            # The queue's put may have stopped this subscriber.
            if socket is None or socket.closed:
                return False
            try:
                frame = socket.recv(_DONTWAIT, copy=False)
            except zmq.Again:
                return False
            if frame.more:
                self._inbox.accept([frame, *_rest(socket)], self.guest)
            else:
                self._inbox.put(frame.bytes)
        return True


def _rest(socket: io.Socket) -> list[zmq.Frame]:
    frames = [socket.recv(_DONTWAIT, copy=False)]
    while frames[-1].more:
        frames.append(socket.recv(_DONTWAIT, copy=False))
    return frames


def _abandon(opened: _Opened, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if not opened.is_gone():
        opened.close_soon()
        warnings.warn(
            f"ZMQSubscriber {address} was left running. Call stop(), or use with.", ResourceWarning, stacklevel=2
        )
