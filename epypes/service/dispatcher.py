"""The home of accepted events: which event the worker gets next, and what happens when it is done or the worker dies.

An event waits in the mailbox, is with the worker, is done and held until the events before it are resolved, or waits
to be tried again. All of that changes under one lock. Nothing is published and no listener is called while the lock is
held: results queue for `publish`, which every caller that has changed anything calls when it has released the lock.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import ServiceError
from epypes.service.result_publisher import (
    Provenance,
    Result,
    ResultPublisher,
    dead_letter_result,
    dropped_result,
    exhausted_result,
    failed_result,
    overflow_reason,
    worker_result,
)

if TYPE_CHECKING:
    from epypes.service.options import Options
    from epypes.service.worker_connection import HangReport, WorkerConnection
    from epypes.transport.channel import Delivery
    from epypes.wire import EncodedEnvelope

# Events that may be done before the eldest is, for each that is worked on at once; more would only fill the memory.
_MAX_AHEAD: Final = 8
# The same of events whose answers a broker has not confirmed.
_MAX_UNCONFIRMED: Final = 256
_COUNTED: Final = ("received", "answered", "failed", "dropped", "retried", "dead_letters")

_log = logging.getLogger("epypes.service")


@dataclass(slots=True, eq=False)
class AcceptedEvent:
    """An event that was accepted, until it is resolved.

    Attributes
    ----------
    seq
        Its place in the order of acceptance, from 1.
    delivery
        Its frames and their header; ack, reject and nack mean nothing over ZeroMQ.
    id
        Id of the event, or of the message that it came in; empty if there is none.
    accepted_ns, started_ns
        When it was accepted, and given to the worker for the last time; of `time.perf_counter_ns`.
    attempts
        How often it was given to a worker.
    deaths
        How often the worker died while this was all that it worked on.
    result
        What is published; None until it is resolved.
    """

    seq: int
    delivery: Delivery
    id: str
    accepted_ns: int
    started_ns: int = 0
    attempts: int = 0
    deaths: int = 0
    result: Result | None = None

    @property
    def stored(self) -> EncodedEnvelope | bytes:
        """What the failure store keeps of it."""
        return self.delivery.envelope or bytes(self.delivery.frames[0])


class Dispatcher:
    """Hands accepted events to the worker, and results to the result publisher.

    Parameters
    ----------
    options
        Of the service: mailbox, threads, retries, broker.
    results
        Publishes results.
    provenance
        Returns what events are computed with; called with the lock held.

    Attributes
    ----------
    lock, changed
        The lock, and the condition on it that is notified when anything changes.
    is_closed
        Whether a broker's events are left with it.
    is_unwatched
        Whether the supervisor must be woken up by the next event.
    answered_in_row
        How many events were answered since a worker last died.
    """

    def __init__(self, options: Options, results: ResultPublisher, provenance: Callable[[], Provenance]) -> None:
        self.lock = threading.RLock()
        self.changed, self._room = threading.Condition(self.lock), threading.Condition(self.lock)
        self.is_closed = self.is_unwatched = False
        self.answered_in_row = 0
        self._policy, self._size, self._slots = options.mailbox_policy, options.capacity, options.threads
        self._retries = options.retries
        # A broker keeps events while there is no room, and confirms their answers: they are in flight until then.
        self._has_broker, self._is_confirmed = options.has_broker, options.is_confirmed
        self._results, self._provenance = results, provenance
        self._connection: WorkerConnection | None = None
        self._holds: set[str] = set()
        self._why_refused, self._waiting_threads = "", 0
        self._last_seq = 0
        self._totals: Counter[str] = Counter()
        self._waiting: deque[AcceptedEvent] = deque()
        # To be tried again: events that did not cause the end of the worker, and suspects, which are tried alone.
        self._again: list[AcceptedEvent] = []
        self._suspects: list[AcceptedEvent] = []
        self._running: dict[int, AcceptedEvent] = {}
        self._is_alone = False
        # Events that were given to a worker at least once, in the order of acceptance, until they are released.
        self._begun: dict[int, AcceptedEvent] = {}
        self._unconfirmed: dict[int, AcceptedEvent] = {}
        self._to_publish: deque[Callable[[], object]] = deque()
        self._publishing, self._publishing_thread = threading.Lock(), 0

    # -- accepting ----------------------------------------------------------------------------------------------------

    def accept(self, delivery: Delivery, block: bool = False, timeout_s: float | None = 0.0) -> None:
        """Accept an event; wait for room only if a broker keeps it meanwhile. Called on the subscriber's thread.

        Raises
        ------
        queue.Full
            There is no room within ``timeout_s``.
        """
        with self.lock:
            if self._has_broker and not (
                self._has_room() or (block and self._room.wait_for(self._has_room, timeout_s))
            ):
                raise queue.Full
            event = self._accepted(delivery)
            if self._why_refused:
                self._drop(event, self._why_refused)
            elif self._is_next_taken():
                # So it needs no room.
                self._waiting.append(event)
            elif len(self._waiting) >= self._size and self._policy == "fault":
                self._drop(event, overflow_reason(self._policy, self._size))
            else:
                while len(self._waiting) >= self._size:
                    self._drop(self._waiting.popleft(), overflow_reason(self._policy, self._size))
                self._waiting.append(event)
            self._assign()
            if self.is_unwatched:
                # Restart the job time-out: the worker is not idle any more.
                self.is_unwatched = False
                self.changed.notify_all()
        if self._to_publish:
            self.publish()

    def accept_exhausted(self, delivery: Delivery) -> None:
        """Make a dead letter of an event that a broker has delivered too often; no worker gets it."""
        with self.lock:
            event = self._accepted(delivery)
            event.attempts = max(delivery.attempt, 1) - 1
            event.result = exhausted_result(event, self._provenance())
            self._count(event, event.result)
            self._to_publish.append(partial(self._results.publish, event, event.result, self._settled))
        self.publish()

    def _accepted(self, delivery: Delivery) -> AcceptedEvent:
        self._last_seq += 1
        self._totals["received"] += 1
        self._totals["redelivered"] += delivery.attempt > 1
        known_as = (delivery.envelope.id if delivery.envelope is not None else "") or delivery.id
        return AcceptedEvent(self._last_seq, delivery, known_as, perf_counter_ns())

    def _drop(self, event: AcceptedEvent, reason: str) -> None:
        """Drop an event, which is published at once and not in the order of acceptance."""
        self._totals["dropped"] += 1
        result = dropped_result(event, reason, self._provenance())
        self._to_publish.append(partial(self._results.publish, event, result, self._settled))

    def _has_room(self) -> bool:
        """Whether an event that comes now is neither dropped nor has another one dropped."""
        if self.is_closed or self._why_refused:
            return False
        return self._is_next_taken() or self._waiting_count() + len(self._unconfirmed) < self._size

    def _is_next_taken(self) -> bool:
        """Whether the worker gets an event that comes now before another one comes."""
        return not self._waiting and not self._again and self._may_begin()

    def _may_begin(self) -> bool:
        if self._connection is None or self._holds or self._suspects or self._is_alone:
            return False
        held = len(self._begun) - len(self._running) - len(self._again)
        is_free = len(self._running) < self._slots and held < _MAX_AHEAD * self._slots
        return is_free and len(self._unconfirmed) < _MAX_UNCONFIRMED

    # -- to the worker ------------------------------------------------------------------------------------------------

    @property
    def connection(self) -> WorkerConnection | None:
        """The worker that gets events; None while there is none."""
        return self._connection

    def use(self, connection: WorkerConnection | None) -> None:
        """Give events to this worker from now on; without one, they wait."""
        with self.lock:
            self._connection = connection
            self._flow()

    def hold(self, reason: str) -> None:
        """Have events wait, for one reason of perhaps several."""
        with self.lock:
            self._holds.add(reason)
            self._flow()

    def release(self, reason: str) -> None:
        """Have events go on, unless there is another reason why they wait."""
        with self.lock:
            self._holds.discard(reason)
            self._flow()

    def is_held(self, reason: str) -> bool:
        """Whether events wait for this reason."""
        return reason in self._holds

    def refuse(self, reason: str) -> None:
        """Answer every event with a failure of this reason from now on; with an empty text, work on events again."""
        with self.lock:
            self._why_refused = reason
        if reason:
            self.give_up(reason)

    def _flow(self) -> None:
        self._assign()
        self.changed.notify_all()

    def _assign(self) -> None:
        """Give the worker what it is free for. With the lock held."""
        connection = self._connection
        while connection is not None and not self._holds and (event := self._next()) is not None:
            self._totals["retried"] += event.attempts > 0
            event.attempts += 1
            event.started_ns = perf_counter_ns()
            self._running[event.seq] = self._begun[event.seq] = event
            try:
                connection.post({"kind": "event", "seq": event.seq}, event.delivery.frames)
            except MemoryError as error:
                self._resolve(event, failed_result(event, error, self._provenance(), "raised"))
        if self._has_broker and self._has_room():
            self._room.notify_all()

    def _next(self) -> AcceptedEvent | None:
        """Return the event that the worker gets next.

        A suspect is taken when nothing else is worked on, and nothing is taken beside it.
        """
        if self._suspects:
            if self._running:
                return None
            self._is_alone = True
            return self._suspects.pop(0)
        if self._again and not self._is_alone and len(self._running) < self._slots:
            return self._again.pop(0)
        if self._waiting and not self._again and self._may_begin():
            return self._waiting.popleft()
        return None

    # -- from the worker ----------------------------------------------------------------------------------------------

    def done(self, connection: WorkerConnection, header: Mapping[str, Any], frames: Sequence[memoryview]) -> None:
        """Take a worker's ``done`` message. An event that timed out meanwhile has been answered already."""
        with self.lock:
            event = self._running.get(header["seq"]) if connection is self._connection else None
        if event is None:
            return
        result = worker_result(event, header, frames, self._locked_provenance)
        with self.lock:
            self._resolve(event, result)
            self.answered_in_row += 1
            self._assign()
            self._wake_idle()
        self.publish()

    def _locked_provenance(self) -> Provenance:
        with self.lock:
            return self._provenance()

    def _resolve(self, event: AcceptedEvent, result: Result) -> None:
        """Note the result of an event that the worker has, and release what is resolved in the order of acceptance."""
        if self._running.pop(event.seq, None) is None:
            return
        self._is_alone = False
        event.result = result
        while self._begun:
            eldest = next(iter(self._begun.values()))
            if eldest.result is None:
                return
            del self._begun[eldest.seq]
            self._count(eldest, eldest.result)
            self._to_publish.append(partial(self._results.publish, eldest, eldest.result, self._settled))

    def _count(self, event: AcceptedEvent, result: Result) -> None:
        """Count an event that is released; one whose answer a broker confirms is in flight until then."""
        if self._is_confirmed:
            self._unconfirmed[event.seq] = event
        else:
            self._totals[result.outcome] += 1

    def worker_died(self, ending: str, died_in: Sequence[str]) -> None:
        """Note that the worker died by itself, or of one of its events; they are tried again, or are dead letters."""
        with self.lock:
            self._connection, self.answered_in_row = None, 0
            running = list(self._running.values())
            if len(running) == 1:
                running[0].deaths += 1
            dead = [event for event in running if event.deaths > self._retries]
            self._put_back([event for event in running if event not in dead], self._suspects)
            for event in dead:
                function = died_in[0] if died_in else ""
                self._resolve(event, dead_letter_result(event, ending, function, self._provenance()))
            self.changed.notify_all()

    def worker_ended(self) -> None:
        """Note that the front itself ended the worker: its events are tried again."""
        with self.lock:
            self._connection = None
            # An event that is tried alone stays a suspect.
            self._put_back(list(self._running.values()), self._suspects if self._is_alone else self._again)
            self.changed.notify_all()

    def _put_back(self, events: list[AcceptedEvent], target: list[AcceptedEvent]) -> None:
        for event in events:
            del self._running[event.seq]
        target += events
        target.sort(key=lambda event: event.seq)
        self._is_alone = self._is_alone and bool(self._running)

    # -- events that take too long ------------------------------------------------------------------------------------

    def overdue(self, timeout_ns: int) -> list[AcceptedEvent]:
        """Return the events that the worker has had for longer than this."""
        with self.lock:
            now_ns = perf_counter_ns()
            return [event for event in self._running.values() if now_ns - event.started_ns >= timeout_ns]

    def due_in_s(self, timeout_ns: int) -> float | None:
        """Return in how many seconds an event will have timed out; None if there is none. With the lock held."""
        starts = [event.started_ns for event in self._running.values()] if self._connection is not None else []
        return max(min(starts) + timeout_ns - perf_counter_ns(), 0) / 1e9 if starts else None

    def stuck(self, report: HangReport, overdue: Sequence[int], timeout_ns: int) -> list[int] | None:
        """Return which overdue events are stuck; None if the worker may go on. With the lock held.

        An event may have waited in the worker for a change of parameters: its time begins when it is begun. If the
        worker works on none of them it is held up by something else, and is ended without blaming an event.
        """
        events = [event for seq in overdue if (event := self._running.get(seq)) is not None]
        now_ns = perf_counter_ns()
        for event in events:
            if event.seq in report.elapsed_ns:
                event.started_ns = now_ns - report.elapsed_ns[event.seq]
            elif report.elapsed_ns:
                event.started_ns = now_ns
        late = [event for event in events if now_ns - event.started_ns >= timeout_ns]
        if not late:
            return None
        is_blamed = not report.has_answered or bool(report.elapsed_ns)
        return [event.seq for event in late if is_blamed or event.attempts > self._retries + 1]

    def fail_stuck(self, stuck: Sequence[int], functions: Mapping[int, str], timeout_s: float) -> None:
        """Answer stuck events with a failure that names the function; the worker gets nothing more. With the lock."""
        provenance = self._provenance()
        for event in [event for seq in stuck if (event := self._running.get(seq)) is not None]:
            function = functions[event.seq]
            where = f"Function {function!r}" if function else "The worker"
            text = f"{where} did not return within {timeout_s:g} s; the worker is replaced."
            error = ServiceError(provenance.bundle, text)
            self._resolve(event, failed_result(event, error, provenance, "stuck", function=function))
        self._connection = None

    def give_up(self, reason: str, functions: Mapping[int, str] | None = None) -> int:
        """Answer all that is not resolved with a failure of this reason; return how many events that were.

        Events of a broker are returned to it instead, and it delivers them again.
        """
        with self.lock:
            if self._has_broker:
                returned = [*self._unconfirmed.values(), *self._begun.values(), *self._waiting]
                for kept in (
                    *(self._waiting, self._again, self._suspects),
                    *(self._running, self._begun, self._unconfirmed),
                ):
                    kept.clear()
                self._is_alone = False
                self._totals["given_back"] += len(returned)
                for event in returned:
                    event.delivery.nack()
                self.changed.notify_all()
                return len(returned)
            waiting = list(self._waiting)
            self._waiting.clear()
            for event in waiting:
                self._drop(event, reason)
            for event in (*self._again, *self._suspects):
                self._running[event.seq] = event
            self._again.clear()
            self._suspects.clear()
            begun = sorted(self._running.values(), key=lambda event: event.seq)
            for event in begun:
                function = (functions or {}).get(event.seq, "")
                where = f" while it is in {function}" if function else ""
                provenance = self._provenance()
                error = ServiceError(provenance.bundle, f"{reason}{where}, so this event was not finished.")
                self._resolve(event, failed_result(event, error, provenance, "killed", function=function))
            self.changed.notify_all()
            return len(waiting) + len(begun)

    # -- publishing ---------------------------------------------------------------------------------------------------

    def publish_later(self, callback: Callable[[], object]) -> None:
        """Have a callback run by the next `publish`, after what was resolved before."""
        self._to_publish.append(callback)

    def publish(self) -> None:
        """Publish results in the order of acceptance, and run what was added by `publish_later`. Without the lock."""
        if self._publishing_thread == threading.get_ident():
            # A listener has changed something, which is published next.
            return
        while self._to_publish:
            with self._publishing:
                self._publishing_thread = threading.get_ident()
                try:
                    while self._to_publish:
                        callback = self._to_publish.popleft()
                        try:
                            callback()
                        except Exception:
                            # What comes after it is published all the same.
                            _log.exception("a result could not be published, or a listener called")
                finally:
                    self._publishing_thread = 0

    def _settled(self, event: AcceptedEvent, result: Result, error: Exception | None) -> None:
        """Note that an answer is confirmed; without that, its broker will deliver the event again."""
        if error is not None:
            if self._has_broker:
                return
            result = self._results.report_lost(event, result, error)
        if not self._is_confirmed:
            return
        if event.seq not in self._unconfirmed:
            # It was given back meanwhile, or dropped.
            return
        if result.failure is not None and result.failure.dead_letter:
            event.delivery.reject(result.failure.summary)
        else:
            event.delivery.ack()
        # Only now: a thread that waits until nothing is in flight may close the connection then.
        with self.lock:
            if self._unconfirmed.pop(event.seq, None) is not None:
                self._totals[result.outcome] += 1
                self._assign()
                self._wake_idle()

    # -- waiting and counting -----------------------------------------------------------------------------------------

    def wait_for(self, predicate: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until something is true; return whether it is."""
        with self.lock:
            self._waiting_threads += 1
            try:
                return self.changed.wait_for(predicate, timeout_s)
            finally:
                self._waiting_threads -= 1

    def _wake_idle(self) -> None:
        # Only if a thread waits for it: otherwise every event would wake up the supervisor.
        if self._waiting_threads and not self._running:
            self.changed.notify_all()

    @property
    def running(self) -> tuple[AcceptedEvent, ...]:
        """The events that the worker has."""
        return tuple(self._running.values())

    @property
    def is_empty(self) -> bool:
        """Whether every event is resolved."""
        return not (self._begun or self._waiting or self._unconfirmed)

    def _waiting_count(self) -> int:
        return len(self._waiting) + len(self._again) + len(self._suspects)

    @property
    def in_flight(self) -> int:
        """How many events the worker has, or has done while an earlier one is not, or whose answer is unconfirmed."""
        return len(self._begun) - len(self._again) - len(self._suspects) + len(self._unconfirmed)

    def counts(self) -> dict[str, int]:
        """Return the counts: received is the sum of all others but ``retried`` and ``redelivered``."""
        with self.lock:
            names = (*_COUNTED, "given_back", "redelivered") if self._has_broker else _COUNTED
            totals = {name: self._totals[name] for name in names}
            return {**totals, "waiting": self._waiting_count(), "in_flight": self.in_flight}
