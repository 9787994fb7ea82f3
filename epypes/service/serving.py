"""How is a bundle served until somebody says stop?"""

from __future__ import annotations

import queue
import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any, Final

from epypes.errors import ServiceError
from epypes.service.server import Service
from epypes.service.state import ServiceState, StateLock

_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT)


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
    signals: queue.SimpleQueue[str] = queue.SimpleQueue()

    def on_signal(number: int, frame: FrameType | None) -> None:
        # No Event, whose lock the main thread may hold when a signal arrives in it.
        signals.put("signal")

    before = {number: signal.signal(number, on_signal) for number in _SIGNALS}
    try:
        with StateLock(path) as lock, ExitStack() as control:
            service = Service(path, sub, pub, insecure=insecure, **options)
            if http:
                _serve_http(service, http, token_file, insecure, control)
            begin = _Aside(service.start, signals)
            if not begin.wait():
                _stop(service, signals)
                return service.counts()
            _announce(service, lock, bool(http), on_ready, on_fault)
            signals.get()
            _stop(service, signals)
            return service.counts()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Aside:
    """Something that takes its time, on a thread of its own, so that the main thread hears of signals."""

    def __init__(self, work: Callable[[], Any], signals: queue.SimpleQueue[str]) -> None:
        self._work, self._signals = work, signals
        self._error: BaseException | None = None

    def wait(self) -> bool:
        """Do it; return whether it was done before a signal came. What it raises is raised."""
        threading.Thread(target=self._run, name="epypes serve", daemon=True).start()
        is_done = self._signals.get() == "done"
        if self._error is not None:
            raise self._error
        return is_done

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            self._error = error
        self._signals.put("done")


def _serve_http(
    service: Service, address: str, token_file: str | Path | None, insecure: bool, control: ExitStack
) -> None:
    from epypes.service.http import HttpServer

    server = HttpServer(service, address, token_file=token_file, insecure=insecure)
    service.http = server.start()
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


def _stop(service: Service, signals: queue.SimpleQueue[str]) -> None:
    """Stop a service; at once, if another signal comes.

    Raises
    ------
    ServiceError
        One came.
    """
    if not _Aside(service.stop, signals).wait():
        count = service.abandon()
        raise ServiceError(service.path, f"Stopped at once by a second signal; {count} events were not finished.")
