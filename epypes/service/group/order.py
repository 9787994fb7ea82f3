"""How do answers wait for their turn, and who publishes them then?"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from hashlib import sha256
from time import monotonic
from typing import Any, Final

from epypes.service.group.turnstile import FIRST, Stream, Turnstile, Waiting

_log = logging.getLogger("epypes.service")
_STOP_S: Final = 2.0
# Longer than the others need to tell what is done.
_STILL_S: Final = 0.5
_MOST_SOURCE: Final = 256


class Order:
    """A turnstile, and the thread that lets answers through it.

    Parameters
    ----------
    timeout_s
        How long an answer waits at most, in seconds.
    begun
        Called with the numbers of events that others must hear of.
    stands_still
        Called with how many answers wait, each time that none was let through for a while; with 0 when it is over.
    """

    def __init__(
        self,
        timeout_s: float,
        begun: Callable[[Sequence[tuple[Stream, int]]], object],
        stands_still: Callable[[int], object],
    ) -> None:
        self._turnstile = Turnstile(timeout_s)
        self._begun, self._stands_still = begun, stands_still
        self._changed = threading.Condition()
        self._is_over = False
        self._thread = threading.Thread(target=self._run, name="epypes order", daemon=True)

    @property
    def overtaken(self) -> int:
        """How many answers went on though an event before them was not known to be done."""
        return self._turnstile.overtaken

    @property
    def waiting(self) -> int:
        """How many answers wait for their turn."""
        with self._changed:
            return self._turnstile.waiting

    def start(self) -> None:
        """Begin to let answers through."""
        self._thread.start()

    def stop(self) -> None:
        """End; what waits still is not let through, and its event comes again elsewhere."""
        with self._changed:
            self._is_over = True
            self._turnstile.leave()
            self._changed.notify_all()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(_STOP_S)

    def arrived(self, event: Any) -> None:
        """Note that an event has come here."""
        place = place_in_stream(event)
        if place is None:
            return
        with self._changed:
            is_news = self._turnstile.arrived(*place, monotonic())
        if is_news:
            self._begun([place])

    def wait_turn(self, event: Any, publish: Callable[[bool], object]) -> None:
        """Have something called when it is an event's turn, with whether it overtakes others; returns at once.

        An event without a number is nobody's follower: it is called at once.
        """
        place = place_in_stream(event)
        if place is None:
            publish(False)
            return
        with self._changed:
            self._turnstile.enter(*place, publish, monotonic())
            self._changed.notify_all()

    def done(self, numbers: Sequence[tuple[Stream, int, bool]]) -> None:
        """Note that events are done, here or elsewhere."""
        now_s = monotonic()
        with self._changed:
            for stream, number, has_overtaken in numbers:
                self._turnstile.done(stream, number, now_s, has_overtaken=has_overtaken)
            self._changed.notify_all()

    def begun_elsewhere(self, numbers: Sequence[tuple[Stream, int]]) -> None:
        """Note that events of streams that others don't know the beginning of have come elsewhere."""
        now_s = monotonic()
        with self._changed:
            for stream, number in numbers:
                self._turnstile.arrived(stream, number, now_s)
            self._changed.notify_all()

    def told(self, known: Sequence[tuple[Stream, int]]) -> None:
        """Note how far others know streams to be done."""
        now_s = monotonic()
        with self._changed:
            for stream, at in known:
                self._turnstile.told(stream, at, now_s)
            self._changed.notify_all()

    def known(self) -> list[tuple[Stream, int]]:
        """Return how far streams are known to be done here."""
        with self._changed:
            return self._turnstile.known()

    def _run(self) -> None:
        told = 0
        while not self._is_over:
            passing = self._next()
            for each in passing:
                _let_through(each)
            waiting = self.waiting
            if waiting != told and not (passing and waiting):
                told = waiting
                self._stands_still(waiting)

    def _next(self) -> list[Waiting]:
        """Return those whose turn it is; nobody if that is so for a while."""
        until_s = monotonic() + _STILL_S
        with self._changed:
            passing = self._turnstile.passing(monotonic())
            while not (passing or self._is_over or (self._turnstile.waiting and monotonic() >= until_s)):
                self._changed.wait(self._wait_s(until_s))
                passing = self._turnstile.passing(monotonic())
            return [] if self._is_over else passing

    def _wait_s(self, until_s: float) -> float | None:
        due_s = self._turnstile.due_s()
        return None if due_s is None else max(min(due_s, until_s) - monotonic(), 0.0)


def place_in_stream(event: Any) -> tuple[Stream, int] | None:
    """Return the stream of an event and its number there; None if it has none."""
    number = getattr(event, "sequence", 0)
    return ((_named(event.source), event.epoch), number) if number >= FIRST else None


def _named(source: str) -> str:
    """Return what a source is called among replicas, who say it often."""
    data = source.encode(errors="replace")
    return source if len(data) <= _MOST_SOURCE else sha256(data).hexdigest()


def _let_through(waiting: Waiting) -> None:
    try:
        waiting.ticket(waiting.has_overtaken)
    except Exception:
        _log.exception("an answer could not be published when it was its turn")
