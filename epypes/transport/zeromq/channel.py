"""Channels over ZeroMQ: an XPUB socket that sends on the caller's thread, or a SUB socket that the I/O thread reads.

ZeroMQ keeps nothing and confirms nothing: a message goes to all subscribers that are connected just then, and is
dropped for one that does not keep up. It carries frames alone, so ids and headers don't go along.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Mapping
from typing import Final

import zmq

from epypes.errors import BrokerError, StillRunning
from epypes.transport.address import Address
from epypes.transport.channel import ERROR, ERROR_REASON, NO_HEADERS, ChannelOptions, Confirmed, Delivery, Frames
from epypes.transport.throttle import Throttle
from epypes.transport.zeromq import io_thread
from epypes.transport.zeromq.connection_guard import SUBSCRIPTION_OPTIONS, has_arrived
from epypes.transport.zeromq.curve import CurveOptions
from epypes.transport.zeromq.handshake import IDENTITY_BYTES, Publishers, Subscriptions
from epypes.transport.zeromq.io_thread import IOThread, OwnedSocket
from epypes.wire import Limits
from epypes.wire.arrays import is_immutable
from epypes.wire.limits import LEADING_FRAMES

log = logging.getLogger("epypes.transport")

# Below this a copy takes less time than to keep account of a buffer that is lent.
_LENT_FROM_BYTES: Final = 64 * 1024
# Frames that are read at once; of a longer message the rest is read at the next turn, so that other sockets get theirs.
_BATCH: Final = 256
# Beside the payloads an envelope has a topic and a header.
_MOST_FRAMES: Final = Limits().frames + LEADING_FRAMES
# A header that is no protobuf.
_NO_HEADER: Final = b"\xff"
_DONTWAIT, _MORE = int(zmq.DONTWAIT), int(zmq.DONTWAIT | zmq.SNDMORE)


class ZeroMQChannel:
    """One ZeroMQ address, opened for sending or for receiving; see `epypes.transport.channel.Channel`.

    Parameters
    ----------
    address
        Of ZeroMQ.
    security
        Whether it is bound, and its keys; without, a socket that sends is bound, and has none.
    subscription
        The first bytes of the messages that are wanted.
    max_message_bytes
        A peer that sends a larger frame is disconnected; a larger message of several frames is refused.
    high_water_mark
        Messages that ZeroMQ keeps for a subscriber, or until the I/O thread has read them.
    heartbeat_s
        After so many seconds of silence publishers are asked whether they live.
    on_stale
        Called on the I/O thread with whether the input is stale, when that changes.

    Attributes
    ----------
    slow_subscribers
        How often the queue of a subscriber was full.
    subscriptions, publishers
        The peers, by the role of the socket.
    """

    keeps_messages: Final = False
    trouble: Final = ""
    reconnects: Final = 0
    waiting: Final = 0

    def __init__(
        self,
        address: str,
        security: CurveOptions | None = None,
        *,
        subscription: bytes = b"",
        max_message_bytes: int = Limits().total_bytes,
        high_water_mark: int = 1_000,
        heartbeat_s: float = 1.0,
        on_stale: Callable[[bool], object] = lambda is_stale: None,
    ) -> None:
        self.address, self._security, self._subscription = address, security, subscription
        self._max_message_bytes, self._high_water_mark = max_message_bytes, high_water_mark
        self._heartbeat_s = heartbeat_s
        self.prefetch = 0
        self.slow_subscribers = 0
        self.subscriptions, self.publishers = Subscriptions(), Publishers(heartbeat_s, on_stale)
        self._log = Throttle(log)
        self._process = os.getpid()
        # Held by the thread that touches the socket, if it sends.
        self._lock = threading.Lock()
        self._owned: OwnedSocket | None = None
        self._is_read_soon = self._is_paused = False
        # Of the message that is being read: its frames so far, their bytes, and why it is refused.
        self._frames: list[memoryview] = []
        self._bytes = 0
        self._refusal = ""
        self._on_delivery: Callable[[Delivery], object] | None = None

    @property
    def is_connected(self) -> bool:
        """Whether the socket is open; whether a peer is there, `publishers` and `subscriptions` know."""
        owned = self._owned
        return owned is not None and not owned.socket.closed and self._process == os.getpid()

    def open(self, on_delivery: Callable[[Delivery], object] | None) -> None:
        """Open the socket; see `Channel.open`."""
        self._on_delivery = on_delivery
        security = self._security or CurveOptions.checked(self.address, bind=on_delivery is None)

        def open_socket(thread: IOThread) -> OwnedSocket:
            options: list[tuple[int, int | bytes]]
            if on_delivery is None:
                options = [
                    (zmq.XPUB_MANUAL, 1),
                    (zmq.SNDHWM, self._high_water_mark),
                    # Not in order to wait for a slow subscriber, but in order to notice it; see `send`.
                    (zmq.XPUB_NODROP, 1),
                    *SUBSCRIPTION_OPTIONS,
                ]
                self._owned = thread.open(
                    zmq.XPUB,
                    self.address,
                    security,
                    self._read_subscriptions,
                    options,
                    prepare=self.subscriptions.add_full_subscriber,
                    lock=self._lock,
                )
            else:
                options = [
                    (zmq.RCVHWM, self._high_water_mark),
                    (zmq.MAXMSGSIZE, self._max_message_bytes),
                    # A subscriber has nothing to send but its subscriptions.
                    (zmq.LINGER, 0),
                    (zmq.SUBSCRIBE, self._subscription),
                    (zmq.SUBSCRIBE, self.publishers.topic),
                ]
                self._owned = thread.open(
                    zmq.SUB,
                    self.address,
                    security,
                    self._read_message,
                    options,
                    max_message_bytes=self._max_message_bytes,
                    tick=self._check_heartbeat,
                    tick_s=self._heartbeat_s,
                )
            return self._owned

        self.address = io_thread.call(open_socket, start=True).endpoint

    def send(
        self,
        frames: Frames,
        *,
        id: str = "",  # noqa: A002 - that is its name in every protocol
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Hand a message to ZeroMQ, on this thread; see `Channel.send`.

        It is dropped for a subscriber whose queue is full.
        """
        if not self.send_if_room(frames):
            self.slow_subscribers += 1
            text = f"{self.address}: a subscriber is too slow and loses messages, which it counts itself (lost)"
            self._log.warning("slow subscriber", text)
            # ZeroMQ then leaves that subscriber out, without notice, until half of its queue is empty.
            self.send_if_room(frames, must_drop=True)
        if confirmed is not None:
            confirmed(None)

    def send_if_room(self, frames: Frames, *, must_drop: bool = False) -> bool:
        """Hand a message to ZeroMQ, unless the queue of a subscriber is full; return whether it was sent.

        With ``must_drop`` it is dropped for such a subscriber, and sent.
        """
        owned = self._owned
        # A thread of the parent may hold the lock of a forked child.
        if owned is None or self._process != os.getpid():
            raise self._closed_error()
        socket = owned.socket
        with self._lock:
            # The I/O thread closes it under the lock.
            if socket.closed:
                raise self._closed_error()
            # Few calls from here to the socket: after an image has filled the caches each takes 3 to 5 us.
            try:
                if must_drop:
                    socket.setsockopt(zmq.XPUB_NODROP, 0)
                for frame in frames[:-1]:
                    socket.send(frame, _MORE, copy=len(frame) < _LENT_FROM_BYTES or not _can_be_lent(frame))
                last = frames[-1]
                socket.send(last, _DONTWAIT, copy=len(last) < _LENT_FROM_BYTES or not _can_be_lent(last))
            except zmq.Again:
                # Nothing has left yet.
                return False
            except BaseException as error:
                # Of a signal's handler, too, as Ctrl+C: how many frames have left is unknown. These two end a message
                # that was begun, or make one whose header is no protobuf, so that the receiver rejects it and not the
                # next one. An empty header would be an envelope without parts.
                if len(frames) > 1:
                    with contextlib.suppress(zmq.ZMQError):
                        socket.send(frames[0], _MORE)
                        socket.send(_NO_HEADER, _DONTWAIT)
                if isinstance(error, zmq.ZMQError):
                    text = f"A message to {self.address} was not sent: {error}."
                    raise BrokerError(self.address, text) from error
                raise
            finally:
                if must_drop:
                    socket.setsockopt(zmq.XPUB_NODROP, 1)
            # The I/O thread reads subscriptions: a signal must not interrupt the answer to a join.
            if not self._is_read_soon and has_arrived(socket):
                self._is_read_soon = True
                io_thread.soon(lambda thread: thread.read_again(owned))
            return True

    def _closed_error(self) -> BrokerError:
        return BrokerError(self.address, f"A message to {self.address} was not sent: the socket is closed.")

    def pause(self) -> None:
        """Drop what arrives from now on; a subscriber counts it as `lost`."""
        self._is_paused = True

    def resume(self) -> None:
        """Take messages again."""
        self._is_paused = False

    def close(self, timeout_s: float = 5.0) -> None:
        """Close the socket; what was sent still leaves. See `Channel.close`."""
        if self._owned is not None and self._process == os.getpid():
            try:
                io_thread.close(self._owned, timeout_s)
            except TimeoutError as error:
                raise StillRunning(f"The socket {self.address}", ["put"], timeout_s) from error

    def abandon(self) -> None:
        """Have the socket closed, without waiting and without a lock; see `Channel.abandon`."""
        owned = self._owned
        if owned is not None and self._process == os.getpid():
            io_thread.soon(lambda thread: thread.close(owned))

    def _read_subscriptions(self) -> bool:
        owned = self._owned
        with self._lock:
            self._is_read_soon = False
            if owned is None or owned.socket.closed:
                return False
            return self.subscriptions.read(owned.socket, owned.guard)

    def _check_heartbeat(self) -> None:
        if self._owned is not None:
            self.publishers.check(self._owned.socket)

    def _read_message(self) -> bool:
        """Read one message, or a part of a long one; return whether the rest is to be read later."""
        owned, on_delivery = self._owned, self._on_delivery
        if owned is None or on_delivery is None or owned.socket.closed:
            return False
        recv, frames = owned.socket.recv, self._frames
        try:
            for _ in range(_BATCH):
                frame = recv(_DONTWAIT, copy=False)
                if not self._refusal:
                    frames.append(frame.buffer)
                    self._bytes += len(frame)
                    if self._bytes > self._max_message_bytes or len(frames) > _MOST_FRAMES:
                        self._refusal = "too many frames" if len(frames) > _MOST_FRAMES else "too large"
                        frames.clear()
                if not frame.more:
                    break
            else:
                return True
        except zmq.Again:
            return False
        if owned.guard is not None:
            owned.guard.message_read(frame)
        refusal, self._frames, self._bytes, self._refusal = self._refusal, [], 0, ""
        if refusal:
            headers = {ERROR: "The message is larger than the limits.", ERROR_REASON: refusal}
            on_delivery(Delivery((), headers=headers))
        # A message that is no answer to a join for its size is one of a user.
        elif len(frames) == 2 and len(frames[1]) == IDENTITY_BYTES and self.publishers.answered(*map(bytes, frames)):
            pass
        elif not self._is_paused:
            on_delivery(Delivery(frames))
        # After it, since the thread that waits for the message is woken up by now. The poller finds out whether there
        # are more: to ask here would keep the interpreter's lock from that thread.
        self.publishers.heard()
        return False


def prepare_lending() -> None:
    """Start the thread by which pyzmq learns that ZeroMQ has read memory that was lent to it.

    It starts with the first large frame otherwise, and if it can't ZeroMQ ends the process.
    """
    zmq.Frame(bytes(_LENT_FROM_BYTES), copy=False)


def _can_be_lent(frame: bytes | memoryview) -> bool:
    """Return whether ZeroMQ may read a large frame later, since it can't be changed meanwhile."""
    return isinstance(frame, bytes) or is_immutable(frame)


def make_channel(address: Address, options: ChannelOptions) -> ZeroMQChannel:
    """Return a channel of an address without keys; the side that sends binds, unless the address says otherwise."""
    endpoint, binds = address.endpoint, address.binds
    security = None if binds is None else CurveOptions.checked(endpoint, binds)
    return ZeroMQChannel(endpoint, security, max_message_bytes=options.max_message_bytes)
