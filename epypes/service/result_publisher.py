"""Results of events: how they are published, and reported to the failure store, the event log and listeners.

The sender gets the answer first. When the answer is confirmed, the result is logged, kept and counted: a ZeroMQ socket,
DDS and Zenoh confirm what they have taken.
"""

from __future__ import annotations

import logging
import threading
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from time import perf_counter_ns, time_ns
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.errors import MailboxOverflow, MessageError, ServiceError
from epypes.run import Failure
from epypes.service.failures.record import FAILURE_TOPIC, FailedEvent
from epypes.store.writer import SeriesWriter
from epypes.transport.channel import Confirmed
from epypes.transport.throttle import Throttle
from epypes.wire import EncodedEnvelope, failure_event
from epypes.wire.envelope import request_fields

if TYPE_CHECKING:
    from epypes.service.dispatcher import AcceptedEvent
    from epypes.service.endpoints import AnswerOutput
    from epypes.service.failures.store import FailureStore
    from epypes.service.options import Options
    from epypes.service.supervision.frame_socket import WorkerMessage
    from epypes.service.tracing import EventTracer

Outcome = Literal["answered", "failed", "dead_letters"]
FailureKind = Literal["raised", "killed", "stuck", "dropped", "exhausted"]
# Called with a kind of message ("state", "run", "failure", "parameters", "deployed") and its contents.
Listener = Callable[[str, dict[str, Any]], None]

# Log texts of an event that failed outside of its graph.
_FAILED: Final = {"f_in": "could not be read (f_in)", "f_out": "has an answer that could not be given (f_out)"}
# Of the series that the event log is in.
_KIND: Final = "events"
_RECORDED: Final = ("function", "tokens", "exception", "message", "trace")
# Upper bounds of the latency histogram in seconds: from a trivial graph to the longest job time-outs.
BOUNDS_S: Final = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)

_log = logging.getLogger("epypes.service")


@dataclass(frozen=True, slots=True)
class Provenance:
    """What a result was computed with: the bundle and its parameters."""

    name: str
    bundle: str
    digest: str
    revision: int
    entries: Mapping[str, Mapping[str, Any]]


@dataclass(slots=True)
class Result:
    """The answers to an event, and what is reported of it.

    Attributes
    ----------
    answers
        Encoded envelopes, or bytes for peers of 2019.
    failure
        None, or the record of its failure.
    revision, total_ns
        Of the run; 0 where there was none.
    durations_ns
        By function.
    """

    answers: Sequence[EncodedEnvelope | bytes]
    failure: FailedEvent | None = None
    revision: int = 0
    total_ns: int = 0
    durations_ns: Mapping[str, int] = field(default_factory=dict)

    @property
    def outcome(self) -> Outcome:
        """How the event is counted."""
        if self.failure is None:
            return "answered"
        return "dead_letters" if self.failure.dead_letter else "failed"


# -- results, by cause ------------------------------------------------------------------------------------------------


def worker_result(event: AcceptedEvent, message: WorkerMessage, provenance: Callable[[], Provenance]) -> Result:
    """Return the result of a worker's ``done`` message."""
    done, frames = message.content, message.frames
    answers: list[EncodedEnvelope | bytes] = []
    begin = 0
    for count in done["answers"]:
        own, begin = frames[begin : begin + count], begin + count
        answers.append(bytes(own[0]) if count == 1 else EncodedEnvelope.read(own))
    failure = done["failure"]
    record = _record(event, failure, provenance(), "raised") if failure else None
    return Result(answers, record, done["revision"], done["total_ns"], done["durations_ns"])


