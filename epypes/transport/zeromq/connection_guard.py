"""Bounds the connections to bound sockets, and what one of them may cost; drops the peer that exceeds that.

Each connection takes a file descriptor of the process, and ZeroMQ accepts as many as there are: idle ones alone would
leave none for HTTP or for a new worker. One too many is shut down; peers that are connected stay. A ZeroMQ peer
that was refused tries again by itself, and a connection that never says anything ends after ``HANDSHAKE_MS``.

ZeroMQ bounds the size of one frame (ZMQ_MAXMSGSIZE) and the number of whole messages (the high-water mark), but neither
the parts of a message whose last part never comes, nor the subscriptions of a peer: libzmq 4.3.5 keeps about 86 bytes
for each byte of a subscription, and stores them in a loop inside one call, which a fast peer keeps going. So a thread
of its own, which needs no socket's lock, asks the kernel how many bytes each connection has received, and shuts down
the connection that has received too many. libzmq then frees what it kept for it.

A UNIX socket (ipc://) has no such counter: its file permissions say which processes may connect. The number of its
connections is bounded all the same.
"""

from __future__ import annotations

import contextlib
import logging
import resource
import socket as sockets
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import zmq
from zmq.backend import zmq_poll
from zmq.utils.monitor import parse_monitor_message

from epypes.transport.throttle import Throttle

