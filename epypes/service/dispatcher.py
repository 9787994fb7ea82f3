"""The home of accepted events: which event the worker gets next, and what happens when it is done or the worker dies.

An event waits in the mailbox, is with the worker, waits to be tried again, or is done and held until the events before
it are resolved. All of that changes under one lock. Nothing is published and no listener is called while the lock is
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
from epypes.service.event_states import Delays, EventStates
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
    from epypes.service.supervision.frame_socket import WorkerMessage
    from epypes.service.supervision.worker_connection import HangReport, WorkerConnection
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
    is_suspect
        Whether a worker died while it had this event: then it is tried alone.
    result
        What is published; None until it is resolved.
    state
        The encoded state between events that it began with; empty for the initial one, and for a bundle without.
    """

    seq: int
    delivery: Delivery
    id: str
    accepted_ns: int
    started_ns: int = 0
    attempts: int = 0
    deaths: int = 0
    is_suspect: bool = False
    result: Result | None = None
    state: bytes = b""

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
    answered_in_row
        How many events were answered since a worker last ended.
    """

    def __init__(self, options: Options, results: ResultPublisher, provenance: Callable[[], Provenance]) -> None:
        self.lock = threading.RLock()
        self.changed, self._room = threading.Condition(self.lock), threading.Condition(self.lock)
        self.is_closed = self._is_idle = False
        self.answered_in_row = 0
        self._policy, self._size, self._slots = options.mailbox_policy, options.capacity, options.threads
        self._max_deaths = options.retries
        # A broker keeps events while there is no room.
        self._has_broker = options.has_broker
        self._results, self._provenance = results, provenance
        results.on_settled = self._settled
        self._connection: WorkerConnection | None = None
        self._holds: set[str] = set()
        self._why_refused, self._waiting_threads = "", 0
        self._last_seq = 0
        self._totals: Counter[str] = Counter()
        self._waiting: deque[AcceptedEvent] = deque()
        # Events to be tried again, suspects first.
        self._retry: list[AcceptedEvent] = []
        self._running: dict[int, AcceptedEvent] = {}
        # Events that were given to a worker at least once, in the order of acceptance, until they are released.
        self._begun: dict[int, AcceptedEvent] = {}
        self._unconfirmed: dict[int, AcceptedEvent] = {}
        # None for a bundle without state between events.
        self._states: EventStates | None = None
        self._state_per = options.state_per
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
            else:
                self._waiting.append(event)
                self._assign()
                while len(self._waiting) > self._size:
                    surplus = self._waiting.pop() if self._policy == "fault" else self._waiting.popleft()
                    self._drop(surplus, overflow_reason(self._policy, self._size))
            if self._is_idle:
                # Restart the job time-out: the worker is not idle any more.
                self._is_idle = False
                self.changed.notify_all()
        if self._to_publish:
            self.publish()

    def accept_exhausted(self, delivery: Delivery) -> None:
        """Make a dead letter of an event that a broker has delivered too often; no worker gets it."""
        with self.lock:
            event = self._accepted(delivery)
            event.attempts = max(delivery.attempt, 1) - 1
            event.result = exhausted_result(event, self._provenance())
            self._release(event, event.result)
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
        event.result = dropped_result(event, reason, self._provenance())
        self._to_publish.append(partial(self._results.publish, event, event.result))

    def _has_room(self) -> bool:
        """Whether an event that comes now is neither dropped nor has another one dropped."""
        is_open = not (self.is_closed or self._why_refused)
        return is_open and self._waiting_count() + len(self._unconfirmed) < self._size

    # -- to the worker ------------------------------------------------------------------------------------------------

    @property
    def connection(self) -> WorkerConnection | None:
        """The worker that gets events; None while there is none."""
        return self._connection

    def use(self, connection: WorkerConnection | None) -> None:
        """Give events to this worker from now on; without one, they wait."""
        with self.lock:
            self._connection = connection
            if connection is not None:
                delays = connection.about.get("delays")
                if not delays:
                    self._states = None
                elif self._states is None or self._states.delays != delays:
                    self._states = EventStates(delays, self._state_per)
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
        while connection is not None and (self._waiting or self._retry) and (event := self._next()) is not None:
            self._totals["retried"] += event.attempts > 0
            event.attempts += 1
            event.started_ns = perf_counter_ns()
            self._running[event.seq] = self._begun[event.seq] = event
            try:
                if self._states is None:
                    connection.post_event(event.seq, event.delivery.frames)
                else:
                    self._states.post(event, connection, self._running.values())
            except MemoryError as error:
                self._resolve(event, failed_result(event, error, self._provenance(), "raised"))
        if self._has_broker and self._has_room():
            self._room.notify_all()

    def _next(self) -> AcceptedEvent | None:
        """Return the event that the worker gets next; None if it is not free, or events wait.

        A suspect is taken when nothing else is worked on, and nothing is taken beside it.
        """
        running = self._running
        if self._holds or len(running) >= self._slots or any(event.is_suspect for event in running.values()):
            return None
        if self._retry:
            return None if self._retry[0].is_suspect and running else self._retry.pop(0)
        is_ahead = len(self._begun) - len(running) >= _MAX_AHEAD * self._slots
        if not self._waiting or is_ahead or len(self._unconfirmed) >= _MAX_UNCONFIRMED:
            return None
        if self._states is None:
            return self._waiting.popleft()
        return self._states.take_next(self._waiting, running.values())

    # -- state between events -----------------------------------------------------------------------------------------

    @property
    def delays(self) -> Delays:
        """Of the bundle whose states are kept; empty for one without."""
        return {} if self._states is None else self._states.delays

    def describe_states(self) -> dict[str, Any] | None:
        """Return what there is of state between events, JSON-ready; None without any."""
        with self.lock:
            return None if self._states is None else self._states.describe()

    def reset_state(self, source: str | None = None) -> int:
        """Have the next event of each series, or of one source's, begin with the initial state; return how many.

        Raises
        ------
        UnknownName
            There is no state of this source.
        ServiceError
            All sources have one state.
        """
        with self.lock:
            return 0 if self._states is None else self._states.reset(source)

    # -- from the worker ----------------------------------------------------------------------------------------------

    def done(self, connection: WorkerConnection, message: WorkerMessage) -> None:
        """Take a worker's ``done`` message. An event that timed out meanwhile has been answered already."""
        with self.lock:
            event = self._running.get(message.number) if connection is self._connection else None
            if event is None:
                return
            if self._states is not None:
                self._states.note(event, message, self._running.values())
            self._resolve(event, worker_result(event, message, self._provenance))
            self.answered_in_row += 1
            self._assign()
            self._wake_waiting()
        self.publish()

    def _resolve(self, event: AcceptedEvent, result: Result) -> None:
        """Note the result of an event that the worker has, and release what is resolved in the order of acceptance."""
        if self._running.pop(event.seq, None) is None:
            return
        event.result = result
        while self._begun:
            eldest = next(iter(self._begun.values()))
            if eldest.result is None:
                return
            del self._begun[eldest.seq]
            self._release(eldest, eldest.result)

    def _release(self, event: AcceptedEvent, result: Result) -> None:
        """Have a result published; the event is in flight until its answer is confirmed."""
        self._unconfirmed[event.seq] = event
        self._to_publish.append(partial(self._results.publish, event, result))

    def worker_died(self, ending: str, died_in: Sequence[str]) -> None:
        """Note that the worker died by itself, or of one of its events; they are tried again, or are dead letters."""
        with self.lock:
            self._connection, self.answered_in_row = None, 0
            running = list(self._running.values())
            if len(running) == 1:
                running[0].deaths += 1
            for event in running:
                event.is_suspect = True
                if event.deaths > self._max_deaths:
                    function = died_in[0] if died_in else ""
                    self._resolve(event, dead_letter_result(event, ending, function, self._provenance()))
            self._put_back()

    def worker_ended(self) -> None:
        """Note that the front itself ended the worker: its events are tried again."""
        with self.lock:
            self._connection, self.answered_in_row = None, 0
            self._put_back()

    def _put_back(self) -> None:
        """Have events of a worker that is gone tried again."""
        self._retry += self._running.values()
        self._retry.sort(key=lambda event: (not event.is_suspect, event.seq))
        self._running.clear()
        self.changed.notify_all()

    # -- events that take too long ------------------------------------------------------------------------------------

    def overdue(self, timeout_s: float) -> list[AcceptedEvent]:
        """Return the events that the worker has had for longer than this."""
        with self.lock:
            now_ns = perf_counter_ns()
            return [event for event in self._running.values() if now_ns - event.started_ns >= timeout_s * 1e9]

    def due_in_s(self, timeout_s: float) -> float | None:
        """Return in how many seconds an event will have timed out; None if there is none. With the lock held.

        The supervisor, which waits for so long, is woken up by the next event if there is none.
        """
        starts = [event.started_ns for event in self._running.values()] if self._connection is not None else []
        self._is_idle = not starts
        return max(min(starts) / 1e9 + timeout_s - perf_counter_ns() / 1e9, 0.0) if starts else None

    def fail_stuck(self, report: HangReport, overdue: Sequence[int], timeout_s: float) -> str | None:
        """Answer overdue events that are stuck with a failure that names the function; the worker gets nothing more.

        An event may have waited in the worker for a change of parameters: its time begins when it is begun. If the
        worker works on none of them it is held up by something else, and is ended without blaming an event. With the
        lock held.

        Returns
        -------
        str or None
            The function that did not return, empty if that can't be known; None if the worker may go on.
        """
        events = [event for seq in overdue if (event := self._running.get(seq)) is not None]
        now_ns = perf_counter_ns()
        for event in events:
            if event.seq in report.elapsed_ns:
                event.started_ns = now_ns - report.elapsed_ns[event.seq]
            elif report.elapsed_ns:
                event.started_ns = now_ns
        late = [event for event in events if now_ns - event.started_ns >= timeout_s * 1e9]
        if not late:
            return None
        is_blamed, provenance, named = not report.has_answered or bool(report.elapsed_ns), self._provenance(), ""
        for event in late:
            if is_blamed or event.attempts > self._max_deaths + 1:
                function = report.functions[event.seq]
                where = f"Function {function!r}" if function else "The worker"
                text = f"{where} did not return within {timeout_s:g} s; the worker is replaced."
                error = ServiceError(provenance.bundle, text)
                self._resolve(event, failed_result(event, error, provenance, "stuck", function=function))
                named = named or function
        self._connection = None
        return named

    def give_up(self, reason: str, functions: Mapping[int, str] | None = None) -> int:
        """Answer all that is not resolved with a failure of this reason; return how many events that were.

        Events of a broker are returned to it instead, and it delivers them again.
        """
        with self.lock:
            if self._has_broker:
                returned = [*self._unconfirmed.values(), *self._begun.values(), *self._waiting]
                for kept in (self._waiting, self._retry, self._running, self._begun, self._unconfirmed):
                    kept.clear()
                self._totals["given_back"] += len(returned)
                for event in returned:
                    event.delivery.nack()
                self.changed.notify_all()
                return len(returned)
            waiting = list(self._waiting)
            self._waiting.clear()
            for event in waiting:
                self._drop(event, reason)
            self._running |= {event.seq: event for event in self._retry}
            self._retry.clear()
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
        """Count an event whose answer is confirmed; without that, the broker that keeps the event delivers it again."""
        is_returned = error is not None and self._has_broker
        if error is not None and not is_returned:
            result = self._results.report_lost(event, result, error)
        if event.seq not in self._unconfirmed:
            # It was given back meanwhile, or dropped.
            return
        if is_returned:
            event.delivery.nack()
        elif result.failure is not None and result.failure.dead_letter:
            event.delivery.reject(result.failure.summary)
        else:
            event.delivery.ack()
        # Only now: a thread that waits until nothing is in flight may close the connection then.
        with self.lock:
            if self._unconfirmed.pop(event.seq, None) is not None:
                self._totals["given_back" if is_returned else result.outcome] += 1
                self._assign()
                self._wake_waiting()

    # -- waiting and counting -----------------------------------------------------------------------------------------

    def wait_for(self, predicate: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until something is true; return whether it is."""
        with self.lock:
            self._waiting_threads += 1
            try:
                return self.changed.wait_for(predicate, timeout_s)
            finally:
                self._waiting_threads -= 1

    def _wake_waiting(self) -> None:
        # Only if a thread is in `wait_for`: otherwise every event would wake up the supervisor.
        if self._waiting_threads:
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
        return len(self._waiting) + len(self._retry)

    @property
    def in_flight(self) -> int:
        """How many events the worker has, or has done while an earlier one is not, or whose answer is unconfirmed."""
        return len(self._begun) - len(self._retry) + len(self._unconfirmed)

    def counts(self) -> dict[str, int]:
        """Return the counts: received is the sum of all others but ``retried`` and ``redelivered``."""
        with self.lock:
            names = (*_COUNTED, "given_back", "redelivered") if self._has_broker else _COUNTED
            totals = {name: self._totals[name] for name in names}
            return {**totals, "waiting": self._waiting_count(), "in_flight": self.in_flight}
