"""uvicorn on a thread of its own beside the service's threads: binding, connections, start and stop.

uvicorn has no limit on how long a caller may take to send a request or to read an answer, and its limit on connections
refuses new callers instead of dropping idle ones. So each connection is uvicorn's protocol with timers beside it.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import re
import resource
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import AddressError, ServiceError
from epypes.service.state_file import state_file
from epypes.transport import is_loopback_host

if TYPE_CHECKING:
    import uvicorn
    from fastapi import FastAPI
    from uvicorn.protocols.http.h11_impl import H11Protocol

    from epypes.service import Service

_log = logging.getLogger("epypes.service")

_START_TIMEOUT_S: Final = 30.0
_STOP_TIMEOUT_S: Final = 3.0
# When the server stops, clients have this time to read their last responses; then uvicorn's own grace begins.
_LAST_RESPONSES_S: Final = 0.5
_GRACE_S: Final = 2
CALLER_TIMEOUT_S: Final = 10.0
MAX_CONNECTIONS: Final = 160
# The share of the process's file descriptors that HTTP may take.
_DESCRIPTOR_SHARE: Final = 8
_BACKLOG: Final = 128
# asyncio accepts this many connections at once before one of them is known and another can be dropped for it; where no
# descriptor is left, it tries this often each second, with an error for each.
_ACCEPTED_AT_ONCE: Final = 8
_LOG_PAUSE_S: Final = 10.0

_ADDRESS: Final = re.compile(
    r"(?:http://)?(?:(?P<host>\[[0-9a-fA-F:.]+\]|[\w.-]+|\*):)?(?P<port>\d{1,5}|\*)/?", re.ASCII
)
_MAX_PORT: Final = 65_535
# The kernel ends a connection whose peer acknowledges nothing for this long.
_UNACKNOWLEDGED_MS: Final = 20_000
_EXAMPLE: Final = "Write 127.0.0.1:8642, or 127.0.0.1:* for a free port."
_ANY_INTERFACE: Final = {"*": "0.0.0.0", "0.0.0.0": "0.0.0.0", "[::]": "::"}  # noqa: S104 - bound with insecure only


# -- the address ------------------------------------------------------------------------------------------------------


def _listen(address: str, insecure: bool) -> socket.socket:
    """Return a socket that listens at ``HOST:PORT``, ``PORT`` or a URL; port 0 or ``*`` takes a free one."""
    found = _ADDRESS.fullmatch(address) if isinstance(address, str) else None
    if found is None:
        raise AddressError(str(address), f"{address!r:.200} is no address for HTTP. {_EXAMPLE}")
    port = 0 if found["port"] == "*" else int(found["port"])
    if port > _MAX_PORT:
        raise AddressError(address, f"{address} has port {port}; ports go up to {_MAX_PORT}. {_EXAMPLE}")
    host = found["host"] or "127.0.0.1"
    # A name may have several addresses; localhost means the first of them.
    host = _ANY_INTERFACE.get(host, "127.0.0.1" if host == "localhost" else host.strip("[]"))
    if not insecure and not is_loopback_host(host):
        raise AddressError(
            address,
            f"{address} can be reached from other machines, and HTTP has no encryption. Bind 127.0.0.1 and reach it "
            "through SSH (ssh -L 8642:127.0.0.1:8642 HOST), or say --insecure.",
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sets TCP_NODELAY only where the protocol is named; without it each response waits 40 ms for its second
    # part.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if sys.platform == "linux":
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNACKNOWLEDGED_MS)
        listener.bind((host, port))
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        reasons = {
            errno.EADDRINUSE: f"port {port} is in use. Stop what uses it, or take 127.0.0.1:* for a free port.",
            errno.EACCES: f"port {port} is the system's. Take one above 1023.",
        }
        text = reasons.get(error.errno or 0, f"{error.strerror or error}. {_EXAMPLE}")
        raise AddressError(address, f"HTTP can't listen at {address}: {text}") from error
    return listener


def _url_and_hosts(listener: socket.socket) -> tuple[str, set[str]]:
    """Return the URL for callers on this machine, and the hosts that requests may name: any where others may call."""
    host, port = listener.getsockname()[:2]
    is_loopback = is_loopback_host(str(host))
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104 - named, not bound
    named = f"[{host}]" if ":" in host else str(host)
    return f"http://{named}:{port}", {"localhost", "127.0.0.1", "[::1]", named} if is_loopback else {"*"}


# -- connections ------------------------------------------------------------------------------------------------------


class TimedConnection(asyncio.Protocol):
    """One connection: uvicorn's protocol, and timers for requests that do not come and answers that are not read."""

    def __init__(self, inner: H11Protocol, pool: ConnectionPool) -> None:
        self._inner, self._pool = inner, pool
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self.is_working = False

    def connection_made(self, transport: Any) -> None:
        """Wait for the first request."""
        self._transport = transport
        self._inner.connection_made(transport)
        self._pool.add(self)
        self.request_ended()

    def data_received(self, data: bytes) -> None:
        """Pass on what came."""
        self._inner.data_received(data)

    def eof_received(self) -> None:
        """Pass on that no more will come."""
        self._inner.eof_received()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._pool.remove(self)
        for timer in self._timers.values():
            timer.cancel()
        self._inner.connection_lost(exc)

    def pause_writing(self) -> None:
        """Wait until the caller reads what was written."""
        self._restart("read")
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        """Go on: the caller has read it."""
        self._timers["read"].cancel()
        self._inner.resume_writing()

    def request_began(self) -> None:
        """Stop the timer: the head of a request is here."""
        self.is_working = True
        self._timers["request"].cancel()

    def request_ended(self) -> None:
        """Wait for the next request."""
        self.is_working = False
        self._restart("request")

    def abort(self) -> None:
        """Drop the connection, whatever is still to be sent."""
        if self._transport is not None:
            self._transport.abort()

    def _restart(self, name: str) -> None:
        if name in self._timers:
            self._timers[name].cancel()
        self._timers[name] = self._loop.call_later(self._pool.timeout_s, self.abort)


