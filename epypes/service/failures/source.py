"""The failures of a bundle, of a running service, or of this machine: listed, found by id, and followed."""

from __future__ import annotations

import queue
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from epypes.bundle.manifest import check_manifest
from epypes.errors import BundleError, FailureNotKept, InvalidType, ServiceError, UnknownName
from epypes.service.failures.record import FAILURE_TOPIC, FailedEvent, read_record
from epypes.service.failures.store import FailureStore, failures_folder

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection
    from epypes.wire import Envelope

_LATEST: Final = "latest"
# Ids of one time begin alike: those of a day have six characters in common.
_MIN_ID_CHARACTERS: Final = 3
# How often a follower looks whether the service still runs.
_LOOK_S: Final = 0.5
_JOIN_TIMEOUT_S: Final = 10.0


class FailureSource(Protocol):
    """Failures of a store on this machine, or of a service."""

    def records(self, limit: int | None = None) -> Sequence[FailedEvent]:
        """Return the records, the newest first."""

    def event(self, failure_id: str) -> Envelope | bytes:
        """Return the event that failed; raise UnknownName or FailureNotKept."""

    def state(self, failure_id: str) -> bytes:
        """Return the packed state between events that it began with; empty for the initial one, and without state."""


class _ServiceFailures:
    """The failures of a running service."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def records(self, limit: int | None = None) -> Sequence[FailedEvent]:
        return self._connection.failures()[:limit]

    def event(self, failure_id: str) -> Envelope | bytes:
        record, event = self._connection.failure(failure_id)
        if event is None:
            reason = record.no_event or "the service had none to give"
            raise FailureNotKept(failure_id, "", f"The event of failure {failure_id} was not kept: {reason}.")
        return event

    def state(self, failure_id: str) -> bytes:
        return self._connection.failure_state(failure_id)


class _LocalFailures:
    """The failures of all bundles that this user has served on this machine, or of one of them.

    Parameters
    ----------
    bundle
        Its failures are in the folder of the bundle that the service was started with. All bundles without.
    """

    def __init__(self, bundle: Path | None = None) -> None:
        parent = failures_folder("").parent
        self._stores = [FailureStore(folder) for folder in sorted(parent.glob("*")) if folder.is_dir()]
        self._bundle = None if bundle is None else str(bundle.resolve())
        self._own = None if bundle is None else failures_folder(bundle)

    def records(self, limit: int | None = None) -> Sequence[FailedEvent]:
        found: list[FailedEvent] = []
        for store in self._stores:
            if self._bundle is None or store.folder == self._own:
                found += store.records(limit)
            else:
                found += [record for record in store.records() if record.bundle == self._bundle]
        return sorted(found, key=lambda record: record.id, reverse=True)[:limit]

    def event(self, failure_id: str) -> Envelope | bytes:
        return self._store(failure_id).event(failure_id)

    def state(self, failure_id: str) -> bytes:
        return self._store(failure_id).state(failure_id)

    def _store(self, failure_id: str) -> FailureStore:
        for store in self._stores:
            if any(record.id == failure_id for record in store.records()):
                return store
        raise UnknownName("failure", failure_id, [record.id for record in self.records()], "on this machine")


def failures_of(source: Any = None) -> FailureSource:
    """Return the failures of a bundle's path, of a service's http URL or Connection, or of this machine without.

    Raises
    ------
    BundleError
        There is no such bundle, and no service of it has left failures.
    ServiceError
        The service can't be reached.
    """
    if source is None:
        return _LocalFailures()
    path = path_of(source)
    if path is None:
        return _ServiceFailures(_connected(source))
    failures = _LocalFailures(path)
    if not failures_folder(path).is_dir() and not failures.records(1):
        # A bundle without failures is fine; a folder that is no bundle is not.
        check_manifest(path)
    return failures


def path_of(source: Any) -> Path | None:
    """Return the bundle's path that a source is; None for a URL, a Connection, or nothing."""
    is_url = isinstance(source, str) and source.startswith(("http://", "https://"))
    return Path(source) if isinstance(source, str | Path) and not is_url else None


def _connected(source: Any) -> Connection:
    from epypes.service.remote.connection import Connection, connect

    if isinstance(source, str):
        return connect(source)
    if not isinstance(source, Connection):
        text = f"Failures come from a bundle's path, a service's http URL or ep.connect(url), not {source!r:.80}."
        raise InvalidType(text)
    return source


def find_failure(failures: FailureSource, given: str) -> FailedEvent:
    """Return a failure by its id, the first or last characters of it, its event's id, or ``latest``.

    Of several failures of one event it is the last one.

    Raises
    ------
    UnknownName
        There is none that can be read, or more than one begins or ends so; the nearest are named.
    """
    records = failures.records()
    # An event fails more than once if a broker has delivered it again: the last time, which comes first, is meant.
    found = [record for record in records if given in (_LATEST, record.id, record.event_id)][:1]
    if not found and len(given) >= _MIN_ID_CHARACTERS:
        found = [record for record in records if record.id.startswith(given) or record.id.endswith(given)]
    if len(found) == 1:
        return found[0]
    if found:
        raise UnknownName("single failure", given, [record.id for record in found], "but several that begin or end so")
    raise UnknownName("failure", given, [record.id for record in records], "here")


