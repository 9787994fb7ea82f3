"""How does what is published come into a queue? Through a subscriber, read by the I/O thread."""

from __future__ import annotations

import logging
import os
import threading
import warnings
import weakref
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import zmq

from epypes.errors import StillRunning
from epypes.transport import io
from epypes.transport.gathering import Gatherer
from epypes.transport.guard import Watch
from epypes.transport.heartbeat import Pulse
from epypes.transport.inbox import Inbox, PutQueue, Source
from epypes.transport.joining import Guest
from epypes.transport.keys import Keys, PublicKey
from epypes.transport.security import Security, security
from epypes.transport.within import Within
from epypes.wire import Limits, topic_frame

log = logging.getLogger("epypes.transport")

HIGH_WATER_MARK = 1_000
# Two small messages in this time cost no CPU to speak of.
HEARTBEAT_S = 1.0


class ZMQSubscriber(Within):
    """Puts what arrives on a ZeroMQ SUB socket into a queue.

    Parameters
    ----------
    address
        Where the publisher is: ``"tcp://127.0.0.1:5555"``.
    queue
        Any object with ``put(item, block=False)``. A message of one frame is put as bytes (2019 mode), one of more
        frames as an Envelope, whose arrays are read-only. It is called on the I/O thread, and must be quick; behind a
        message with more than 32 kB in its header, on the thread that decodes such messages.
    topic
        Topic of the envelopes: ``"cam1"`` gets ``cam1`` and ``cam1/left``, not ``cam10``; ``""`` gets everything.
        Messages of 2019 have no topic: with one given, only those come whose own bytes begin with it and a slash.
    bind
        True to bind, for publishers that connect.
    insecure
        True to bind an address that other machines can reach, without keys.
    keys
        Its own pair of CURVE keys, from `make_keys` or `read_keys`, or the path of its .key_secret file.
    allow
        With keys: the public keys of the peers that may connect, as text, .key files or a folder of these; where it
        connects itself, the one of the peer that is bound there.
    max_message_bytes
        A peer that sends a larger frame is disconnected; a larger message of several frames is counted in `rejected`.
        ZeroMQ keeps such a message in memory until its last frame has come. Where a TCP port is bound, a peer that has
        sent 64 MB more than this without ending its message is disconnected.
    high_water_mark
        Messages kept by ZeroMQ until the I/O thread has read them.
    undecoded
        True to put every message as the tuple of its frames, read-only memoryviews of what came.
    heartbeat_s
        After so many seconds of silence publishers of EPypes 1.0 are asked whether they live; after three times as
        many without an answer the input is stale.

    Attributes
    ----------
    on_stale
        None, or called with True when the input becomes stale and with False when something is heard again. It is
        called on the I/O thread, and must be quick.

    Raises
    ------
    AddressError
        If ``bind`` is asked for an address that is not loopback, with neither keys nor ``insecure``.
    KeysError
        If keys can't be read, or it is not said which are allowed.
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
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
        max_message_bytes: int = Limits().total_bytes,
        high_water_mark: int = HIGH_WATER_MARK,
        undecoded: bool = False,
        heartbeat_s: float = HEARTBEAT_S,
    ) -> None:
        self._security = security(address, bind, insecure, keys, allow)
        self._given = address
        self._subscription = topic_frame(topic) if topic else b""
        self._limits = Limits(total_bytes=max_message_bytes)
        self._high_water_mark = high_water_mark
        self._inbox = Inbox(queue, self._limits, undecoded)
        self._heartbeat_s = heartbeat_s
        self.on_stale: Callable[[bool], None] | None = None
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

    @property
    def refused(self) -> Counter[str]:
        """How often peers were refused because their key is not allowed, by public key; a copy."""
        return Counter(self._security.refused)

    @property
    def is_stale(self) -> bool:
        """Whether a publisher that had joined is silent: it does not even answer. One that is idle does."""
        opened = self._opened
        return opened is not None and opened.pulse.is_stale

    @property
    def last_heard_s(self) -> float | None:
        """How many seconds ago anything came from a publisher; None before that, and when it is stopped."""
        opened = self._opened
        return None if opened is None else opened.pulse.last_heard_s

    def start(self) -> Self:
        """Open the socket and begin to receive; nothing happens if it runs already.

        Raises
        ------
        AddressError
            If the address can't be bound, or can't be understood.
        """
        with self._lock:
            if self._opened is None or self._opened.is_gone():
                pulse = Pulse(self._heartbeat_s, _reporter(self))
                self._opened = opened = _Opened(self._inbox, pulse, self._limits)
                try:
                    opened.open(self._given, self._security, self._options(opened.guest), self._heartbeat_s)
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

    def __repr__(self) -> str:
        state = "stopped" if self._opened is None else "running"
        return f"<ZMQSubscriber {self.address[:40]} {state}: {self.received} received>"


class _Opened:
    """From a start to its stop: the socket, and who has confirmed its subscription."""

    def __init__(self, inbox: Inbox, pulse: Pulse, limits: Limits) -> None:
        self._inbox, self.pulse = inbox, pulse
        self._gatherer, self._limits = Gatherer(limits), limits
        self._watch: Watch | None = None
        self._process = os.getpid()
        self._socket: io.Socket | None = None
        self.guest = Guest()
        self.address = ""

    def open(
        self, address: str, security: Security, options: Sequence[tuple[int, int | bytes]], heartbeat_s: float
    ) -> None:
        self._inbox.begin()
        gate = security.gate()
        more = security.options(gate)

        def open_socket(thread: io.IOThread) -> str:
            self._socket = opened = thread.open(
                zmq.SUB,
                address,
                security.bind,
                self._read,
                [*options, *more],
                gate=gate,
                max_message_bytes=self._limits.total_bytes,
            )
            self._watch = thread.watch_of(opened)
            thread.every(heartbeat_s, opened, self._look)
            return thread.address_of(self._socket, address)

        self.address = io.call(open_socket, start=True)

    def close(self, timeout_s: float) -> None:
        if self._socket is not None and not self.is_gone():
            try:
                io.close(self._socket, timeout_s)
            except TimeoutError as error:
                raise StillRunning(f"ZMQSubscriber {self.address}", ["put"], timeout_s) from error
            if not self._inbox.end(timeout_s):
                raise StillRunning(f"ZMQSubscriber {self.address}", ["put"], timeout_s)

    def close_soon(self) -> None:
        if self._socket is not None:
            io.close_soon(self._socket)

    def is_gone(self) -> bool:
        """Return whether this is a forked child, where there is neither thread nor socket."""
        return self._process != os.getpid()

    def _look(self) -> None:
        if self.pulse.look(self.guest.has_joined) and self._socket is not None:
            self._socket.setsockopt(zmq.UNSUBSCRIBE, self.guest.topic)
            self._socket.setsockopt(zmq.SUBSCRIBE, self.guest.topic)

    def _read(self) -> bool:
        socket = self._socket
        if socket is None or socket.closed:
            return False
        try:
            frames = self._gatherer.read(socket, self._watch)
        except zmq.Again:
            return False
        if frames is None:
            return True
        if frames:
            self._inbox.accept(frames, self.guest)
        else:
            self._inbox.reject(self._gatherer.refused(), "it is larger than the limits")
        # After it, since the thread that waits for the message is woken up by now. Whether there are more the poller
        # finds out: to ask here would keep the interpreter's lock from that thread.
        self.pulse.heard()
        return False


def _reporter(subscriber: ZMQSubscriber) -> Callable[[bool], None]:
    """Return what calls a subscriber's on_stale, and does not keep the subscriber alive."""
    known = weakref.ref(subscriber)

    def report(is_stale: bool) -> None:
        found = known()
        if found is not None and found.on_stale is not None:
            found.on_stale(is_stale)

    return report


def _abandon(opened: _Opened, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if not opened.is_gone():
        opened.close_soon()
        warnings.warn(
            f"ZMQSubscriber {address} was left running. Call stop(), or use with.", ResourceWarning, stacklevel=2
        )