class ConnectionPool:
    """All connections of a server; of too many, the one that has been idle for longest is dropped."""

    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        is_limited = descriptors != resource.RLIM_INFINITY
        self._limit = min(MAX_CONNECTIONS, max(descriptors // _DESCRIPTOR_SHARE, 1)) if is_limited else MAX_CONNECTIONS
        self._open: dict[TimedConnection, None] = {}

    def __len__(self) -> int:
        return len(self._open)

    def new_protocol(self, *, app_state: dict[str, Any], **given: Any) -> TimedConnection:
        """Return the protocol for a new connection; requests find it as ``connection`` in their state."""
        from uvicorn.protocols.http.h11_impl import H11Protocol

        state = dict(app_state)
        connection = state["connection"] = TimedConnection(H11Protocol(app_state=state, **given), self)
        return connection

    def add(self, connection: TimedConnection) -> None:
        """Add a connection, and make room for it."""
        if len(self._open) >= self._limit:
            idle = next((each for each in self._open if not each.is_working), connection)
            self._open.pop(idle, None)
            idle.abort()
        self._open[connection] = None

    def remove(self, connection: TimedConnection) -> None:
        """Forget a connection."""
        self._open.pop(connection, None)

    def abort(self, *, only_idle: bool = False) -> None:
        """Drop all connections, or those that wait for a request."""
        for connection in list(self._open):
            if not (only_idle and connection.is_working):
                connection.abort()


# -- the server -------------------------------------------------------------------------------------------------------


class HttpServer:
    """The HTTP control of one service; use it in a ``with`` statement, or start and stop it.

    Parameters
    ----------
    service
        A ``Service``.
    address
        ``"127.0.0.1:8642"``, a port, or a URL; port 0 or ``*`` takes a free one.
    token_file
        Holds the token that changes need; it is made, readable by its owner alone, if it does not exist. Beside the
        service's state file, if not given.
    insecure
        Whether an address that other machines can reach may be taken; HTTP has no encryption.
    timeout_s
        How long a caller may take to send a request, and to read an answer, in seconds.
    """

    def __init__(
        self,
        service: Service,
        address: str,
        *,
        token_file: str | Path | None = None,
        insecure: bool = False,
        timeout_s: float = CALLER_TIMEOUT_S,
    ) -> None:
        self.address, self.insecure = address, insecure
        self.url = ""
        self._service = service
        if token_file is None:
            info = service.info()
            token_file = state_file(info["bundle"], info.get("replica", "")).with_suffix(".token")
        self.token_file = Path(token_file)
        self.connections = ConnectionPool(timeout_s)
        self._server: uvicorn.Server | None = None
        self._app: FastAPI | None = None
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._started = threading.Event()
        self._error: BaseException | None = None
        self._logged_s = -_LOG_PAUSE_S

    @property
    def listeners(self) -> int:
        """How many clients read the events."""
        return 0 if self._app is None else len(self._app.state.events)

    def start(self) -> str:
        """Listen; return the URL.

        Raises
        ------
        AddressError
            The address can't be taken, or is not on loopback and not ``insecure``.
        KeysError
            The token's file can't be used.
        ServiceError
            The server did not start.
        """
        from epypes.service.http.security import read_or_make_token

        token = read_or_make_token(self.token_file)
        listener = _listen(self.address, self.insecure)
        try:
            self.url, hosts = _url_and_hosts(listener)
            self._server = self._new_server(token, hosts, listener)
            self._thread = threading.Thread(target=self._run, args=(listener,), name="epypes-http", daemon=True)
            self._thread.start()
            if not self._started.wait(_START_TIMEOUT_S) or self._error is not None:
                raise ServiceError(self.address, f"HTTP did not start: {self._error or 'no answer'}.")
        except BaseException:
            self.stop()
            listener.close()
            raise
        return self.url

    def _new_server(self, token: str, hosts: set[str], listener: socket.socket) -> uvicorn.Server:
        import uvicorn

        from epypes.service.http.app import create_app
        from epypes.service.http.security import MAX_HEAD_BYTES, secured

        async def on_started() -> None:
            if self._loop is None:
                # asyncio has set the backlog to the number of connections that it accepts at once.
                listener.listen(_BACKLOG)
                self._loop = asyncio.get_running_loop()
                self._loop.set_exception_handler(self._on_loop_error)
            self._started.set()

        self._app = create_app(self._service)
        # uvicorn asks for a class, and only calls it.
        protocol: Any = self.connections.new_protocol
        config = uvicorn.Config(
            secured(self._app, token, self.token_file, hosts, self.connections.timeout_s),
            http=protocol,
            ws="none",
            loop="asyncio",
            lifespan="off",
            interface="asgi3",
            log_config=None,
            log_level="error",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            h11_max_incomplete_event_size=MAX_HEAD_BYTES,
            timeout_graceful_shutdown=_GRACE_S,
            backlog=_ACCEPTED_AT_ONCE,
            callback_notify=on_started,
        )
        return uvicorn.Server(config)

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an error of the event loop; one line in ten seconds where no connection can be accepted."""
        if not str(context.get("message")).startswith("socket.accept()"):
            loop.default_exception_handler(context)
        elif monotonic() - self._logged_s >= _LOG_PAUSE_S:
            self._logged_s = monotonic()
            _log.error("HTTP accepts no connection now, and tries again: %s", context.get("exception"))

    def _run(self, listener: socket.socket) -> None:
        try:
            if self._server is not None:
                self._server.run(sockets=[listener])
        except BaseException as error:
            self._error = error
        finally:
            listener.close()
            self._started.set()

    def stop(self, timeout_s: float = _STOP_TIMEOUT_S) -> None:
        """Answer the requests that are here, drop all connections and end the thread; from any thread, also twice."""
        server, thread = self._server, self._thread
        if server is None or thread is None:
            return
        server.should_exit = True
        self._call_soon(self._begin_stop)
        thread.join(timeout_s)
        if thread.is_alive():
            server.force_exit = True
            self._call_soon(self.connections.abort)
            thread.join(timeout_s)

    def _begin_stop(self) -> None:
        if self._app is not None:
            self._app.state.events.stop()
        self.connections.abort(only_idle=True)
        asyncio.get_running_loop().call_later(_LAST_RESPONSES_S, self.connections.abort)

    def _call_soon(self, function: Callable[[], None]) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # it has ended
                self._loop.call_soon_threadsafe(function)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
