"""How does an item of the user's queue become a message? One bridge thread per publisher takes it there."""

from __future__ import annotations

import dataclasses
import logging
import os
import queue as queues
import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any, Protocol

import zmq

from epypes.errors import MessageError, StillRunning
from epypes.transport import io
from epypes.transport.joining import Doorkeeper
from epypes.wire import Envelope, Limits, encode, serialized

log = logging.getLogger("epypes.transport")

# How long the bridge sleeps in the user's queue before it looks at its stop flag: a stop takes this long at most,
# and an idle publisher wakes up 40 times a second.
_TICK_S = 0.025
# A subscription is short; whoever sends more to a publisher is no subscriber.
_MAX_SUBSCRIPTION_BYTES = 64 * 1024

Frames = Sequence[bytes | memoryview]


class TakeQueue(Protocol):
    """What a publisher takes from: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def get(self, *, timeout: float) -> Any:
        """Return the next item, or raise queue.Empty after ``timeout`` seconds."""


@dataclasses.dataclass(slots=True)
class Counts:
    """What a publisher has done since it was made; sent by the I/O thread, rejected by its bridge."""

    sent: int = 0
    rejected: Counter[str] = dataclasses.field(default_factory=Counter)


class Bridge:
    """From a start to its stop: the thread that takes from the queue, and the socket."""

    def __init__(self, queue: TakeQueue, topic: str, limits: Limits, counts: Counts) -> None:
        self._queue, self._topic, self._limits, self._counts = queue, topic, limits, counts
        self._sequences: Counter[str] = Counter()
        self._epoch = time.time_ns()
        self._process = os.getpid()
        self._deadline = 0.0
        # Not an Event: the garbage collector sets it, in any thread, where a lock could be held already.
        self.stopping = False
        self.doorkeeper = Doorkeeper()
        self.address = ""
        self._thread = threading.Thread(target=self._run, name="epypes-publisher", daemon=True)

    def start(self, address: str, bind: bool, high_water_mark: int) -> None:
        """Open the socket, then begin to take; raise AddressError if the address is refused."""
        options = [
            (zmq.XPUB_MANUAL, 1),
            (zmq.SNDHWM, high_water_mark),
            (zmq.MAXMSGSIZE, _MAX_SUBSCRIPTION_BYTES),
        ]

        def open_socket(thread: io.IOThread) -> tuple[io.Socket, str]:
            opened = thread.open(zmq.XPUB, address, bind, self.doorkeeper.read, options)
            self.doorkeeper.attach(opened)
            return opened, thread.address_of(opened, address)

        self._socket, self.address = io.call(open_socket, start=True)
        self._thread.start()

    def is_alive(self) -> bool:
        """Return whether the thread runs; in a forked child it does not."""
        return self._process == os.getpid() and self._thread.is_alive()

    def finish_if_stopping(self) -> bool:
        """Return whether this bridge is over, after waiting for it if it is about to be."""
        if self.is_alive() and not self.stopping:
            return False
        self.stop(5.0)
        return True

    def stop(self, timeout_s: float) -> None:
        """Let the thread send what is queued, and wait until it has ended; raise StillRunning if it does not."""
        # In a forked child there is neither thread nor socket.
        if self._process != os.getpid():
            return
        self._deadline = time.monotonic() + timeout_s
        self.stopping = True
        if self._thread is threading.current_thread() or io.on_io_thread():
            # Called by the user's queue, in get() or in put(): the thread ends by itself once that returns, and
            # needs the I/O thread for it.
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            io.close(self._socket, timeout_s)
            raise StillRunning(f"ZMQPublisher {self.address}", ["get"], timeout_s)

    def _run(self) -> None:
        try:
            while not self.stopping:
                self._take(_TICK_S)
            self._drain()
        finally:
            io.close(self._socket)

    def _drain(self) -> None:
        # As many as there were: a producer that goes on must not keep it from stopping.
        size = getattr(self._queue, "qsize", None)
        left = size() if callable(size) else None
        while left != 0 and time.monotonic() < self._deadline and self._take(0.0):
            left = None if left is None else left - 1

    def _take(self, timeout_s: float) -> bool:
        try:
            item = self._queue.get(timeout=timeout_s)
        except queues.Empty:
            return False
        except Exception as error:
            # A queue that is shut down or broken raises at once, each time: without the pause this would spin.
            self._reject("queue failed", f"the queue raised {error!r}", log_once=True)
            time.sleep(_TICK_S)
            return False
        self._publish(item)
        return True

    def _publish(self, item: object) -> None:
        try:
            frames = self._frames(item)
            io.call(lambda _: self._send(frames))
        except MessageError as error:
            self._reject(error.reason, str(error))
        except (zmq.ZMQError, TimeoutError) as error:
            self._reject("not sent", f"a message could not be sent: {error}")
        except Exception as error:
            # The item's own code, called to make bytes of it, may raise anything.
            self._reject(type(error).__name__, f"a {type(item).__name__} could not be sent: {error!r}")

    def _send(self, frames: Frames) -> None:
        # Counted before: whoever has received it must find it counted.
        self._counts.sent += 1
        try:
            _send(self._socket, frames)
        except zmq.ZMQError:
            self._counts.sent -= 1
            raise

    def _frames(self, item: object) -> Frames:
        if isinstance(item, Envelope):
            return self._envelope_frames(item)
        if isinstance(item, bytes | bytearray | memoryview):
            data = bytes(item)
        elif callable(getattr(item, "SerializeToString", None)):
            data = serialized(item)  # type: ignore[arg-type]  # google is imported in wire alone
        else:
            raise MessageError(
                "no codec",
                f"A publisher sends bytes, protobuf messages and Envelopes, not {type(item).__name__}. "
                "Let f_out return one of these.",
            )
        if len(data) > self._limits.total_bytes:
            raise MessageError(
                "too large", f"A message of {len(data):,} bytes; the limit is {self._limits.total_bytes:,}."
            )
        return [data]

    def _envelope_frames(self, envelope: Envelope) -> Frames:
        number = self._sequences[envelope.source] + 1
        stamped = dataclasses.replace(envelope, epoch=self._epoch, sequence=number, published_ns=time.time_ns())
        frames = encode(stamped, self._topic, limits=self._limits)
        # Counted when it can be sent: a rejected item is no loss on the way.
        self._sequences[envelope.source] = number
        return frames

    def _reject(self, reason: str, text: str, log_once: bool = False) -> None:
        self._counts.rejected[reason] += 1
        if not log_once or self._counts.rejected[reason] == 1:
            log.warning("%s rejected an item (%s): %s", self.address, reason, text)


def _send(socket: io.Socket, frames: Frames) -> None:
    last = len(frames) - 1
    for index, frame in enumerate(frames):
        flags = zmq.DONTWAIT if index == last else zmq.DONTWAIT | zmq.SNDMORE
        # bytes can't change until they are sent; the memory of an array can.
        socket.send(frame, flags, copy=not isinstance(frame, bytes))