MOST_CONNECTIONS: Final = 1_024
HANDSHAKE_MS: Final = 10_000
# Of the descriptors that the process may have: a service has three bound sockets, and HTTP.
_SHARE: Final = 5
# A topic has 1,024 bytes at most; a peer that sends larger frames to a publisher is no subscriber.
_MAX_SUBSCRIPTION_FRAME_BYTES: Final = 2_048
# For sockets that receive subscriptions only. What waits in libzmq and in the kernel of a peer that is dropped is still
# taken in, 0.3 ms for 1 kB.
SUBSCRIPTION_OPTIONS: Final = (
    (int(zmq.MAXMSGSIZE), _MAX_SUBSCRIPTION_FRAME_BYTES),
    (int(zmq.RCVHWM), 100),
    (int(zmq.RCVBUF), 16 * 1024),
)
# A subscriber needs one subscription for its topic and one to join; an honest one with hundreds of topics has room.
MAX_SUBSCRIPTIONS: Final = 1_024
MAX_SUBSCRIPTION_BYTES: Final = 64 * 1024
# Heartbeats and joins of honest subscribers take some 300 bytes a second.
_BURST_BYTES: Final = 2 * MAX_SUBSCRIPTION_BYTES
_BYTES_PER_S: Final = 64 * 1024
# What the kernel may hold of the messages behind the one that is being received, and the heads of its frames.
_SLACK_BYTES: Final = 64 * 1024**2
# How often `ConnectionGuard.check` is called.
CHECK_S: Final = 0.1
_EVENTS: Final = int(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
_SRCFD, _HAS, _POLLIN = int(zmq.SRCFD), int(zmq.EVENTS), int(zmq.POLLIN)
# In Linux' struct tcp_info: tcpi_bytes_received, 8 bytes.
_RECEIVED_AT: Final = 128

log = logging.getLogger("epypes.transport")


def has_arrived(opened: zmq.Socket[bytes]) -> bool:
    """Return whether a socket can be read.

    To be asked after other calls on the socket: they may have used up the signal by which its file descriptor wakes
    the I/O thread.
    """
    # Not socket.get(EVENTS), which holds the interpreter's lock while libzmq takes in subscriptions: for 19 s if a peer
    # sends 20,000 of 1 kB.
    return bool(zmq_poll([(opened, _POLLIN)], 0))


def connection_limit(most: int, share: int) -> int:
    """Return how many connections there may be: ``most``, or a ``share``-th of the descriptors of this process."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return most if soft == resource.RLIM_INFINITY else min(most, max(soft // share, 1))


@dataclass(slots=True, eq=False)
class _Peer:
    """One accepted connection.

    Attributes
    ----------
    fd
        Its file descriptor, which belongs to libzmq.
    received, read
        Bytes that it had received, and messages that the socket had given, when it was last seen to be within bounds.
    credit
        Bytes that it may send at once, where only subscriptions come.
    subscriptions, subscription_bytes
        How many it holds, and their bytes.
    is_known
        Whether something that came is known to be from it.
    """

    fd: int
    received: int = 0
    read: int = 0
    credit: float = float(_BURST_BYTES)
    subscriptions: int = 0
    subscription_bytes: int = 0
    is_known: bool = False
    is_dropped: bool = False


class ConnectionGuard:
    """The connections of one bound socket.

    Parameters
    ----------
    socket
        The socket, before it is bound; called on the I/O thread.
    max_message_bytes
        Of one message with all its parts; 0 for a socket that receives subscriptions only.
    submit
        Has a function called on the I/O thread.

    Attributes
    ----------
    descriptor
        Readable when there is something for `update`.
    endpoint
        Where the socket is bound.
    """

    def __init__(
        self, socket: zmq.Socket[bytes], max_message_bytes: int, submit: Callable[[Callable[[object], None]], object]
    ) -> None:
        address = f"inproc://connections-{int(socket.get(zmq.FD))}"
        socket.monitor(address, _EVENTS)
        self._socket = socket
        self._monitor: zmq.Socket[bytes] = socket.context.socket(zmq.PAIR)
        # ZeroMQ's own thread would wait for room.
        self._monitor.setsockopt(zmq.RCVHWM, 0)
        self._monitor.connect(address)
        self.descriptor = int(self._monitor.get(zmq.FD))
        self._most = connection_limit(MOST_CONNECTIONS, _SHARE)
        self._max_message_bytes, self._submit = max_message_bytes, submit
        # Held by every thread that touches the monitor or the peers.
        self._lock = threading.Lock()
        self._peers: dict[int, _Peer] = {}
        # Descriptors that messages came from since the last `check`, and how many messages were read.
        self._senders: set[int] = set()
        self._read = 0
        self._is_closed = False
        self._log = Throttle(log)
        self.endpoint = ""

    def close(self) -> None:
        """Watch no more; on the I/O thread, while the socket is open."""
        with self._lock:
            self._is_closed = True
            # First: ZeroMQ's own thread would wait for ever to report a connection that comes or goes meanwhile.
            self._socket.disable_monitor()
            self._monitor.close(linger=0)
            self._peers.clear()

    def update(self) -> bool:
        """Take note of connections that came and went, and refuse those beyond the limit.

        Always returns False: nothing is left to read.
        """
        with self._lock:
            self._update()
        return False

    def message_read(self, frame: zmq.Frame) -> None:
        """Take note that a whole message was read, of which this is a frame; on the I/O thread."""
        try:
            fd = int(frame.get(_SRCFD))
            with self._lock:
                self._senders.add(fd)
        except zmq.ZMQError:
            self._drop_old()
        self._read += 1

    def allows_subscription(self, frame: zmq.Frame, change: int) -> bool:
        """Count a subscription (``change`` 1) or its end (-1); return whether the peer is within its bounds.

        A peer that is not is dropped.
        """
        try:
            fd = int(frame.get(_SRCFD))
        except zmq.ZMQError:
            # The end of a subscription of a peer that is gone has no descriptor either.
            if change > 0:
                self._drop_old()
            return change < 0
        with self._lock:
            # A connection is reported before anything that it sends.
            self._update()
            peer = self._peers.get(fd)
            if peer is None:
                # It has gone meanwhile.
                return False
            peer.is_known = True
            peer.subscriptions += change
            peer.subscription_bytes += change * len(frame)
            if peer.subscriptions <= MAX_SUBSCRIPTIONS and peer.subscription_bytes <= MAX_SUBSCRIPTION_BYTES:
                return True
            self._drop(peer, "it holds too many subscriptions")
            return False

    def check(self, passed_s: float) -> None:
        """Drop the peers that exceed their bounds; ``passed_s`` seconds after the last check."""
        with self._lock:
            if self._is_closed:
                return
            self._update()
            senders, self._senders = self._senders, set()
            for peer in [*self._peers.values()]:
                peer.is_known |= peer.fd in senders
                received = None if peer.is_dropped else _received_bytes(peer.fd)
                if received is None:
                    continue
                if self._max_message_bytes:
                    self._check_message(peer, received, peer.fd in senders)
                else:
                    self._check_rate(peer, received, passed_s)

    def _check_rate(self, peer: _Peer, received: int, passed_s: float) -> None:
        credit = peer.credit + passed_s * _BYTES_PER_S - (received - peer.received)
        peer.credit, peer.received = min(credit, _BURST_BYTES), received
        if credit < 0:
            self._drop(peer, "it sends subscriptions too fast")

    def _check_message(self, peer: _Peer, received: int, has_sent: bool) -> None:
        if has_sent:
            peer.received, peer.read = received, self._read
        elif received - peer.received > self._max_message_bytes + _SLACK_BYTES:
            since = peer.received
            self._submit(lambda _: self._judge(peer, since))

    def _judge(self, peer: _Peer, since: int) -> None:
        """Drop a peer that has sent more than a message since ``since`` bytes, if there was no whole message in it.

        On the I/O thread. ZeroMQ reads from connections in turns. So one that had a whole message has been read if
        nothing is left to be read, or if more messages were read meanwhile than there are connections. A later check
        may have found that before this one is answered.
        """
        with self._lock:
            if self._is_closed:
                return
            had_its_turn = self._read - peer.read > len(self._peers) or not has_arrived(self._socket)
            if had_its_turn and peer.received == since and peer.fd not in self._senders:
                self._drop(peer, "it sends a message without an end")

    def _drop_old(self) -> None:
        """Drop every peer that is not known as a sender: one of them sent a message that names no connection.

        libzmq names the connection of messages over ZMTP 3.0 (libzmq 4.0 of 2013) and later.
        """
        with self._lock:
            self._update()
            for peer in self._peers.values():
                if not peer.is_known and peer.fd not in self._senders:
                    self._drop(peer, "it speaks a ZeroMQ protocol older than ZMTP 3.0")

    def _update(self) -> None:
        """See `update`; the lock is held."""
        while not self._is_closed and int(self._monitor.get(_HAS)) & _POLLIN:
            event = parse_monitor_message(self._monitor.recv_multipart())
            fd = int(event["value"])
            self._peers.pop(fd, None)
            self._senders.discard(fd)
            if event["event"] == zmq.EVENT_ACCEPTED:
                # The event may come late, when messages of the connection were read already.
                self._peers[fd] = peer = _Peer(fd, received=_received_bytes(fd) or 0, read=self._read)
                if len(self._peers) > self._most:
                    self._drop(peer, f"connection limit reached: {self._most} peers are connected")

    def _drop(self, peer: _Peer, why: str) -> None:
        if peer.is_dropped:
            return
        peer.is_dropped = True
        text = f"{self.endpoint} dropped a peer: {why}. With keys= and allow= only known peers can connect."
        self._log.warning(why, text)
        with contextlib.suppress(OSError):  # it has gone by itself
            borrowed = sockets.socket(fileno=peer.fd)
            try:
                # The number may be that of another file by now.
                if _is_at(borrowed, self.endpoint):
                    # libzmq's close then resets the connection, which a peer that waits to send more notices.
                    borrowed.setsockopt(sockets.SOL_SOCKET, sockets.SO_LINGER, struct.pack("ii", 1, 0))
                    borrowed.shutdown(sockets.SHUT_RDWR)
            finally:
                borrowed.detach()


def _received_bytes(fd: int) -> int | None:
    """Return how many bytes a TCP connection has received; None if it is gone."""
    try:
        borrowed = sockets.socket(sockets.AF_INET, sockets.SOCK_STREAM, fileno=fd)
    except OSError:
        return None
    try:
        info = borrowed.getsockopt(sockets.IPPROTO_TCP, sockets.TCP_INFO, _RECEIVED_AT + 8)
        return int(struct.unpack_from("<Q", info, _RECEIVED_AT)[0])
    except (OSError, struct.error):
        return None
    finally:
        borrowed.detach()


def _is_at(connected: sockets.socket, endpoint: str) -> bool:
    """Return whether a connection was accepted where a socket is bound."""
    local: Any = connected.getsockname()
    if connected.family == sockets.AF_UNIX:
        return endpoint == f"ipc://{local}"
    return endpoint.rpartition(":")[2] == str(local[1])
