"""How is a bundle served until somebody says stop?"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from epypes.errors import ServiceError
from epypes.service.server import Service
from epypes.service.signals import Signals
from epypes.service.state import ServiceState, StateLock


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
    with Signals() as signals, StateLock(path) as lock, ExitStack() as control:
        service = Service(path, sub, pub, insecure=insecure, **options)
        if http:
            _serve_http(service, http, token_file, insecure, control)
        if signals.wait_during(service.start):
            _announce(service, lock, bool(http), on_ready, on_fault)
            signals.wait()
        _stop(service, signals)
        return service.counts()


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


def _stop(service: Service, signals: Signals) -> None:
    """Stop a service; at once, if another signal comes.

    Raises
    ------
    ServiceError
        One came.
    """
    if not signals.wait_during(service.stop):
        count = service.abandon()
        raise ServiceError(service.path, f"Stopped at once by a second signal; {count} events were not finished.")
