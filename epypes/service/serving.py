"""Serving a bundle until SIGTERM or SIGINT, and waiting for these signals."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import ServiceError
from epypes.service.state_file import ServiceState, StateLock

if TYPE_CHECKING:
    from epypes.service.options import Options
    from epypes.service.service import Service

_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT)
# No signal has this number.
_DONE: Final = 0


def serve(
    path: str | Path,
    sub: str,
    pub: str,
    *,
    http: str = "",
    access_key_file: str | Path | None = None,
    insecure: bool = False,
    on_ready: Callable[[ServiceState], None] = lambda state: None,
    on_fault: Callable[[str], None] = lambda reason: None,
    **options: Any,
) -> dict[str, int]:
    """Serve a bundle until SIGTERM or SIGINT; return the counts of events. A second signal stops at once.

    Parameters
    ----------
    http
        Address of the HTTP control, as ``127.0.0.1:8642``; none without.
    access_key_file
        The file of the access key for that; one is made without.
    on_ready
        Called when events are answered.
    on_fault
        Called if the bundle can't be served, and stays reachable over HTTP: another one may be deployed.
    options
        As for Service.

    Raises
    ------
    ServiceError
        The bundle is being served already, or can't be served and there is no HTTP to deploy another one; or the
        service was stopped at once.
    BundleError, AddressError
        As for Service.
    """
    # `epypes record` and `play` wait for signals too, and serve nothing.
    from epypes.service.options import Options
    from epypes.service.service import Service

    given = Options(sub, pub, insecure=insecure, **options)
    given.check(path)
    with SignalWait() as signals, _lock(path, given) as lock, ExitStack() as control:
        service = Service(path, sub, pub, insecure=insecure, **{**options, "replica": lock.replica})
        if http:
            _serve_http(service, http, access_key_file, insecure, control)
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
    service: Service, address: str, access_key_file: str | Path | None, insecure: bool, control: ExitStack
) -> None:
    from epypes.service.http import HttpServer

    server = HttpServer(service, address, access_key_file=access_key_file, insecure=insecure)
    service.http, service.access_key_file = server.start(), str(server.access_key_file)
    control.callback(server.stop)


def _announce(
    service: Service,
    lock: StateLock,
    give_up: Callable[[], None] | None,
    on_ready: Callable[[ServiceState], None],
    on_fault: Callable[[str], None],
) -> list[str]:
    """Publish the state file, and call ``on_ready`` once the service is ready, or ``on_fault`` if it can't be.

    Return a list that gets the reason once there will be no worker any more and without HTTP no other bundle can be
    deployed; ``give_up`` is called then, so that the process ends.
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

    def on_event(kind: str, data: dict[str, Any]) -> None:
        if kind == "state" and data["state"] == "READY":
            announce()
        elif kind == "deployed":
            lock.publish(service.service_state)
        elif kind == "state" and data["state"] == "FAULTED" and service.has_given_up and give_up is not None:
            fault.append(data["reason"])
            give_up()

    service.listen(on_event)
    if service.state != "FAULTED":
        announce()
        return fault
    lock.publish(service.service_state)
    if not reason:
        # The state changed before `listen`.
        on_event("state", {"state": "FAULTED", "reason": service.reason})
    return fault


def _stop(service: Service, signals: SignalWait) -> None:
    """Stop a service; at once, if another signal comes.

    Raises
    ------
    ServiceError
        One came.
    """
    if not signals.wait_during(service.stop):
        count = service.abandon()
        raise ServiceError(service.path, f"Stopped at once by a second signal; {count} events were not finished.")


class SignalWait:
    """While its block runs, SIGTERM and SIGINT end `wait` instead of the process.

    The system may deliver a signal to any thread, and the main thread, which waits, would not notice. So each writes
    its number into a socket, which the main thread reads from.
    """

    def __enter__(self) -> Self:
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._woken_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, _ignore) for number in _SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._woken_before)
        self._reader.close()
        self._writer.close()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for a signal, for `now`, or for ``timeout_s`` seconds; return whether it was a signal."""
        self._reader.settimeout(timeout_s)
        with suppress(TimeoutError):
            while (number := self._reader.recv(1)[0]) not in (*_SIGNALS, _DONE):
                continue
            return number != _DONE
        return False

    def now(self) -> None:
        """End `wait`; from any thread. Does nothing if it has ended."""
        with suppress(OSError):
            self._writer.send(bytes([_DONE]))

    def wait_during(self, work: Callable[[], Any]) -> bool:
        """Run a function on a thread of its own; return whether it was done before a signal came.

        Exceptions of the function are raised.
        """
        errors: list[BaseException] = []

        def run() -> None:
            try:
                work()
            except BaseException as error:
                errors.append(error)
            self.now()

        try:
            threading.Thread(target=run, name="epypes serve", daemon=True).start()
        except RuntimeError:
            # The system has no thread to give: signals wait meanwhile.
            run()
        is_signal = self.wait()
        if errors:
            raise errors[0]
        return not is_signal


def _ignore(number: int, frame: FrameType | None) -> None:
    """Do nothing: the signal's number has been written."""
