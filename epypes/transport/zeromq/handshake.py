"""The handshake of a subscriber and a publisher on a private topic: joining without loss, and heartbeats.

A subscription takes its time to reach the publisher, and what is published meanwhile is lost without a trace. So a
subscriber also subscribes to a private topic, and the publisher answers on exactly that topic. ZeroMQ sends a peer's
subscriptions in the order of their bytes; the private topic begins with bytes that no UTF-8 text has and that sort
last: when it has arrived, all others have.

The heartbeat is the same handshake: a subscriber that has heard nothing for a while takes its private subscription
back and gives it again, which the publisher answers. Peers of 2019 see nothing of either.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import uuid
from collections import Counter
from collections.abc import Callable
from time import monotonic
from typing import Final

import zmq

from epypes.transport.zeromq.connection_guard import ConnectionGuard

Socket = zmq.Socket[bytes]

_JOIN_PREFIX: Final = b"\xff\xffepypes/join/"
# Of the publisher that answers: a UUID.
IDENTITY_BYTES: Final = 16
# A peer that invents identities must not fill the memory.
_MAX_PUBLISHERS: Final = 512
_SUBSCRIBE: Final = 1
_BATCH: Final = 100
_DONTWAIT: Final = int(zmq.DONTWAIT)
# ZMQ_XPUB_MANUAL_LAST_VALUE: the next message goes only to the peer whose subscription was read last, or to all if that
# peer has gone. It is a draft option, which the libzmq 4.3.5 of pyzmq's wheels takes all the same; where it is refused,
# the answer goes to all.
_ONLY_TO_LAST_PEER: Final = 98
# In heartbeats. Silence is checked once in each, so that it is reported within three.
_ASKED_AFTER, _STALE_AFTER = 0.5, 2.0
# If the next check comes so late, this process itself was held up, and its silence proves nothing.
_LATE_AFTER: Final = 1.5

log = logging.getLogger("epypes.transport")


class Subscriptions:
    """The publisher's side: grants the subscriptions of an XPUB socket, and answers the subscribers that join.

    The socket is in manual mode, where every subscription of every peer is seen and is granted here, and the answer
    can be sent to the peer that asks and to no other: a peer of 2019 that subscribes to everything sees nothing of it.
    If the peer that asks has gone, libzmq would send the answer to all. So a subscriber within this process, which
    reads nothing and whose queue is full, is subscribed to all private topics: libzmq then sends to none of them.

    The thread that calls `read` holds the socket's lock; any thread may call the rest.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        # By topic: a peer may take back what it has never had, or was refused.
        self._counts: Counter[bytes] = Counter()
        self._identity = uuid.uuid4().bytes

    def add_full_subscriber(self, socket: Socket) -> Socket | None:
        """Connect the subscriber whose queue is full to a socket that is not bound yet; return it, to be closed later.

        None if libzmq can't send an answer to one peer alone.
        """
        try:
            socket.setsockopt(_ONLY_TO_LAST_PEER, 0)
        except zmq.ZMQError:
            return None
        finally:
            socket.setsockopt(zmq.XPUB_MANUAL, 1)
        full: Socket = socket.context.socket(zmq.SUB)
        full.setsockopt(zmq.RCVHWM, 1)
        full.setsockopt(zmq.SUBSCRIBE, _JOIN_PREFIX)
        high_water_mark = int(socket.getsockopt(zmq.SNDHWM))
        # Both ends of such a connection count for its queue: it has room for two messages.
        socket.setsockopt(zmq.SNDHWM, 1)
        address = f"inproc://epypes-join-{uuid.uuid4().hex}"
        socket.bind(address)
        socket.setsockopt(zmq.SNDHWM, high_water_mark)
        full.connect(address)
        # Its subscription.
        socket.recv()
        socket.setsockopt(zmq.SUBSCRIBE, _JOIN_PREFIX)
        with contextlib.suppress(zmq.Again):
            while True:
                socket.send(_JOIN_PREFIX, zmq.DONTWAIT)
        return full

    def read(self, socket: Socket, guard: ConnectionGuard | None) -> bool:
        """Grant some of the subscriptions that have arrived; return whether there may be more."""
        for _ in range(_BATCH):
            try:
                frame = socket.recv(_DONTWAIT, copy=False)
            except zmq.Again:
                return False
            message = frame.bytes
            if message[:1] in {b"\0", b"\1"}:
                change = 1 if message[0] == _SUBSCRIBE else -1
                if guard is None or guard.allows_subscription(frame, change):
                    self._grant(socket, change, message[1:])
        return True

    def wait(self, timeout_s: float) -> bool:
        """Return whether there is a subscriber, of any topic, within ``timeout_s`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._counts), timeout_s)

    def _grant(self, socket: Socket, change: int, topic: bytes) -> None:
        # libzmq ignores it for a peer that has gone meanwhile.
        with contextlib.suppress(zmq.ZMQError):
            socket.setsockopt(zmq.SUBSCRIBE if change > 0 else zmq.UNSUBSCRIBE, topic)
        if topic.startswith(_JOIN_PREFIX):
            if change > 0:
                self._answer(socket, topic)
            return
        with self._changed:
            self._counts[topic] += change
            if self._counts[topic] <= 0:
                del self._counts[topic]
            self._changed.notify_all()

    def _answer(self, socket: Socket, topic: bytes) -> None:
        try:
            with contextlib.suppress(zmq.ZMQError):
                socket.setsockopt(_ONLY_TO_LAST_PEER, 1)
            socket.send_multipart([topic, self._identity], zmq.DONTWAIT)
        except zmq.Again:
            # The peer has gone, or its queue is full; then it asks again.
            pass
        except zmq.ZMQError as error:
            log.warning("a join could not be answered: %s", error)
        finally:
            # Taking it back switches manual mode off as well; nothing is read between these two lines.
            with contextlib.suppress(zmq.ZMQError):
                socket.setsockopt(_ONLY_TO_LAST_PEER, 0)
            socket.setsockopt(zmq.XPUB_MANUAL, 1)


class Publishers:
    """The subscriber's side: the publishers that have answered on its private topic, and whether they still live.

    Parameters
    ----------
    heartbeat_s
        Time between two calls of `check`, in seconds.
    report
        Called with True when the input has become stale, and with False when something is heard again; on the I/O
        thread.

    Attributes
    ----------
    topic
        The private topic.
    """

    def __init__(self, heartbeat_s: float, report: Callable[[bool], object]) -> None:
        self.topic = _JOIN_PREFIX + uuid.uuid4().hex.encode()
        self._heartbeat_s, self._report = heartbeat_s, report
        self._changed = threading.Condition()
        self._identities: set[bytes] = set()
        self._checked_s = monotonic()
        self._heard_s = 0.0
        self.is_stale = False

    @property
    def last_heard_s(self) -> float | None:
        """How many seconds ago something was heard; None if nothing was yet."""
        return monotonic() - self._heard_s if self._heard_s else None

    def heard(self) -> None:
        """Take note that something has been heard."""
        self._heard_s = monotonic()
        if self.is_stale:
            self._change(False)

    def answered(self, topic: bytes, identity: bytes) -> bool:
        """Take note of a message if it answers a join; return whether it does, of any subscriber's."""
        if topic == self.topic:
            with self._changed:
                if len(self._identities) < _MAX_PUBLISHERS:
                    self._identities.add(identity)
                self._changed.notify_all()
        return topic.startswith(_JOIN_PREFIX)

    def wait(self, timeout_s: float, publishers: int) -> bool:
        """Return whether so many publishers have answered within ``timeout_s`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: len(self._identities) >= publishers, timeout_s)

    def check(self, socket: Socket) -> None:
        """Once per heartbeat: see whether the input is stale, and ask again after silence."""
        now_s = monotonic()
        was_late = now_s - self._checked_s > _LATE_AFTER * self._heartbeat_s
        self._checked_s = now_s
        silent_s = now_s - self._heard_s
        # Silence of publishers that never answered means nothing.
        if self._identities and not self.is_stale and not was_late and silent_s >= _STALE_AFTER * self._heartbeat_s:
            self._change(True)
        if silent_s > _ASKED_AFTER * self._heartbeat_s:
            socket.setsockopt(zmq.UNSUBSCRIBE, self.topic)
            socket.setsockopt(zmq.SUBSCRIBE, self.topic)

    def _change(self, is_stale: bool) -> None:
        self.is_stale = is_stale
        try:
            self._report(is_stale)
        except BaseException:
            # It is the user's; the other sockets go on.
            log.exception("on_stale itself failed")
