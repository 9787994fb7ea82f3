"""The limit on how many peers may be connected to one bound socket.

Each connection takes a file descriptor of the process, and ZeroMQ accepts as many as there are: idle ones alone would
leave none for HTTP or for a new worker. ZeroMQ reports each connection to a monitor, which the I/O thread reads. One
too many is shut down, and ZeroMQ then closes it as if the peer had gone; peers that are connected stay. A ZeroMQ peer
that was refused tries again by itself, and a connection that never says anything ends after ``HANDSHAKE_MS``.
"""

from __future__ import annotations

import contextlib
import logging
import resource
import socket
from time import monotonic
from typing import Final

import zmq
from zmq.utils.monitor import parse_monitor_message

log = logging.getLogger("epypes.transport")

MOST_CONNECTIONS: Final = 1_024
HANDSHAKE_MS: Final = 10_000
# Of the descriptors that the process may have: a service has three bound sockets, and HTTP.
_SHARE: Final = 5
_LOG_PAUSE_S: Final = 10.0


def connection_limit(most: int, share: int) -> int:
    """Return how many connections there may be: ``most``, or a ``share``-th of the descriptors of this process."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return most if soft == resource.RLIM_INFINITY else min(most, max(soft // share, 1))


class ConnectionLimit:
    """Counts the connections of a bound socket, and shuts down those beyond the limit; all of it on the I/O thread.

    Parameters
    ----------
    bound
        The socket, before it is bound.

    Attributes
    ----------
    monitor
        Readable when there is something to `read`.
    """

    def __init__(self, bound: zmq.Socket[bytes]) -> None:
        self._most = connection_limit(MOST_CONNECTIONS, _SHARE)
        self._open: set[int] = set()
        self._refused, self._logged_s = 0, -_LOG_PAUSE_S
        address = f"inproc://connections-{int(bound.get(zmq.FD))}"
        bound.monitor(address, zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self.monitor: zmq.Socket[bytes] = bound.context.socket(zmq.PAIR)
        # ZeroMQ's own thread would wait for room.
        self.monitor.setsockopt(zmq.RCVHWM, 0)
        self.monitor.connect(address)

    def read(self) -> bool:
        """Read what ZeroMQ has reported, some of it at a time; return whether there may be more."""
        for _ in range(self._most):
            try:
                event = parse_monitor_message(self.monitor.recv_multipart(zmq.DONTWAIT))
            except zmq.Again:
                return False
            descriptor, address = int(event["value"]), event["endpoint"].decode(errors="replace")
            if event["event"] == zmq.EVENT_ACCEPTED:
                self._open.add(descriptor)
                if len(self._open) > self._most:
                    self._refuse(descriptor, address)
            elif event["event"] == zmq.EVENT_DISCONNECTED:
                self._open.discard(descriptor)
        return True

    def _refuse(self, descriptor: int, address: str) -> None:
        with contextlib.suppress(OSError):  # it has gone by itself
            connection = socket.socket(fileno=descriptor)
            try:
                # The number may be that of another file by now.
                if _is_at(connection, address):
                    connection.shutdown(socket.SHUT_RDWR)
            finally:
                connection.detach()
        self._refused += 1
        now_s = monotonic()
        if now_s - self._logged_s >= _LOG_PAUSE_S:
            self._logged_s = now_s
            log.warning(
                "connection limit reached at %s: %d peers are connected, and %d connections were refused",
                address,
                self._most,
                self._refused,
            )


def _is_at(connection: socket.socket, address: str) -> bool:
    """Return whether a connection was accepted at an address that is bound."""
    local = connection.getsockname()
    if connection.family == socket.AF_UNIX:
        return address == f"ipc://{local}"
    return address.rpartition(":")[2] == str(local[1])
