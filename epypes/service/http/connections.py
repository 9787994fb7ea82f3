"""How long may a caller keep a connection without using it?

Each connection is uvicorn's protocol with a clock beside it: a caller who begins a request and does not end it, or who
takes no more of an answer, loses the connection, so that slow callers can't keep others out.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from epypes.transport.zeromq.connection_guard import connection_limit

if TYPE_CHECKING:
    from uvicorn.protocols.http.h11_impl import H11Protocol

MOST_CONNECTIONS: Final = 160
# Of the descriptors that the process may have; bound sockets of ZeroMQ have another share.
_SHARE: Final = 8
REQUEST_TIMEOUT_S: Final = 10.0
TAKING_TIMEOUT_S: Final = 10.0


class Connection:
    """One connection: what asyncio calls of a protocol, handed on to uvicorn's."""

    def __init__(self, inner: H11Protocol, others: Connections) -> None:
        self._inner, self._others = inner, others
        self._loop = asyncio.get_running_loop()
        self._transport: Any = None
        self._asking: asyncio.TimerHandle | None = None
        self._taking: asyncio.TimerHandle | None = None
        self.working = False

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begin to wait for the first request."""
        self._transport = transport
        self._inner.connection_made(transport)
        self._others.add(self)
        self.ended()

    def data_received(self, data: bytes) -> None:
        """Hand on what came."""
        self._inner.data_received(data)

    def eof_received(self) -> None:
        """Hand on that no more will come."""
        self._inner.eof_received()

    def connection_lost(self, error: Exception | None) -> None:
        """Forget the connection."""
        self._others.remove(self)
        _cancel(self._asking)
        _cancel(self._taking)
        self._inner.connection_lost(error)

    def pause_writing(self) -> None:
        """Begin to wait until the caller takes what was written."""
        self._taking = self._loop.call_later(TAKING_TIMEOUT_S, self.abort)
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Go on: the caller has taken it."""
        _cancel(self._taking)
        self._inner.resume_writing()

    def began(self) -> None:
        """Stop waiting: a whole request is here."""
        self.working = True
        _cancel(self._asking)

    def ended(self) -> None:
        """Wait for the next request: the last one was answered."""
        self.working = False
        _cancel(self._asking)
        self._asking = self._loop.call_later(REQUEST_TIMEOUT_S, self.abort)

    def abort(self) -> None:
        """Drop the connection, whatever is still to be sent."""
        if self._transport is not None:
            self._transport.abort()


class Connections:
    """All connections of a server. When there are too many, the one that has been idle for longest is dropped."""

    def __init__(self, most: int = MOST_CONNECTIONS) -> None:
        self._most = connection_limit(most, _SHARE)
        self._open: dict[Connection, None] = {}

    def protocol(self, *, app_state: dict[str, Any], **given: Any) -> Connection:
        """Return what handles a new connection; requests find it as their state's ``connection``."""
        from uvicorn.protocols.http.h11_impl import H11Protocol

        own_state = dict(app_state)
        connection = own_state["connection"] = Connection(H11Protocol(app_state=own_state, **given), self)
        return connection

    def __len__(self) -> int:
        return len(self._open)

    def add(self, connection: Connection) -> None:
        """Know a connection, and make room for it."""
        if len(self._open) >= self._most:
            idle = next((each for each in self._open if not each.working), connection)
            self._open.pop(idle, None)
            idle.abort()
        self._open[connection] = None

    def remove(self, connection: Connection) -> None:
        """Forget a connection."""
        self._open.pop(connection, None)

    def abort_idle(self) -> None:
        """Drop all that wait for a request."""
        for connection in list(self._open):
            if not connection.working:
                connection.abort()

    def abort(self) -> None:
        """Drop all."""
        for connection in list(self._open):
            connection.abort()


def _cancel(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()
