"""How is a bundle served until somebody says stop?"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from epypes.errors import ServiceError
from epypes.service.options import Options
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
        The bundle is being served already, can't be served, or not any more and there is no HTTP to mend that by; or
        the service was stopped at once.
    BundleError, AddressError
        As for Service.
    """
    given = Options(sub, pub, insecure=insecure, **options)
    given.check(path)
    with Signals() as signals, _lock(path, given) as lock, ExitStack() as control:
        service = Service(path, sub, pub, insecure=insecure, **{**options, "replica": lock.replica})
        if http:
            _serve_http(service, http, token_file, insecure, control)
        fault: list[str] = []
        if signals.wait_during(service.start):
            fault = _announce(service, lock, None if http else signals.now, on_ready, on_fault)
            signals.wait()
        _stop(service, signals)
        if fault:
            raise ServiceError(service.path, fault[0])
        return service.counts()


def _lock(path: str | Path, options: Options) -> StateLock:
    """Return the right to serve a bundle: alone, or beside other replicas."""
    if options.has_broker and not options.replica:
        return StateLock.of_next(path)
    return StateLock(path, options.replica)


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
    give_up: Callable[[], None] | None,
    on_ready: Callable[[ServiceState], None],
    on_fault: Callable[[str], None],
) -> list[str]:
    """Let others find the service, and say that it is ready, once it is; or that it is not.

    Return a list that has the reason in it once there will be no worker any more and nobody could deploy another
    bundle; ``give_up`` is called then, so that whoever has started the service can act.
    """
    reason, fault = service.reason, list[str]()
    announced: list[ServiceState] = []
    if service.state == "FAULTED":
        if give_up is not None:
            service.stop(0.0)
            raise ServiceError(service.path, reason)
        on_fault(reason)

    def announce() -> None:
        lock.publish(service.service_state)
        if not announced:
            announced.append(service.service_state)
            on_ready(announced[0])

    def hear(kind: str, data: dict[str, Any]) -> None:
        if kind == "state" and data["state"] == "READY":
            announce()
        elif kind == "deployed":
            lock.publish(service.service_state)
        elif kind == "state" and data["state"] == "FAULTED" and service.has_given_up and give_up is not None:
            fault.append(data["reason"])
            give_up()

    service.listen(hear)
    if service.state != "FAULTED":
        announce()
        return fault
    lock.publish(service.service_state)
    if not reason:
        # It was before anybody listened.
        hear("state", {"state": "FAULTED", "reason": service.reason})
    return fault


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
