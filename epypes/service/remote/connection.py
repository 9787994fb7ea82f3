"""How is a running service looked at and changed from a notebook?"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self
from urllib.parse import quote

from epypes.bundle.entries import plain, written
from epypes.bundle.ports import in_order
from epypes.errors import EpypesError, ServiceError
from epypes.service.failures.record import FailureRecord
from epypes.service.parameters import Parameters
from epypes.service.remote.control import Control, address_of, parameters_of

if TYPE_CHECKING:
    from epypes.display.views.graphview import GraphView
    from epypes.service.remote.runner import RemoteRunner
    from epypes.wire import Envelope

_TOKEN: Final = "EPYPES_TOKEN"  # noqa: S105 - the name of a variable, not a secret
# A bundle is replayed in a process of its own before it is written or takes another one's place.
_REPLAY_TIMEOUT_S: Final = 300.0
_TELLS: Final = ("name", "digest", "state", "func_io", "outputs", "versions")
_RECORD: Final = frozenset(field.name for field in fields(FailureRecord))


@dataclass(frozen=True, slots=True)
class WrittenBack:
    """What writing back has changed, or would change.

    Attributes
    ----------
    diff
        Of pipeline.toml, as ``diff -u`` writes it; empty if nothing is changed.
    digest
        The bundle's, from then on.
    """

    diff: str
    digest: str


@dataclass(frozen=True, slots=True)
class Addresses:
    """Where a service takes events and gives answers, as ``ep.ZMQPublisher`` and ``ep.ZMQSubscriber`` take them.

    Attributes
    ----------
    sub
        Where it takes events: publish there.
    pub
        Where it publishes answers: subscribe there.
    failures
        Where it publishes events that failed.
    """

    sub: str
    pub: str
    failures: str


def connect(url: str, *, token: str | None = None, timeout_s: float = 5.0) -> Connection:
    """Connect to the HTTP control of a running service.

    Parameters
    ----------
    url
        Where it is, as ``http://127.0.0.1:8642``; the address of its page does too.
    token
        What its changes are asked for with. Without: that of the address, that of EPYPES_TOKEN, or, for a service of
        this user's on this machine, the one in its token file. Looking needs none.
    timeout_s
        How long an answer may take, in seconds.

    Returns
    -------
    Connection
        It shows itself in a notebook; ``tune(connection)`` is the panel of the running service.

    Raises
    ------
    ServiceError
        The address is none, nothing answers there, it is no EPypes service, or one of another version.
    """
    address, in_url = address_of(url)
    given = token or in_url or os.environ.get(_TOKEN) or _token_on_this_machine(address)
    return Connection(Control(address, given, timeout_s))


class Connection:
    """A running service, as its HTTP control shows it; made by ``ep.connect``. May be used from several threads.

    What it shows in a notebook is what it read when it was made, or by the last ``info()``.

    Parameters
    ----------
    control
        Asks the service.
    """

    def __init__(self, control: Control) -> None:
        self._control = control
        self._info: dict[str, Any] = {}
        self._view: GraphView | None = None
        self._runner: RemoteRunner | None = None
        try:
            _check_version(control.url, self.info())
        except BaseException:
            control.close()
            raise

    @property
    def url(self) -> str:
        """Where the service's HTTP control is."""
        return self._control.url

    @property
    def addresses(self) -> Addresses:
        """Where it takes events, and publishes answers and failures; as of the last ``info()``."""
        told = self._info.get("addresses")
        known = told if isinstance(told, Mapping) else {}
        return Addresses(*(str(known.get(name, "")) for name in ("sub", "pub", "failures")))

    # -- looking ------------------------------------------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        """Return what is served, in which state, by which processes and at which addresses."""
        self._info = self._told(self._control.get("/v1/info"))
        with suppress(EpypesError):
            self._view = self._seen()
        return dict(self._info)

    def group(self) -> dict[str, Any]:
        """Return which replicas share its events with it, how each is, and whether all compute with the same."""
        return dict(self._control.get("/v1/group"))

    def parameters(self) -> Parameters:
        """Return the hyperparameters: their revision, and an entry by token as in pipeline.toml."""
        return parameters_of(self.url, self._control.get("/v1/parameters"))

    def run(self, tokens: str | Sequence[str] | None = None, revision: int | None = None) -> dict[str, Any]:
        """Return values of the service's last completed run, by token.

        Parameters
        ----------
        tokens
            Which; the service's outputs without.
        revision
            Of the hyperparameters: if no event has come since, the service runs the last one again, unpublished.

        Raises
        ------
        NotComputed
            No event has been worked on yet, or a token was not computed.
        """
        envelope = self.envelope(self._info["outputs"] if tokens is None else tokens, revision)
        return in_order(envelope, self._info.get("rgb", ()))

    def envelope(self, tokens: str | Sequence[str], revision: int | None = None) -> Envelope:
        """Return what ``run`` does as the service sends it: with its revision, event and times."""
        from epypes.service.packing import unpack
        from epypes.wire import decode

        asked = [tokens] if isinstance(tokens, str) else list(tokens)
        since = {} if revision is None else {"revision": revision}
        return decode(unpack(self._control.content("/v1/run", tokens=asked, **since)[1]))

    def preview(self, token: str, max_side_px: int = 512) -> tuple[str, bytes]:
        """Return a token of the last run as a small picture, or as text: its media type and its bytes."""
        return self._control.content(f"/v1/tokens/{quote(token, safe='')}/preview", max_side_px=max_side_px)

    def view(self) -> dict[str, Any]:
        """Return what is to be seen of the graph, as ``ep.show(...).save("x.json")`` writes it."""
        found = self._control.get("/v1/view")
        return found if isinstance(found, dict) else {}

    def failures(self, limit: int = 100) -> list[FailureRecord]:
        """Return what is known of the last events that failed."""
        said = self._control.get("/v1/failures", limit=limit)
        records = said.get("failures", []) if isinstance(said, dict) else said
        return [_record(record) for record in records]

    def failure(self, failure_id: str) -> tuple[FailureRecord, Envelope | bytes | None]:
        """Return what is known of an event that failed, and the event; None if it was not kept."""
        from epypes.service.packing import unpack_event

        path = f"/v1/failures/{quote(failure_id, safe='')}"
        record = _record(self._control.get(path))
        event = unpack_event(self._control.content(f"{path}/event")[1]) if record.has_event else None
        return record, event

    def events(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield what the service tells of as it happens: ``("run", {...})``, state, failure, parameters and counts.

        Raises
        ------
        ServiceError
            It is gone.
        """
        with self._control.events() as stream:
            yield from stream

    # -- changing -----------------------------------------------------------------------------------------------

    def set(self, revision: int | None = None, **values: Any) -> Parameters:
        """Set hyperparameters between two events, all or none.

        Parameters
        ----------
        revision
            That of the values that were looked at; if they have another one now, nothing is set. Any without.
        values
            By token.

        Raises
        ------
        RevisionConflict
            Somebody else has changed them meanwhile; ``current`` has what they are.
        ParametersRefused
            With a reason for each value that the service does not take.
        """
        if not values:
            return self.parameters()
        body = {"revision": revision, "values": {token: _sent(value) for token, value in values.items()}}
        return parameters_of(self.url, self._control.change("PATCH", "/v1/parameters", body))

    def write_back(self, dry_run: bool = False) -> WrittenBack:
        """Write the values of the hyperparameters into the bundle's pipeline.toml, and return what was changed.

        Parameters
        ----------
        dry_run
            Whether to return only what would be changed.
        """
        said = self._control.change("POST", "/v1/parameters/write-back", {"dry_run": dry_run}, _REPLAY_TIMEOUT_S)
        return WrittenBack(str(said.get("diff", "")), str(said.get("digest", "")))

    def deploy(self, path: str | Path) -> dict[str, Any]:
        """Have another bundle on the service's machine take the place of the one that is served.

        Raises
        ------
        DeployRefused
            It does not compute what was recorded, or does not fit; the one before goes on.
        """
        return self._asked("deploy", {"bundle": str(Path(path).resolve())})

    def rollback(self) -> dict[str, Any]:
        """Have the bundle that was served before take its place again."""
        return self._asked("rollback")

    def pause(self) -> dict[str, Any]:
        """Let events wait."""
        return self._asked("pause")

    def resume(self) -> dict[str, Any]:
        """Go on after a pause."""
        return self._asked("resume")

    def drain(self, timeout_s: float = 5.0) -> dict[str, Any]:
        """Take no more events, and work off those that wait."""
        return self._asked("drain", {"timeout_s": timeout_s})

    # -- itself -------------------------------------------------------------------------------------------------

    def to_tune(self) -> RemoteRunner:
        """Return what ``tune`` moves: the same for all panels of this connection, so that they share a history."""
        from epypes.service.remote.runner import RemoteRunner

        if self._runner is None:
            self._runner = RemoteRunner(self, self._control.events)
        return self._runner

    def close(self) -> None:
        """End the connection; the service goes on. May be called twice."""
        if self._runner is not None:
            self._runner.close()
        self._control.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        name, state = self._info["name"], self._info["state"]
        return f"<Connection: {name!r:.24} at {self.url:.36}; {state:.12}, revision {self._info.get('revision', 0)}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display.mime import bundle_of
        from epypes.service.remote.shown import painted

        return bundle_of(self, lambda: painted(self.url, self._info, self._view), lambda: self._seen_or_nothing())

    def _seen_or_nothing(self) -> GraphView:
        from epypes.display.views.graphview import GraphView

        return self._view or GraphView((), (), ())

    def _seen(self) -> GraphView:
        """Return what is to be seen of the graph now, as the painters take it."""
        from epypes.display.views.jsonview import from_json

        try:
            return from_json(self.view())
        except (TypeError, ValueError, KeyError) as error:
            raise ServiceError(self.url, f"The view of {self.url} can't be read: {error}.") from error

    def _asked(self, verb: str, body: Mapping[str, Any] | None = None) -> dict[str, Any]:
        self._info = self._told(self._control.change("POST", f"/v1/{verb}", body, _REPLAY_TIMEOUT_S))
        return dict(self._info)

    def _told(self, said: Any) -> dict[str, Any]:
        if isinstance(said, dict) and all(key in said for key in _TELLS):
            return said
        raise ServiceError(self.url, f"What answers at {self.url} is no EPypes service. Is the address right?")


def _check_version(url: str, info: Mapping[str, Any]) -> None:
    """Raise ServiceError for a service of another version, whose answers may mean something else."""
    from epypes import __version__

    there = str(info["versions"].get("epypes", "")) if isinstance(info["versions"], Mapping) else ""
    if there.partition(".")[0] != __version__.partition(".")[0]:
        text = f"The service at {url} runs EPypes {there or 'of no version'}, and this is {__version__}."
        raise ServiceError(url, f"{text} Install the same version here.")


def _token_on_this_machine(address: str) -> str:
    """Return the token of a service of this user's; empty if there is none."""
    # It is of no use where no service can run.
    from epypes.service import state_file

    try:
        found = state_file.running_at(address)
        return Path(found.token_file).read_text(encoding="ascii").strip() if found and found.token_file else ""
    except (OSError, UnicodeDecodeError, ServiceError):
        return ""


def _sent(value: Any) -> Any:
    """Return a value of a hyperparameter as JSON has it."""
    return written(plain(value)).get("value")


def _record(said: Mapping[str, Any]) -> FailureRecord:
    return FailureRecord(**{key: value for key, value in said.items() if key in _RECORD})
