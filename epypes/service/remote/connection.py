"""A running service as an object: reading it, changing it, and showing it in a notebook."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self
from urllib.parse import quote

from epypes.bundle.adapters import in_order
from epypes.bundle.settings import encode_value
from epypes.bundle.writeback import WriteBack
from epypes.catalog import plain
from epypes.errors import EpypesError, ServiceError
from epypes.service.failures.record import FailedEvent, read_record
from epypes.service.parameters import Parameters
from epypes.service.remote.control import Control, Event, read_parameters, split_url

if TYPE_CHECKING:
    from epypes.display import GraphView
    from epypes.service.event_states import StateChoice
    from epypes.service.remote.runner import RemoteRunner
    from epypes.wire import Envelope

# The second one is its former name.
_VARIABLES: Final = ("EPYPES_ACCESS_KEY", "EPYPES_TOKEN")
# A bundle is replayed in a process of its own before it is written or takes another one's place.
_REPLAY_TIMEOUT_S: Final = 300.0
_INFO_KEYS: Final = ("name", "digest", "state", "func_io", "outputs", "versions")
_DIGEST_CHARACTERS: Final = 12


@dataclass(frozen=True, slots=True)
class Addresses:
    """The sockets of a service, as ``ep.ZMQPublisher`` and ``ep.ZMQSubscriber`` take them.

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


def connect(url: str, *, access_key: str | None = None, timeout_s: float = 5.0, token: str | None = None) -> Connection:
    """Connect to the HTTP control of a running service.

    Parameters
    ----------
    url
        Its address, as ``http://127.0.0.1:8642``, or the link to its page that ``epypes serve`` prints.
    access_key
        For changes; reading needs none. Without: that of the link, that of the environment variable EPYPES_ACCESS_KEY,
        or, for a service of this user on this machine, the one in its file.
    timeout_s
        How long an answer may take, in seconds.
    token
        The former name of ``access_key``.

    Returns
    -------
    Connection
        It shows itself in a notebook; ``tune(connection)`` is the panel of the running service.

    Raises
    ------
    ServiceError
        This is no address, nothing answers there, it is no EPypes service, or one of another version.
    """
    address, key_in_url = split_url(url)
    in_environment = (os.environ.get(name) for name in _VARIABLES)
    key = next(filter(None, (access_key, token, key_in_url, *in_environment)), "") or _key_on_this_machine(address)
    return Connection(Control(address, key, timeout_s))


def _key_on_this_machine(address: str) -> str:
    """Return the access key of a service of this user; empty if there is none."""
    from epypes.service import state_file

    try:
        found = state_file.running_at(address)
        return (
            Path(found.access_key_file).read_text(encoding="ascii").strip() if found and found.access_key_file else ""
        )
    except (OSError, UnicodeDecodeError, ServiceError):
        return ""


