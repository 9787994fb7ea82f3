"""What has become of an event?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import time_ns
from typing import Any, Final, Literal

from epypes.errors import MailboxOverflow, MessageError, ServiceError
from epypes.run import Failure
from epypes.service.failures.record import FailureRecord
from epypes.service.ledger import Entry, Outcome
from epypes.wire import Envelope, failure_event

FAILURE_TOPIC: Final = "failure"
Kind = Literal["raised", "killed", "stuck", "dropped", "exhausted"]


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
    """Return the id of an event, or that of the message that it came in; empty if it has none."""
    return str(getattr(event, "id", "") or getattr(getattr(event, "received", None), "id", ""))


def answer_id(event: object, number: int) -> str:
    """Return what the answers to an event are known by, so that one that is published twice is told."""
    own = event_id(event)
    return f"{own}/{number}" if own and number > 1 else own


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


def exhausted(entry: Entry, setting: Setting) -> Result:
    """Return the result of an event that a broker has delivered too often: whoever had it before has not answered."""
    text = f"This event was delivered {entry.attempts} times before, and nobody has answered it. It is put aside."
    return failed_without_worker(entry, ServiceError(setting.bundle, text), setting, "exhausted", is_dead=True)


def acknowledge(event: Any, result: Result) -> None:
    """Tell the broker that has delivered an event that it is done with, or to be put aside; nobody, if none has."""
    kind = type(event)
    if not (hasattr(kind, "ack") and hasattr(kind, "reject")):
        return
    if result.failure is not None and result.failure.dead_letter:
        event.reject(result.failure.summary)
    else:
        event.ack()
