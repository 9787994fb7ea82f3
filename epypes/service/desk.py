"""Who is told what has become of an event? Its sender first, then its broker, the failures, the log and listeners."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import MessageError
from epypes.service.failures.record import FailureRecord
from epypes.service.failures.store import FailureStore
from epypes.service.latency import Stopwatch
from epypes.service.ledger import Entry
from epypes.service.outcome import Result, Setting, answer_id, event_id, failed_without_worker
from epypes.transport.throttle import Throttle
from epypes.wire import Envelope

if TYPE_CHECKING:
    from epypes.service.eventlog import EventLog

# What is said of an event that failed outside of its graph.
_FAILED: Final = {"f_in": "could not be read (f_in)", "f_out": "has an answer that could not be given (f_out)"}
# Called with a kind of happening ("state", "run", "failure", "parameters", "deployed") and what there is to know of it.
Listener = Callable[[str, dict[str, Any]], None]
# Called when something has arrived, with None, or can't: with the reason.
Arrived = Callable[[Exception | None], object]

_log = logging.getLogger("epypes.service")


class _All:
    """Calls back once, when so many things have arrived, or could not: with the first reason why."""

    def __init__(self, count: int, then: Arrived) -> None:
        self._left, self._then = count, then
        self._turn = threading.Lock()
        self._error: Exception | None = None

    def one(self, error: Exception | None) -> None:
        with self._turn:
            self._left -= 1
            self._error = self._error or error
            is_last = self._left == 0
        if is_last:
            self._then(self._error)


class Desk:
    """Publishes results, keeps failures and tells listeners.

    Parameters
    ----------
    answer
        Publishes an answer, under an id, and calls back when it has arrived or can't.
    report
        Publishes a failure event on the failures' own socket.
    store
        Where failures are kept.
    event_log
        Where what has become of each event is kept.
    setting
        Returns what events are worked on with.

    Attributes
    ----------
    in_turn
        Called with an event that has a result, and with what publishes that: at once, or when its turn has come.
    """

    def __init__(
        self,
        answer: Callable[[Any, str, Arrived], object],
        report: Callable[[Any], object],
        store: Callable[[], FailureStore],
        event_log: EventLog,
        setting: Callable[[], Setting],
    ) -> None:
        self._answer, self._report, self._store, self._event_log = answer, report, store, event_log
        self._setting = setting
        self.in_turn: Callable[[Entry, Callable[[], object]], object] = lambda entry, publish: publish()
        self._listeners: list[Listener] = []
        self.latency = Stopwatch()
        self._throttle = Throttle(_log)

    def listen(self, callback: Listener) -> Callable[[], None]:
        """Have everything told to a callback; return what ends that."""
        self._listeners.append(callback)

        def forget() -> None:
            if callback in self._listeners:
                self._listeners.remove(callback)

        return forget

    def tell(self, kind: str, data: dict[str, Any]) -> None:
        """Tell listeners; what they raise is logged."""
        for callback in tuple(self._listeners):
            try:
                callback(kind, data)
            except Exception:
                _log.exception("a listener failed")

    def settle(self, entry: Entry, result: Result, then: Callable[[Result, Exception | None], object]) -> None:
        """Publish what has become of an event, and tell of it once that has arrived.

        Parameters
        ----------
        then
            Called when it has arrived, with what was published and None; with a reason if it has not.
        """
        self.in_turn(entry, lambda: self._publish(entry, result, then))

    def _publish(self, entry: Entry, result: Result, then: Callable[[Result, Exception | None], object]) -> None:
        told = partial(self._arrived, entry, result, then)
        if not result.answers:
            told(None)
            return
        all_of_them = _All(len(result.answers), told)
        for number, answer in enumerate(result.answers, 1):
            self._answer(answer, answer_id(entry.event, number), all_of_them.one)

    def _arrived(
        self,
        entry: Entry,
        result: Result,
        then: Callable[[Result, Exception | None], object],
        error: Exception | None,
    ) -> None:
        if isinstance(error, MessageError) and result.failure is None:
            # It can never be sent, so its sender is told that.
            refusal = failed_without_worker(entry, error, self._setting(), "raised", function="f_out")
            self._publish(entry, refusal, then)
            return
        if error is None or isinstance(error, MessageError):
            error = None
            self._tell_of(entry, result)
        then(result, error)

    def lost(self, entry: Entry, result: Result, error: Exception) -> Result:
        """Tell of an event whose answer was lost on its way, which nobody has a copy of; return what became of it."""
        if result.failure is None:
            result = failed_without_worker(entry, error, self._setting(), "raised", function="f_out")
        self._tell_of(entry, result)
        return result

    def _tell_of(self, entry: Entry, result: Result) -> None:
        if result.failure is not None:
            self._event_log.keep(entry, result, self._settle_failure(entry, result, result.failure))
            return
        self._event_log.keep(entry, result, None)
        self.latency.observe(perf_counter_ns() - entry.accepted_ns, result.total_ns, result.durations_ns)
        if self._listeners:
            told = {"seq": entry.seq, "event_id": event_id(entry.event), "revision": result.revision}
            self.tell("run", {**told, "total_ns": result.total_ns})

    def _log(self, failure: FailureRecord) -> None:
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

    def _settle_failure(self, entry: Entry, result: Result, failure: FailureRecord) -> FailureRecord:
        self._log(failure)
        # In a storm dropped events would fill the store's memory with images of no interest.
        kept = self._store().keep(failure, None if failure.kind == "dropped" else entry.event)
        # With its id, so that who hears of it can have it run again.
        more = {"id": kept.id, "kind": kept.kind, "dead_letter": kept.dead_letter, "when_ns": kept.when_ns}
        for answer in result.answers:
            if isinstance(answer, Envelope) and answer.failure is not None:
                self._report(replace(answer, attributes={**answer.attributes, **more}))
        self.tell("failure", asdict(kept))
        return kept
