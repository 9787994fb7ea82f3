"""How is a running service tuned as a runner is?

Everything that a panel asks of a runner is here: the graph, the hyperparameters, the last run. They change when the
panel asks for it, on its own thread: what the service tells meanwhile waits until then, so that no change of somebody
else's is taken for seen before it was.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import (
    EpypesError,
    HyperparameterError,
    NotComputed,
    ParametersRefused,
    PayloadError,
    RevisionConflict,
    ServiceError,
    UnknownName,
)
from epypes.run import Run
from epypes.run.program import Program
from epypes.run.watchers import Watchers
from epypes.service.parameters import Parameters
from epypes.service.remote.control import parameters_of
from epypes.service.remote.following import Follower
from epypes.service.remote.runs import RemoteRuns
from epypes.service.remote.seenruns import SeenRuns
from epypes.service.remote.standins import graph_of

if TYPE_CHECKING:
    from epypes.service.remote.connection import Connection
    from epypes.service.remote.control import Stream

# Somebody else who changes the parameters all the time must not keep the panel from coming to an end.
_MOST_TRIES: Final = 5


class RemoteRunner:
    """A running service that is tuned as a runner is; made by ``Connection.to_tune``.

    Its hyperparameters and its last run are those that the panel has taken over. Nothing runs here.

    Parameters
    ----------
    connection
        To the service.
    events
        Opens the stream of what it tells.

    Attributes
    ----------
    cg
        Its graph; the functions are stand-ins.
    last
        The last run that was taken over; None before the first.
    """

    def __init__(self, connection: Connection, events: Callable[[], AbstractContextManager[Stream]]) -> None:
        self.connection = connection
        info, known = connection.info(), connection.parameters()
        self.cg = graph_of(connection.url, info["func_io"], known.entries, _rgb(connection, info))
        self._program = Program(self.cg, True)
        self._runs = RemoteRuns(connection, self._program, known, info["outputs"])
        self._seen = SeenRuns()
        self._events = events
        self._watchers = Watchers()
        self._lock = threading.Lock()
        self._follower: Follower | None = None
        # What the service has; what the panel has been told of; what it will be told of next.
        self._known = known
        self._told: Mapping[str, Any] = MappingProxyType(self._runs.values(known))
        self._news: Parameters | None = None
        self._process, self._is_anew = _process(info), False
        self._state: tuple[str, str] = (str(info["state"]), str(info.get("reason") or ""))
        self._gone = ""
        self._failed: Mapping[str, Any] | None = None
        self._refused: tuple[object, ParametersRefused] | None = None
        self._tried: tuple[Run, dict[str, Any], bool] | None = None
        self.first_hyperparameters: Mapping[str, Any] = self._told
        self.last: Run | None = self._first_run()

    # -- what a panel reads -------------------------------------------------------------------------------------

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values that the panel has been told of, by token: a snapshot."""
        return self._told

    @property
    def revision(self) -> int:
        """The revision of the hyperparameters, as far as it is known here."""
        return self._known.revision

    @property
    def free_source_tokens(self) -> tuple[str, ...]:
        """The source tokens that an event brings."""
        return tuple(token for token in self.cg.source_tokens if token not in self._told)

    @property
    def stale(self) -> tuple[str, ...]:
        """Nothing: the service runs what its events need."""
        return ()

    @property
    def running(self) -> tuple[str, ...]:
        """Nothing: no function runs here."""
        return ()

    @property
    def notice(self) -> str:
        """What is to be said beside the picture: why it may not be the newest; empty if it is."""
        if self._gone:
            return f"The picture is the last one: {self._gone} It is tried again."
        state, reason = self._state
        told = f": {reason}" if reason else "."
        if state == "READY":
            return ""
        if state == "PAUSED":
            return f"The service is paused{told} Its events wait."
        way_out = "" if state in ("STOPPED", "FAULTED") else " The worker may be starting again; the picture follows."
        return f"The service is {state}{told}{way_out}"

    # -- what a panel does --------------------------------------------------------------------------------------

    def trial(self, values: Mapping[str, Any], /, *targets: str, payload: Mapping[str, Any] | None = None) -> Run:
        """Set hyperparameters of the service, and return its run with them.

        Parameters
        ----------
        values
            By token. One that somebody else has changed since the panel was told of it is not set.
        targets
            The tokens to fetch; everything that can be without.
        payload
            None: a service has its events.

        Returns
        -------
        Run
            If the last event failed, its ``failure`` says so.

        Raises
        ------
        ServiceError
            The service is gone, or does not take the values.
        NotComputed
            It has not worked on an event yet.
        PayloadError
            A payload was given.
        """
        self._check(values, targets, payload)
        try:
            return self._tried_there(values, targets)
        except ServiceError as error:
            # Why nothing can be had says more than that it can't.
            if isinstance(error, ParametersRefused) or not self.notice:
                raise
            raise ServiceError(self.connection.url, self.notice) from error
        except NotComputed as error:
            if self.notice:
                raise ServiceError(self.connection.url, self.notice) from error
            raise NotComputed("", self._waiting()) from error

    def _waiting(self) -> str:
        """Return what is waited for where the service has no run to show."""
        try:
            answered = self.connection.info().get("counts", {}).get("answered", 0)
        except EpypesError:
            answered = 0
        address = self.connection.addresses.sub
        if not answered and self.last is None:
            return f"Waiting for the first event at {address}"
        seen = "; the picture and its values are those before" if self.last is not None else ""
        return f"No event since the bundle was deployed or its worker started again{seen}. Waiting for one at {address}"

    def _tried_there(self, values: Mapping[str, Any], targets: tuple[str, ...]) -> Run:
        self._require_there()
        accepted = self._sent(values)
        failed = self._failed if not accepted else None
        if failed is not None and self.last is not None:
            run = self._runs.failed(self.last, failed, self._known)
        else:
            run = self._runs.fetched(targets, self._known)
            if run.failure is None:
                self._seen.add(run)
        self._tried = run, dict(values), all(name in accepted or self._has(name, values[name]) for name in values)
        return run

    def adopt(self, run: Run, /) -> bool:
        """Make a run of ``trial`` the last one, and its hyperparameters those that the panel was told of.

        Return False, and do nothing, if somebody else has changed one of those that were set.

        Raises
        ------
        ValueError
            The run was not tried here, or another one has been since.
        """
        if self._tried is None or self._tried[0] is not run:
            raise ValueError("Only the run that this runner's trial() returned last can be adopted.")
        _, values, is_whole = self._tried
        if not is_whole:
            return False
        now = self._runs.values(self._known)
        self._told = MappingProxyType({**self._told, **{name: now[name] for name in values}})
        self.last = run
        return True

    def remembered(self, values: Mapping[str, Any], /, *targets: str) -> Run:
        """Return the run that the service has shown with these hyperparameters.

        Raises
        ------
        LookupError
            It has shown none since it was connected to.
        """
        run = self._seen.find({**self._told, **values})
        if run is None or any(target not in run for target in targets):
            names = ", ".join(targets)
            raise LookupError(
                f"The service has not shown {names} with these values since it was connected to, and is not run on "
                "other values on the side. Set them, and compare with those of now."
            )
        return run

    def put(self, values: Mapping[str, Any], /) -> None:
        """Set hyperparameters of the service, but for those that somebody else has changed meanwhile."""
        self._check(values, (), None)
        self._sent(values)

    def catch_up(self) -> None:
        """Let the panel be told of what others have changed meanwhile."""
        with self._lock:
            news, self._news = self._news, None
            is_anew, self._is_anew = self._is_anew, False
        # What was on its way while a value was set is older than what the service has answered to that.
        if news is not None and (is_anew or news.revision > self._known.revision):
            self._learn(news)

    def watch(self, callback: Callable[[], object], /) -> Callable[[], None]:
        """Call something without arguments when the service has told of something; return what ends that.

        It is called on a thread of its own, which ends with the last one that watches.
        """
        remove = self._watchers.add(callback)
        with self._lock:
            if self._follower is None:
                self._follower = Follower(self._events, self._back, self._heard, self._lost)
                self._follower.start()

        def forget() -> None:
            remove()
            if not self._watchers.callbacks:
                self._rest()

        return forget

    def close(self) -> None:
        """Tell nobody any more."""
        self._watchers = Watchers()
        self._rest()

    def __repr__(self) -> str:
        return f"<RemoteRunner of {self.connection!r:.60}>"

    # -- values -------------------------------------------------------------------------------------------------

    def _check(self, values: Mapping[str, Any], targets: tuple[str, ...], payload: Mapping[str, Any] | None) -> None:
        if payload is not None:
            text = f"The service at {self.connection.url} takes its events from its own line, not from here."
            raise PayloadError(self.free_source_tokens, f"{text} Load its bundle to run others: ep.load(...).")
        for target in targets:
            self.cg.require_token(target)
        for name in values:
            if name not in self._told:
                if self.cg.has_token(name):
                    raise HyperparameterError(name, f"Token {name!r} is no hyperparameter of this service.")
                raise UnknownName("hyperparameter", name, self._told, "of this service")

    def _sent(self, values: Mapping[str, Any]) -> set[str]:
        """Set what differs, and return the names; what somebody else has changed meanwhile is left out."""
        told = self._told
        if self._refused is not None and self._refused[0] == (self._known.revision, dict(values)):
            raise self._refused[1]  # who follows the line would ask again at each event
        for _ in range(_MOST_TRIES):
            is_theirs = {name for name in values if self._told[name] is not told[name]}
            left = {n: value for n, value in values.items() if n not in is_theirs and not self._has(n, value)}
            if not left:
                return set()
            try:
                self._known = self.connection.set(self._known.revision, **left)
            except RevisionConflict as conflict:
                self._learn(conflict.current)
                continue
            except ParametersRefused as refused:
                self._refused = (self._known.revision, dict(values)), refused
                raise
            self._failed = None
            return set(left)
        raise ServiceError(
            self.connection.url,
            f"Nothing was set: somebody else changes the parameters of {self.connection.url} all the time.",
        )

    def _has(self, name: str, value: Any) -> bool:
        return self._runs.is_same(self._known, name, value)

    def _learn(self, news: Parameters) -> None:
        """Know what the service has, and let the panel be told of what somebody else has changed."""
        before, now = self._runs.values(self._known), self._runs.values(news)
        theirs = {name: value for name, value in now.items() if name in before and value is not before[name]}
        self._known = news
        self._told = MappingProxyType({**self._told, **theirs})

    def _require_there(self) -> None:
        if self._gone:
            raise ServiceError(self.connection.url, self.notice)

    def _first_run(self) -> Run | None:
        try:
            run = self._runs.fetched((), self._known)
        except EpypesError:
            return None
        self._seen.add(run)
        return run

    # -- what the service tells, on the follower's thread -------------------------------------------------------

    def _back(self) -> None:
        info, news = self.connection.info(), self.connection.parameters()
        with self._lock:
            self._news = news
            # Another process counts revisions from 0 again.
            process, self._process = self._process, _process(info)
            self._is_anew = self._is_anew or process != self._process
        self._state, self._gone = (str(info["state"]), str(info.get("reason") or "")), ""
        self._watchers.tell()

    def _lost(self, reason: str) -> None:
        self._gone = reason
        self._watchers.tell()

    def _heard(self, name: str, said: Mapping[str, Any]) -> None:
        if name == "run":
            self._failed = None
        elif name == "failure" and said.get("kind") != "dropped":
            self._failed = said
        elif name == "state":
            self._state = str(said.get("state", "")), str(said.get("reason") or "")
        elif name == "parameters":
            is_whole = "parameters" in said
            news = parameters_of(self.connection.url, said) if is_whole else self.connection.parameters()
            with self._lock:
                self._news = news
        else:
            return
        self._watchers.tell()

    def _rest(self) -> None:
        with self._lock:
            follower, self._follower = self._follower, None
        if follower is not None:
            follower.stop()
        self._gone = ""


def _process(info: Mapping[str, Any]) -> tuple[object, object]:
    return info.get("pid"), info.get("started_ns")


def _rgb(connection: Connection, info: Mapping[str, Any]) -> list[str]:
    """Return the tokens whose colours are RGB: of all, if the service can tell; else of its ports."""
    try:
        tokens = connection.view()["tokens"]
        return [str(token["name"]) for token in tokens if token.get("order") == "rgb"]
    except (EpypesError, KeyError, TypeError, AttributeError):
        return [str(token) for token in info.get("rgb", ())]