def bundle_of(record: FailedEvent, given: str | Path | None = None) -> tuple[Path, str]:
    """Return the folder of the bundle that failed, and how it has changed since; an empty text if it has not.

    Parameters
    ----------
    given
        The first folder to look at; the second is the one that was served.

    Raises
    ------
    BundleError
        It is in neither folder, or not as it was promoted.
    """
    digests: dict[Path, str] = {}
    refused: BundleError | None = None
    for folder in (Path(each).resolve() for each in (given, record.bundle) if each):
        try:
            digests[folder] = check_manifest(folder)
        except BundleError as error:
            refused = refused or error
            continue
        if digests[folder] == record.digest:
            return folder, ""
    if not digests:
        text = f"The bundle that failed is not on this machine: it was {record.bundle or 'not named'}."
        raise refused or BundleError(record.bundle, f"{text} Copy it here, and name its folder.")
    folder, digest = next(iter(digests.items()))
    changed = f"{folder} has changed since: {record.digest[:12] or 'another bundle'} failed, now it is {digest[:12]}"
    return folder, changed


# -- from now on ------------------------------------------------------------------------------------------------------


def follow_failures(source: Any, *, keys: Any = None, allow: Any = None) -> Iterator[FailedEvent | None]:
    """Yield None when the failures are heard, then the record of each failure as it happens; goes on without end.

    Parameters
    ----------
    source
        The path of the bundle that is served: then the failures of all its replicas are heard at their sockets; or the
        http URL of the service.
    keys, allow
        As for ZMQSubscriber, where the service has keys.

    Raises
    ------
    ServiceError
        No service runs, it can't be reached, or it has ended.
    """
    path = path_of(source)
    if path is not None:
        yield from _follow_sockets(path, keys=keys, allow=allow)
        return
    is_first, connection = True, _connected(source)
    for kind, data in connection.events():
        # The service reports its state at once: from its first event on nothing is missed.
        if is_first:
            is_first = False
            yield None
        if kind == "failure":
            yield read_record(data)
    raise ServiceError(connection.url, f"The service at {connection.url} has ended.")


def _follow_sockets(path: Path, **secured: Any) -> Iterator[FailedEvent | None]:
    from epypes.service.ops.client import why_unreachable
    from epypes.service.state_file import read_states
    from epypes.transport import ZMQSubscriber
    from epypes.wire import Envelope

    states = read_states(path)
    if not states:
        raise ServiceError(path, f"No service runs for {path}. Start one: epypes serve {path}")
    received: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with ExitStack() as subscribers:
        for address in sorted({state.failures for state in states}):
            _check_shared(path, address)
            subscriber = subscribers.enter_context(ZMQSubscriber(address, received, FAILURE_TOPIC, **secured))
            if not subscriber.wait_joined(_JOIN_TIMEOUT_S):
                text = f"The failures of {path} can't be reached at {address} within {_JOIN_TIMEOUT_S:g} s."
                raise ServiceError(path, f"{text} {why_unreachable(secured['keys'] is not None)}")
        yield None
        while True:
            try:
                event = received.get(timeout=_LOOK_S)
            except queue.Empty:
                if not read_states(path):
                    raise ServiceError(path, f"The service of {path} has ended.") from None
                continue
            if isinstance(event, Envelope) and event.failure is not None:
                yield _record_of(event)


def _check_shared(path: Path, address: str) -> None:
    """Raise ServiceError where failures go to one receiver, which would miss what another one hears."""
    from epypes.transport.address import parse_address

    place = parse_address(address)
    if not place.is_zeromq or place.binds is False:
        text = f"The service of {path} sends its failures to {place}; listen there, or ask its http URL."
        raise ServiceError(path, text)


def _record_of(event: Envelope) -> FailedEvent:
    """Return what a failure event says; the rest of the record is in the store, under its id."""
    failure, attributes = event.failure, event.attributes
    if failure is None:
        return FailedEvent()
    return FailedEvent(
        id=str(attributes.get("id", "")),
        event_id=failure.input_id,
        function=failure.function,
        tokens=failure.tokens,
        exception=failure.exception,
        # Its notes come after it; they name the function once more.
        message=failure.message.partition(" | In function ")[0],
        kind=str(attributes.get("kind", "raised")),
        attempt=failure.attempt,
        dead_letter=bool(attributes.get("dead_letter", False)),
        when_ns=int(attributes.get("when_ns", 0)) or event.published_ns,
        digest=event.bundle_digest,
        revision=event.revision,
    )
