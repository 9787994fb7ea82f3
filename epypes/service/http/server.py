"""uvicorn on a thread of its own beside the service's threads: binding, start and stop.

Connections are uvicorn's own, but for one bound, since idle ones would use up the descriptors that a new worker needs:
beyond `MAX_CONNECTIONS` the oldest idle connection is closed. The kernel ends the connection of a caller that has
vanished. An address that other machines reach belongs behind a proxy that cuts off slow callers.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import re
import socket
import sys
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import AddressError, ServiceError
from epypes.service.state_file import state_file
from epypes.transport import is_loopback_host
from epypes.transport.throttle import Throttle

if TYPE_CHECKING:
    import uvicorn
    from fastapi import FastAPI

    from epypes.service import Service

_throttle: Final = Throttle(logging.getLogger("epypes.service"))

_START_TIMEOUT_S: Final = 30.0
_STOP_TIMEOUT_S: Final = 3.0
# Before that, uvicorn cancels the requests that are still worked on.
_GRACE_S: Final = 2
MAX_CONNECTIONS: Final = 64
# asyncio accepts as many at a time, before the first of them is counted.
_BACKLOG: Final = 16

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
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
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


# -- the server -------------------------------------------------------------------------------------------------------


def _bounded_protocol() -> type[asyncio.Protocol]:
    """Return uvicorn's HTTP protocol with a bounded number of connections."""
    # Imported here: it takes 0.1 s, and addresses are checked without a server.
    from uvicorn.protocols.http.h11_impl import H11Protocol

    # In the order of opening.
    opened: dict[H11Protocol, None] = {}

    class BoundedProtocol(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            opened[self] = None
            if len(opened) > MAX_CONNECTIONS:
                # Without a whole request, as this one, or with none that is being answered.
                oldest = next(
                    one for one in opened if one.cycle is None or one.cycle.more_body or one.cycle.response_complete
                )
                del opened[oldest]
                oldest.transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            opened.pop(self, None)
            super().connection_lost(exc)

    return BoundedProtocol


def _report_briefly(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Write one line where asyncio has a traceback for each caller that it can't accept."""
    error = context.get("exception")
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        _throttle.warning("accept", f"HTTP can't accept a connection: {error.strerror}")
    else:
        loop.default_exception_handler(context)


class HttpServer:
    """The HTTP control of one service; use it in a ``with`` statement, or start and stop it.

    Parameters
    ----------
    service
        A ``Service``.
    address
        ``"127.0.0.1:8642"``, a port, or a URL; port 0 or ``*`` takes a free one.
    access_key_file
        Holds the access key that changes need; it is made, readable by its owner alone, if it does not exist. Without
        it, beside the service's state file.
    insecure
        Whether an address that other machines can reach may be taken; HTTP has no encryption.
    """

    def __init__(
        self,
        service: Service,
        address: str,
        *,
        access_key_file: str | Path | None = None,
        insecure: bool = False,
    ) -> None:
        self.address, self.insecure = address, insecure
        self.url = ""
        self._service = service
        if access_key_file is None:
            info = service.info()
            access_key_file = state_file(info["bundle"], info.get("replica", "")).with_suffix(".access_key")
        self.access_key_file = Path(access_key_file)
        self._server: uvicorn.Server | None = None
        self._app: FastAPI | None = None
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._started = threading.Event()
        self._error: BaseException | None = None

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
            The access key's file can't be used.
        ServiceError
            The server did not start.
        """
        from epypes.service.http.security import read_or_make_access_key

        access_key = read_or_make_access_key(self.access_key_file)
        self._error = None
        self._started.clear()
        listener = _listen(self.address, self.insecure)
        try:
            self.url, hosts = _url_and_hosts(listener)
            self._server = self._new_server(access_key, hosts)
            self._thread = threading.Thread(target=self._run, args=(listener,), name="epypes-http", daemon=True)
            self._thread.start()
            if not self._started.wait(_START_TIMEOUT_S) or self._error is not None:
                raise ServiceError(self.address, f"HTTP did not start: {self._error or 'no answer'}.")
        except BaseException:
            self.stop()
            listener.close()
            raise
        return self.url

    def _new_server(self, access_key: str, hosts: set[str]) -> uvicorn.Server:
        import uvicorn
        from starlette.concurrency import run_in_threadpool

        from epypes.service.http.app import create_app
        from epypes.service.http.security import secured

        @asynccontextmanager
        async def lifespan(app: FastAPI) -> AsyncIterator[None]:
            self._loop = asyncio.get_running_loop()
            self._loop.set_exception_handler(_report_briefly)
            # What the first request would import is loaded now: it may come when no file descriptor is free.
            await run_in_threadpool(lambda: None)
            self._started.set()
            yield

        self._app = create_app(self._service, lifespan)
        config = uvicorn.Config(
            secured(self._app, access_key, self.access_key_file, hosts),
            http=_bounded_protocol(),
            ws="none",
            loop="asyncio",
            lifespan="on",
            interface="asgi3",
            log_config=None,
            log_level="error",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            timeout_graceful_shutdown=_GRACE_S,
            backlog=_BACKLOG,
        )
        return uvicorn.Server(config)

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
        server, thread, loop, app = self._server, self._thread, self._loop, self._app
        if server is None or thread is None:
            return
        server.should_exit = True
        if loop is not None and app is not None:
            with suppress(RuntimeError):  # it has ended
                loop.call_soon_threadsafe(app.state.events.stop)
        thread.join(timeout_s)
        if thread.is_alive():
            server.force_exit = True
            thread.join(timeout_s)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
