"""The record of an event that failed in a service, and its id."""

from __future__ import annotations

import re
import secrets
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from time import time_ns
from typing import Any, Final

from epypes.bundle.arrays import StoredArray
from epypes.bundle.settings import decode_value
from epypes.errors import InvalidValue
from epypes.service.supervision.packing import unpack_state

# The topic of the events that publish failures.
FAILURE_TOPIC: Final = "failure"
# Longer texts would make a list of failures slow.
_MAX_CHARACTERS: Final = 2_000
_MAX_LINES: Final = 200

# Crockford's digits: without i, l, o and u, which are read as others or make words.
_DIGITS: Final = "0123456789abcdefghjkmnpqrstvwxyz"
_TIME_DIGITS, _RANDOM_DIGITS = 11, 3
ID: Final = re.compile(f"[{_DIGITS}]{{{_TIME_DIGITS + _RANDOM_DIGITS}}}")


@dataclass(frozen=True, slots=True)
class FailedEvent:
    """What is known of an event that failed in a service; JSON-ready by ``dataclasses.asdict``.

    Attributes
    ----------
    id
        Its own: short, unique, safe as a file's name, and in the order of time.
    event_id
        Id of the event; empty if it has none.
    function
        What failed: a function of the graph, ``"f_in"``, ``"f_out"`` or ``"compute"``; where a worker was killed or
        stuck, the function that was running, if that is known.
    tokens
        Its input and output tokens.
    exception, message
        Name and text of what was raised.
    trace
        The lines of the traceback.
    kind
        ``"raised"``, ``"killed"`` (the worker with it), ``"stuck"`` (it took too long), ``"dropped"``, or
        ``"exhausted"`` (a broker has delivered it as often as it may, and no replica has answered it).
    attempt
        Which try of the event it was, from 1.
    dead_letter
        Whether the event is a dead letter: it killed the worker again.
    when_ns
        Unix time in nanoseconds.
    bundle, digest
        The path of the bundle that was served, and which state of it.
    revision, hyperparameters
        What it was computed with: entries by token, as in pipeline.toml.
    has_event
        Whether the event was kept.
    no_event
        Why it was not.
    state_bytes
        Size of the state that it began with, which was kept with it; 0 for the initial state, and without state.
    """

    id: str = ""
    event_id: str = ""
    function: str = ""
    tokens: Sequence[str] = ()
    exception: str = ""
    message: str = ""
    trace: Sequence[str] = ()
    kind: str = "raised"
    attempt: int = 1
    dead_letter: bool = False
    when_ns: int = 0
    bundle: str = ""
    digest: str = ""
    revision: int = 0
    hyperparameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    has_event: bool = False
    no_event: str = ""
    state_bytes: int = 0

    @property
    def cause(self) -> tuple[str, str, str]:
        """What failures with the same cause have in common."""
        return self.kind, self.function, self.exception

    @property
    def summary(self) -> str:
        """Exception and message in one line of printable characters."""
        return f"{self.exception}: {self.text}" if self.text else self.exception

    @property
    def text(self) -> str:
        """The message in one line of printable characters."""
        line = " ".join(self.message.split())
        return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)


_ids_lock: Final = threading.Lock()
_last_us = 0


def _new_id(when_ns: int) -> str:
    """Return an id that is later than all others of this process, whatever its clock does."""
    global _last_us
    with _ids_lock:
        number = _last_us = max(when_ns // 1_000, _last_us + 1)
    number = (number << 5 * _RANDOM_DIGITS) | secrets.randbits(5 * _RANDOM_DIGITS)
    digits = (_DIGITS[(number >> 5 * place) % 32] for place in reversed(range(_TIME_DIGITS + _RANDOM_DIGITS)))
    return "".join(digits)


def with_id(record: FailedEvent) -> FailedEvent:
    """Return a record with an id and a time, and with long texts cut."""
    when_ns = record.when_ns or time_ns()
    return replace(
        record,
        id=record.id if ID.fullmatch(record.id) else _new_id(when_ns),
        when_ns=when_ns,
        message=record.message[:_MAX_CHARACTERS],
        trace=tuple(line[:_MAX_CHARACTERS] for line in record.trace[-_MAX_LINES:]),
        tokens=tuple(record.tokens),
    )


def read_record(entries: Any) -> FailedEvent:
    """Return the record in an object of JSON; keys that a later version adds are left out.

    Raises
    ------
    ValueError
        An entry has another type than a record's, or there is no id.
    """
    if not isinstance(entries, Mapping):
        raise InvalidValue(f"a record is an object, not {type(entries).__name__}")
    given: dict[str, Any] = {}
    for name, like in _EMPTY.items():
        value = entries.get(name, like)
        if not isinstance(value, (list, tuple) if isinstance(like, tuple) else type(like)):
            raise InvalidValue(f"{name!r} is {value!r:.40}")
        given[name] = tuple(map(str, value)) if isinstance(like, tuple) else value
    record = FailedEvent(**given)
    if not ID.fullmatch(record.id):
        raise InvalidValue(f"{record.id!r:.40} is no id of a failure")
    return record


def values_of(
    record: FailedEvent, known: Collection[str], enums: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], str]:
    """Return the values of a record's hyperparameters, and a note on those that the bundle can't take.

    Parameters
    ----------
    known
        The hyperparameters of the bundle as it is now.
    enums
        Its enumerations by name.
    """
    values, gone = {}, []
    for token, entry in record.hyperparameters.items():
        try:
            value = decode_value(entry, enums)
        except (LookupError, TypeError, ValueError):
            gone.append(token)
            continue
        if isinstance(value, StoredArray):
            continue  # the bundle has it
        if token in known:
            values[token] = value
        else:
            gone.append(token)
    return values, f"{', '.join(map(repr, gone))} can't have the value that failed" if gone else ""


def state_of(block: bytes, known: Collection[str]) -> tuple[dict[str, Any], str]:
    """Return the state between events that an event began with, and a note on what the bundle can't go on with.

    Parameters
    ----------
    block
        As it was packed; empty for the initial state.
    known
        The keys of the state of the bundle as it is now.
    """
    state = unpack_state(block) if block else {}
    gone = [key for key in state if key not in known]
    values = {key: value for key, value in state.items() if key in known}
    return values, f"the state of {', '.join(map(repr, gone))} has no place in the bundle any more" if gone else ""


_EMPTY: Final[Mapping[str, Any]] = {each.name: getattr(FailedEvent(), each.name) for each in fields(FailedEvent)}