def failed_result(
    event: AcceptedEvent,
    error: Exception,
    provenance: Provenance,
    kind: FailureKind,
    *,
    function: str = "",
    is_dead: bool = False,
) -> Result:
    """Return the result of an event that the front answers, since no worker does."""
    function = function or ("mailbox" if kind == "dropped" else "worker")
    known = {"function": function, "exception": type(error).__name__, "message": str(error)}
    record = replace(_record(event, known, provenance, kind), dead_letter=is_dead)
    failure = Failure(function, (), {}, error, event.id, max(event.attempts, 1))
    request = event.delivery.envelope
    stamp = {} if request is None else request_fields(request)
    answer = failure_event(failure, provenance.name, provenance.digest)
    answer = replace(answer, revision=provenance.revision, **stamp)
    return Result([EncodedEnvelope.encode(answer)], record, provenance.revision)


def dropped_result(event: AcceptedEvent, reason: str, provenance: Provenance) -> Result:
    """Return the result of an event that is not worked on."""
    error = MessageError("dropped", f"The service dropped this event: {reason}. Send it again later.")
    return failed_result(event, error, provenance, "dropped")


def overflow_reason(policy: str, size: int) -> str:
    """Return why an event is dropped when the mailbox is full."""
    if policy == "fault":
        return str(MailboxOverflow(size)).partition(".")[0].replace("The", "the", 1)
    return "it has more events than it can answer"


def dead_letter_result(event: AcceptedEvent, ending: str, function: str, provenance: Provenance) -> Result:
    """Return the result of an event that killed the worker too often."""
    times = "once" if event.deaths == 1 else f"{event.deaths} times"
    text = f"{ending} while it computed this event alone ({times}). The event is a dead letter."
    error = ServiceError(provenance.bundle, text)
    return failed_result(event, error, provenance, "killed", function=function, is_dead=True)


def exhausted_result(event: AcceptedEvent, provenance: Provenance) -> Result:
    """Return the result of an event that a broker has delivered too often."""
    text = f"This event was delivered {event.attempts} times before, and never answered. It is a dead letter."
    return failed_result(event, ServiceError(provenance.bundle, text), provenance, "exhausted", is_dead=True)


def _record(event: AcceptedEvent, known: Mapping[str, Any], provenance: Provenance, kind: FailureKind) -> FailedEvent:
    return FailedEvent(
        event_id=event.id,
        kind=known.get("kind") or kind,
        attempt=event.attempts,
        when_ns=time_ns(),
        bundle=provenance.bundle,
        digest=provenance.digest,
        revision=provenance.revision,
        hyperparameters=provenance.entries,
        **{name: known[name] for name in _RECORDED if name in known},
    )


# -- latency ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Latency:
    """Durations from the acceptance of events to their answers.

    Attributes
    ----------
    bounds_s
        Upper bounds of the buckets, in seconds.
    counts
        How many durations are in each bucket, one more for those beyond the last bound.
    count, total_s
        How many there are, and their sum in seconds.
    computing_s
        How much of it the graph took.
    functions_s
        How much of that each function took.
    """

    bounds_s: tuple[float, ...]
    counts: tuple[int, ...]
    count: int
    total_s: float
    computing_s: float
    functions_s: Mapping[str, float]


