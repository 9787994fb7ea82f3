"""How is a running service watched and controlled over HTTP?

uvicorn runs on a thread of its own beside the service's threads. It knows no signals, writes no log of requests, and
ends in bounded time.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import ServiceError
from epypes.service.http.address import BACKLOG, listening, names_of, url_of
from epypes.service.http.connections import Connections
from epypes.service.http.token import owned_token
from epypes.service.state_file import state_file

if TYPE_CHECKING:
    import socket

    import uvicorn

    from epypes.service.http.served import Served
    from epypes.service.service import Service

STOP_TIMEOUT_S: Final = 3.0
_START_TIMEOUT_S: Final = 30.0
# How long answers may take to get out when the server stops; uvicorn counts in whole seconds what comes after.
_TAKING_S: Final = 0.5
_GRACE_S: Final = 2
# asyncio accepts so many at once, before one of them is known and another can be dropped for it; and if there is no
# descriptor left it tries so often each second, with an error for each.
_ACCEPTED_AT_ONCE: Final = 8
_LOG_PAUSE_S: Final = 10.0

_log = logging.getLogger("epypes.service")


class HttpServer:
    """The control of one service over HTTP; use it in a ``with`` statement, or start and stop it.

    Parameters
    ----------
    service
        A ``Service``.
    address
        ``"127.0.0.1:8642"``, a port, or a URL; port 0 or ``*`` takes a free one.
    token_file
        Holds the token that changes need; it is made, readable by its owner alone, if it isn't there. Where services
        leave their state, if not given.
    insecure
        Whether an address that other machines can reach may be taken; HTTP has no encryption.
    """

    def __init__(
        self, service: Service, address: str, *, token_file: str | Path | None = None, insecure: bool = False
    ) -> None:
        self.address, self.insecure = address, insecure
        self.url = ""
        self._service = service
        info = service.info()
        of_its_own = state_file(info["bundle"], info.get("replica", "")).with_suffix(".token")
        self.token_file = Path(token_file) if token_file else of_its_own
        self._server: uvicorn.Server | None = None
        self._thread: threading.Thread | None = None
        self._started = threading.Event()
        self.connections = Connections()
        self._served: Served | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._listener: socket.socket | None = None
        self._logged_s = -_LOG_PAUSE_S
        self._error: BaseException | None = None

    @property
    def listeners(self) -> int:
        """How many are told of events."""
        return 0 if self._served is None else len(self._served.told)

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
        token = owned_token(self.token_file)
        listener = self._listener = listening(self.address, insecure=self.insecure)
        try:
            self._server = self._made(token, listener)
            self.url = url_of(listener)
            self._thread = threading.Thread(target=self._run, args=(listener,), name="epypes-http", daemon=True)
            self._thread.start()
            if not self._started.wait(_START_TIMEOUT_S) or self._error is not None:
                raise ServiceError(self.address, f"HTTP did not start: {self._error or 'no answer'}.")
        except BaseException:
            self.stop()
            listener.close()
            raise
        return self.url

    def _made(self, token: str, listener: socket.socket) -> uvicorn.Server:
        import uvicorn

        from epypes.service.http.app import app_of
        from epypes.service.http.guard import MOST_HEADER_BYTES, Guard
        from epypes.service.http.served import Served
        from epypes.service.http.told import Told

        self._served = Served(self._service, Told(self._service))
        hint = f"It is in {self.token_file}, which `epypes serve` has named."
        # A class is asked for, but only ever called.
        protocol: Any = self.connections.protocol
        config = uvicorn.Config(
            Guard(app_of(self._served), token, hint, names_of(listener)),
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
            date_header=False,
            h11_max_incomplete_event_size=MOST_HEADER_BYTES,
            timeout_graceful_shutdown=_GRACE_S,
            backlog=_ACCEPTED_AT_ONCE,
            callback_notify=self._on_started,
        )
        return uvicorn.Server(config)

    async def _on_started(self) -> None:
        if self._loop is None and self._listener is not None:
            # More may wait than asyncio accepts at once, which has made the one of the other.
            self._listener.listen(BACKLOG)
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(self._on_error)
        self._started.set()

    def _on_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log what fails in the event loop; that nothing can be accepted just now seldom, and in one line."""
        if not str(context.get("message")).startswith("socket.accept()"):
            loop.default_exception_handler(context)
        elif monotonic() - self._logged_s >= _LOG_PAUSE_S:
            self._logged_s = monotonic()
            _log.error("HTTP accepts no connection just now, and tries again: %s", context.get("exception"))

    def _run(self, listener: socket.socket) -> None:
        try:
            if self._server is not None:
                self._server.run(sockets=[listener])
        except BaseException as error:
            self._error = error
        finally:
            listener.close()
            self._started.set()

    def stop(self, timeout_s: float = STOP_TIMEOUT_S) -> None:
        """Answer what is being asked, drop all connections and end the thread; from any thread, also twice."""
        server, thread = self._server, self._thread
        if server is None or thread is None:
            return
        server.should_exit = True
        self._soon(self._end)
        thread.join(timeout_s)
        if thread.is_alive():
            server.force_exit = True
            self._soon(self.connections.abort)
            thread.join(timeout_s)

    def _soon(self, function: Callable[[], None]) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # it has ended
                self._loop.call_soon_threadsafe(function)

    def _end(self) -> None:
        """Let all who wait have an answer; those who don't take it lose their connection."""
        if self._served is not None:
            self._served.stop()
        self.connections.abort_idle()
        asyncio.get_running_loop().call_later(_TAKING_S, self.connections.abort)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
