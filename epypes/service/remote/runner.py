"""A running service as a panel tunes it: its graph, its hyperparameters and its last run.

What the panel has taken over changes only when the panel calls a method, on its own thread. What the service reports in
between waits until ``catch_up``, so that no concurrent change is taken for seen before the panel has seen it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import (
    EpypesError,
    HyperparameterError,
    InvalidValue,
    NotComputed,
    ParametersRefused,
    PayloadError,
    RevisionConflict,
    ServiceError,
    UnknownName,
)
from epypes.run import Run
from epypes.service.parameters import Parameters
from epypes.service.remote.control import read_parameters
from epypes.service.remote.runs import RemoteRuns, ShownRuns, remote_graph

if TYPE_CHECKING:
    from epypes.images import Order
    from epypes.service.remote.connection import Connection

_log = logging.getLogger(__name__)

# Tries of a change while the parameters are changed concurrently.
_MAX_TRIES: Final = 5
# Between two attempts to reconnect; doubled each time.
_FIRST_WAIT_S: Final = 0.25
_LAST_WAIT_S: Final = 8.0


class RemoteRunner:
    """A running service that is tuned as a runner is; made by ``Connection.to_tune``. Nothing runs here.

    Parameters
    ----------
    connection
        To the service.

    Attributes
    ----------
    cg
        Its graph; the functions refuse to be called.
    last
        The last run that the panel has taken over; None before the first.
    first_hyperparameters
        The values by token when the connection was made.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        info, parameters = connection.info(), connection.parameters()
        states = (info.get("states") or {}).get("tokens", {})
        self.cg = remote_graph(connection.url, info["func_io"], parameters.entries, _orders(connection, info), states)
        self._runs = RemoteRuns(connection, self.cg, parameters, info["outputs"])
        self._shown = ShownRuns()
        # Set to end the thread that follows the events; None without a thread.
        self._end_following: threading.Event | None = None
        self._callbacks: tuple[Callable[[], object], ...] = ()
        self._lock = threading.Lock()
        # What the service has, as far as it is known; what the panel has taken over; what it will be shown next.
        self._parameters = parameters
        self._taken: Mapping[str, Any] = MappingProxyType(self._runs.values(parameters))
        self._news: Parameters | None = None
        self._process, self._is_another_process = _process(info), False
        self._state: tuple[str, str] = (str(info["state"]), str(info.get("reason") or ""))
        self._lost = ""
        self._failed: Mapping[str, Any] | None = None
        self._refused: tuple[object, ParametersRefused] | None = None
        # The last trial: its run, its values, and whether the service has all of them.
        self._trial: tuple[Run, dict[str, Any], bool] | None = None
        self.first_hyperparameters: Mapping[str, Any] = self._taken
        self.last: Run | None = None
        try:
            self.last = self._runs.fetch((), parameters)
            self._shown.add(self.last)
        except EpypesError:  # no event has been completed yet, or there is no worker now
            pass

    # -- what a panel reads -------------------------------------------------------------------------------------

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values that the panel has taken over, by token: a snapshot."""
        return self._taken

    @property
    def revision(self) -> int:
        """The revision of the service's hyperparameters, as far as it is known here."""
        return self._parameters.revision

    @property
    def free_source_tokens(self) -> tuple[str, ...]:
        """The source tokens that an event brings."""
        known = {**self._taken, **self.cg.delays}
        return tuple(token for token in self.cg.source_tokens if token not in known)

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
        """Why the picture may not be the newest; empty if it is."""
        if self._lost:
            return f"The picture is the last one: {self._lost} It is tried again."
        state, reason = self._state
        text = f"{state}: {reason}" if reason else f"{state}."
        if state == "READY":
            return ""
        if state == "PAUSED":
            return f"The service is paused{text.removeprefix(state)} Its events wait."
        way_out = "" if state in ("STOPPED", "FAULTED") else " The worker may be starting again; the picture follows."
        return f"The service is {text}{way_out}"

    # -- what a panel does --------------------------------------------------------------------------------------

    def trial(self, values: Mapping[str, Any], /, *targets: str, payload: Mapping[str, Any] | None = None) -> Run:
        """Set hyperparameters of the service, and return its run with them.

        Parameters
        ----------
        values
            By token. A value that was changed concurrently, which the panel has not seen yet, is not set.
        targets
            The tokens to fetch; everything that can be without.
        payload
            None: a service has its events.

        Returns
        -------
        Run
            If the last event failed, its ``failure`` says so. If no event has come since the values were set, the last
            one is run again, on the state between events that it began with; the service's state stays as it is.

        Raises
        ------
        ServiceError
            The service is gone, or refuses the values.
        NotComputed
            It has not worked on an event yet.
        PayloadError
            A payload was given.
        """
        self._check(values, targets, payload)
        try:
            if self._lost:
                raise ServiceError(self.connection.url, self.notice)
            changed = self._set(values)
            if self._failed is not None and not changed and self.last is not None:
                run = self._runs.failed(self.last, self._failed, self._parameters)
            else:
                run = self._runs.fetch(targets, self._parameters)
                if run.failure is None:
                    self._shown.add(run)
        except ParametersRefused:
            raise
        except (ServiceError, NotComputed) as error:
            # The state of the service says more than that it has no answer.
            if self.notice:
                raise ServiceError(self.connection.url, self.notice) from error
            if isinstance(error, NotComputed):
                raise NotComputed("", self._waiting()) from error
            raise
        self._trial = run, dict(values), all(name in changed or self._has(name, values[name]) for name in values)
        return run

    def _waiting(self) -> str:
        """Return what a panel waits for where the service has no run to show."""
        try:
            answered = self.connection.info().get("counts", {}).get("answered", 0)
        except EpypesError:
            answered = 0
        address = self.connection.addresses.sub
        if not answered and self.last is None:
            return f"Waiting for the first event at {address}"
        before = "; the picture and its values are those before" if self.last is not None else ""
        return (
            f"No event since the bundle was deployed or its worker started again{before}. Waiting for one at {address}"
        )

    def adopt(self, run: Run, /) -> bool:
        """Take over a run of ``trial`` and its hyperparameters; return False if one was changed concurrently.

        Raises
        ------
        ValueError
            The run is not that of the last trial.
        """
        if self._trial is None or self._trial[0] is not run:
            raise InvalidValue("Only the run that this runner's trial() returned last can be adopted.")
        _, values, is_whole = self._trial
        if is_whole:
            now = self._runs.values(self._parameters)
            self._taken = MappingProxyType({**self._taken, **{name: now[name] for name in values}})
            self.last = run
        return is_whole

    def remembered(self, values: Mapping[str, Any], /, *targets: str) -> Run:
        """Return the run that the service has shown with these hyperparameters.

        Raises
        ------
        LookupError
            It has shown none since the connection was made.
        """
        run = self._shown.find({**self._taken, **values})
        if run is None or any(target not in run for target in targets):
            names = ", ".join(targets)
            raise LookupError(
                f"The service has not shown {names} with these values since it was connected to, and is not run on "
                "other values on the side. Set them, and compare with those of now."
            )
        return run

    def put(self, values: Mapping[str, Any], /) -> None:
        """Set hyperparameters of the service, but for those that were changed concurrently."""
        self._check(values, (), None)
        self._set(values)

    def catch_up(self) -> None:
        """Take over what was changed concurrently."""
        with self._lock:
            news, self._news = self._news, None
            is_another, self._is_another_process = self._is_another_process, False
        # What was on its way while a value was set is older than the service's answer to that.
        if news is not None and (is_another or news.revision > self._parameters.revision):
            self._take_over(news)

    def watch(self, callback: Callable[[], object], /) -> Callable[[], None]:
        """Call something without arguments when the service has reported something; return what ends that.

        It is called on a thread of its own. When the last callback is gone, that ends at the service's next event: the
        counts come each second.
        """

        # An object of its own for each call, so that one callback may be added twice and removed once.
        def entry() -> object:
            return callback()

        with self._lock:
            self._callbacks = (*self._callbacks, entry)
            if self._end_following is None:
                ended = self._end_following = threading.Event()
                threading.Thread(target=self._follow, args=(ended,), name="epypes-follower", daemon=True).start()

        def forget() -> None:
            with self._lock:
                self._callbacks = tuple(each for each in self._callbacks if each is not entry)
            if not self._callbacks:
                self._stop_following()

        return forget

    def close(self) -> None:
        """Call no callback any more."""
        self._callbacks = ()
        self._stop_following()

    def _stop_following(self) -> None:
        with self._lock:
            ended, self._end_following = self._end_following, None
        if ended is not None:
            ended.set()
        self._lost = ""

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
            if name not in self._taken:
                if self.cg.has_token(name):
                    raise HyperparameterError(name, f"Token {name!r} is no hyperparameter of this service.")
                raise UnknownName("hyperparameter", name, self._taken, "of this service")

    def _set(self, values: Mapping[str, Any]) -> set[str]:
        """Set the values that differ, and return their names; what was changed concurrently is left out."""
        request = (self._parameters.revision, dict(values))
        if self._refused is not None and self._refused[0] == request:
            raise self._refused[1]  # a panel that follows the events would request it at each of them
        seen = self._taken
        for _ in range(_MAX_TRIES):
            wanted = {
                name: value
                for name, value in values.items()
                if self._taken[name] is seen[name] and not self._has(name, value)
            }
            if not wanted:
                return set()
            try:
                self._parameters = self.connection.set(self._parameters.revision, **wanted)
            except RevisionConflict as conflict:
                self._take_over(conflict.current)
                continue
            except ParametersRefused as refused:
                self._refused = (self._parameters.revision, dict(values)), refused
                raise
            self._failed = None
            return set(wanted)
        text = f"Nothing was set: the parameters of {self.connection.url} were changed concurrently. Try again."
        raise ServiceError(self.connection.url, text)

    def _has(self, name: str, value: Any) -> bool:
        return self._runs.is_same(self._parameters, name, value)

    def _take_over(self, news: Parameters) -> None:
        """Take over what was changed concurrently: it is another object than before."""
        before, now = self._runs.values(self._parameters), self._runs.values(news)
        changed = {name: value for name, value in now.items() if name in before and value is not before[name]}
        self._parameters = news
        self._taken = MappingProxyType({**self._taken, **changed})

    # -- what the service reports, on the follower's thread -----------------------------------------------------

    def _follow(self, ended: threading.Event) -> None:
        wait_s = _FIRST_WAIT_S
        while not ended.is_set():
            reason, is_connected = "It ended the connection.", False
            try:
                for name, data in self.connection.events():
                    if ended.is_set():
                        return
                    if not is_connected:
                        is_connected, wait_s = True, _FIRST_WAIT_S
                        self._on_connected()
                    self._on_event(name, data)
            except EpypesError as error:
                reason = str(error)
            except Exception as error:
                _log.exception("An event of a service could not be handled")
                reason = f"{type(error).__name__}: {error}"
            if not ended.is_set():
                self._lost = reason
                self._notify()
            ended.wait(wait_s)
            wait_s = min(2 * wait_s, _LAST_WAIT_S)

    def _on_connected(self) -> None:
        info, news = self.connection.info(), self.connection.parameters()
        with self._lock:
            self._news = news
            # Another process counts revisions from 0 again.
            process, self._process = self._process, _process(info)
            self._is_another_process = self._is_another_process or process != self._process
        self._state, self._lost = (str(info["state"]), str(info.get("reason") or "")), ""
        self._notify()

    def _on_event(self, name: str, data: Mapping[str, Any]) -> None:
        if name == "run":
            self._failed = None
        elif name == "failure" and data.get("kind") != "dropped":
            self._failed = data
        elif name == "state":
            self._state = str(data.get("state", "")), str(data.get("reason") or "")
        elif name == "parameters":
            with self._lock:
                self._news = read_parameters(self.connection.url, data)
        else:
            return
        self._notify()

    def _notify(self) -> None:
        for callback in self._callbacks:
            try:
                callback()
            except Exception:
                _log.exception("A callback of a remote runner has failed")


def _process(info: Mapping[str, Any]) -> tuple[object, object]:
    return info.get("pid"), info.get("started_ns")


def _orders(connection: Connection, info: Mapping[str, Any]) -> dict[str, Order]:
    """Return the orders of colours by token: of the whole graph, or of its ports where the view can't be read."""
    try:
        tokens = connection.view()["tokens"]
        return {
            str(token["name"]): "rgb" if token["order"] == "rgb" else "bgr"
            for token in tokens
            if token.get("order") == "rgb" or token.get("order_by")
        }
    except (EpypesError, KeyError, TypeError, AttributeError):
        return {str(token): "rgb" for token in info.get("rgb", ())}
