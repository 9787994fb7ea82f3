"""The front of a service: a bundle between sockets or a broker's queues, which stays up whatever its functions do."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic, time_ns
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.errors import ServiceError
from epypes.service.bundle_info import BundleInfo, read_bundle_info
from epypes.service.deploy import Deployer
from epypes.service.dispatcher import Dispatcher
from epypes.service.endpoints import AnswerOutput, Endpoints, EventInput, group_address
from epypes.service.event_states import StateChoice, why_refused
from epypes.service.failures.record import FailedEvent
from epypes.service.failures.store import FailureStore, failures_folder
from epypes.service.lifecycle import Lifecycle, State
from epypes.service.options import ANY_PORT, Options
from epypes.service.parameters import ParameterControl, Parameters
from epypes.service.replication.replicas import Replicas
from epypes.service.result_publisher import EventLog, Latency, Listener, Provenance, ResultPublisher
from epypes.service.ros_messages import with_input_name
from epypes.service.sd_notify import notify
from epypes.service.state_file import ServiceState
from epypes.service.supervision.supervisor import Supervisor
from epypes.service.supervision.worker_queries import WorkerQueries
from epypes.service.tracing import EventTracer
from epypes.wire import Envelope, decode, encode

if TYPE_CHECKING:
    from epypes.bundle.writeback import WriteBack

# The share of a drain's time for working on accepted events; the rest is for reporting others, and for closing.
_DRAIN_SHARE: Final = 0.7
_CHANGE_TIMEOUT_S: Final = 10.0
_JOINING: Final = "joining the replicas"

_log = logging.getLogger("epypes.service")


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
    http, access_key_file
        Its HTTP address, and the file of the access key for that; set by the HTTP server.

    Raises
    ------
    BundleError
        The folder is not the bundle that was promoted.
    AddressError
        An address is not on loopback, or has messages of ROS 2 that can't be the events or answers of the bundle.
    ServiceError, StoreError
        The mailbox, a time-out or the number of threads is invalid, or the bundle has state between events, which these
        options would mix up; or the database can't be used.
    """

    def __init__(self, path: str | Path, sub: str = ANY_PORT, pub: str = ANY_PORT, **options: Any) -> None:
        given = Options(sub, pub, **options)
        given.check(path)
        bundle = read_bundle_info(path)
        if reason := why_refused(bundle.settings.states, given):
            raise ServiceError(bundle.path, reason)
        self.options = given = with_input_name(given, bundle)
        self.path, self.threads = bundle.path, given.threads
        self.job_timeout_s, self.drain_timeout_s = given.job_timeout_s, given.drain_timeout_s
        self.http = self.access_key_file = ""
        self.failure_store = FailureStore(failures_folder(bundle.path))
        self.event_log = EventLog(given, bundle.settings.name, self._provenance)
        answers = AnswerOutput(given.pub, given, self._changed)
        failures = AnswerOutput(given.failures, given, self._changed)
        tracer = EventTracer.configured(given.tracer_provider)
        self._results = ResultPublisher(answers, failures, self.failure_store, self.event_log, self._provenance, tracer)
        self._dispatcher = Dispatcher(given, self._results, self._provenance)
        events = EventInput(given, self._dispatcher.accept, self._dispatcher.accept_exhausted, self._changed)
        self._endpoints = Endpoints(events, answers, failures)
        change_timeout_s = min(given.job_timeout_s, _CHANGE_TIMEOUT_S)
        self._parameters = ParameterControl(bundle, self._dispatcher, self._results.notify, change_timeout_s)
        self._lifecycle = Lifecycle(self._dispatcher, self._endpoints, self._results, lambda: self._supervisor.health)
        self._supervisor = Supervisor(
            self._dispatcher, bundle, given.threads, given.job_timeout_s, self._parameters, self._lifecycle.check
        )
        self._queries = WorkerQueries(lambda: self._supervisor.bundle, lambda: self._dispatcher.connection)
        self._deployer = Deployer(
            self._dispatcher,
            self._supervisor,
            self._parameters,
            given.job_timeout_s,
            self._results.notify,
            self._why_refused,
        )
        self._replicas = Replicas(group_address(given), self._facts, self._parameters, self._joined)
        self._parameters.newest = self._replicas.newest
        self._started_ns = 0
        self._lock = threading.Lock()

    # -- start and stop -----------------------------------------------------------------------------------------------

    def start(self) -> ServiceState:
        """Bind the sockets, start a worker, wait until it has proved the bundle; return addresses and process.

        If the bundle can't be served the state is FAULTED, and `reason` says why.

        Raises
        ------
        AddressError
            An address can't be bound.
        """
        with self._lock:
            if not self._lifecycle.is_running:
                _warm_up()
                self._endpoints.start()
                self._lifecycle.is_running = True
                self._started_ns = time_ns()
                self._dispatcher.refuse("")
                self._dispatcher.reset_state()
                if self._replicas.is_shared:
                    # Until the parameters of the other replicas are known.
                    self._dispatcher.hold(_JOINING)
                self._replicas.start()
                self._supervisor.start()
                self._changed()
        self._dispatcher.wait_for(lambda: self.state != "LOADING", None)
        return self.service_state

    @property
    def service_state(self) -> ServiceState:
        """The contents of its state file."""
        addresses = self._endpoints.addresses
        return ServiceState(
            os.getpid(),
            addresses["sub"],
            addresses["pub"],
            self._supervisor.bundle.digest,
            addresses["failures"],
            self.http,
            self.access_key_file,
            self.options.replica,
            self.options.shows_failures,
            str(self._supervisor.bundle.path),
        )

    def stop(self, timeout_s: float | None = None) -> None:
        """Take no more events, answer or report those that were accepted, end the worker.

        Parameters
        ----------
        timeout_s
            Longest time, in seconds; drain_timeout_s without. An event that is not done in time is answered with a
            failure.
        """
        timeout_s = self.drain_timeout_s if timeout_s is None else timeout_s
        deadline_s = monotonic() + timeout_s
        with self._lock:
            if not self._lifecycle.is_running:
                return
            notify("STOPPING=1")
            self._lifecycle.close(timeout_s, is_stopping=True)
            self._lifecycle.wait_empty(timeout_s * _DRAIN_SHARE)
            self._lifecycle.give_up()
            self._supervisor.stop()
            self.failure_store.flush(max(deadline_s - monotonic(), 0.1))
            self.event_log.close(max(deadline_s - monotonic(), 0.1))
            # A broker that does not answer may take all the time that is left, also the replicas' share.
            share = 0.5 if self.options.has_broker else 1.0
            self._endpoints.stop(max((deadline_s - monotonic()) * share, 0.5))
            self._replicas.stop(max(deadline_s - monotonic(), 0.5))
            self._dispatcher.release(_JOINING)
            self._lifecycle.stopped()

    def abandon(self) -> int:
        """Kill the worker, and report all accepted events as not finished; return how many events that were."""
        self._supervisor.abandon()
        count = self._dispatcher.give_up("The service was stopped at once")
        self._dispatcher.publish()
        return count

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    # -- description --------------------------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """LOADING, READY, PAUSED, DEGRADED, DRAINING, FAULTED or STOPPED."""
        return self._lifecycle.state()[0]

    @property
    def reason(self) -> str:
        """Why it is in this state; empty if there is nothing to say."""
        return self._lifecycle.state()[1]

    @property
    def has_given_up(self) -> bool:
        """Whether it is FAULTED and no worker will be started any more, unless another bundle is deployed."""
        return self._supervisor.health.is_final

    def alive(self) -> str:
        """Return why nothing is computed, or will be; empty if something is, however busy it is."""
        health = self._supervisor.health
        if health.fault or health.stuck:
            return health.fault or f"{health.stuck}."
        overdue = self._dispatcher.overdue(self.job_timeout_s)
        return f"An event has been worked on for more than {self.job_timeout_s:g} s." if overdue else ""

    def ready(self) -> str:
        """Return why events would not be answered now; empty if they are."""
        state, reason = self._lifecycle.state()
        return "" if state == "READY" else reason or f"It is {state}."

    def counts(self) -> dict[str, int]:
        """Return how many events are where.

        ``received`` is the sum of answered, failed, dropped, dead_letters, waiting, in_flight and, where a broker
        delivers them, given_back; ``retried`` is how often events were tried again, ``redelivered`` how many had been
        delivered before, ``rejected`` how many messages were no events, ``slow_subscribers`` how often the queue of a
        subscriber of the answers filled up, so that at least one answer was lost to it; ``lost``, without a broker, how
        many events were sent and never came, by gaps in their senders' numbers.
        """
        return {**self._dispatcher.counts(), **self._endpoints.counts()}

    def group(self) -> dict[str, Any]:
        """Return the replicas that share its events, this one among them, JSON-ready."""
        return self._replicas.describe()

    def latency(self) -> Latency:
        """Return how long events took, from their acceptance to their answer."""
        return self._results.latency.read()

    def info(self) -> dict[str, Any]:
        """Return a description of the bundle, the processes and the state, JSON-ready."""
        import epypes

        state, reason = self._lifecycle.state()
        bundle, connection = self._supervisor.bundle, self._dispatcher.connection
        return {
            "name": bundle.settings.name,
            "bundle": str(bundle.path),
            "digest": bundle.digest,
            "inputs": list(bundle.settings.inputs),
            "outputs": list(bundle.settings.outputs),
            "rgb": list(bundle.settings.rgb),
            "colours": {token: str(found) for token, found in bundle.settings.colours.items()},
            "func_io": {} if connection is None else dict(connection.about.get("func_io", {})),
            "pid": os.getpid(),
            "worker_pid": None if connection is None else connection.pid,
            "versions": {"epypes": epypes.__version__, "python": sys.version.split()[0]},
            "state": state,
            "reason": reason,
            "replica": self.options.replica,
            "threads": self.threads,
            "revision": self._parameters.current.revision,
            "addresses": {**self._endpoints.addresses, "http": self.http},
            "shows_failures": self.options.shows_failures,
            "started_ns": self._started_ns,
            "restarts": self._supervisor.health.restarts,
            "counts": self.counts(),
            "states": self._dispatcher.describe_states(),
        }

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Call a function with whatever happens from now on; return what ends that.

        Parameters
        ----------
        callback
            Called on threads of the service with a kind (``"state"``, ``"run"``, ``"failure"``, ``"parameters"``,
            ``"deployed"``: another bundle, or other values in it) and its data. It must return at once, and change
            nothing of the service.
        """
        return self._results.listen(callback)

    def _changed(self) -> None:
        self._lifecycle.changed()

    def _facts(self) -> dict[str, Any]:
        """Return what this replica publishes to the others."""
        state, reason = self._lifecycle.state()
        name, replica = self._supervisor.bundle.settings.name, self.options.replica
        about = {"state": state, "reason": reason, "counts": self.counts(), "http": self.http}
        return {"replica": replica, "name": name, **about}

    def _provenance(self) -> Provenance:
        bundle, current = self._supervisor.bundle, self._parameters.current
        return Provenance(bundle.settings.name, str(bundle.path), bundle.digest, current.revision, current.entries)

    def _why_refused(self, bundle: BundleInfo) -> str:
        """Return why a bundle can't be served with these options, and beside these replicas; empty if it can."""
        return why_refused(bundle.settings.states, self.options, self._replicas.others())

    def _joined(self) -> None:
        """Work on events, now that the other replicas are known; unless the bundle can't be served beside them."""
        with self._dispatcher.lock:
            if reason := self._why_refused(self._supervisor.bundle):
                self._supervisor.refuse(reason)
        self._dispatcher.release(_JOINING)
        self._dispatcher.publish()

    # -- operation ----------------------------------------------------------------------------------------------------

    def pause(self) -> None:
        """Have events wait in the mailbox."""
        self._lifecycle.pause()

    def resume(self) -> None:
        """Work on events again, also after `pause` and `drain`."""
        with self._lock:
            self._lifecycle.resume()

    def drain(self, timeout_s: float | None = None) -> bool:
        """Take no more events, until `resume`, and finish those that were accepted; return whether that was done."""
        timeout_s = self.drain_timeout_s if timeout_s is None else timeout_s
        with self._lock:
            if not self._lifecycle.is_running:
                return True
            self._lifecycle.close(timeout_s)
        is_done = self._lifecycle.wait_empty(timeout_s)
        if is_done and self._lifecycle.is_draining:
            self._lifecycle.leave(timeout_s)
        return is_done

    def deploy(self, path: str | Path, state: StateChoice | None = None) -> dict[str, Any]:
        """Serve another bundle from now on; return `info`, and which values changed.

        A second worker proves it beside the first one, and gets the events when none is worked on. It has its own
        parameters, with the next revision: ``changed`` has a line for each value that differs, as
        ``"sigma 1.4 -> 1.0 (tuned, not written back)"``, and one that says whether the state between events is kept.

        Parameters
        ----------
        path
            The bundle.
        state
            Whether to ``"keep"`` or ``"reset"`` the state between events. Without, it is kept if both bundles delay the
            same tokens with the same initial values.

        Raises
        ------
        DeployRefused
            It does not compute what was recorded, or has other ports, or can't keep the state; the bundle that is
            served goes on.
        ServiceError
            A deploy, a rollback or a write-back is running already.
        """
        return {"changed": self._deployer.deploy(path, state), **self.info()}

    def rollback(self, state: StateChoice | None = None) -> dict[str, Any]:
        """Serve the bundle again that was served before; return what `deploy` returns.

        The bundle that is left is the one before then, so a second rollback undoes the first.

        Raises
        ------
        DeployRefused
            There was none, or it was changed since.
        """
        return {"changed": self._deployer.rollback(state), **self.info()}

    def reset(self, source: str | None = None) -> int:
        """Have the next event begin with the initial state, as if it were the first; return how many states were reset.

        Parameters
        ----------
        source
            Whose state; every state without.

        Raises
        ------
        UnknownName
            There is no state of this source.
        ServiceError
            The bundle has no state between events; or all sources have one.
        """
        if not self._supervisor.bundle.settings.states:
            text = "There is nothing to reset: no bundle with state between events (ep.delay) is served."
            raise ServiceError(self._supervisor.bundle.path, text)
        count = self._dispatcher.reset_state(source)
        _log.info("the state %s is reset", "between events" if source is None else f"of source {source!r:.80}")
        return count

    # -- its parameters ---------------------------------------------------------------------------------------------

    def parameters(self) -> Parameters:
        """Return the hyperparameters, their ranges and their revision."""
        return self._parameters.current

    def set_parameters(self, values: Mapping[str, Any], revision: int | None = None) -> Parameters:
        """Change hyperparameters between two events, all of them or none; return all of them.

        Parameters
        ----------
        values
            By token, as JSON has them.
        revision
            The revision that the caller knows; None to change them whatever it is.

        Raises
        ------
        RevisionConflict
            They have another revision by now.
        ParametersRefused
            There is no such token, or a value is not within its range.
        ServiceError
            There is no worker, or it is busy for too long.
        """
        return self._replicas.set(values, revision)

    def write_back(self, *, dry_run: bool = False) -> WriteBack:
        """Write the parameters into the pipeline.toml of the bundle that is served; return the diff and its digest.

        The service goes on with the bundle that has them.

        Raises
        ------
        BundleError
            The bundle was changed, or can't be written.
        ServiceError
            A deploy, a rollback or a write-back is running already.
        """
        return self._deployer.write_back(dry_run=dry_run)

    # -- what is seen of it -----------------------------------------------------------------------------------------

    def view(self) -> bytes:
        """Return the graph with the values of the last completed run, as JSON of a GraphView."""
        return self._queries.graph("view")

    def graph_svg(self) -> bytes:
        """Return the graph with the values of the last completed run, as a picture."""
        return self._queries.graph("svg")

    def preview(self, token: str, max_side_px: int = 512) -> tuple[str, bytes]:
        """Return the media type and the bytes of a picture or text of a token in the last completed run."""
        return self._queries.preview(token, max_side_px)

    def run(self, tokens: Sequence[str] = (), revision: int | None = None) -> bytes:
        """Return tokens of the last completed run, or of one with this revision, as one packed Envelope."""
        return self._queries.run(tokens, revision)

    def failure_records(self, limit: int | None = None) -> list[FailedEvent]:
        """Return the records of failures, the newest first."""
        return self.failure_store.records(limit)


def _warm_up() -> None:
    """Load what the first event needs: where memory is limited that fails now, and not at an event."""
    import numpy as np

    decode(encode(Envelope("epypes.warm_up", {"array": np.zeros(1)})))
