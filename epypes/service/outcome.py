"""What has become of an event, and who is told?"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from time import perf_counter_ns, time_ns
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.errors import MailboxOverflow, MessageError, ServiceError
from epypes.run import Failure
from epypes.service.failures.record import FailureRecord
from epypes.service.failures.store import FailureStore
from epypes.service.latency import Stopwatch
from epypes.service.ledger import Entry, Outcome
from epypes.wire import Envelope
from epypes.wire.failures import failure_event

if TYPE_CHECKING:
    from epypes.service.eventlog import EventLog

FAILURE_TOPIC: Final = "failure"
_LOG_PAUSE_NS: Final = 5_000_000_000
Kind = Literal["raised", "killed", "stuck", "dropped"]
# Called with a kind of happening ("state", "run", "failure", "parameters", "deployed") and what there is to know of it.
Listener = Callable[[str, dict[str, Any]], None]

_log = logging.getLogger("epypes.service")


@dataclass(frozen=True, slots=True)
class Setting:
    """What an event was worked on with: the bundle and its parameters."""

    name: str
    bundle: str
    digest: str
    revision: int
    entries: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Result:
    """What is published of an event, and what is told of it.

    Attributes
    ----------
    answers
        Envelopes, or bytes for peers of 2019.
    failure
        None, or what is known of its failure.
    revision, total_ns
        Of the run; 0 where there was none.
    durations_ns
        By function.
    """

    answers: Sequence[Envelope | bytes]
    failure: FailureRecord | None = None
    revision: int = 0
    total_ns: int = 0
    durations_ns: Mapping[str, int] = field(default_factory=dict)

    @property
    def outcome(self) -> Outcome:
        """What has become of the event."""
        if self.failure is None:
            return "answered"
        return "dead_letters" if self.failure.dead_letter else "failed"


def event_id(event: object) -> str:
    """Return the id of an event; empty if it has none."""
    return str(getattr(event, "id", ""))


def reported(entry: Entry, told: Mapping[str, Any], setting: Setting, kind: Kind) -> FailureRecord:
    """Return the record of a failure.

    Parameters
    ----------
    told
        function, tokens, exception, message and trace, as far as they are known.
    """
    known = {name: told[name] for name in ("function", "tokens", "exception", "message", "trace") if name in told}
    return FailureRecord(
        event_id=event_id(entry.event),
        kind=told.get("kind") or kind,
        attempt=entry.attempts,
        when_ns=time_ns(),
        bundle=setting.bundle,
        digest=setting.digest,
        revision=setting.revision,
        hyperparameters=setting.entries,
        **known,
    )


def failed_without_worker(
    entry: Entry, error: Exception, setting: Setting, kind: Kind, *, function: str = "", is_dead: bool = False
) -> Result:
    """Return the result of an event that no worker has told of: the front answers it."""
    function = function or ("mailbox" if kind == "dropped" else "worker")
    told = {"function": function, "exception": type(error).__name__, "message": str(error)}
    record = replace(reported(entry, told, setting, kind), dead_letter=is_dead)
    failure = Failure(function, (), {}, error, record.event_id, max(entry.attempts, 1))
    answer = replace(failure_event(failure, setting.name, setting.digest), revision=setting.revision)
    return Result([answer], record, setting.revision)


def dropped(entry: Entry, policy: str, size: int, setting: Setting) -> Result:
    """Return the result of an event that found no room in the mailbox, or had to make room there."""
    why = "it has more events than it can answer"
    if policy == "fault":
        why = str(MailboxOverflow(size)).partition(".")[0].replace("The", "the", 1)
    return refused(entry, why, setting)


def refused(entry: Entry, why: str, setting: Setting) -> Result:
    """Return the result of an event that is not worked on."""
    error = MessageError("dropped", f"The service dropped this event: {why}. Send it again later.")
    return failed_without_worker(entry, error, setting, "dropped")


def dead_letter(entry: Entry, ending: str, function: str, setting: Setting) -> Result:
    """Return the result of an event that killed the worker again and again."""
    again = f", and so it was {entry.deaths} times" if entry.deaths > 1 else ""
    error = ServiceError(
        setting.bundle, f"{ending} while this event was all that it worked on{again}. It is put aside."
    )
    return failed_without_worker(entry, error, setting, "killed", function=function, is_dead=True)


class Desk:
    """Publishes results, keeps failures and tells listeners.

    Parameters
    ----------
    answer, report
        Publish an answer, and a failure event on the failures' own socket.
    store
        Where failures are kept.
    event_log
        Where what has become of each event is kept.
    """

    def __init__(
        self,
        answer: Callable[[Any], object],
        report: Callable[[Any], object],
        store: Callable[[], FailureStore],
        event_log: EventLog,
    ) -> None:
        self._answer, self._report, self._store, self._event_log = answer, report, store, event_log
        self._listeners: list[Listener] = []
        self.latency = Stopwatch()
        self._logged_ns, self._unlogged = -_LOG_PAUSE_NS, 0

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

    def settle(self, entry: Entry, result: Result) -> None:
        """Publish what has become of an event, and tell of it."""
        for answer in result.answers:
            self._answer(answer)
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
            self._unlogged += 1
            now_ns = perf_counter_ns()
            if now_ns - self._logged_ns < _LOG_PAUSE_NS:
                return
            _log.warning("%s; %d events since this was said last", failure.summary, self._unlogged)
            self._logged_ns, self._unlogged = now_ns, 0
            return
        _log.warning("event %s failed in %s: %s", failure.event_id or "without id", failure.function, failure.summary)

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
