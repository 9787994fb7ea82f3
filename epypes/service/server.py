"""How does a bundle run as a service between a SUB and a PUB socket?

One process so far: the I/O thread owns the sockets, the event loop's thread computes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, Self

from epypes.bundle.load import pipeline_of, read_bundle
from epypes.bundle.replay import replay
from epypes.errors import MessageError, ReplayDiffers, StillRunning
from epypes.pipeline import Mailbox
from epypes.run import Failure
from epypes.service.state import ServiceState, StateLock
from epypes.transport import ZMQPublisher, ZMQSubscriber
from epypes.wire.failures import failure_event

# How many events wait while one is computed; the oldest is dropped, and counted, when another comes.
MAILBOX_SIZE = 8
# Answers kept for a subscriber that does not read; images are large, so this bounds the memory that one can cost.
_KEPT_ANSWERS = 256
DRAIN_TIMEOUT_S = 5.0
_DRAIN_SHARE = 0.6
_CONNECT = "connect:"

_log = logging.getLogger("epypes.service")


class Service:
    """A bundle's FullPipeline between two sockets.

    Parameters
    ----------
    path
        The bundle.
    sub, pub
        Where events come from and where answers go: an address is bound, ``connect:ADDRESS`` is connected to.
        ``tcp://127.0.0.1:*`` takes any free port.
    insecure
        Whether an address that other machines can reach may be bound.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    ReplayDiffers
        It does not compute what was recorded.
    AddressError
        An address can't be bound, or is not on loopback.
    """

    def __init__(self, path: str | Path, sub: str, pub: str, *, insecure: bool = False) -> None:
        self.bundle = read_bundle(path)
        report = replay(self.bundle)
        if not report.identical:
            raise ReplayDiffers(path, report)
        self.mailbox = Mailbox("drop_oldest", MAILBOX_SIZE, on_drop=self._refuse)
        answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.pipeline = pipeline_of(self.bundle, self.mailbox, answers)
        self.pipeline.on_error = self._report
        self._answers = answers
        self._sub, self._pub = sub, pub
        self.subscriber = ZMQSubscriber(*_endpoint(sub, self.mailbox), insecure=insecure)
        self.publisher = ZMQPublisher(*_endpoint(pub, answers), insecure=insecure, high_water_mark=_KEPT_ANSWERS)
        self._unanswered = 0

    def start(self) -> ServiceState:
        """Bind the sockets and begin to answer; return what is to be known of the service."""
        try:
            self.publisher.start()
            self.subscriber.start()
        except Exception:
            self.stop()
            raise
        self.pipeline.listen()
        sub, pub = _shown(self._sub, self.subscriber), _shown(self._pub, self.publisher)
        return ServiceState(os.getpid(), sub, pub, self.bundle.digest)

    def stop(self, timeout_s: float = DRAIN_TIMEOUT_S) -> None:
        """Take no more events, work off those that wait, send the answers; each bounded by ``timeout_s``.

        What could not be worked off in time is answered with a failure.

        Raises
        ------
        StillRunning
            A function did not return; it is named.
        """
        self.subscriber.stop(timeout_s)
        try:
            self._drain(timeout_s)
        finally:
            self.publisher.stop(timeout_s)

    def _drain(self, timeout_s: float) -> None:
        """Work off what waits for part of the time; then refuse the rest, so that the event under way can end."""
        if not self.pipeline.loop.drain(timeout_s * _DRAIN_SHARE):
            with contextlib.suppress(queue.Empty):
                while True:
                    self._refuse(self.mailbox.get_nowait(), "the service stops")
        try:
            self.pipeline.stop(timeout_s * (1 - _DRAIN_SHARE))
        except StillRunning as error:
            self._refuse(self.pipeline.working_on, f"the service stops while it is in {', '.join(error.functions)}")
            raise StillRunning(error.name, error.functions, timeout_s) from None

    def counts(self) -> dict[str, int]:
        """Return how many events were received, answered, failed, dropped and rejected."""
        return {
            "received": self.subscriber.received,
            "answered": self.publisher.sent,
            "failed": self.pipeline.failed,
            "dropped": self._unanswered,
            "rejected": sum(self.subscriber.rejected.values()),
        }

    def _refuse(self, event: Any, why: str = "it has more events than it can answer") -> None:
        """Answer an event that is not worked on."""
        self._unanswered += 1
        refusal = MessageError("dropped", f"The service dropped this event: {why}. Send it again later.")
        self._report(Failure("mailbox", (), {}, refusal, getattr(event, "id", "")))

    def _report(self, failure: Failure) -> None:
        _log.warning("event %s failed in %s", failure.event_id or "without id", failure)
        self._answers.put(failure_event(failure, self.pipeline.name, self.bundle.digest))

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()


def _endpoint(address: str, queue_: Any) -> tuple[str, Any, str, bool]:
    """Return address, queue, topic and bind for a socket."""
    return address.removeprefix(_CONNECT), queue_, "", not address.startswith(_CONNECT)


def _shown(given: str, socket: ZMQSubscriber | ZMQPublisher) -> str:
    return given if given.startswith(_CONNECT) else socket.address


def serve(
    path: str | Path,
    sub: str,
    pub: str,
    *,
    insecure: bool = False,
    on_ready: Callable[[ServiceState], None] = lambda state: None,
) -> dict[str, int]:
    """Serve a bundle until SIGTERM or SIGINT; return the counts of events.

    Raises
    ------
    ServiceError
        The bundle is being served already.
    BundleError, ReplayDiffers, AddressError
        As for Service.
    StillRunning
        A function did not return in time after the signal.
    """
    stopped = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stopped.set()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        with StateLock(path) as lock:
            service = Service(path, sub, pub, insecure=insecure)
            state = service.start()
            lock.publish(state)
            on_ready(state)
            stopped.wait()
            service.stop()
            return service.counts()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