class Connection:
    """A running service, over its HTTP control; made by ``ep.connect``. May be used from several threads.

    A notebook shows what was read when the connection was made, or by the last ``info()``.

    Parameters
    ----------
    control
        Sends the requests.
    """

    def __init__(self, control: Control) -> None:
        from epypes import __version__

        self._control = control
        self._info: dict[str, Any] = {}
        self._view: GraphView | None = None
        self._runner: RemoteRunner | None = None
        try:
            versions = self.info()["versions"]
            there = str(versions.get("epypes", "")) if isinstance(versions, Mapping) else ""
            if there.partition(".")[0] != __version__.partition(".")[0]:
                text = f"The service at {self.url} runs EPypes {there or 'of no version'}, and this is {__version__}."
                raise ServiceError(self.url, f"{text} Install the same version here.")
        except BaseException:
            control.close()
            raise

    @property
    def url(self) -> str:
        """The address of the service's HTTP control."""
        return self._control.url

    @property
    def addresses(self) -> Addresses:
        """The sockets for events, answers and failures; as of the last ``info()``."""
        known = self._info.get("addresses")
        known = known if isinstance(known, Mapping) else {}
        return Addresses(*(str(known.get(name, "")) for name in ("sub", "pub", "failures")))

    # -- reading ------------------------------------------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        """Return what is served, in which state, by which processes and at which addresses."""
        self._set_info(self._control.get("/v1/info"))
        with suppress(EpypesError):
            self._view = self._read_view()
        return dict(self._info)

    def group(self) -> dict[str, Any]:
        """Return the replicas that share its events, the state of each, and whether all have the same parameters."""
        return dict(self._control.get("/v1/group"))

    def parameters(self) -> Parameters:
        """Return the hyperparameters: their revision, and an entry by token as in pipeline.toml."""
        return read_parameters(self.url, self._control.get("/v1/parameters"))

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
        from epypes.service.supervision.packing import unpack
        from epypes.wire import decode

        names = [tokens] if isinstance(tokens, str) else list(tokens)
        since = {} if revision is None else {"revision": revision}
        return decode(unpack(self._control.content("/v1/run", tokens=names, **since)[1]))

    def preview(self, token: str, max_side_px: int = 512) -> tuple[str, bytes]:
        """Return a token of the last run as a small picture, or as text: its media type and its bytes."""
        return self._control.content(f"/v1/tokens/{quote(token, safe='')}/preview", max_side_px=max_side_px)

    def view(self) -> dict[str, Any]:
        """Return what the picture of the graph is drawn from, as ``ep.show(...).save("x.json")`` writes it."""
        found = self._control.get("/v1/view")
        return found if isinstance(found, dict) else {}

    def failures(self, limit: int = 100) -> list[FailedEvent]:
        """Return the records of the last events that failed."""
        body = self._control.get("/v1/failures", limit=limit)
        return [self._record(record) for record in (body.get("failures", []) if isinstance(body, dict) else [])]

    def failure(self, failure_id: str) -> tuple[FailedEvent, Envelope | bytes | None]:
        """Return the record of an event that failed, and the event; None if it was not kept."""
        from epypes.service.supervision.packing import unpack_event

        path = f"/v1/failures/{quote(failure_id, safe='')}"
        record = self._record(self._control.get(path))
        event = unpack_event(self._control.content(f"{path}/event")[1]) if record.has_event else None
        return record, event

    def failure_state(self, failure_id: str) -> bytes:
        """Return the packed state between events that a failure began with; empty for the initial one."""
        return self._control.content(f"/v1/failures/{quote(failure_id, safe='')}/state")[1]

    def events(self) -> Iterator[Event]:
        """Yield what happens in the service as it happens: ``("run", {...})``, state, failure, parameters and counts.

        Raises
        ------
        ServiceError
            It is gone.
        """
        yield from self._control.events()

    # -- changing -----------------------------------------------------------------------------------------------

    def set(self, revision: int | None = None, **values: Any) -> Parameters:
        """Set hyperparameters between two events, all or none.

        Parameters
        ----------
        revision
            Of the values that were read before; if they have another one now, nothing is set. Any without.
        values
            By token.

        Raises
        ------
        RevisionConflict
            They were changed concurrently; ``current`` has what they are.
        ParametersRefused
            With a reason for each value that the service refuses.
        """
        if not values:
            return self.parameters()
        entries = {token: encode_value(plain(value)).get("value") for token, value in values.items()}
        body = {"revision": revision, "values": entries}
        return read_parameters(self.url, self._control.change("PATCH", "/v1/parameters", body))

    def write_back(self, dry_run: bool = False) -> WriteBack:
        """Write the values of the hyperparameters into the bundle's pipeline.toml, and return what was changed.

        Parameters
        ----------
        dry_run
            Whether to return only what would be changed.
        """
        body = self._control.change("POST", "/v1/parameters/write-back", {"dry_run": dry_run}, _REPLAY_TIMEOUT_S)
        return WriteBack(str(body.get("diff", "")), str(body.get("digest", "")))

    def deploy(self, path: str | Path, state: StateChoice | None = None) -> dict[str, Any]:
        """Serve another bundle on the service's machine from the next event on.

        Parameters
        ----------
        path
            The bundle.
        state
            Whether to ``"keep"`` or ``"reset"`` the state between events. Without, it is kept if both bundles delay the
            same tokens with the same initial values; ``changed`` says what was done.

        Raises
        ------
        DeployRefused
            It does not compute what was recorded, or does not fit; the bundle before goes on.
        """
        return self._post("deploy", {"bundle": str(Path(path).resolve()), **_chosen(state)})

    def rollback(self, state: StateChoice | None = None) -> dict[str, Any]:
        """Serve the bundle again that was served before; ``state`` as for `deploy`."""
        return self._post("rollback", _chosen(state))

    def reset(self, source: str | None = None) -> dict[str, Any]:
        """Have the next event begin with the initial state between events, as if it were the first.

        Parameters
        ----------
        source
            Of events, whose state alone is reset; every state without.

        Raises
        ------
        ServiceError
            The bundle has no state, or there is none of this source.
        """
        return self._post("reset", {} if source is None else {"source": source})

    def pause(self) -> dict[str, Any]:
        """Let events wait."""
        return self._post("pause")

    def resume(self) -> dict[str, Any]:
        """Go on after a pause."""
        return self._post("resume")

    def drain(self, timeout_s: float = 5.0) -> dict[str, Any]:
        """Take no more events, and work off those that wait."""
        return self._post("drain", {"timeout_s": timeout_s})

    # -- itself -------------------------------------------------------------------------------------------------

    def to_tune(self) -> RemoteRunner:
        """Return what ``tune`` tunes: the same object for all panels of this connection, which share a history."""
        from epypes.service.remote.runner import RemoteRunner

        if self._runner is None:
            self._runner = RemoteRunner(self)
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
        from epypes.display import Figure

        table = self._table()
        if self._view is None:
            return {"text/plain": repr(self), "text/html": table}
        shown = Figure(self._view, table)._repr_mimebundle_()
        # Where no picture can be drawn, the text has the graph and the reason.
        text = repr(self) if "text/html" in shown else f"{self!r}\n{shown['text/plain']}"
        return {**shown, "text/plain": text}

    def _table(self) -> str:
        info, addresses = self._info, self._info.get("addresses")
        reason = str(info.get("reason") or "")
        rows = {
            "http": self.url,
            **(addresses if isinstance(addresses, Mapping) else {}),
            "bundle": info.get("bundle", ""),
            "digest": str(info["digest"])[:_DIGEST_CHARACTERS],
            "revision": info.get("revision", 0),
            "restarts": info.get("restarts", 0),
        }
        cells = (f"<tr><td>{escape(name)}</td><td>{escape(str(v))}</td></tr>" for name, v in rows.items() if v != "")
        state = f"{info['name']} is {info['state']}{f': {reason}' if reason else '.'}"
        return f"<p>{escape(state)}</p><table>{''.join(cells)}</table>"

    def _read_view(self) -> GraphView:
        from epypes.display.views.graphview import from_json

        try:
            return from_json(self.view())
        except (TypeError, ValueError, KeyError) as error:
            raise ServiceError(self.url, f"The view of {self.url} can't be read: {error}.") from error

    def _post(self, verb: str, body: Mapping[str, Any] | None = None) -> dict[str, Any]:
        self._set_info(self._control.change("POST", f"/v1/{verb}", body, _REPLAY_TIMEOUT_S))
        return dict(self._info)

    def _set_info(self, body: Any) -> None:
        if not isinstance(body, dict) or any(key not in body for key in _INFO_KEYS):
            raise ServiceError(self.url, f"What answers at {self.url} is no EPypes service. Is the address right?")
        self._info = body

    def _record(self, entries: Any) -> FailedEvent:
        try:
            return read_record(entries)
        except ValueError as error:
            raise ServiceError(self.url, f"A failure at {self.url} can't be read: {error}.") from error


def _chosen(state: StateChoice | None) -> dict[str, str]:
    return {} if state is None else {"state": state}
