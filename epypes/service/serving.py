"""How is a bundle served until somebody says stop?"""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType
from typing import Any, Final, Self

from epypes.errors import ServiceError
from epypes.service.server import Service
from epypes.service.state import ServiceState, StateLock

_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT)
# No signal has this number.
_DONE: Final = 0


def serve(
    path: str | Path,
    sub: str,
    pub: str,
    *,
    http: str = "",
    token_file: str | Path | None = None,
    insecure: bool = False,
    on_ready: Callable[[ServiceState], None] = lambda state: None,
    on_fault: Callable[[str], None] = lambda reason: None,
    **options: Any,
) -> dict[str, int]:
    """Serve a bundle until SIGTERM or SIGINT; return the counts of events. A second signal stops at once.

    Parameters
    ----------
    http
        Where it is controlled over HTTP, as ``127.0.0.1:8642``; nowhere without.
    token_file
        Where the token for that is; one is made without.
    on_ready
        Called when events are answered.
    on_fault
        Called if the bundle can't be served, and stays reachable over HTTP: another one may be deployed.
    options
        As for Service.

    Raises
    ------
    ServiceError
        The bundle is being served already, can't be served, or was stopped at once.
    BundleError, AddressError
        As for Service.
    """
    with _Signals() as signals, StateLock(path) as lock, ExitStack() as control:
        service = Service(path, sub, pub, insecure=insecure, **options)
        if http:
            _serve_http(service, http, token_file, insecure, control)
        if signals.wait_during(service.start):
            _announce(service, lock, bool(http), on_ready, on_fault)
            signals.wait()
        _stop(service, signals)
        return service.counts()


class _Signals:
    """While its block runs, SIGTERM and SIGINT end `wait` instead of the process.

    A signal may be given to any thread, and then the main thread, which waits, would not hear of it. So each writes its
    number into a socket, which the main thread reads from.
    """

    def __enter__(self) -> Self:
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._woken_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, _hear) for number in _SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._woken_before)
        self._reader.close()
        self._writer.close()

    def wait(self) -> bool:
        """Wait for a signal, or for `wait_during`'s work to be done; return whether it was a signal."""
        while (number := self._reader.recv(1)[0]) not in (*_SIGNALS, _DONE):
            continue
        return number != _DONE

    def wait_during(self, work: Callable[[], Any]) -> bool:
        """Do something on a thread of its own; return whether it was done before a signal came.

        What it raises is raised.
        """
        errors: list[BaseException] = []

        def run() -> None:
            try:
                work()
            except BaseException as error:
                errors.append(error)
            # Closed, if nobody waits any more.
            with suppress(OSError):
                self._writer.send(bytes([_DONE]))

        threading.Thread(target=run, name="epypes serve", daemon=True).start()
        is_signal = self.wait()
        if errors:
            raise errors[0]
        return not is_signal


def _hear(number: int, frame: FrameType | None) -> None:
    """Do nothing: the signal's number has been written."""


def _serve_http(
    service: Service, address: str, token_file: str | Path | None, insecure: bool, control: ExitStack
) -> None:
    from epypes.service.http import HttpServer

    server = HttpServer(service, address, token_file=token_file, insecure=insecure)
    service.http, service.token_file = server.start(), str(server.token_file)
    control.callback(server.stop)


def _announce(
    service: Service,
    lock: StateLock,
    can_be_mended: bool,
    on_ready: Callable[[ServiceState], None],
    on_fault: Callable[[str], None],
) -> None:
    """Let others find the service, and say that it is ready; or that it is not."""
    reason = service.reason
    if service.state == "FAULTED":
        if not can_be_mended:
            service.stop(0.0)
            raise ServiceError(service.path, reason)
        on_fault(reason)

    def republish(kind: str, data: dict[str, Any]) -> None:
        if kind == "state" and data["state"] == "READY":
            lock.publish(service.service_state)

    service.listen(republish)
    lock.publish(service.service_state)
    if service.state != "FAULTED":
        on_ready(service.service_state)


def _stop(service: Service, signals: _Signals) -> None:
    """Stop a service; at once, if another signal comes.

    Raises
    ------
    ServiceError
        One came.
    """
    if not signals.wait_during(service.stop):
        count = service.abandon()
        raise ServiceError(service.path, f"Stopped at once by a second signal; {count} events were not finished.")
