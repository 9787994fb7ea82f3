"""What is a service? A bundle between sockets, that stays up whatever its functions do."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic, time_ns
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.service.about import about
from epypes.service.announcing import Announcer
from epypes.service.asks import Asks
from epypes.service.deploying import Deployer
from epypes.service.desk import Desk, Listener
from epypes.service.dispatch import Dispatcher
from epypes.service.eventlog import EventLog
from epypes.service.failures.record import FailureRecord
from epypes.service.failures.store import FailureStore, failures_folder
from epypes.service.group.peers import Parts, peers_of
from epypes.service.intake import Intake
from epypes.service.latency import Latency
from epypes.service.notify import notify
from epypes.service.options import ANY_PORT, Options
from epypes.service.outcome import Setting
from epypes.service.parameters import Parameters
from epypes.service.served import read_served
from epypes.service.sockets import Sockets
from epypes.service.state import ServiceState
from epypes.service.states import Facts, State
from epypes.service.supervisor import Supervisor
from epypes.service.tuning import Tuning
from epypes.transport.zeromq.channel import prepare_lending
from epypes.wire import Envelope, decode, encode

if TYPE_CHECKING:
    from epypes.bundle.writeback import WriteBack

# What of a drain's time is left for reporting what could not be worked off, and for closing.
_DRAIN_SHARE: Final = 0.7
_CHANGE_S: Final = 10.0
# While it is so, other replicas are better off with a broker's events.
_OF_NO_USE: Final = ("STOPPED", "LOADING", "FAULTED")


class Service:
    """A bundle's FullPipeline between sockets: the front, which executes none of the bundle's code.

    Parameters
    ----------
    path
        The bundle.
    sub, pub, options
        As the attributes of `Options`.

    Attributes
    ----------
    http, token_file
        Where it answers over HTTP, and where the token for that is kept; set by who serves it there.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    AddressError
        An address is not on loopback.
    ServiceError, StoreError
        The mailbox, a time or the number of threads can't be; or the database.
    """

    def __init__(self, path: str | Path, sub: str = ANY_PORT, pub: str = ANY_PORT, **options: Any) -> None:
        self.options = given = Options(sub, pub, **options)
        given.check(path)
        served = read_served(path)
        self.path, self.threads = served.path, given.threads
        self.job_timeout_s, self.drain_timeout_s = given.job_timeout_s, given.drain_timeout_s
        self.http = self.token_file = ""
        self.failure_store = FailureStore(failures_folder(served.path))
        self.event_log = EventLog(given.store, served.settings.name, self._setting, given.replica)
        self._desk = Desk(
            lambda *answer: self._sockets.answer(*answer),
            lambda item: self._sockets.report(item),
            lambda: self.failure_store,
            self.event_log,
            self._setting,
        )
        self._dispatcher = Dispatcher(given.ledger(), self._desk, self._setting)
        self._tuning = Tuning(served, self._dispatcher, self._desk, min(given.job_timeout_s, _CHANGE_S))
        self._announcer = Announcer(self._dispatcher, self._desk, self._facts, self._follow)
        settling = self._tuning.for_new_worker, self._announcer.look, self._tuning.heard
        self._supervisor = Supervisor(self._dispatcher, served, given.threads, given.job_timeout_s, *settling)
        self._asks = Asks(lambda: self._supervisor.served, lambda: self._dispatcher.link)
        self._sockets = Sockets(given, self._dispatcher, self._changed)
        self._intake = Intake(self._dispatcher, self._sockets, self._changed, lambda: self.state not in _OF_NO_USE)
        self._is_running = False
        self._started_ns = 0
        self._deployer = Deployer(
            self._dispatcher, self._supervisor, self._tuning, given.job_timeout_s, self._desk.tell
        )
        told = self._health, self._sockets.entrance, self._changed
        self._peers = peers_of(Parts(given, self._dispatcher, self._desk, self._tuning, *told))
        self._turn = threading.Lock()

    # -- beginning and end ----------------------------------------------------------------------------------------

    def start(self) -> ServiceState:
        """Bind the sockets, start a worker, wait until it has proved the bundle; return what is to be known of it.

        If the bundle can't be served the state is FAULTED, and `reason` says why.

        Raises
        ------
        AddressError
            An address can't be bound.
        """
        with self._turn:
            if not self._is_running:
                _warm_up()
                self._sockets.start()
                self._is_running = True
                self._started_ns = time_ns()
                self._dispatcher.refuse("")
                self._peers.start()
                self._supervisor.start()
                self._changed()
        self._dispatcher.wait_for(lambda: self.state != "LOADING", None)
        return self.service_state

    @property
    def service_state(self) -> ServiceState:
        """What is to be known of it, for its state file."""
        where = self._sockets.addresses
        digest = self._supervisor.served.digest
        return ServiceState(
            os.getpid(),
            where["sub"],
            where["pub"],
            digest,
            where["failures"],
            self.http,
            self.token_file,
            self.options.replica,
            self.options.shows_failures,
        )

    def stop(self, timeout_s: float | None = None) -> None:
        """Take no more events, answer or report those that were accepted, end the worker; bounded by ``timeout_s``.

        Without it, by drain_timeout_s. What could not be worked off in time is answered with a failure.
        """
        timeout_s = self.drain_timeout_s if timeout_s is None else timeout_s
        deadline_s = monotonic() + timeout_s
        with self._turn:
            if not self._is_running:
                return
            notify("STOPPING=1")
            self._intake.close(timeout_s, for_good=True)
            self._intake.work_off(timeout_s * _DRAIN_SHARE)
            self._peers.give_up()
            self._intake.give_up()
            self._supervisor.stop()
            self.failure_store.flush(max(deadline_s - monotonic(), 0.1))
            self.event_log.close(max(deadline_s - monotonic(), 0.1))
            # A broker that does not answer may take all the time that there is, from the group too.
            share = 0.5 if self.options.has_broker else 1.0
            self._sockets.stop(max((deadline_s - monotonic()) * share, 0.5))
            self._peers.stop(max(deadline_s - monotonic(), 0.5))
            self._is_running = self._intake.is_draining = self._intake.is_stopping = self._dispatcher.is_closed = False
            self._changed()

    def abandon(self) -> int:
        """Kill the worker, and report all that was accepted as not finished; return how many events that were."""
        self._supervisor.abandon()
        count = self._dispatcher.give_up("The service was stopped at once")
        self._dispatcher.publish()
        return count

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    # -- how it is --------------------------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """LOADING, READY, PAUSED, DEGRADED, DRAINING, FAULTED or STOPPED."""
        return self._state()[0]

    @property
    def reason(self) -> str:
        """Why it is in this state; empty if there is nothing to say."""
        return self._state()[1]

    @property
    def has_given_up(self) -> bool:
        """Whether it is FAULTED and no worker will be started any more, unless another bundle is deployed."""
        return self._supervisor.health.is_final

    def _state(self) -> tuple[State, str]:
        return self._announcer.state()

    def _facts(self) -> Facts:
        health, has_worker = self._supervisor.health, self._dispatcher.link is not None
        is_so = self._is_running, self._intake.is_draining, self._intake.is_paused
        return Facts(*is_so, has_worker, health.was_ready, health.fault, health.trouble, self._sockets.trouble)

    def alive(self) -> str:
        """Return why nothing is computed, or will be; empty if something is, however busy it is."""
        health = self._supervisor.health
        if health.fault or health.stuck:
            return health.fault or f"{health.stuck}."
        late = self._dispatcher.overdue(int(self.job_timeout_s * 1e9))
        return f"An event has been worked on for more than {self.job_timeout_s:g} s." if late else ""

    def ready(self) -> str:
        """Return why events would not be answered now; empty if they are."""
        state, reason = self._state()
        return "" if state == "READY" else reason or f"It is {state}."

    def counts(self) -> dict[str, int]:
        """Return how many events are where.

        ``received`` is the sum of answered, failed, dropped, dead_letters, waiting, in_flight and, where a broker
        delivers them, given_back; ``retried`` is how often events were tried again, ``redelivered`` how many had been
        delivered before, ``rejected`` how many messages were no events, ``slow_subscribers`` how often the queue of a
        subscriber of the answers filled up, so that at least one answer was lost to it; ``lost``, without a broker, how
        many events were sent and never came, by gaps in their senders' numbers.
        """
        with self._dispatcher.changed:
            counts = self._dispatcher.ledger.counts()
        entrance = self._sockets.entrance
        counts |= {"rejected": entrance.rejected, "slow_subscribers": self._sockets.answers.slow_subscribers}
        return {**counts, **entrance.counts(), **self._peers.counts()}

    def group(self) -> dict[str, Any]:
        """Return what there is to know of the replicas that share its events, this one among them, JSON-ready."""
        return self._peers.told()

    def _health(self) -> dict[str, Any]:
        state, reason = self._state()
        name = self._supervisor.served.settings.name
        return {"name": name, "state": state, "reason": reason, "counts": self.counts(), "http": self.http}

    def latency(self) -> Latency:
        """Return how long events took, from their acceptance to their answer."""
        return self._desk.latency.read()

    def info(self) -> dict[str, Any]:
        """Return what there is to know of it, JSON-ready."""
        state, reason = self._state()
        return {
            **about(self._supervisor.served, self._dispatcher.link),
            "state": state,
            "reason": reason,
            "replica": self.options.replica,
            "threads": self.threads,
            "revision": self._tuning.current.revision,
            "addresses": {**self._sockets.addresses, "http": self.http},
            "shows_failures": self.options.shows_failures,
            "started_ns": self._started_ns,
            "restarts": self._supervisor.health.restarts,
            "counts": self.counts(),
        }

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Have it told to a callback what happens; return what ends that.

        Parameters
        ----------
        callback
            Called on threads of the service with a kind (``"state"``, ``"run"``, ``"failure"``, ``"parameters"``,
            ``"deployed"``: another bundle, or other values in it) and what there is to know. It must return at once,
            and change nothing of the service.
        """
        return self._desk.listen(callback)

    def _changed(self) -> None:
        self._announcer.changed()

    def _follow(self, before: State, now: State) -> None:
        if (before in _OF_NO_USE) != (now in _OF_NO_USE):
            self._intake.follow()

    def _setting(self) -> Setting:
        served, current = self._supervisor.served, self._tuning.current
        return Setting(served.settings.name, str(served.path), served.digest, current.revision, current.entries)

    # -- what it is told to do --------------------------------------------------------------------------------------

    def pause(self) -> None:
        """Have events wait in the mailbox."""
        self._intake.pause()

    def resume(self) -> None:
        """Work on events again, also after `pause` and `drain`."""
        with self._turn:
            self._intake.resume()

    def drain(self, timeout_s: float | None = None) -> bool:
        """Take no more events, until `resume`, and work off those that were accepted; return whether that was done."""
        timeout_s = self.drain_timeout_s if timeout_s is None else timeout_s
        with self._turn:
            if not self._is_running:
                return True
            self._intake.close(timeout_s)
        is_done = self._intake.work_off(timeout_s)
        if is_done and self._intake.is_draining:
            self._intake.leave(timeout_s)
        return is_done

    def deploy(self, path: str | Path) -> dict[str, Any]:
        """Serve another bundle from now on; return what there is to know of the service then.

        A second worker proves it beside the first one, and gets the events when none is worked on. It has its own
        parameters, with the next revision: ``changed`` of what is returned has a line for each value that is another
        one now, as ``"sigma 1.4 -> 1.0 (tuned, not written back)"``.

        Raises
        ------
        DeployRefused
            It does not compute what was recorded, or has other ports; the one that is served goes on.
        ServiceError
            Another one is being deployed.
        """
        return {"changed": self._deployer.deploy(path), **self.info()}

    def rollback(self) -> dict[str, Any]:
        """Serve the bundle again that was served before; return what `deploy` returns.

        The one that is left is the one before then: to roll back twice is to be where one was.

        Raises
        ------
        DeployRefused
            There was none, or it is not any more what it was.
        """
        return {"changed": self._deployer.rollback(), **self.info()}

    # -- its parameters ---------------------------------------------------------------------------------------------

    def parameters(self) -> Parameters:
        """Return the hyperparameters, their ranges and their revision."""
        return self._tuning.current

    def set_parameters(self, values: Mapping[str, Any], revision: int | None = None) -> Parameters:
        """Change hyperparameters between two events, all of them or none; return what they are then.

        Parameters
        ----------
        values
            By token, as JSON has them.
        revision
            The one that is known to who changes them; None to change them whatever it is.

        Raises
        ------
        RevisionConflict
            They have another revision by now.
        ParametersRefused
            There is no such token, or a value is not within its range.
        ServiceError
            There is no worker, or it is busy for too long.
        """
        return self._peers.set(values, revision)

    def write_back(self, *, dry_run: bool = False) -> WriteBack:
        """Write the parameters into the pipeline.toml of the bundle that is served; return the diff and its digest.

        The service goes on with the bundle that has them.

        Raises
        ------
        BundleError
            The bundle was changed, or can't be written.
        ServiceError
            Another one is being deployed.
        """
        return self._deployer.write_back(dry_run=dry_run)

    # -- what is seen of it -----------------------------------------------------------------------------------------

    def view(self) -> bytes:
        """Return the graph with the values of the last completed run, as JSON of a GraphView."""
        return self._asks.graph("view")

    def graph_svg(self) -> bytes:
        """Return the graph with the values of the last completed run, as a picture."""
        return self._asks.graph("svg")

    def preview(self, token: str, max_side_px: int = 512) -> tuple[str, bytes]:
        """Return the media type and the bytes of a picture or text of a token in the last completed run."""
        return self._asks.preview(token, max_side_px)

    def run(self, tokens: Sequence[str] = (), revision: int | None = None) -> bytes:
        """Return tokens of the last completed run, or of one with this revision, as one packed Envelope."""
        return self._asks.run(tokens, revision)

    def failure_records(self, limit: int | None = None) -> list[FailureRecord]:
        """Return what is known of failures, the newest first."""
        return self.failure_store.records(limit)


def _warm_up() -> None:
    """Load what the first event needs: where memory is limited that fails now, and not at an event."""
    import numpy as np

    prepare_lending()
    decode(encode(Envelope("epypes.warm_up", {"array": np.zeros(1)})))