class LatencyHistogram:
    """Counts durations by bucket."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._total_ns = self._computing_ns = 0
        self._functions_ns: dict[str, int] = {}

    def observe(self, duration_ns: int, computing_ns: int, functions_ns: Mapping[str, int]) -> None:
        """Count a duration, and how much of it the graph and each function took, in nanoseconds."""
        self._counts[bisect_left(BOUNDS_S, duration_ns / 1e9)] += 1
        self._total_ns += duration_ns
        self._computing_ns += computing_ns
        for function, spent_ns in functions_ns.items():
            self._functions_ns[function] = self._functions_ns.get(function, 0) + spent_ns

    def read(self) -> Latency:
        """Return the counts."""
        counts = tuple(self._counts)
        # Another thread may add a function meanwhile; a copy is made in one step.
        functions_s = {function: spent_ns / 1e9 for function, spent_ns in self._functions_ns.copy().items()}
        return Latency(BOUNDS_S, counts, sum(counts), self._total_ns / 1e9, self._computing_ns / 1e9, functions_s)


# -- event log -------------------------------------------------------------------------------------------------------


class EventLog:
    """A row of each event, in the series ``events`` of the bundle's name; nothing waits for the database.

    Parameters
    ----------
    options
        Of the service: the store, which is a path or a URL or None, and the name of the replica.
    name
        Of the bundle.
    provenance
        Returns what events are worked on with.

    Raises
    ------
    StoreError
        There can be no such database. One that is away is reported in the log.
    """

    def __init__(self, options: Options, name: str, provenance: Callable[[], Provenance]) -> None:
        self._options, self._provenance, self._began_ns = options, provenance, time_ns()
        self._writer = None if options.store is None else SeriesWriter(options.store, _KIND, name)

    def keep(self, event: AcceptedEvent, result: Result, failure: FailedEvent | None) -> None:
        """Have a row of an event written; returns at once and raises nothing."""
        if self._writer is not None:
            row = _row(event, result, failure, self._provenance().digest)
            if self._options.has_broker:
                row |= {"deliveries": event.delivery.attempt, "replica": self._options.replica}
            self._writer.append(f"{self._began_ns}-{event.seq}", row)

    def counts(self) -> Mapping[str, int]:
        """Return how many rows were written, skipped and so on, as `SeriesWriter.counts`; none without a store."""
        return {} if self._writer is None else self._writer.counts()

    def close(self, timeout_s: float) -> None:
        """Write all rows that wait; those that are not written in time are reported in the log. More may follow."""
        if self._writer is not None and not self._writer.close(timeout_s):
            _log.warning("%d rows of events could not be stored in time", self._writer.counts()["waiting"])


def _row(event: AcceptedEvent, result: Result, failure: FailedEvent | None, digest: str) -> dict[str, Any]:
    now_ns = time_ns()
    row = {
        "seq": event.seq,
        "event_id": event.id,
        "outcome": "answered",
        "received_ns": now_ns - (perf_counter_ns() - event.accepted_ns),
        "answered_ns": now_ns,
        "total_ns": result.total_ns,
        "times_ns": dict(result.durations_ns),
        "attempts": event.attempts,
        "revision": result.revision,
        "digest": digest,
    }
    return row if failure is None else {**row, **_of_failure(failure, result)}


def _of_failure(failure: FailedEvent, result: Result) -> dict[str, Any]:
    """Return what a row has besides if the event failed; ``failure`` is the id to open it by."""
    dropped = failure.kind == "dropped"
    return {
        "outcome": "dropped" if dropped else result.outcome.removesuffix("s"),
        "failure": failure.id,
        "function": failure.function,
        "exception": failure.exception,
        "message": failure.message,
        "digest": failure.digest,
    }


# -- publishing -------------------------------------------------------------------------------------------------------


class ResultPublisher:
    """Publishes results, keeps failures and calls listeners.

    Parameters
    ----------
    answers, failures
        Where answers go, and where failures are published.
    store
        Where failures are kept.
    event_log
        Where a row of each event is kept.
    provenance
        Returns what events are computed with now.
    tracer
        Makes the spans of events; None for none.

    Attributes
    ----------
    on_settled
        Called with an event, the result that was published, and None; or with the reason why it was not.
    """

    def __init__(
        self,
        answers: AnswerOutput,
        failures: AnswerOutput,
        store: FailureStore,
        event_log: EventLog,
        provenance: Callable[[], Provenance],
        tracer: EventTracer | None,
    ) -> None:
        self._answers, self._failures, self._tracer = answers, failures, tracer
        self._store, self._event_log, self._provenance = store, event_log, provenance
        self._listeners: list[Listener] = []
        self.on_settled: Callable[[AcceptedEvent, Result, Exception | None], object] = lambda *_: None
        self.latency = LatencyHistogram()
        self._throttle = Throttle(_log)

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Call a function with every message to listeners from now on; return what ends that."""
        self._listeners.append(callback)

        def forget() -> None:
            if callback in self._listeners:
                self._listeners.remove(callback)

        return forget

    def notify(self, kind: str, data: dict[str, Any]) -> None:
        """Call the listeners; what they raise is logged."""
        for callback in tuple(self._listeners):
            try:
                callback(kind, data)
            except Exception:
                _log.exception("a listener failed")

    def publish(self, event: AcceptedEvent, result: Result) -> None:
        """Publish the answers to an event, and report its result once they are confirmed."""
        confirmed: Confirmed = partial(self._confirmed, event, result)
        if not result.answers:
            confirmed(None)
            return
        if len(result.answers) > 1:
            confirmed = _Countdown(len(result.answers), confirmed).one
        for number, answer in enumerate(result.answers, 1):
            # Numbered, so that the second answer is no duplicate of the first.
            own_id = f"{event.id}/{number}" if event.id and number > 1 else event.id
            self._answers.publish(answer, own_id, confirmed)

    def _confirmed(self, event: AcceptedEvent, result: Result, error: Exception | None) -> None:
        if isinstance(error, MessageError):
            if result.failure is None:
                # It can never be sent, so the sender gets that as a failure.
                refusal = failed_result(event, error, self._provenance(), "raised", function="f_out")
                self.publish(event, refusal)
                return
            error = None
        try:
            if error is None:
                self._report(event, result)
        finally:
            self.on_settled(event, result, error)

    def report_lost(self, event: AcceptedEvent, result: Result, error: Exception) -> Result:
        """Report an event whose answer was lost and that no broker keeps; return its result."""
        if result.failure is None:
            result = failed_result(event, error, self._provenance(), "raised", function="f_out")
        self._report(event, result)
        return result

    def _report(self, event: AcceptedEvent, result: Result) -> None:
        if self._tracer is not None:
            self._tracer.trace(event, result, self._provenance())
        if result.failure is not None:
            self._event_log.keep(event, result, self._report_failure(event, result, result.failure))
            return
        self._event_log.keep(event, result, None)
        self.latency.observe(perf_counter_ns() - event.accepted_ns, result.total_ns, result.durations_ns)
        if self._listeners:
            data = {"seq": event.seq, "event_id": event.id, "revision": result.revision}
            self.notify("run", {**data, "total_ns": result.total_ns})

    def _report_failure(self, event: AcceptedEvent, result: Result, failure: FailedEvent) -> FailedEvent:
        self._log_failure(failure)
        # In a storm dropped events would fill the store's memory with images of no interest.
        stored = None if failure.kind == "dropped" else event.stored
        kept = self._store.keep(failure, stored, event.state)
        # With its id, by which a receiver can run it again.
        more = {"id": kept.id, "kind": kept.kind, "dead_letter": kept.dead_letter, "when_ns": kept.when_ns}
        for answer in result.answers:
            if isinstance(answer, EncodedEnvelope) and answer.failure is not None:
                envelope = answer.decode()
                envelope = replace(envelope, attributes={**envelope.attributes, **more})
                self._failures.publish(EncodedEnvelope.encode(envelope, FAILURE_TOPIC))
        self.notify("failure", asdict(kept))
        return kept

    def _log_failure(self, failure: FailedEvent) -> None:
        if failure.kind == "dropped":
            # In a storm a line for each would take longer than the answer.
            self._throttle.warning("dropped", failure.summary)
            return
        failed = _FAILED.get(failure.function, f"failed in {failure.function}")
        text = f"event {failure.event_id or 'without id'} {failed}: {failure.summary}"
        if failure.function == "f_in":
            # A peer can send any number of these, and nothing is computed for them.
            self._throttle.warning("f_in", text)
        else:
            _log.warning("%s", text)


class _Countdown:
    """Calls back once, when so many answers are confirmed or can't be sent: with the first reason."""

    def __init__(self, count: int, confirmed: Confirmed) -> None:
        self._left, self._confirmed = count, confirmed
        self._lock = threading.Lock()
        self._error: Exception | None = None

    def one(self, error: Exception | None) -> None:
        with self._lock:
            self._left -= 1
            self._error = self._error or error
            is_last = self._left == 0
        if is_last:
            self._confirmed(self._error)
