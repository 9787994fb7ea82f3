"""Which failures does a service tell of from now on?"""

from __future__ import annotations

import queue
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import ServiceError
from epypes.service.client import why_unreachable
from epypes.service.endpoints import FAILURE_TOPIC
from epypes.service.failures.record import FailureRecord, record_of
from epypes.service.failures.source import connected, path_of
from epypes.service.state_file import read_states
from epypes.transport import ZMQSubscriber
from epypes.transport.channels import is_brokered
from epypes.wire import Envelope

if TYPE_CHECKING:
    from epypes.transport import Keys
    from epypes.transport.zeromq.curve import PublicKey

# How often it is looked whether the service still runs.
_LOOK_S: Final = 0.5
_JOIN_S: Final = 10.0


def failures_from_now_on(
    source: Any,
    *,
    keys: Keys | str | Path | None = None,
    allow: PublicKey | Collection[PublicKey] | None = None,
) -> Iterator[FailureRecord | None]:
    """Yield None when it is listened, and then the record of each failure as it happens; goes on without end.

    Parameters
    ----------
    source
        The path of the bundle that is served: then the failures' sockets of all its replicas are heard; or the http
        URL of the service.
    keys, allow
        As for ZMQSubscriber, where the service has keys.

    Raises
    ------
    ServiceError
        No service runs, it can't be reached, or it has ended.
    """
    path = path_of(source)
    return _of_connection(source) if path is None else _of_sockets(path, keys=keys, allow=allow)


def _of_connection(source: Any) -> Iterator[FailureRecord | None]:
    is_heard, connection = False, connected(source)
    for kind, data in connection.events():
        # It tells its counts each second; from the first word on nothing is missed.
        if not is_heard:
            is_heard = True
            yield None
        if kind == "failure":
            yield record_of(data)
    raise ServiceError(connection.url, f"The service at {connection.url} has ended.")


def _of_sockets(path: Path, **secured: Any) -> Iterator[FailureRecord | None]:
    states = read_states(path)
    if not states:
        raise ServiceError(path, f"No service runs for {path}. Start one: epypes serve {path}")
    found: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with ExitStack() as opened:
        for address in sorted({state.failures for state in states}):
            subscriber = opened.enter_context(ZMQSubscriber(_heard(path, address), found, FAILURE_TOPIC, **secured))
            if not subscriber.wait_joined(_JOIN_S):
                text = f"The failures of {path} can't be reached at {address} within {_JOIN_S:g} s."
                raise ServiceError(path, f"{text} {why_unreachable(secured['keys'] is not None)}")
        yield None
        while True:
            try:
                event = found.get(timeout=_LOOK_S)
            except queue.Empty:
                if not read_states(path):
                    raise ServiceError(path, f"The service of {path} has ended.") from None
                continue
            if isinstance(event, Envelope) and event.failure is not None:
                yield _record(event)


def _heard(path: Path, address: str) -> str:
    """Return where failures can be heard without anybody missing one for it.

    Raises
    ------
    ServiceError
        They are sent to somebody else.
    """
    where = address.removeprefix("connect:")
    if where != address or is_brokered(where):
        text = f"The service of {path} sends its failures to {where}; listen there, or ask its http URL."
        raise ServiceError(path, text)
    return address


def _record(event: Envelope) -> FailureRecord:
    """Return what a failure event says; the rest of the record is in the store, under its id."""
    failure, more = event.failure, event.attributes
    if failure is None:
        return FailureRecord()
    return FailureRecord(
        id=str(more.get("id", "")),
        event_id=failure.input_id,
        function=failure.function,
        tokens=failure.tokens,
        exception=failure.exception,
        # Its notes come after it; they name the function once more.
        message=failure.message.partition(" | In function ")[0],
        kind=str(more.get("kind", "raised")),
        attempt=failure.attempt,
        dead_letter=bool(more.get("dead_letter", False)),
        when_ns=int(more.get("when_ns", 0)) or event.published_ns,
        digest=event.bundle_digest,
        revision=event.revision,
    )
