"""Which event goes to the worker next, and what happens when it is done, or the worker is gone?

The one place where accepted events change hands, under one lock. Nothing is sent, published or told while it is held:
messages go into the link's outbox, and what is resolved waits for `publish`, which whoever has changed anything calls
when it has given the lock back.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from time import perf_counter_ns
from typing import Any

from epypes.errors import EpypesError, ServiceError
from epypes.service.desk import Desk
from epypes.service.ledger import Entry, Ledger
from epypes.service.link import Link
from epypes.service.outcome import (
    Result,
    Setting,
    acknowledge,
    dead_letter,
    dropped,
    exhausted,
    failed_without_worker,
    refused,
    reported,
)
from epypes.service.stuck import Where
from epypes.wire import Envelope, decode, encode

_log = logging.getLogger("epypes.service")


class Dispatcher:
    """Hands accepted events to the worker, and results to the desk.

    Parameters
    ----------
    ledger
        The events.
    desk
        Who publishes.
    setting
        Returns what events are worked on with; called with the lock held.

    Attributes
    ----------
    changed
        The lock, and whom to wake up when anything changes.
    is_closed
        Whether a broker's events are left with it.
    on_accepted, on_done
        Called with each event that comes, and with each entry whose end has arrived and what acknowledges it, to be
        called once; at once, and without the lock.
    is_unwatched
        Whether the supervisor wants to be woken up by the next event.
    answered_in_row
        How many events were answered since a worker last died.
    """

    def __init__(self, ledger: Ledger, desk: Desk, setting: Callable[[], Setting]) -> None:
        lock = threading.RLock()
        self.changed, self._room = threading.Condition(lock), threading.Condition(lock)
        self.ledger, self.answered_in_row = ledger, 0
        self._desk, self._setting = desk, setting
        self._link: Link | None = None
        self._holds: set[str] = set()
        self.is_unwatched, self._waiting = False, 0
        self._why_refused, self.is_closed = "", False
        self.on_accepted: Callable[[Any], object] = lambda event: None
        self.on_done: Callable[[Entry, Callable[[], object]], object] = lambda entry, then: then()
        self._to_tell: deque[Callable[[], object]] = deque()
        self._publishing, self._publisher = threading.Lock(), 0

    # -- as the subscriber's queue --------------------------------------------------------------------------------

    def put(self, item: Any, *, block: bool = False, timeout: float | None = 0.0) -> None:
        """Accept an event; waits for room only if its broker keeps it meanwhile. Called on the subscriber's thread.

        Raises
        ------
        queue.Full
            There is no room within ``timeout`` seconds.
        """
        with self.changed:
            if self.ledger.waits and not self._room.wait_for(self._has_room, timeout if block else 0.0):
                raise queue.Full
            for entry in self.ledger.accept(item, perf_counter_ns()):
                self._tell_at_once(entry, dropped(entry, self.ledger.policy, self.ledger.size, self._setting()))
            if self._why_refused:
                self._refuse_waiting(self._why_refused)
            self._assign()
            if self.is_unwatched:
                # Who watches over events that take too long has one to watch now, for as long as one may take.
                self.is_unwatched = False
                self.changed.notify_all()
        self.on_accepted(item)
        if self._to_tell:
            self.publish()

    def _has_room(self) -> bool:
        return not (self.is_closed or self._why_refused) and self.ledger.has_room

    def exhausted(self, item: Any) -> None:
        """Put an event aside that was delivered too often: no worker is given it."""
        with self.changed:
            entry = self.ledger.accept_resolved(item, perf_counter_ns(), item.attempt - 1, "dead_letters")
            self._tell_at_once(entry, exhausted(entry, self._setting()))
        self.publish()

    def _tell_at_once(self, entry: Entry, result: Result) -> None:
        self.tell(lambda: self._settle(entry, result))

    def tell(self, telling: Callable[[], object]) -> None:
        """Have something told by the next `publish`, after what was resolved before."""
        self._to_tell += self._released()
        self._to_tell.append(telling)

    def _refuse_waiting(self, why: str) -> None:
        waiting, _ = self.ledger.give_up()
        for entry in waiting:
            self._tell_at_once(entry, refused(entry, why, self._setting()))

    # -- to the worker --------------------------------------------------------------------------------------------

    @property
    def link(self) -> Link | None:
        """The worker that gets events; None while there is none."""
        return self._link

    def use(self, link: Link | None) -> None:
        """Give events to this worker from now on; to none, they wait."""
        with self.changed:
            self._link = link
            self._flow()

    def hold(self, why: str) -> None:
        """Have events wait, for one reason of perhaps several."""
        with self.changed:
            self._holds.add(why)
            self._flow()

    def let_go(self, why: str) -> None:
        """Have events go on, unless there is another reason why they wait."""
        with self.changed:
            self._holds.discard(why)
            self._flow()

    def is_held(self, why: str) -> bool:
        """Whether events wait for this reason."""
        return why in self._holds

    def refuse(self, why: str) -> None:
        """Answer every event with a failure that says why it is not worked on; with an empty text, no more."""
        with self.changed:
            self._why_refused = why
        if why:
            self.give_up(why)

    def _flow(self) -> None:
        self.ledger.flowing = self._link is not None and not self._holds
        self._assign()
        self.changed.notify_all()

    def _assign(self) -> None:
        while self._link is not None and (entry := self.ledger.take(perf_counter_ns())) is not None:
            try:
                is_raw = not isinstance(entry.event, Envelope)
                frames: Sequence[Any] = [entry.event] if is_raw else encode(entry.event)
                self._link.post({"kind": "event", "seq": entry.seq, "raw": is_raw}, frames)
            except (EpypesError, MemoryError) as error:
                self._resolve(entry, failed_without_worker(entry, error, self._setting(), "raised", function="f_in"))
        if self.ledger.waits and self.ledger.has_room:
            self._room.notify_all()

    # -- from the worker ------------------------------------------------------------------------------------------

    def done(self, link: Link, header: Mapping[str, Any], frames: Sequence[memoryview]) -> None:
        """Take a worker's word that it is done with an event."""
        with self.changed:
            entry = self.ledger.running_at(header["seq"]) if link is self._link else None
            setting = self._setting()
        if entry is None:
            # Its time was over, and it has been answered.
            return
        result = _result(entry, header, frames, setting)
        with self.changed:
            self._resolve(entry, result)
            self.answered_in_row += 1
            self._assign()
            self._tell_waiting()
        self.publish()

    def _resolve(self, entry: Entry, result: Result) -> None:
        self.ledger.resolve(entry.seq, result.outcome, result)

    def worker_died(self, ending: str, died_in: Sequence[str]) -> None:
        """Note that the worker died by itself, or of one of its events; they are tried again or put aside."""
        with self.changed:
            self._link = None
            self.ledger.flowing = False
            self.answered_in_row = 0
            for entry in self.ledger.worker_died():
                function = died_in[0] if died_in else ""
                self._resolve(entry, dead_letter(entry, ending, function, self._setting()))
            self.changed.notify_all()

    def worker_ended(self) -> None:
        """Note that the worker was ended by the front: what it had is tried again."""
        with self.changed:
            self._link = None
            self.ledger.flowing = False
            self.ledger.worker_ended()
            self.changed.notify_all()

    # -- what takes too long --------------------------------------------------------------------------------------

    def overdue(self, timeout_ns: int) -> list[Entry]:
        """Return the events that the worker has had for longer than this."""
        with self.changed:
            now_ns = perf_counter_ns()
            return [entry for entry in self.ledger.running() if now_ns - entry.started_ns >= timeout_ns]

    def due_in_s(self, timeout_ns: int) -> float | None:
        """Return in how many seconds an event will have taken so long; None if there is none. With the lock held."""
        starts = [entry.started_ns for entry in self.ledger.running()] if self._link is not None else []
        return max(min(starts) + timeout_ns - perf_counter_ns(), 0) / 1e9 if starts else None

    def still_stuck(self, where: Where, overdue: Sequence[int], timeout_ns: int) -> list[int] | None:
        """Return which of some events must be reported as stuck; None if the worker may go on. With the lock held.

        An event may have waited in the worker for a change of parameters: its time begins when it is begun. If the
        worker works on none of them it is held up by something else, and ended without blaming an event for it.
        """
        entries = [entry for seq in overdue if (entry := self.ledger.running_at(seq)) is not None]
        now_ns, waiting = perf_counter_ns(), where.waiting(overdue)
        for entry in entries:
            if entry.seq in waiting:
                entry.started_ns = now_ns
            elif entry.seq in where.elapsed_ns:
                entry.started_ns = now_ns - where.elapsed_ns[entry.seq]
        late = [entry for entry in entries if now_ns - entry.started_ns >= timeout_ns]
        if not late:
            return None
        is_blamed = not where.has_answered or bool(where.elapsed_ns)
        return [entry.seq for entry in late if is_blamed or entry.attempts > self.ledger.retries + 1]

    def fail_stuck(self, stuck: Sequence[int], functions: Mapping[int, str], timeout_s: float) -> None:
        """Report events as stuck, by the function of each; the worker gets nothing more. With the lock held."""
        setting = self._setting()
        for entry in [entry for seq in stuck if (entry := self.ledger.running_at(seq)) is not None]:
            function = functions[entry.seq]
            where = f"Function {function!r}" if function else "The worker"
            text = f"{where} did not return within {timeout_s:g} s; the worker is replaced."
            error = ServiceError(setting.bundle, text)
            self._resolve(entry, failed_without_worker(entry, error, setting, "stuck", function=function))
        self._link = None
        self.ledger.flowing = False

    def give_up(self, why: str, functions: Mapping[int, str] | None = None) -> int:
        """Answer everything that is not resolved with a failure that says why; return how many events that were.

        What came from a broker is given back instead, which delivers it again.
        """
        with self.changed:
            if self.ledger.waits:
                given_back = self.ledger.give_back()
                for entry in given_back:
                    entry.event.give_back()
                self.changed.notify_all()
                return len(given_back)
            waiting, begun = self.ledger.give_up()
            for entry in waiting:
                self._tell_at_once(entry, refused(entry, why, self._setting()))
            for entry in begun:
                function = (functions or {}).get(entry.seq, "")
                where = f" while it is in {function}" if function else ""
                error = ServiceError(self._setting().bundle, f"{why}{where}, so this event was not finished.")
                self._resolve(entry, failed_without_worker(entry, error, self._setting(), "killed", function=function))
            self.changed.notify_all()
        return len(waiting) + len(begun)

    # -- what is resolved -----------------------------------------------------------------------------------------

    def publish(self) -> None:
        """Publish what is resolved, in the order of acceptance, and tell what is to be told. Without the lock."""
        if self._publisher == threading.get_ident():
            # Somebody who is told changes something again: that is told next.
            return
        while True:
            with self._publishing:
                self._publisher = threading.get_ident()
                try:
                    found = self._found()
                    for telling in found:
                        try:
                            telling()
                        except Exception:
                            # What comes after it is told all the same.
                            _log.exception("something could not be published, or told")
                finally:
                    self._publisher = 0
            if not found:
                return

    def _found(self) -> list[Callable[[], object]]:
        with self.changed:
            found = [*self._to_tell, *self._released()]
            self._to_tell.clear()
            if found:
                # Room for others to be done ahead, and the end of a drain.
                self._assign()
                self._tell_waiting()
            return found

    def _released(self) -> list[Callable[[], object]]:
        return [partial(self._settle, entry, entry.outputs) for entry in self.ledger.release()]

    def _settle(self, entry: Entry, result: Result) -> None:
        self._desk.settle(entry, result, partial(self._arrived, entry))

    def _arrived(self, entry: Entry, result: Result, error: Exception | None) -> None:
        """Note that the answer to an event has arrived, or could not: then its broker will deliver the event again."""
        if error is not None:
            if self.ledger.waits:
                return
            result = self._desk.lost(entry, result, error)
        if self.ledger.is_confirmed and not self.ledger.is_waited_for(entry.seq):
            # It was given back meanwhile.
            return
        self.on_done(entry, partial(self._acknowledge, entry, result))

    def _acknowledge(self, entry: Entry, result: Result) -> None:
        acknowledge(entry.event, result)
        if self.ledger.is_confirmed:
            # Only now: whoever waits until nothing is in flight may end the connection then.
            with self.changed:
                if self.ledger.confirm(entry.seq, result.outcome):
                    self._assign()
                    self._tell_waiting()

    def wait_for(self, is_so: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until something is so; return whether it is."""
        with self.changed:
            self._waiting += 1
            try:
                return self.changed.wait_for(is_so, timeout_s)
            finally:
                self._waiting -= 1

    def _tell_waiting(self) -> None:
        # Only if somebody waits: the supervisor, which waits too, would be woken up by every event.
        if self._waiting and not self.ledger.running():
            self.changed.notify_all()


def _result(entry: Entry, header: Mapping[str, Any], frames: Sequence[memoryview], setting: Setting) -> Result:
    """Return what a worker has made of an event."""
    answers: list[Envelope | bytes] = []
    begin = 0
    for answer in header.get("answers", ()):
        end = begin + answer["frames"]
        own, begin = frames[begin:end], end
        answers.append(bytes(own[0]) if answer["raw"] else decode(own))
    failure = header.get("failure")
    record = reported(entry, failure, setting, "raised") if failure else None
    return Result(answers, record, header.get("revision", 0), header.get("total_ns", 0), header.get("durations_ns", {}))
