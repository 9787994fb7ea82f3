"""Whose turn is it to work on one connection that several threads use?

Pika's connection belongs to one thread at a time. Here that is whichever thread waits for something: it works for the
others too, until it has what it waits for, and then the next one does. So a single thread that sends and waits needs
no other one in between, which would cost two switches of threads a message.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from time import monotonic

from pika.adapters.select_connection import IOLoop


def nothing() -> None:
    """Do nothing: what wakes a loop up."""


def always() -> bool:
    """Return True: for who waits for nothing."""
    return True


class Turns:
    """One loop, driven by one thread at a time.

    Parameters
    ----------
    failed
        Called, by the thread whose turn it is, with what the loop or a piece of work raised.
    """

    def __init__(self, failed: Callable[[Exception], object]) -> None:
        self.loop = IOLoop()
        self.loop.activate_poller()
        self._failed = failed
        self._changed = threading.Condition()
        self._work: deque[Callable[[], object]] = deque()
        self._is_taken = self._is_over = False

    def run(self, work: Callable[[], object], is_done: Callable[[], object], timeout_s: float) -> bool:
        """Have some work done on the connection, wait until ``is_done``, and return whether it is. From any thread.

        With a time of 0 nobody waits: the work is done here, or by the thread whose turn it is.
        """
        until_s = monotonic() + timeout_s
        with self._changed:
            if self._is_over:
                return bool(is_done())
            self._work.append(work)
            if not self._is_taken:
                self._lead(is_done, until_s)
            else:
                self.loop.add_callback_threadsafe(nothing)
            while not (is_done() or self._is_over or monotonic() >= until_s):
                if self._is_taken:
                    self._changed.wait(max(until_s - monotonic(), 0.0))
                else:
                    self._lead(is_done, until_s)
            return bool(is_done())

    def _lead(self, is_done: Callable[[], object], until_s: float) -> None:
        """Take the turn; called with the lock, and held again afterwards."""
        self._is_taken = True
        try:
            self._changed.release()
            try:
                self._turn(is_done, until_s)
            finally:
                self._changed.acquire()
            while self._work:
                # Who left it relied on us; under the lock nobody can leave more.
                self._turn(always, 0.0, is_locked=True)
        finally:
            self._is_taken = False
            self._changed.notify_all()

    def _turn(self, is_done: Callable[[], object], until_s: float, *, is_locked: bool = False) -> None:
        alarm = self.loop.call_later(max(until_s - monotonic(), 0.0), nothing)
        try:
            while True:
                self._step(is_done)
                if not is_locked:
                    with self._changed:
                        self._changed.notify_all()
                if not self._work and (is_done() or monotonic() >= until_s):
                    return
        finally:
            self.loop.remove_timeout(alarm)

    def _step(self, is_done: Callable[[], object]) -> None:
        try:
            while self._work:
                self._work.popleft()()
            if is_done():
                # What was written has to go out, but there is nothing to wait for.
                self.loop.call_later(0.0, nothing)
            self.loop.poll()
            self.loop.process_timeouts()
        except Exception as error:  # whatever a library raises here must not end the thread of whoever waits
            self._failed(error)

    def end(self, timeout_s: float) -> None:
        """Close the loop, once no thread works on it; work that comes later is not done."""
        until_s = monotonic() + timeout_s
        with self._changed:
            while self._is_taken and monotonic() < until_s:
                self.loop.add_callback_threadsafe(nothing)
                self._changed.wait(max(until_s - monotonic(), 0.0))
            if not self._is_taken and not self._is_over:
                self._is_over = True
                self.loop.close()
