"""Whose turn is it to work on one connection that several threads use?

A client's connection belongs to one thread at a time. Here that is whichever thread waits for something: it works for
the others too, until it has what it waits for, and then the next one does. So a single thread that sends and waits
needs no other one in between, which would cost two switches of threads a message. When nobody has waited for a while,
a thread that does nothing else takes the turn, until somebody wants it: heartbeats go on, and nothing that comes waits.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from time import monotonic
from typing import Any, Final, Protocol

from epypes.transport.forked import forget_in_child

# For so long nobody has waited when the thread takes over that does nothing else.
_IDLE_S: Final = 0.25
_LONG_S: Final = 60.0


class Loop(Protocol):
    """What a client's connection is driven by.

    Attributes
    ----------
    is_waiting
        Set by a step while it only waits, also if that is ended by what a signal's handler raises: nothing has been
        left half-way then.
    """

    is_waiting: bool

    def step(self, timeout_s: float, aside: AbstractContextManager[object]) -> None:
        """Do what is ready, and wait at most so long until there was something; with 0 see that what is said goes out.

        While it only waits it may step ``aside``: others may use the connection then. What it raises is taken for the
        end of the connection.
        """

    def flush(self) -> None:
        """See that what is said goes out; by another thread, while a step is aside."""

    def wake(self) -> None:
        """Have a step end soon; from any thread."""

    def suits(self) -> bool:
        """Return whether the calling thread may take steps."""

    def close(self) -> None:
        """Take no more steps."""


class _Aside:
    """Leaves the connection to others within a with block."""

    def __init__(self, hands: Any) -> None:
        self._hands = hands

    def __enter__(self) -> None:
        self._hands.release()

    def __exit__(self, *_: object) -> None:
        self._hands.acquire()


def nothing() -> None:
    """Do nothing: for who has only to wait."""


def always() -> bool:
    """Return True: for who waits for nothing."""
    return True


class Turns:
    """One loop, driven by one thread at a time.

    Parameters
    ----------
    loop
        To be driven.
    failed
        Called, by the thread whose turn it is, with what the loop or a piece of work raised.
    name
        Of the thread that drives it while nobody else does.
    """

    def __init__(self, loop: Loop, failed: Callable[[Exception], object], name: str) -> None:
        self._loop, self._failed = loop, failed
        self._make_locks()
        self._work: deque[Callable[[], object]] = deque()
        self._leader: int | None = None
        # What the leader waits for.
        self._is_done: Callable[[], object] = always
        # How often somebody else than the keeper has led, and whether he shall, or shall no more.
        self._taken = 0
        self._is_called = self._is_wanted = self._is_over = False
        # Who does something while the leader waits.
        self._guest: int | None = None
        self._keeper = threading.Thread(target=self._keep, name=name, daemon=True)
        self._keeper.start()
        forget_in_child(self)

    def _make_locks(self) -> None:
        # Taken by itself, not by way of a condition: there a signal may come when it is taken, and nobody knows it yet.
        self._lock = lock = threading.RLock()
        # Two of one lock: whatever changes does not wake the keeper.
        self._changed, self._called = threading.Condition(lock), threading.Condition(lock)
        # Held by who uses the connection.
        self._hands = threading.RLock()
        self._aside = _Aside(self._hands)

    def forget(self) -> None:
        """Do nothing more, in a forked child: the connection is the parent's, and so is whoever leads."""
        self._make_locks()
        self._leader, self._guest, self._is_over = None, None, True

    def run(self, work: Callable[[], object], is_done: Callable[[], object], timeout_s: float) -> bool:
        """Have some work done on the connection, wait until ``is_done``, and return whether it is. From any thread.

        With a time of 0 nobody waits: the work is done here, or by the thread whose turn it is. Nobody waits for
        himself either: a signal's handler, or what the connection calls, may only leave work.
        """
        until_s = monotonic() + timeout_s
        with self._lock:
            if self._is_over:
                return bool(is_done())
            self._work.append(work)
            if self._leader is None:
                self._drive(is_done, until_s)
            is_left = self._leader is not None and not self._is_done_here(timeout_s)
        if is_left:
            # Without the lock, which who is woken takes first.
            self._loop.wake()
        return bool(is_done()) if timeout_s <= 0.0 else self._waited(is_done, until_s)

    def _is_done_here(self, timeout_s: float) -> bool:
        """Do what nobody waits for, if the leader only waits, and return whether it was done; called with the lock.

        Never in the main thread, where a signal's handler may come in the midst of it, and wait, or raise.
        """
        me = threading.get_ident()
        if timeout_s > 0.0 or me in (self._leader, self._guest, threading.main_thread().ident):
            return False
        if not self._loop.suits() or not self._hands.acquire(blocking=False):
            return False
        self._guest = me
        try:
            self._do()
            self._loop.flush()
        except BaseException as error:
            self._broke(error, is_half_way=True)
        finally:
            self._guest = None
            self._hands.release()
        self._changed.notify_all()
        return not self._is_done()

    def _broke(self, error: BaseException, *, is_half_way: bool) -> None:
        """Tell of what was raised; what a signal's handler raises goes on to whoever it hit."""
        if isinstance(error, Exception):
            # Whatever a library raises here must not end the thread of whoever waits.
            self._failed(error)
            return
        if is_half_way:
            self._failed(InterruptedError("a signal came in the midst of a message"))
            self._loop.wake()
        raise error

    def _waited(self, is_done: Callable[[], object], until_s: float) -> bool:
        me = threading.get_ident()
        with self._lock:
            while not (is_done() or self._is_over or me in (self._leader, self._guest) or monotonic() >= until_s):
                if self._leader is None:
                    self._drive(is_done, until_s)
                else:
                    self._wait(until_s)
            return bool(is_done())

    def _drive(self, is_done: Callable[[], object], until_s: float) -> None:
        """Lead, or have the keeper do so; called with the lock."""
        if self._loop.suits():
            self._taken += 1
            self._lead(is_done, until_s)
        else:
            self._is_called = True
            self._called.notify()
            self._changed.wait(max(until_s - monotonic(), 0.0))

    def _wait(self, until_s: float) -> None:
        """Wait for whoever leads; called with the lock. The keeper makes way."""
        if self._leader == self._keeper.ident and not self._is_wanted and self._loop.suits():
            self._is_wanted = True
            self._loop.wake()
        self._changed.wait(max(until_s - monotonic(), 0.0))

    def _lead(self, is_done: Callable[[], object], until_s: float) -> None:
        """Take the turn; called with the lock, and held again afterwards."""
        self._leader, self._is_done = threading.get_ident(), is_done
        try:
            self._lock.release()
            try:
                self._turn(is_done, until_s)
            finally:
                self._lock.acquire()
            while self._work:
                # Who left it relied on us; under the lock nobody can leave more.
                self._step(always, 0.0)
        finally:
            self._leader = None
            if self._is_over:
                self._loop.close()
            self._changed.notify_all()

    def _turn(self, is_done: Callable[[], object], until_s: float) -> None:
        is_well = True
        while is_well and (self._work or not (is_done() or self._is_over or monotonic() >= until_s)):
            is_well = self._step(is_done, until_s)
            with self._lock:
                self._changed.notify_all()

    def _step(self, is_done: Callable[[], object], until_s: float) -> bool:
        """Return whether it went well: a connection that is over must not keep anybody busy."""
        # Nothing has begun.
        self._loop.is_waiting = True
        try:
            self._hands.acquire()
            self._loop.is_waiting = False
            self._do()
            self._loop.step(0.0 if is_done() else max(until_s - monotonic(), 0.0), self._aside)
        except BaseException as error:
            self._broke(error, is_half_way=not self._loop.is_waiting)
            return False
        finally:
            # The first call, since a signal comes after one. It may have come as it wanted them, or wanted them back.
            try:  # noqa: SIM105
                self._hands.release()
            except RuntimeError:
                pass
        return True

    def _do(self) -> None:
        while self._work:
            self._work.popleft()()

    def _keep(self) -> None:
        with self._lock:
            while not self._is_over:
                taken = self._taken
                if not self._is_called:
                    self._called.wait(_IDLE_S)
                is_due = self._is_called or taken == self._taken
                self._is_called = self._is_wanted = False
                if is_due and self._leader is None and not self._is_over:
                    self._lead(lambda: self._is_wanted, monotonic() + _LONG_S)

    def end(self, timeout_s: float) -> None:
        """Close the loop; work that comes later is not done. If a thread works on it that does so when it is done."""
        until_s = monotonic() + timeout_s
        with self._lock:
            if not self._is_over:
                self._is_over = True
                self._called.notify()
                if self._leader is None:
                    self._loop.close()
            while self._leader is not None:
                self._loop.wake()
                if self._leader == threading.get_ident() or monotonic() >= until_s:
                    break
                self._changed.wait(max(until_s - monotonic(), 0.0))
        if self._keeper is not threading.current_thread():
            self._keeper.join(max(until_s - monotonic(), 0.0))
