"""Whose failures are meant, and which of them? A bundle's, those of a running service, or of all on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from epypes.bundle.seal import check_seal
from epypes.errors import BundleError, FailureNotKept, UnknownName
from epypes.service.failures.record import ID, FailureRecord, record_of
from epypes.service.failures.store import FailureStore, failures_folder

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection
    from epypes.wire import Envelope

LATEST: Final = "latest"
# Ids of one time begin alike: those of a day have six characters in common.
_LEAST: Final = 3


class Failures(Protocol):
    """What has failures: a store on this machine, or a service."""

    def records(self, limit: int | None = None) -> Sequence[FailureRecord]:
        """Return the records, the newest first."""

    def record(self, failure_id: str) -> FailureRecord:
        """Return one of them; raise UnknownName or FailureNotKept."""

    def event(self, failure_id: str) -> Envelope | bytes:
        """Return the event that failed; raise UnknownName or FailureNotKept."""


class _ByConnection:
    """The failures of a running service."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def records(self, limit: int | None = None) -> Sequence[FailureRecord]:
        return [_record(found) for found in self._connection.failures()][:limit]

    def record(self, failure_id: str) -> FailureRecord:
        return _record(self._connection.failure(failure_id)[0])

    def event(self, failure_id: str) -> Envelope | bytes:
        found, event = self._connection.failure(failure_id)
        if event is None:
            why = _record(found).no_event or "the service had none to give"
            raise FailureNotKept(failure_id, "", f"The event of failure {failure_id} was not kept: {why}.")
        return event


class _Everywhere:
    """The failures of all bundles that were served on this machine by this user, or of one of them.

    Parameters
    ----------
    bundle
        The one: what failed in it is in the folder of the bundle that its service began with; and whatever failed in
        the service that began with it. All without.
    """

    def __init__(self, bundle: Path | None = None) -> None:
        parent = failures_folder("").parent
        self._stores = [FailureStore(folder) for folder in sorted(parent.glob("*")) if folder.is_dir()]
        self._bundle = None if bundle is None else str(bundle.resolve())
        self._own = None if bundle is None else failures_folder(bundle)

    def _of(self, store: FailureStore, limit: int | None) -> Sequence[FailureRecord]:
        if self._bundle is None or store.folder == self._own:
            return store.records(limit)
        return [record for record in store.records() if record.bundle == self._bundle]

    def records(self, limit: int | None = None) -> Sequence[FailureRecord]:
        found = [record for store in self._stores for record in self._of(store, limit)]
        return sorted(found, key=lambda record: record.id, reverse=True)[:limit]

    def record(self, failure_id: str) -> FailureRecord:
        return self._store(failure_id).record(failure_id)

    def event(self, failure_id: str) -> Envelope | bytes:
        return self._store(failure_id).event(failure_id)

    def _store(self, failure_id: str) -> FailureStore:
        for store in self._stores:
            if any(record.id == failure_id for record in store.records()):
                return store
        raise UnknownName("failure", failure_id, [record.id for record in self.records()], "on this machine")


def _record(found: Any) -> FailureRecord:
    return found if isinstance(found, FailureRecord) else record_of(found)


def failures_of(source: Any = None) -> Failures:
    """Return the failures of a bundle's path, of a service's http URL or Connection, or of this machine without.

    Raises
    ------
    BundleError
        There is no such bundle, and no service of it has left failures.
    ServiceError
        The service can't be reached.
    """
    if source is None:
        return _Everywhere()
    path = path_of(source)
    if path is not None:
        failures = _Everywhere(path)
        if not failures_folder(path).is_dir() and not failures.records(1):
            # A bundle without failures is one all the same; what is no bundle is said.
            check_seal(path)
        return failures
    return _ByConnection(connected(source))


def connected(source: Any) -> Connection:
    """Return the Connection that is meant: itself, or one to the service at a URL.

    Raises
    ------
    ServiceError
        The service can't be reached.
    TypeError
        It is neither.
    """
    from epypes.service.remote.connection import Connection, connect

    if isinstance(source, str):
        return connect(source)
    if not isinstance(source, Connection):
        text = f"Failures come from a bundle's path, a service's http URL or ep.connect(url), not {source!r:.80}."
        raise TypeError(text)
    return source


def path_of(source: Any) -> Path | None:
    """Return the bundle's path that a source is; None for a URL, a Connection, or nothing."""
    is_url = isinstance(source, str) and source.startswith(("http://", "https://"))
    return Path(source) if isinstance(source, str | Path) and not is_url else None


def found_by(failures: Failures, given: str) -> FailureRecord:
    """Return the failure that is meant by its id, the first or last characters of it, its event's id, or ``latest``.

    Of several failures of one event it is the last one.

    Raises
    ------
    UnknownName
        There is none, or more than one begins or ends so; the nearest are named.
    FailureNotKept
        It can't be read.
    """
    records = failures.records()
    # An event fails more than once if a broker has delivered it again: the last time, which comes first, is meant.
    exact = [record for record in records if given in (record.id, record.event_id)]
    meant = exact[:1] or _meant(records, given)
    if len(meant) == 1:
        return meant[0]
    if meant:
        raise UnknownName("single failure", given, [record.id for record in meant], "but several that begin or end so")
    if not ID.fullmatch(given):
        raise UnknownName("failure", given, [record.id for record in records], "here")
    return failures.record(given)


def _meant(records: Sequence[FailureRecord], given: str) -> list[FailureRecord]:
    if given == LATEST:
        return list(records[:1])
    if len(given) < _LEAST:
        return []
    return [record for record in records if record.id.startswith(given) or record.id.endswith(given)]


def bundle_of(record: FailureRecord, given: str | Path | None = None) -> tuple[Path, str]:
    """Return the folder of the bundle that failed, and how it has changed since; an empty text if it has not.

    Parameters
    ----------
    given
        Where it is looked for first; then where it was served from.

    Raises
    ------
    BundleError
        It is in neither place, or not as it was promoted.
    """
    digests: dict[Path, str] = {}
    refused: BundleError | None = None
    for place in (given, record.bundle):
        if not place:
            continue
        folder = Path(place).resolve()
        try:
            digests[folder] = digest = check_seal(folder)
        except BundleError as error:
            refused = refused or error
            continue
        if digest == record.digest:
            return folder, ""
    if not digests:
        text = f"The bundle that failed is not on this machine: it was {record.bundle or 'not named'}."
        raise refused or BundleError(record.bundle, f"{text} Copy it here, and name its folder.")
    folder, digest = next(iter(digests.items()))
    changed = f"{folder} has changed since: {record.digest[:12] or 'another bundle'} failed, now it is {digest[:12]}"
    return folder, changed
