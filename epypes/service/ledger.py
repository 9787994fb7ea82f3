"""Where is each accepted event, until it is resolved?

Waiting in the mailbox, with the worker, held until those before it are resolved, or to be tried again. Pure: no
threads, sockets or clocks; times are given.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final, Literal, get_args

from epypes.errors import ServiceError

Policy = Literal["latest", "drop_oldest", "fault"]
POLICIES: Final = get_args(Policy)
Outcome = Literal["answered", "failed", "dead_letters"]
# Events that may be done before the eldest is, for each that is worked on at once; more would only fill the memory.
_AHEAD: Final = 8
# Events whose answers a broker has not confirmed, likewise.
_MOST_UNCONFIRMED: Final = 256


@dataclass(slots=True, eq=False)
class Entry:
    """An event that was accepted.

    Attributes
    ----------
    seq
        Its place in the order of acceptance, from 1.
    event
        What came.
    accepted_ns, started_ns
        When it was accepted, and given to the worker for the last time; on a clock of the caller.
    attempts
        How often it was given to a worker.
    deaths
        How often the worker died while this was all that it worked on.
    outcome, outputs
        What has become of it, and what is to be published; None while it is not resolved.
    """

    seq: int
    event: Any
    accepted_ns: int
    started_ns: int = 0
    attempts: int = 0
    deaths: int = 0
    outcome: Outcome | None = None
    outputs: Any = None


@dataclass(slots=True)
class _Totals:
    received: int = 0
    answered: int = 0
    failed: int = 0
    dropped: int = 0
    dead_letters: int = 0
    retried: int = 0
    given_back: int = 0
    redelivered: int = 0


@dataclass(slots=True)
class Ledger:
    """Every accepted event until it is resolved.

    Parameters
    ----------
    policy, size
        What happens when more than ``size`` events wait: ``"drop_oldest"`` drops the eldest, ``"latest"`` (of size 1)
        too, ``"fault"`` the one that comes.
    slots
        How many events the worker works on at once.
    retries
        How often an event that killed the worker while it was alone is tried again.
    waits
        Whether events come from a broker, who keeps them while there is no room: none comes then.
    is_confirmed
        Whether an event is resolved only when `confirm` says that its answer has arrived: until then it is in flight.

    Raises
    ------
    ServiceError
        The policy or the size can't be.
    """

    policy: Policy = "drop_oldest"
    size: int = 8
    slots: int = 1
    retries: int = 1
    waits: bool = False
    is_confirmed: bool = False
    # Whether a worker takes events: then each that is accepted is to be taken at once, if a slot is free.
    flowing: bool = False
    _last: int = 0
    _totals: _Totals = field(default_factory=_Totals)
    _waiting: deque[Entry] = field(default_factory=deque)
    # To be tried again: innocent ones, which the worker was ended for another's sake, and suspects of its death.
    _again: list[Entry] = field(default_factory=list)
    _suspects: list[Entry] = field(default_factory=list)
    _running: dict[int, Entry] = field(default_factory=dict)
    _alone: bool = False
    # Those that were given to a worker at least once, by their order, until they are released.
    _begun: dict[int, Entry] = field(default_factory=dict)
    _unconfirmed: dict[int, Entry] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.policy not in POLICIES:
            known = ", ".join(map(repr, POLICIES))
            text = f"A service has no mailbox of policy {self.policy!r}, and can't make its peers wait. Take {known}."
            raise ServiceError(self.policy, text)
        if self.size < 1 or (self.policy == "latest" and self.size != 1):
            raise ServiceError(self.size, f"A mailbox with policy {self.policy!r} can't have size {self.size}.")

    def accept(self, event: Any, now_ns: int) -> list[Entry]:
        """Take an event; return those that are dropped, which is told at once and not in the order of acceptance."""
        entry = self._accepted(event, now_ns)
        dropped: list[Entry] = []
        if self._is_taken_at_once():
            # So it needs no room.
            self._waiting.append(entry)
        elif len(self._waiting) >= self.size and self.policy == "fault":
            dropped.append(entry)
        else:
            while len(self._waiting) >= self.size:
                dropped.append(self._waiting.popleft())
            self._waiting.append(entry)
        self._totals.dropped += len(dropped)
        return dropped

    @property
    def has_room(self) -> bool:
        """Whether an event that comes now is neither dropped nor has another one dropped."""
        return self._is_taken_at_once() or self.waiting + len(self._unconfirmed) < self.size

    def _is_taken_at_once(self) -> bool:
        """Whether an event that comes now is taken before another comes."""
        return not self._waiting and self._may_begin() and not self._again

    def _accepted(self, event: Any, now_ns: int) -> Entry:
        self._last += 1
        self._totals.received += 1
        # A broker counts its deliveries.
        self._totals.redelivered += getattr(event, "attempt", 0) > 1
        return Entry(self._last, event, now_ns)

    def accept_resolved(self, event: Any, now_ns: int, attempts: int, outcome: Outcome) -> Entry:
        """Take an event that no worker is to be given, since it is known what becomes of it; it is to be told."""
        entry = self._accepted(event, now_ns)
        entry.attempts, entry.outcome = attempts, outcome
        self._count(entry)
        return entry

    def _may_begin(self) -> bool:
        held = len(self._begun) - len(self._running) - len(self._again) - len(self._suspects)
        is_free = self.flowing and not self._suspects and not self._alone and len(self._running) < self.slots
        return is_free and held < _AHEAD * self.slots and len(self._unconfirmed) < _MOST_UNCONFIRMED

    def take(self, now_ns: int) -> Entry | None:
        """Return the event that the worker is to be given next; None while there is none, or no slot is free.

        A suspect is taken when nothing else is worked on, and nothing is taken beside it.
        """
        entry = self._next()
        if entry is None:
            return None
        self._totals.retried += entry.attempts > 0
        entry.attempts += 1
        entry.started_ns = now_ns
        self._running[entry.seq] = self._begun[entry.seq] = entry
        return entry

    def _next(self) -> Entry | None:
        if self._suspects:
            if self._running or not self.flowing:
                return None
            self._alone = True
            return self._suspects.pop(0)
        if self._again and self.flowing and not self._alone and len(self._running) < self.slots:
            return self._again.pop(0)
        if self._waiting and not self._again and self._may_begin():
            return self._waiting.popleft()
        return None

    def running(self) -> tuple[Entry, ...]:
        """Return the events that the worker has."""
        return tuple(self._running.values())

    def running_at(self, seq: int) -> Entry | None:
        """Return an event that the worker has, None if it has none of this number."""
        return self._running.get(seq)

    def resolve(self, seq: int, outcome: Outcome, outputs: Any = None) -> Entry | None:
        """Note what has become of an event that the worker has; None if it has none of this number."""
        entry = self._running.pop(seq, None)
        if entry is not None:
            self._alone = False
            entry.outcome, entry.outputs = outcome, outputs
        return entry

    def worker_died(self) -> list[Entry]:
        """Note that the worker died of one of its events, or by itself; return those that are not tried any more.

        Their outcome is for the caller to resolve: they count as events that the worker has until then.
        """
        running = list(self._running.values())
        if len(running) == 1:
            running[0].deaths += 1
        dead = [entry for entry in running if entry.deaths > self.retries]
        self._put_back([entry for entry in running if entry not in dead], self._suspects)
        return dead

    def worker_ended(self) -> None:
        """Note that the worker was ended for a reason that its events have no part in: they are tried again."""
        # One that is tried alone stays a suspect.
        self._put_back(list(self._running.values()), self._suspects if self._alone else self._again)

    def _put_back(self, entries: list[Entry], to: list[Entry]) -> None:
        for entry in entries:
            del self._running[entry.seq]
        to += entries
        to.sort(key=lambda entry: entry.seq)
        self._alone = self._alone and bool(self._running)

    def give_up(self) -> tuple[list[Entry], list[Entry]]:
        """Stop to try: return the events that waited, which count as dropped, and those that were begun.

        The caller resolves those that were begun: they count as events that the worker has until then.
        """
        waiting = list(self._waiting)
        self._waiting.clear()
        self._totals.dropped += len(waiting)
        for entry in (*self._again, *self._suspects):
            self._running[entry.seq] = entry
        self._again.clear()
        self._suspects.clear()
        return waiting, sorted(self._running.values(), key=lambda entry: entry.seq)

    def give_back(self) -> list[Entry]:
        """Forget every event that is not resolved, and return them: somebody else is to be given them."""
        entries = [*self._unconfirmed.values(), *self._begun.values(), *self._waiting]
        for kept in (self._waiting, self._again, self._suspects, self._running, self._begun, self._unconfirmed):
            kept.clear()
        self._alone = False
        self._totals.given_back += len(entries)
        return entries

    def release(self) -> Iterator[Entry]:
        """Give what is resolved, in the order of acceptance; it is counted, or is so when it is confirmed."""
        while self._begun:
            entry = self._eldest()
            if entry is None or entry.outcome is None:
                return
            del self._begun[entry.seq]
            self._count(entry)
            yield entry

    def _count(self, entry: Entry) -> None:
        if self.is_confirmed:
            self._unconfirmed[entry.seq] = entry
        elif entry.outcome is not None:
            setattr(self._totals, entry.outcome, getattr(self._totals, entry.outcome) + 1)

    def is_waited_for(self, seq: int) -> bool:
        """Return whether the answer to an event is on its way."""
        return seq in self._unconfirmed

    def confirm(self, seq: int, outcome: Outcome) -> bool:
        """Note that the answer to an event has arrived; return whether it was waited for."""
        entry = self._unconfirmed.pop(seq, None)
        if entry is not None:
            setattr(self._totals, outcome, getattr(self._totals, outcome) + 1)
        return entry is not None

    def _eldest(self) -> Entry | None:
        # Begun in order of acceptance; tried again they keep their place.
        return next(iter(self._begun.values()), None)

    @property
    def is_empty(self) -> bool:
        """Whether every event is resolved."""
        return not (self._begun or self._waiting or self._unconfirmed)

    @property
    def waiting(self) -> int:
        """How many events wait to be given to the worker, those that are tried again too."""
        return len(self._waiting) + len(self._again) + len(self._suspects)

    @property
    def in_flight(self) -> int:
        """How many events the worker has, or has done while one before them is not, or their answer is on its way."""
        return len(self._begun) - len(self._again) - len(self._suspects) + len(self._unconfirmed)

    def counts(self) -> dict[str, int]:
        """Return the counts: received is the sum of all others but ``retried`` and ``redelivered``."""
        totals = self._totals
        of_broker = {"given_back": totals.given_back, "redelivered": totals.redelivered} if self.waits else {}
        return {
            "received": totals.received,
            "answered": totals.answered,
            "failed": totals.failed,
            "dropped": totals.dropped,
            "retried": totals.retried,
            "dead_letters": totals.dead_letters,
            "waiting": self.waiting,
            "in_flight": self.in_flight,
            **of_broker,
        }
