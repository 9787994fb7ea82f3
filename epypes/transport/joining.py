"""When has a subscriber joined, so that it loses nothing from then on?

A subscription takes its time to reach the publisher, and what is published meanwhile is lost without a trace. So
our subscriber also subscribes to a private topic, and our publisher answers on exactly that topic. ZeroMQ sends
a peer's subscriptions in the order of their bytes; the private topic begins with bytes that no UTF-8 text has
and that sort last: when it is seen, all others have been.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import uuid
from collections import Counter

import zmq

from epypes.transport.guard import Watch
from epypes.transport.iothread import Socket

JOIN_PREFIX = b"\xff\xffepypes/join/"
# Of the publisher that answers: a UUID.
IDENTITY_BYTES = 16
# A peer that invents identities must not fill the memory.
_MAX_PUBLISHERS = 512
_SUBSCRIBE, _UNSUBSCRIBE = 1, 0
_BATCH = 100
_DONTWAIT = int(zmq.DONTWAIT)
# ZMQ_XPUB_MANUAL_LAST_VALUE: the next message goes only to the peer whose subscription was read last. It is a draft
# option, which the libzmq 4.3.5 of pyzmq's wheels takes all the same; where it is refused, the answer goes to all.
_ONLY_TO_LAST_PEER = 98

log = logging.getLogger("epypes.transport")


class Doorkeeper:
    """The publisher's side: takes subscriptions from its XPUB socket, and answers those that join.

    The socket is in manual mode, where every subscription of every peer is seen and is granted here, and the answer
    can be sent to the peer that asks and to nobody else: a peer of 2019 that subscribes to everything sees nothing
    of it. (Where libzmq refuses that option, it would.) Who calls `read` holds the socket's lock; the rest any thread
    may call.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._subscriptions: Counter[bytes] = Counter()
        self._identity = uuid.uuid4().bytes
        self._socket: Socket | None = None
        self._watch: Watch | None = None

    def attach(self, socket: Socket, watch: Watch | None) -> None:
        """Take the socket whose subscriptions `read` will read, and what bounds them, if it is bound."""
        self._socket, self._watch = socket, watch

    def read(self) -> bool:
        """Grant some of the subscriptions that have arrived; return whether there may be more."""
        socket = self._socket
        for _ in range(_BATCH):
            if socket is None or socket.closed:
                return False
            try:
                frame = socket.recv(_DONTWAIT, copy=False)
            except zmq.Again:
                return False
            message = frame.bytes
            if message[:1] in {b"\0", b"\1"}:
                change = 1 if message[0] == _SUBSCRIBE else -1
                if self._watch is None or self._watch.may_subscribe(frame, change):
                    self._grant(socket, message[0], message[1:])
        return True

    def wait(self, timeout_s: float) -> bool:
        """Return whether there is a subscriber, of any topic, within ``timeout_s`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._subscriptions), timeout_s)

    def _grant(self, socket: Socket, what: int, topic: bytes) -> None:
        option = zmq.SUBSCRIBE if what == _SUBSCRIBE else zmq.UNSUBSCRIBE
        # It is refused for a peer that has gone meanwhile, and then there is nothing to do.
        with contextlib.suppress(zmq.ZMQError):
            socket.setsockopt(option, topic)
        if not topic.startswith(JOIN_PREFIX):
            self._count(topic, 1 if what == _SUBSCRIBE else -1)
        elif what == _SUBSCRIBE:
            self._answer(socket, topic)

    def _count(self, topic: bytes, change: int) -> None:
        with self._changed:
            self._subscriptions[topic] += change
            if self._subscriptions[topic] <= 0:
                del self._subscriptions[topic]
            self._changed.notify_all()

    def _answer(self, socket: Socket, topic: bytes) -> None:
        try:
            with contextlib.suppress(zmq.ZMQError):
                socket.setsockopt(_ONLY_TO_LAST_PEER, 1)
            socket.send_multipart([topic, self._identity], zmq.DONTWAIT)
        except zmq.Again:
            # The peer's queue is full; it asks again.
            pass
        except zmq.ZMQError as error:
            log.warning("a join could not be answered: %s", error)
        finally:
            # Taking it back switches manual mode off as well; nothing is read between these two lines.
            with contextlib.suppress(zmq.ZMQError):
                socket.setsockopt(_ONLY_TO_LAST_PEER, 0)
            socket.setsockopt(zmq.XPUB_MANUAL, 1)


class Guest:
    """The subscriber's side: a private topic, and the publishers that have answered on it."""

    def __init__(self) -> None:
        self.topic = JOIN_PREFIX + uuid.uuid4().hex.encode()
        self._changed = threading.Condition()
        self._publishers: set[bytes] = set()

    @property
    def has_joined(self) -> bool:
        """Whether a publisher has answered."""
        return bool(self._publishers)

    def saw(self, topic: bytes, identity: bytes) -> bool:
        """Take note of a message that is an answer to a join; return whether it is one, of any subscriber's."""
        if topic == self.topic:
            with self._changed:
                if len(self._publishers) < _MAX_PUBLISHERS:
                    self._publishers.add(identity)
                self._changed.notify_all()
        return topic.startswith(JOIN_PREFIX)

    def wait(self, timeout_s: float, publishers: int) -> bool:
        """Return whether so many publishers have answered within ``timeout_s`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: len(self._publishers) >= publishers, timeout_s)
